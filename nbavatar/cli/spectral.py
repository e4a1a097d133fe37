"""Spectral coordinates of the meshes: smooth functions on the surface that the neural textures start from.

Reads a mesh sequence (.npz) and uses its rest meshes only: `<part>.rest` [m] and `<part>.faces`.

Writes arrays, per part:

  <part>.coords       float32 [V, K]  lowest non-constant eigenfunctions of the robust cotangent Laplacian, each
                                      connected component on its own, scaled to max |value| = 1 within it
  <part>.eigenvalues  float64 [P, K]  of each of the P components [1/m^2]; inf where a component has no such mode
  <part>.residual     float64 [P, K]  relative residual of the eigenproblem
  <part>.group        int64   [P, K]  equal numbers: eigenvalues too close to tell their functions apart
  <part>.component    int64   [V]     component of each vertex, -1 if no face uses it

The picture shows, per part, the first modes on the surface and, below each, the same values read back from the texels
of billboards: they must look alike, with no seam at the triangles.
"""

import argparse
from pathlib import Path

import numpy as np

from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.geometry import SpectralConfig
from nbavatar.data.sequences import Part, read_sequence
from nbavatar.io.arrays import write_arrays
from nbavatar.io.atomic import atomic_write
from nbavatar.io.images import encode_png
from nbavatar.mesh.drawing import draw_mesh, look_from, signed_colors
from nbavatar.mesh.spectral import spectral_coordinates
from nbavatar.mesh.texels import texel_values
from nbavatar.mesh.topology import validate_mesh
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]

_SIDE = 256
_SHOWN = 6
_TEXELS = 16
# Half side of the billboards in the picture, in face units: covers every triangle.
_HALF = 1.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence of `nbavatar tracks` or `fit`")
    parser.add_argument("--out", required=True, metavar="NPZ", help="arrays to write")
    parser.add_argument("--picture", metavar="PNG", help="also draw the first modes")
    add_cfg_argument(parser, SpectralConfig)


def main(args: argparse.Namespace) -> None:
    """Writes the coordinates."""
    cfg = stage_config(args, SpectralConfig)
    sequence, _ = read_sequence(args.meshes)
    arrays: dict[str, np.ndarray] = {}
    rows = []
    for name, part in sequence.parts.items():
        validate_mesh(part.rest, part.faces, f"{args.meshes}: {name}.rest")
        found = spectral_coordinates(part.rest, part.faces, cfg.modes)
        arrays[f"{name}.coords"] = found.coords.astype(np.float32)
        for field in ("eigenvalues", "residual", "group", "component"):
            arrays[f"{name}.{field}"] = getattr(found, field)
        if args.picture:
            rows += _rows(part, found.coords[:, :_SHOWN])
    record = run_record("spectral", config=to_mapping(cfg), inputs={"meshes": args.meshes})
    write_arrays(args.out, arrays, record)
    if args.picture:
        with atomic_write(args.picture) as temporary:
            Path(temporary).write_bytes(encode_png(np.concatenate(rows), level=6))


def _rows(part: Part, coords: np.ndarray) -> list[np.ndarray]:
    """Two rows of the picture: vertex values, and the same through texels."""
    towards, up = _view(part)
    K, pose = look_from(part.rest.astype(np.float64), towards, up, _SIDE)
    half = np.full((len(part.faces), 2), _HALF)
    texels = texel_values(coords, part.rest, part.faces, half, _TEXELS)
    plain, carried = [], []
    for k in range(coords.shape[1]):
        plain.append(draw_mesh(part.rest, part.faces, signed_colors(coords[:, k]), K, pose, _SIDE))
        sampler = _Sampler(part, texels[..., k])
        carried.append(draw_mesh(part.rest, part.faces, sampler, K, pose, _SIDE))
    missing = [np.full((_SIDE, _SIDE, 3), 255, np.uint8)] * (_SHOWN - coords.shape[1])
    return [np.concatenate(row + missing, axis=1) for row in (plain, carried)]


def _view(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """A view on the broad side of the part, up along its longest axis; heads in models' axes: front, y up."""
    rest = part.rest.astype(np.float64)
    extent = np.ptp(rest, axis=0)
    if extent.min() > 0.5 * extent.max():
        return np.array([0.3, 0.1, 1.0]), np.array([0.0, 1.0, 0.0])
    axes = np.linalg.svd(rest - rest.mean(axis=0), full_matrices=False)[2]
    return axes[2] + 0.2 * axes[1], axes[0]


class _Sampler:
    """Colours of pixels from the texels of the face they lie on (nearest texel)."""

    def __init__(self, part: Part, texels: np.ndarray) -> None:
        import torch

        from nbavatar.mesh.frames import face_frames

        faces = np.asarray(part.faces, np.int64)
        rest = np.asarray(part.rest, np.float64)
        frames = face_frames(torch.from_numpy(rest), torch.from_numpy(faces))
        corners = (rest[faces] - frames.T.numpy()[:, None]) @ frames.R.numpy()
        self._uv = corners[..., :2] / frames.k.numpy()[:, None, None] / _HALF
        self._texels = texels

    def __call__(self, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
        uv = np.einsum("pc,pci->pi", weights, self._uv[faces])
        column, row = np.rint((np.clip(uv, -1, 1) + 1) / 2 * (_TEXELS - 1)).astype(int).T
        return signed_colors(self._texels[faces, row, column])
