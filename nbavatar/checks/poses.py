"""Do a capture's meshes project onto its masks, and if they do not: how else could its cameras be meant?

The misfit of a camera is judged pixel by pixel, over a few frames: the share of the meshes' pixels that do not lie on
their own part of the mask. What users' cameras go wrong by is then tried out (camera to world, other axes, units, a
position in place of t, calibrations of two cameras exchanged, mirrored or turned pictures, frames counted from
another one), and said if it explains the misfit.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from nbavatar.camera.distortion import distort_vertices
from nbavatar.camera.pinhole import Camera
from nbavatar.data.sequences import PARTS
from nbavatar.errors import DataError
from nbavatar.io.framepack import parts_in, unseen_in
from nbavatar.mesh.zbuffer import joined_meshes, rasterize_mesh

__all__ = ["PoseJudge", "sampled_frames"]

_SIDE = 160  # longer side of the small masks that are compared [px]
_FRAMES = 4  # a camera; an error of calibration is the same in all
_WORST = 0.5  # misfit that no tracker has; hair, glasses and jitter stay below 0.2
_SUSPICIOUS = 0.03  # below this a camera is right; neighbours that are exchanged have more
_STRANGE = 0.05  # where other readings of R and t are tried
_LEAST_KEPT = 0.9  # of what the meshes cover
_TRIED = 6  # cameras, the worst: a reading is true of all
_LEAST_GAIN = 0.03
_GOOD = 0.15  # misfit that an explanation leaves at most
_OUT_OF_STEP = 0.015  # what another frame's mesh gains at least, where it is the right one
_ELSEWHERE = 0.8  # misfit of one part in all cameras, when its mesh is somewhere else
_LEAST_SEEN = 50  # pixels by which a part is judged on its own
_FLIPS = {
    "are mirrored: flip them left to right": (slice(None), slice(None, None, -1)),
    "are mirrored: flip them upside down": (slice(None, None, -1), slice(None)),
    "are turned by 180 degrees: turn them": (slice(None, None, -1), slice(None, None, -1)),
}
_LEAST_COVERED = 0.1  # share of a mask that meshes cover at least; a person's body has no mesh, so it can be little


@dataclasses.dataclass(frozen=True)
class _View:
    """One frame in one camera: what is compared."""

    frame: str
    mask: np.ndarray
    labelled: bool


@dataclasses.dataclass(frozen=True)
class _Fit:
    """Share of the meshes' pixels off their part, share of the mask that meshes cover, intersection over union."""

    misfit: float
    covered: float
    overlap: float


@dataclasses.dataclass(frozen=True)
class _Reading:
    """One way to misunderstand the cameras: how to mend it, and what it makes of a pose and a camera matrix."""

    text: str
    pose: np.ndarray | None = None
    inverse: bool = False
    position: bool = False
    transposed: bool = False
    scale: float = 1.0
    world: np.ndarray | None = None
    zoom: float = 1.0

    def apply(self, cam_from_world: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pose and the camera matrix that this reading means."""
        R, t = cam_from_world[:3, :3], self.scale * cam_from_world[:3, 3]
        if self.inverse:
            R, t = R.T, -R.T @ t
        elif self.position:
            t = -R @ t
        elif self.transposed:
            R = R.T
        meant = np.eye(4)
        meant[:3, :3], meant[:3, 3] = R, t
        if self.pose is not None:
            meant = self.pose @ meant
        if self.world is not None:
            meant = meant @ self.world
        return meant, np.diag([self.zoom, self.zoom, 1.0]) @ K


def _readings() -> Iterator[_Reading]:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    gl = "their axes are OpenGL's, y up and z backward (y and z look flipped): negate the last two rows of R and t"
    poses = {
        "": {},
        "R, t are camera to world: store R transposed, and -R transposed times t": {"inverse": True},
        gl: {"pose": flip},
        f"R, t are camera to world, and {gl}, after inverting them": {"inverse": True, "pose": flip},
        "t is the camera's position: store -R t": {"position": True},
        f"t is the camera's position (store -R t), and {gl}": {"position": True, "pose": flip},
        "R is camera to world: store R transposed": {"transposed": True},
    }
    units = {
        "": 1.0,
        "t is in millimetres and the meshes in metres: divide t by 1000": 1e-3,
        "t is in centimetres and the meshes in metres: divide t by 100": 1e-2,
        "the meshes are in millimetres and t in metres: divide vertices by 1000": 1e3,
        "the meshes are in centimetres and t in metres: divide vertices by 100": 1e2,
    }
    for pose, change in poses.items():
        for unit, scale in units.items():
            if pose or unit:
                yield _Reading("; and ".join(filter(None, (pose, unit))), scale=scale, **change)
    for angle, text in ((1, "(x, -z, y)"), (-1, "(x, z, -y)"), (2, "(x, -y, -z)")):
        c, s = (0.0, float(angle)) if abs(angle) == 1 else (-1.0, 0.0)
        turn = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])
        yield _Reading(f"the meshes' world has other axes than the cameras': store vertices as {text}", world=turn)
    for zoom in (0.25, 0.5, 2.0, 4.0):
        yield _Reading(f"K belongs to images of another size: multiply its first two rows by {zoom:g}", zoom=zoom)


def sampled_frames(frames: list[str]) -> list[str]:
    """Frames by which a camera is judged."""
    return [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, _FRAMES).round().astype(int))]


class PoseJudge:
    """Collects masks of some frames and compares them with the projected meshes.

    Args:
        cameras: by name.
        topology: part -> faces int64 `[F, 3]` and whatever else; the faces are used.
        meshes: frame -> part -> vertices `[V, 3]` [m, world].
    """

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        topology: Mapping[str, tuple[np.ndarray, np.ndarray | None]],
        meshes: Mapping[str, Mapping[str, np.ndarray]],
    ) -> None:
        self._cameras, self._topology, self._meshes = cameras, topology, meshes
        self._views: dict[str, list[_View]] = {}
        self._known: dict[str, _Fit] = {}
        self._parts: dict[str, list[tuple[float, float]]] = {}

    @property
    def moving(self) -> bool:
        """Whether the meshes are not the same in all frames."""
        first = next(iter(self._meshes.values()), {})
        return any(
            part in first and not np.array_equal(verts, first[part])
            for mesh in self._meshes.values()
            for part, verts in mesh.items()
        )

    def add(self, camera: str, frame: str, mask: np.ndarray, *, labelled: bool) -> None:
        """Takes one mask, `[H, W]` of the camera's size: labels 0..3 and 255 (which says nothing), or above 0 wherever
        the person is.
        """
        step = self._step(self._cameras[camera])
        small = np.ascontiguousarray(mask[step // 2 :: step, step // 2 :: step])
        if frame in self._meshes and parts_in(small).any():
            self._views.setdefault(camera, []).append(_View(frame, small, labelled))
            self._known.clear()

    def misfits(self) -> dict[str, float]:
        """Camera -> misfit from 0 to 1, mean over its frames; cameras without a mask are left out."""
        return {name: fit.misfit for name, fit in self._fits().items()}

    def overlaps(self) -> dict[str, float]:
        """Camera -> intersection over union of meshes and masks, mean over its frames."""
        return {name: fit.overlap for name, fit in self._fits().items()}

    def defects(self, path: object) -> list[str]:
        """One line for each thing that is wrong; none if meshes and masks agree.

        Args:
            path: `cameras.json`, for the lines.
        """
        now = self._fits()
        root = Path(str(path)).parent
        if max((fit.misfit for fit in now.values()), default=0.0) < _SUSPICIOUS:  # no camera is wrong, frames may be
            other = self._out_of_step(now, root)
            return [] if other is None else [str(other)]
        expected = "meshes that project onto the masks"
        exchanged, before, after = self._exchange(now)
        strange = {name: fit for name, fit in now.items() if fit.misfit >= _STRANGE}
        reading, meant = self._best_reading(strange) if strange else (None, 1.0)
        if exchanged and (reading is None or after <= meant + _LEAST_GAIN):
            found = f"{1 - before:.0%} of their pixels there, and {1 - after:.0%} if {_words(exchanged)}"
            fix = "give each camera its own calibration, or images"
            return [str(DataError.of(path, "K, R, t", expected=expected, found=found, fix=fix))]
        if reading is not None:
            found = f"{1 - _mean(strange.values()).misfit:.0%} of their pixels there in {', '.join(strange)}"
            fix = f"{1 - meant:.0%} would lie there if {reading.text}"
            return [str(DataError.of(path, "R, t", expected=expected, found=found, fix=fix))]
        other = self._other_pictures(strange, root) or self._out_of_step(now, root)
        if other is not None:
            return [str(other)]
        fix = "R, t must map world to camera (OpenCV axes), lengths be metres, names of frames belong together"
        return [
            str(
                DataError.of(
                    f"{path}: camera {name}",
                    expected=expected,
                    found=f"{1 - fit.misfit:.0%} of their pixels there",
                    fix=fix,
                )
            )
            for name, fit in now.items()
            if fit.misfit > _WORST
        ] or self._lost_parts(root)

    def _other_pictures(self, strange: Iterable[str], root: Path) -> DataError | None:
        """Cameras whose pictures are mirrored or turned, if that is what is wrong with them."""
        for text, flip in _FLIPS.items():
            found, fits = [], []
            for name in strange:
                views = [dataclasses.replace(view, mask=view.mask[flip]) for view in self._views[name]]
                after = _mean(self._compare(view, self._cameras[name]) for view in views)
                if _explains(self._fits()[name], after):
                    found.append(name)
                    fits.append(after)
            if found:
                share = 1 - _mean(self._fits()[name] for name in found).misfit
                return DataError.of(
                    root / "masks" / found[0], expected="masks on which the meshes project",
                    found=f"{share:.0%} of their pixels there in {', '.join(found)}",
                    fix=f"{1 - _mean(fits).misfit:.0%} would lie there if images and masks {text}",
                )  # fmt: skip
        return None

    def _out_of_step(self, now: Mapping[str, _Fit], root: Path) -> DataError | None:
        """Cameras whose masks have the meshes of other frames, counted in another way, if any."""
        order = list(self._meshes)
        place, last = {frame: i for i, frame in enumerate(order)}, len(order) - 1
        for words, turn, step in (
            ("next frame", 1, 1),
            ("frame before", 1, -1),
            ("frame as far from the end", -1, last),
        ):
            meant = {frame: order[turn * i + step] for frame, i in place.items() if 0 <= turn * i + step <= last}
            found, pairs = [], []
            for name in now:
                views = [view for view in self._views[name] if meant.get(view.frame, view.frame) != view.frame]
                if len(views) < 2:
                    continue
                others = [dataclasses.replace(view, frame=meant[view.frame]) for view in views]
                before, after = (_mean(self._compare(v, self._cameras[name]) for v in some) for some in (views, others))
                if after.misfit <= 0.5 * before.misfit and before.misfit - after.misfit >= _OUT_OF_STEP:
                    found.append(name)
                    pairs.append((before, after))
            if found:
                before, after = (_mean(fits) for fits in zip(*pairs))
                return DataError.of(
                    root / "masks" / found[0], expected="masks and meshes of the same moment",
                    found=f"{1 - before.misfit:.0%} of the meshes' pixels on the masks of {', '.join(found)}",
                    fix=f"{1 - after.misfit:.0%} would lie there with meshes of the {words}; number both alike",
                )  # fmt: skip
        return None

    def _lost_parts(self, root: Path) -> list[str]:
        """One line for each part that lies elsewhere than its label in all cameras, though the others do not."""
        lines = []
        for part, pairs in self._parts.items():
            met, weight = np.sum(pairs, axis=0)
            if weight >= _LEAST_SEEN and met < (1 - _ELSEWHERE) * weight:
                label, share = PARTS.index(part) + 1, met / weight
                error = DataError.of(
                    root / "meshes", part, expected=f"vertices that project onto label {label} of the masks",
                    found=f"{share:.0%} of their pixels there",
                    fix="are they in the world of the cameras, and of the frame that the file is named after?",
                )  # fmt: skip
                lines.append(str(error))
        return lines

    def _fits(self) -> dict[str, _Fit]:
        if not self._known:
            self._parts.clear()
            for name, views in self._views.items():
                found = [self._measure(view, self._cameras[name]) for view in views]
                self._known[name] = _mean(fit for fit, _ in found)
                for part, pair in (item for _, parts in found for item in parts.items()):
                    self._parts.setdefault(part, []).append(pair)
        return self._known

    def _exchange(self, now: Mapping[str, _Fit]) -> tuple[dict[str, str], float, float]:
        """Camera -> camera whose calibration fits its masks, where that is another; their misfits now and then."""
        names = list(now)
        fits: dict[tuple[int, int], _Fit] = {}
        cost = np.ones((len(names), len(names)))
        for i, name in enumerate(names):
            for j, other in enumerate(names):
                a, b = self._cameras[name], self._cameras[other]
                if (a.width, a.height) == (b.width, b.height):
                    fits[i, j] = now[name] if i == j else self._fit(name, b)
                    cost[i, j] = fits[i, j].misfit
        best = linear_sum_assignment(cost)[1].tolist()
        moved = [i for i in range(len(names)) if best[i] != i]
        if not moved:
            return {}, 0.0, 0.0
        before, after = _mean(fits[i, i] for i in moved), _mean(fits[i, best[i]] for i in moved)
        pairs = {names[i]: names[best[i]] for i in moved} if _explains(before, after) else {}
        return pairs, before.misfit, after.misfit

    def _best_reading(self, strange: Mapping[str, _Fit]) -> tuple[_Reading | None, float]:
        """What explains the misfit of these cameras best, if anything does, and the misfit then."""
        best, least = None, 1.0
        tried = sorted(strange, key=lambda name: strange[name].misfit)[-_TRIED:]
        before = _mean(strange[name] for name in tried)
        for reading in _readings():
            if reading.world is not None and len(strange) < len(self._views):
                continue  # the meshes' world is the same for all cameras
            cameras = []
            for name in tried:
                camera = self._cameras[name]
                pose, K = reading.apply(camera.cam_from_world, camera.K)
                cameras.append(dataclasses.replace(camera, cam_from_world=pose, K=K))
            known = [self._cameras[name] for name in tried]
            if reading.zoom != 1.0 and any(_off_centre(c) > _off_centre(k) for c, k in zip(cameras, known)):
                continue  # a matrix of another image size has its principal point aside
            after = _mean(self._fit(camera.name, camera) for camera in cameras)
            if after.misfit < least - 1e-9 and _explains(before, after):
                best, least = reading, after.misfit
        return best, least

    def _fit(self, name: str, camera: Camera) -> _Fit:
        """How the masks of one camera are met under a calibration, given with this name or not; mean of its frames."""
        return _mean(self._compare(view, camera) for view in self._views[name])

    def _compare(self, view: _View, camera: Camera) -> _Fit:
        return self._measure(view, camera)[0]

    def _measure(self, view: _View, camera: Camera) -> tuple[_Fit, dict[str, tuple[float, float]]]:
        """The fit of a view; and, where masks are labels, part -> pixels that are met, and pixels."""
        mesh, (height, width) = self._meshes[view.frame], view.mask.shape
        names = [part for part in PARTS if part in mesh and part in self._topology]
        verts, faces, _ = joined_meshes([(mesh[part], self._topology[part][0]) for part in names])
        part = np.concatenate([np.full(len(self._topology[p][0]), PARTS.index(p) + 1) for p in names])
        points = verts.astype(np.float64) @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        if camera.distortion is not None:
            corners = np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)], dtype=np.float64)
            reach = np.linalg.norm((corners - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], axis=1).max()
            points = distort_vertices(points, camera.distortion, float(1.1 * reach))
        K = camera.K.copy()
        K[:2] /= self._step(camera)
        face, _, _ = rasterize_mesh(points, faces, K, width, height)
        known = ~unseen_in(view.mask)
        drawn = (face >= 0) & known
        there = parts_in(view.mask)
        both = float((drawn & there).sum())
        if view.labelled:
            # A part that is in the mask has to be drawn as well: it may lie outside the image.
            shown = np.where(drawn, part[face], 0)
            pairs = {name: (shown == PARTS.index(name) + 1, view.mask == PARTS.index(name) + 1) for name in names}
        else:
            pairs = {"": (drawn, there)}
        parts: dict[str, tuple[float, float]] = {}
        for name, (mesh_pixels, mask_pixels) in pairs.items():
            agree, size, wanted = (float(x.sum()) for x in (mesh_pixels & mask_pixels, mesh_pixels, mask_pixels))
            parts[name] = agree * min(1.0, agree / max(_LEAST_COVERED * wanted, 1.0)), size if size else wanted
        met, weight = np.sum(list(parts.values()), axis=0)
        misfit = 1.0 - met / weight if weight else 1.0
        fit = _Fit(float(misfit), both / float(there.sum()), both / float(max((drawn | there).sum(), 1)))
        return fit, parts if view.labelled else {}

    @staticmethod
    def _step(camera: Camera) -> int:
        return max(1, max(camera.width, camera.height) // _SIDE)


def _mean(fits: Iterable[_Fit]) -> _Fit:
    values = [dataclasses.astuple(fit) for fit in fits]
    return _Fit(*np.mean(values, axis=0).tolist())


def _explains(before: _Fit, after: _Fit) -> bool:
    """Whether a change of the cameras is what was wrong.

    Most of the misfit goes, and more than noise makes; and not because the meshes got so small that they lie inside.
    """
    smaller = after.covered < _LEAST_KEPT * before.covered and before.misfit < _WORST
    gain = before.misfit - after.misfit
    return after.misfit <= min(0.5 * before.misfit, _GOOD) and gain >= _LEAST_GAIN and not smaller


def _off_centre(camera: Camera) -> float:
    """Distance of the principal point from the centre of the image [px]."""
    return float(np.hypot(camera.K[0, 2] - camera.width / 2, camera.K[1, 2] - camera.height / 2))


def _words(exchanged: Mapping[str, str]) -> str:
    if len(exchanged) == 2:
        return f"cameras {' and '.join(exchanged)} are exchanged"
    return "calibrations are exchanged: " + ", ".join(f"{b} has that of {a}" for a, b in exchanged.items())
