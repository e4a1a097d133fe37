"""The names that `import nbavatar` offers: load an avatar, pose it, render it, train one.

Arrays are NumPy's; letters, units and frames are those of CONVENTIONS.md. Bad input raises `NBAvatarError` with one
line that says which file and field, what was expected and what was found.
"""

import argparse
import json
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from nbavatar.camera.pinhole import Camera, facing_pose
from nbavatar.data.sequences import MeshSequence, read_sequence
from nbavatar.errors import DataError, NBAvatarError
from nbavatar.methods.base import MeshAvatar
from nbavatar.methods.storage import load_avatar as _load_avatar

__all__ = [
    "Camera",
    "NBAvatarError",
    "Rendered",
    "load_avatar",
    "load_meshes",
    "look_at",
    "pose",
    "render",
    "train",
]

Vertices = Mapping[str, np.ndarray]
"""Vertices of a frame by part (`head`, `right_hand`, `left_hand`), float [V, 3], world [m]."""


class Rendered(NamedTuple):
    """A picture.

    Attributes:
        rgb: colour on the background, sRGB, float32 [H, W, 3] in [0, 1].
        alpha: opacity, float32 [H, W] in [0, 1].
    """

    rgb: np.ndarray
    alpha: np.ndarray


def load_avatar(path: str | os.PathLike[str], device: str = "cpu", *, engine: str = "eager") -> MeshAvatar:
    """Reads a trained avatar (model.pt), of whatever method.

    Args:
        path: file of `nbavatar train`.
        device: `cpu` or `cuda`.
        engine: what runs the U-Net on a CPU: `eager` (torch), or up to rounding `openvino`, `onnxruntime`, or `auto`
            for the fastest that is installed.

    Raises:
        NBAvatarError: missing, damaged, or not an avatar; an engine that is not there, or named on a GPU.
    """
    from nbavatar.methods.billboards.engine import chosen_engine

    avatar = _load_avatar(path, device)
    avatar.use_engine(chosen_engine(engine, device))
    return avatar


def load_meshes(path: str | os.PathLike[str]) -> MeshSequence:
    """Reads a mesh sequence (.npz): `frames`, and `parts[name].verts` [N, V, 3], `.faces` [F, 3], `.rest` [V, 3].

    Raises:
        NBAvatarError: missing, damaged, or not a mesh sequence.
    """
    return read_sequence(path)[0]


def look_at(
    position: Sequence[float] | np.ndarray,
    target: Sequence[float] | np.ndarray,
    *,
    up: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0),
    width: int = 512,
    height: int = 512,
    fov: float = 0.4,
) -> Camera:
    """A pinhole camera that looks at a point, which it shows in the middle of the picture.

    Args:
        position, target: of the camera and of the point, world [m], (3,).
        up: what is up in the picture, world (3,).
        width, height: size of the picture [px].
        fov: vertical angle of view [rad].

    Raises:
        NBAvatarError: position and target are the same, or up lies along the direction of view.
    """
    eye, forward = np.asarray(position, np.float64), np.asarray(target, np.float64) - np.asarray(position, np.float64)
    right = np.cross(forward, np.asarray(up, np.float64))
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        raise DataError.of("look_at", expected="a target apart from the position, and up across the direction of view",
                           found=f"position {list(position)}, target {list(target)}, up {list(up)}")  # fmt: skip
    focal = 0.5 * height / math.tan(0.5 * fov)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera("look_at", int(width), int(height), K, facing_pose(eye, np.asarray(target), np.asarray(up)))


def pose(avatar: MeshAvatar, vertices: Vertices, *, frame: str | None = None) -> dict[str, np.ndarray]:
    """Where an avatar's billboards or Gaussians are on posed meshes.

    Args:
        avatar: of `load_avatar`.
        vertices: by part; a part that is missing or not finite is left out.
        frame: id of a training frame, to use what was learnt about it.

    Returns:
        `means` float32 [N, 3] [m], `quats` float32 [N, 4] wxyz, world, and `half_extents` [N, 2] [m] of billboards or
        `scales` [N, 3] [m] (standard deviations) of Gaussians.
    """
    with torch.no_grad():
        anchor = avatar.anchor(_tensors(avatar, vertices), frame)
        posed = avatar.place(anchor)[0] if hasattr(avatar, "place") else avatar.pose(anchor)  # type: ignore[attr-defined]
    names = ("means", "quats", "half_extents", "scales")
    return {name: getattr(posed, name).float().cpu().numpy() for name in names if hasattr(posed, name)}


def render(
    avatar: MeshAvatar,
    vertices: Vertices,
    camera: Camera,
    *,
    background: Sequence[float] = (1.0, 1.0, 1.0),
    frame: str | None = None,
    precision: str = "fp32",
) -> Rendered:
    """One picture of an avatar on posed meshes.

    Args:
        avatar: of `load_avatar`.
        vertices: by part, float [V, 3], world [m]; a part that is missing or not finite is left out.
        camera: pinhole; any principal point, no distortion.
        background: RGB in [0, 1], sRGB.
        frame: id of a training frame, to use what was learnt about it (corrections of its meshes).
        precision: arithmetic of the U-Net: fp32, bf16 or fp16.

    Raises:
        NBAvatarError: another number of vertices than the avatar's, or a camera with distortion.
    """
    if camera.distortion is not None and np.any(np.asarray(camera.distortion) != 0):
        raise DataError.of(f"camera {camera.name}", "distortion", expected="none", found=list(camera.distortion),
                           fix="render without it and distort the picture")  # fmt: skip
    verts = _tensors(avatar, vertices)
    device = avatar.faces.device
    with torch.no_grad():
        image, alpha, _ = avatar.eval().render(
            verts,
            torch.tensor(np.asarray(camera.cam_from_world), dtype=torch.float32, device=device),
            torch.tensor(np.asarray(camera.K), dtype=torch.float32, device=device),
            camera.width,
            camera.height,
            torch.tensor(background, dtype=torch.float32, device=device),
            frame=frame,
            precision=precision,
        )
    return Rendered(image.clamp(0, 1).permute(1, 2, 0).float().cpu().numpy(), alpha.clamp(0, 1).float().cpu().numpy())


def train(
    frames: Sequence[str | os.PathLike[str]],
    meshes: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    spectral: str | os.PathLike[str] | None = None,
    light: str | os.PathLike[str] | None = None,
    start: str | os.PathLike[str] | None = None,
    device: str = "auto",
    **options: Any,
) -> MeshAvatar:
    """Trains an avatar, as `nbavatar train` does: stopped at any moment, the same call goes on from there.

    Args:
        frames: frame packs (.zip) of the training cameras.
        meshes: mesh sequence (.npz).
        out: model.pt to write; `<out>.state/` beside it keeps what a later call resumes from.
        spectral: spectral coordinates (.npz); needed for `init="spectral"`, which is the default.
        light: the studio's lights (.npz, `nbavatar light`), of which billboards are told what reaches each face.
        start: model.pt of another avatar of the same method, to begin with what fits of it.
        device: `auto`, `cpu` or `cuda`.
        options: of `TrainConfig` (config/README.md), such as `steps=2000, billboards={"texels": 8}`.

    Raises:
        NBAvatarError: bad input, an unknown option, or the training was told to stop before its end.
    """
    from nbavatar.cli.train import main

    files = {"spectral": spectral, "light": light, "start": start}
    given = argparse.Namespace(
        frames=[os.fspath(path) for path in frames], meshes=os.fspath(meshes), out=os.fspath(out), history=None,
        **{name: None if path is None else os.fspath(path) for name, path in files.items()},
        device=device, max_minutes=None, preset=None, presets=None, cfg=json.dumps(options), set=[],
    )  # fmt: skip
    if main(given) != 0:
        raise NBAvatarError(f"{out}: the training was told to stop before its end; the same call goes on from there")
    return load_avatar(out)


def _tensors(avatar: MeshAvatar, vertices: Vertices) -> dict[str, torch.Tensor]:
    unknown = set(vertices) - set(avatar.parts)
    if unknown == set(vertices):
        raise DataError.of("vertices", expected=f"parts {', '.join(avatar.parts)}", found=", ".join(unknown) or "none")
    device = avatar.faces.device
    return {
        part: torch.tensor(np.asarray(vertices[part]), dtype=torch.float32, device=device)
        for part in avatar.parts
        if part in vertices
    }
