"""The pictures of the viewer: render, billboards, features, opacity, mesh edges, error; two avatars with a wipe."""

import colorsys
import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from nbavatar.camera.pinhole import project
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.gaussians.avatar import GaussianAvatar
from nbavatar.rendering.billboards.functional import render_billboards
from nbavatar.rendering.gaussians.functional import render_gaussians
from nbavatar.viewer.eye import Eye
from nbavatar.viewer.scene import EXACT, Entry, Scene

__all__ = ["SHOWS", "Drawn", "Request", "draw"]

SHOWS = ("render", "billboards", "features", "alpha", "wireframe", "error")
_ERROR_RANGE = 0.25  # mean absolute difference of the channels that is drawn brightest
_HEAT = np.array([[0, 0, 0], [90, 15, 110], [190, 55, 80], [245, 130, 25], [252, 255, 165]], np.float32) / 255.0
_EDGE = (20, 120, 220)


@dataclasses.dataclass(frozen=True)
class Request:
    """What is to be drawn.

    Attributes:
        eye: where one looks from.
        frame: id.
        first, second: names of avatars; the second, or empty, is to the right of the wipe.
        wipe: place of the border between them, share of the width.
        show: one of `SHOWS`.
        preset: name of a measured setting, or `EXACT`.
        background: RGB in [0, 1].
    """

    eye: Eye
    frame: str
    first: str
    second: str = ""
    wipe: float = 0.5
    show: str = "render"
    preset: str = EXACT
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)


class Drawn(NamedTuple):
    """A picture.

    Attributes:
        image: uint8 (H, W, 3), of the canvas's shape.
        size: width and height [px] that were rendered.
        remarks: on it.
        decoders: what ran the avatars' U-Nets, with the version; empty where no U-Net was run.
    """

    image: np.ndarray
    size: tuple[int, int]
    remarks: list[str]
    decoders: list[str]


class _View(NamedTuple):
    """One avatar's picture, float32 (H, W, 3) in [0, 1], remarks on it, and what ran its U-Net, if anything did."""

    image: np.ndarray
    remarks: list[str]
    decoder: str


def draw(scene: Scene, request: Request, side: int) -> Drawn:
    """One picture with a longer side of `side` pixels, or of the camera's own size where the error is shown."""
    if request.show == "error" and request.eye.camera:
        side = min(side, max(request.eye.width, request.eye.height))
    eye = request.eye.scaled(side)
    views = [_view(scene, scene.entries[name], request, eye) for name in (request.first, request.second) if name]
    image, remarks = views[0].image, [remark for view in views for remark in view.remarks]
    if request.second:
        border = round(request.wipe * eye.width)
        image = np.concatenate((image[:, :border], views[1].image[:, border:]), axis=1)
        image[:, max(0, border - 1) : border + 1] = (0.9, 0.3, 0.1)
        remarks = [f"left {request.first}, right {request.second}", *remarks]
    pixels = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    decoders = [view.decoder for view in views if view.decoder]
    canvas, size = _on_canvas(pixels, eye.aspect), (eye.width, eye.height)
    return Drawn(canvas, size, list(dict.fromkeys(remarks)), list(dict.fromkeys(decoders)))


def _view(scene: Scene, entry: Entry, request: Request, eye: Eye) -> _View:
    """One avatar."""
    background = torch.tensor(request.background, dtype=torch.float32, device=scene.device)
    verts, frame = entry.vertices(request.frame, scene.device)
    viewmat = torch.tensor(eye.cam_from_world, dtype=torch.float32, device=scene.device)
    K = torch.tensor(eye.K, dtype=torch.float32, device=scene.device)
    place = viewmat, K, eye.width, eye.height
    with torch.no_grad():
        if request.show == "billboards":
            return _View(_pixels(_primitives(entry.avatar, verts, frame, *place, background)), [], "")
        if request.show == "features":
            features = _features(entry.avatar, verts, frame, *place)
            if features is not None:
                return _View(_pixels(features), [], "")
            remark = [f"{entry.name} has no features: its render"]
        else:
            remark = []
        avatar = entry.under(request.preset)
        if request.preset != EXACT and request.preset not in entry.presets:
            remark = [*remark, f"{entry.name} has no preset {request.preset}: the exact setting"]
        before = _decoded(entry.avatar)
        image, alpha, _ = avatar.render(verts, *place, background, frame=frame)
    decoder = _decoder(entry.avatar, before)
    if request.show == "alpha":
        return _View(_pixels(alpha.expand(3, -1, -1)), remark, decoder)
    picture = _pixels(image)
    if request.show == "wireframe":
        picture = _edges(picture, entry.avatar, verts, eye)
    elif not eye.camera:
        remark = [*remark, "choose a camera to see the error"] if request.show == "error" else remark
    elif max(eye.width, eye.height) <= max(request.eye.width, request.eye.height):  # else no truth of this size
        picture, remark = _judged(scene, entry, request, eye, picture, remark)
    return _View(picture, remark, decoder)


def _decoded(avatar: Any) -> int:
    """How many pictures the avatar's engine has decoded."""
    return avatar.engine.decoded if isinstance(avatar, Avatar) and avatar.engine is not None else 0


def _decoder(avatar: Any, before: int) -> str:
    """What has run the avatar's U-Net since the engine had decoded this many: the engine, else torch."""
    if not isinstance(avatar, Avatar) or avatar.unet is None:
        return ""
    if avatar.engine is not None and avatar.engine.decoded > before:
        return avatar.engine.name
    return f"torch {torch.__version__}"


def _judged(
    scene: Scene, entry: Entry, request: Request, eye: Eye, picture: np.ndarray, remark: list[str]
) -> tuple[np.ndarray, list[str]]:
    """The picture, or its error, with the PSNR against what the camera recorded."""
    found = scene.truth(eye.camera, request.frame, np.array(request.background))
    if found is None:
        return picture, [*remark, "no picture of this camera and frame"]
    truth, known = found
    if truth.shape != picture.shape:
        size = (eye.width, eye.height)
        channels = [Image.fromarray(truth[..., c]).resize(size, Image.Resampling.BOX) for c in range(3)]
        truth = np.stack([np.asarray(channel) for channel in channels], axis=-1)
        known = np.asarray(Image.fromarray(known).resize(size, Image.Resampling.NEAREST))
    difference = np.clip(picture, 0, 1) - truth
    mse = float((difference[known] ** 2).mean()) if known.any() else float("nan")
    remark = [*remark, f"{entry.name}: {-10 * np.log10(max(mse, 1e-10)):.2f} dB PSNR at this size"]
    if request.show != "error":
        return picture, remark
    strength = np.where(known, np.abs(difference).mean(-1) / _ERROR_RANGE, 0.0)
    place = np.clip(strength, 0, 1) * (len(_HEAT) - 1)
    steps = np.arange(len(_HEAT))
    heat = np.stack([np.interp(place, steps, _HEAT[:, c]) for c in range(3)], axis=-1)
    return heat, [*remark, f"error: black 0, yellow {round(255 * _ERROR_RANGE)} of 255 or more"]


def _primitives(
    avatar: Any, verts: Any, frame: str | None, viewmat: Tensor, K: Tensor, width: int, height: int, background: Tensor
) -> Tensor:
    """Every billboard or Gaussian in a colour of its own, with its own opacity, (3, H, W)."""
    anchor = avatar.anchor(verts, frame)
    if isinstance(avatar, GaussianAvatar):
        posed = avatar.pose(anchor)
        colours, opacity = _colours(avatar.primitives).to(background), avatar.appearance(posed)[0]
        if posed.rows is not None:
            colours = colours[posed.rows]
        shown = render_gaussians(posed.means, posed.quats, posed.scales, opacity, colours, viewmat, K, width, height)
        colour, alpha = shown.colour, shown.alpha
    else:
        assert isinstance(avatar, Avatar)
        placed, keep = avatar.place(anchor)
        opacity, colours = avatar.billboards.alpha(), _colours(avatar.primitives).to(background)
        if keep is not None:
            opacity, colours = opacity[keep], colours[keep]
        features = colours[:, None, None].expand(*opacity.shape, 3).contiguous()
        colour, alpha = render_billboards(
            *placed.planes, features, opacity, viewmat, K, width, height, order=avatar.architecture.order
        )
    return colour + (1.0 - alpha) * background[:, None, None]


def _features(
    avatar: Any, verts: Any, frame: str | None, viewmat: Tensor, K: Tensor, width: int, height: int
) -> Tensor | None:
    """The first three features in false colours, zero is grey, (3, H, W); None where there are none."""
    if not isinstance(avatar, Avatar) or avatar.unet is None:
        return None
    posed, keep = avatar.pose(verts, frame)
    features, alpha = avatar.textures(keep)
    features = features[..., [min(i, features.shape[-1] - 1) for i in range(3)]].contiguous()
    shown, _ = render_billboards(
        *posed.planes, features, alpha, viewmat, K, width, height, order=avatar.architecture.order
    )
    return 0.5 + 0.5 * torch.tanh(shown)


@functools.lru_cache(maxsize=4)
def _colours(count: int) -> Tensor:
    """Colours that differ from neighbour to neighbour, float32 (count, 3)."""
    turns = [(0.61803398875 * i) % 1.0 for i in range(count)]
    values = [colorsys.hsv_to_rgb(turn, 0.45 + 0.4 * ((7 * i) % 5) / 4, 0.95) for i, turn in enumerate(turns)]
    return torch.tensor(values, dtype=torch.float32).reshape(count, 3)


def _edges(picture: np.ndarray, avatar: Any, verts: dict[str, Tensor], eye: Eye) -> np.ndarray:
    """Edges of the faces that face the camera, over the paled picture."""
    points, keep = avatar.merged(verts)
    faces = (avatar.faces if keep is None else avatar.faces[keep]).cpu().numpy()
    pixels, depth = project(points.double().cpu().numpy(), eye.K, eye.cam_from_world)
    corners = pixels[faces]
    sides = corners[:, 1:] - corners[:, :1]
    turned = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    seen = (depth[faces] > 0.01).all(1) & (turned < 0) & np.isfinite(corners).all((1, 2))
    pairs = np.sort(np.concatenate([faces[seen][:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]), axis=1)
    canvas = Image.fromarray((np.clip(0.5 * picture + 0.5, 0, 1) * 255).astype(np.uint8))
    pen = ImageDraw.Draw(canvas)
    for a, b in np.unique(pairs, axis=0).tolist():
        pen.line((*pixels[a], *pixels[b]), fill=_EDGE)
    return np.asarray(canvas).astype(np.float32) / 255.0


def _pixels(image: Tensor) -> np.ndarray:
    """(3, H, W) to float32 (H, W, 3) on the CPU."""
    return image.permute(1, 2, 0).float().cpu().numpy()


def _on_canvas(image: np.ndarray, aspect: float) -> np.ndarray:
    """The picture in the middle of a grey canvas of this shape."""
    height, width = image.shape[:2]
    wide, high = max(width, round(height * aspect)), max(height, round(width / aspect))
    if (wide - width) <= 1 and (high - height) <= 1:
        return image
    canvas = np.full((high, wide, 3), 70, np.uint8)
    top, left = (high - height) // 2, (wide - width) // 2
    canvas[top : top + height, left : left + width] = image
    return canvas
