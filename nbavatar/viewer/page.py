"""The page in the browser: controls, camera, and the picture behind them.

The picture is the background image of viser's canvas: the browser's own camera moves at once, and the picture follows
as fast as it can be drawn (`nbavatar.viewer.worker`). Every browser tab has its own controls and camera.
"""

import contextlib
import dataclasses
import io
import threading
import time
from typing import Any

import numpy as np

from nbavatar.errors import DataError, NBAvatarError, require
from nbavatar.viewer.eye import Eye, free_eye, pose_of, view_angle
from nbavatar.viewer.pictures import SHOWS, Drawn, Request, draw
from nbavatar.viewer.scene import EXACT, Scene
from nbavatar.viewer.worker import RenderWorker, Work

__all__ = ["Viewer"]

_FREE = "free"
_NOTHING = "nothing"
_MOVED = 1e-2  # a camera of the capture is left when the browser's turns [rad] or moves [radii] by more than this
_ARRIVAL_S = 3.0  # how long the browser may take to get to a camera of the capture
_LONG_S = 2.0  # a picture that takes longer is told about while it is drawn


class Viewer:
    """A running viewer.

    Args:
        scene: what to look at.
        host: address to listen on; 127.0.0.1 is this machine only.
        port: of the address; the next free one is taken where it is in use.
        side: longer side of a whole picture at the start [px].
        title: of the page.
    """

    def __init__(self, scene: Scene, *, host: str, port: int, side: int, title: str) -> None:
        viser = require("viser", "viser", "nbavatar view")
        self.scene, self.side, self.title = scene, side, title
        self._tabs: dict[int, _Tab] = {}
        self._worker = RenderWorker(self._show, self._failed)
        self._worker.start()
        with contextlib.redirect_stdout(io.StringIO()):  # its banner; the caller prints the address
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        if self.server.get_host() != host:
            raise DataError.of("--host", expected=f"to listen on {host}", found=self.server.get_host())
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self.server.scene.set_up_direction(tuple(map(float, scene.up)))
        self._first_view()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)

    @property
    def address(self) -> str:
        """What to type into a browser."""
        host = self.server.get_host()
        return f"http://{'127.0.0.1' if host in ('0.0.0.0', '::') else host}:{self.server.get_port()}"

    def stop(self) -> None:
        """Ends the server and the thread that draws."""
        for tab in list(self._tabs.values()):
            tab.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        self._worker.stop()

    def _first_view(self) -> None:
        """The view that a tab opens with."""
        first, view = self.server.initial_camera, self.scene.first_view()
        first.position, first.look_at, first.up = view.position, view.look_at, self.scene.up
        first.fov, first.near = view.fov, 0.01

    def _connected(self, client: Any) -> None:
        self._tabs[client.client_id] = _Tab(self, client)

    def _left(self, client: Any) -> None:
        self._worker.forget(client.client_id)
        tab = self._tabs.pop(client.client_id, None)
        if tab is not None:
            tab.close()

    def submit(self, client: int, request: Request, side: int) -> None:
        """Has a picture drawn for a tab."""
        self._worker.submit(client, request, side)

    def _show(self, work: Work) -> None:
        tab = self._tabs.get(work.client)
        if tab is None:
            return
        long = threading.Timer(_LONG_S, tab.say, ["drawing: the first picture of a kind compiles its kernels, once"])
        long.start()
        began = time.perf_counter()
        try:
            drawn = draw(self.scene, work.request, work.side)
        finally:
            long.cancel()
        spent = time.perf_counter() - began
        tab.show(drawn, work.request.frame, spent, work.whole)

    def _failed(self, client: int, error: Exception) -> None:
        tab = self._tabs.get(client)
        if tab is not None:
            tab.say(f"**error** {error if isinstance(error, NBAvatarError) else f'{type(error).__name__}: {error}'}")
        if not isinstance(error, NBAvatarError):
            import traceback

            traceback.print_exception(error)


@dataclasses.dataclass
class _Held:
    """A camera of the capture that was chosen: its place [m] and direction, whether the browser's has got there."""

    position: np.ndarray
    forward: np.ndarray
    until: float
    reached: bool = False


class _Tab:
    """One browser tab: its controls, and what was last asked for."""

    def __init__(self, viewer: Viewer, client: Any) -> None:
        self._viewer, self._client = viewer, client
        self._closed = threading.Event()
        self._held: _Held | None = None
        self._asking = threading.RLock()
        self._build()
        client.camera.on_update(lambda _: self._looked())
        threading.Thread(target=self._play, name="play", daemon=True).start()
        self._ask()

    def _build(self) -> None:
        gui, scene = self._client.gui, self._viewer.scene
        names, frames = list(scene.entries), scene.frames
        self._status = gui.add_markdown("drawing")
        last = max(1, len(frames) - 1)
        self._frame = gui.add_slider("Frame", min=0, max=last, step=1, initial_value=0, disabled=len(frames) < 2)
        self._playing = gui.add_checkbox("Play", initial_value=False, disabled=len(frames) < 2)
        self._fps = gui.add_slider("Frames a second", min=1, max=30, step=1, initial_value=12)
        self._camera = gui.add_dropdown("Camera", [_FREE, *scene.packs], initial_value=_FREE)
        shows = SHOWS if scene.packs else SHOWS[:-1]
        self._what = gui.add_dropdown("Show", shows, initial_value=SHOWS[0])
        self._first = gui.add_dropdown("Avatar", names, initial_value=names[0], disabled=len(names) < 2)
        self._second = gui.add_dropdown("Compare with", [_NOTHING, *names], initial_value=_NOTHING)
        self._wipe = gui.add_slider("Wipe", min=0.0, max=1.0, step=0.01, initial_value=0.5)
        presets = list(dict.fromkeys(name for entry in scene.entries.values() for name in entry.presets))
        self._preset = gui.add_dropdown("Preset", [EXACT, *presets], initial_value=EXACT, disabled=not presets)
        self._background = gui.add_rgb("Background", initial_value=(255, 255, 255))
        self._side = gui.add_slider(
            "Resolution", min=64, max=1024, step=32, initial_value=self._viewer.side, hint="longer side at rest [px]"
        )
        self._again = gui.add_button("First view")
        for control in (self._frame, self._what, self._first, self._second, self._wipe, self._preset, self._background):
            control.on_update(lambda _: self._ask())
        self._side.on_update(lambda _: self._ask())
        self._camera.on_update(lambda _: self._chosen())
        self._again.on_click(lambda _: self._return())

    def close(self) -> None:
        self._closed.set()

    def say(self, text: str) -> None:
        """Text above the controls."""
        self._status.content = text

    def show(self, drawn: Drawn, frame: str, spent: float, whole: bool) -> None:
        """Puts a picture of a frame on the canvas, and how it was made above the controls."""
        if self._closed.is_set():
            return
        self._client.scene.set_background_image(drawn.image, format="jpeg", jpeg_quality=90 if whole else 70)
        state = "" if whole else " while moving"
        rate = 1.0 / max(spent, 1e-6)
        width, height = drawn.size
        line = f"**{width} x {height} px**{state}, **{1000 * spent:.0f} ms**, {rate:.1f} pictures a second"
        decoder = [f"decoded by {' and '.join(drawn.decoders)}"] if drawn.decoders else []
        self.say("  \n".join([line, *decoder, f"frame {frame}", *drawn.remarks]))

    def _row(self) -> int:
        return min(int(self._frame.value), len(self._viewer.scene.frames) - 1)

    def _eye(self) -> Eye | None:
        """Where this tab looks from; None before the browser has said so."""
        camera, scene = self._client.camera, self._viewer.scene
        try:
            width, height = max(1, camera.image_width), max(1, camera.image_height)
            free = free_eye(camera.wxyz, camera.position, camera.fov, width, height)
        except AssertionError:  # viser's way to say that nothing is known yet
            return None
        name = self._camera.value
        if name == _FREE:
            return free
        K, pose, own_width, own_height = scene.camera(name, scene.frames[self._row()])
        return Eye(K, pose, own_width, own_height, free.aspect, name)

    def _ask(self) -> None:
        """Asks for the picture of what the controls say now.

        viser calls from several threads: reading the controls and asking are one, or an older state could come last.
        """
        with self._asking:
            eye = self._eye()
            if eye is None or self._closed.is_set():
                return
            second = self._second.value
            request = Request(
                eye,
                self._viewer.scene.frames[self._row()],
                self._first.value,
                "" if second == _NOTHING else second,
                float(self._wipe.value),
                self._what.value,
                self._preset.value,
                tuple(value / 255.0 for value in self._background.value),  # type: ignore[arg-type]
            )
            self._viewer.submit(self._client.client_id, request, int(self._side.value))

    def _looked(self) -> None:
        """The browser's camera has moved: a chosen camera of the capture is left, unless it is only arrived at."""
        held = self._held
        if held is not None:
            camera = self._client.camera
            position, forward, _ = pose_of(free_eye(camera.wxyz, camera.position, 1.0, 1, 1).cam_from_world)
            near = np.linalg.norm(position - held.position) < _MOVED * self._viewer.scene.radius
            if near and float(forward @ held.forward) > 1 - _MOVED**2:
                held.reached = True
            elif held.reached or time.monotonic() > held.until:
                self._held = None
                self._camera.value = _FREE  # which asks for the picture
                return
        self._ask()

    def _chosen(self) -> None:
        """A camera was chosen: the browser's goes there."""
        name = self._camera.value
        if name == _FREE:
            self._held = None
        else:
            scene, camera = self._viewer.scene, self._client.camera
            K, pose, width, height = scene.camera(name, scene.frames[self._row()])
            position, forward, up = pose_of(pose)
            distance = max(float((scene.centre - position) @ forward), 0.1)
            self._held = _Held(position, forward, time.monotonic() + _ARRIVAL_S)
            with self._client.atomic():
                camera.up_direction = up
                camera.position = position
                camera.look_at = position + distance * forward
                camera.fov = view_angle(K, width, height, camera.aspect)
        self._ask()

    def _return(self) -> None:
        """Back to the view that the page opened with."""
        first, camera = self._viewer.server.initial_camera, self._client.camera
        self._held = None
        self._camera.value = _FREE
        with self._client.atomic():
            camera.up_direction = self._viewer.scene.up
            camera.position, camera.look_at, camera.fov = first.position, first.look_at, first.fov
        self._ask()

    def _play(self) -> None:
        """Moves the frame slider on, as long as the box is ticked and the tab is there."""
        while not self._closed.wait(1.0 / max(1, int(self._fps.value))):
            if self._playing.value:
                self._frame.value = (self._row() + 1) % len(self._viewer.scene.frames)
