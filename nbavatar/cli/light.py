"""The light of the studio, from how the brightness of skin changes as head and hands turn and shadow each other.

Reads
  --meshes   mesh sequence (.npz, `nbavatar shell`, `align` or `tracks`)
  --frames   frame packs (.zip, `nbavatar ingest`) of the training cameras, layer rgb, as recorded; only frames of the
             split `train` are looked at
  --masks    frame packs (.zip, `nbavatar masks`) of the same cameras, layers label and alpha
and writes
  --out      far lights (.npz): directions float32 [K, 3], unit, world, and weights float32 [K], 4 in all. None at all
             (K = 0) where a light that stands still does not explain how the brightness changes; the record says why
  --picture  photographs of one camera, below each the same meshes in that light, grey; on the right all directions as a
             map: in the middle light that comes from the camera, above it light from above, at both ends light from
             behind

`nbavatar train --light` tells the decoder how much of this light each face gets. Cameras are taken to have the same
exposure in all frames.
"""

import argparse
import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.geometry import LightConfig
from nbavatar.data.lights import Light, write_light
from nbavatar.data.sequences import PARTS, SHELL, MeshSequence, read_sequence
from nbavatar.errors import ConfigError, DataError
from nbavatar.fitting.evidence import Lens
from nbavatar.fitting.light import Brightness, add_picture, estimate_light
from nbavatar.fitting.light_picture import Shot, light_picture
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack
from nbavatar.io.images import encode_png
from nbavatar.math.directions import sphere_directions
from nbavatar.mesh.incidence import incidence
from nbavatar.mesh.zbuffer import joined_meshes, rasterize_mesh
from nbavatar.preprocess.sources import camera_of
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]

_COVERED = 250  # coverage from which a pixel shows one surface alone [1/255]
_SHOWN = 4  # photographs in the picture


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence of `nbavatar shell` or `align`")
    parser.add_argument("--frames", nargs="+", required=True, metavar="ZIP", help="frame packs of the training cameras")
    parser.add_argument("--masks", nargs="+", required=True, metavar="ZIP", help="masks of the same cameras")
    parser.add_argument("--out", required=True, metavar="NPZ", help="lights to write")
    parser.add_argument("--picture", metavar="PNG", help="also draw photographs beside the meshes in the light")
    add_cfg_argument(parser, LightConfig)


def main(args: argparse.Namespace) -> None:
    """Looks, estimates and writes."""
    cfg = stage_config(args, LightConfig)
    sequence, _ = read_sequence(args.meshes)
    with contextlib.ExitStack() as stack:
        packs, masks = (
            {str(p.manifest["camera"]): p for p in (stack.enter_context(FramePack(path)) for path in paths)}
            for paths in (args.frames, args.masks)
        )
        if set(packs) != set(masks):
            raise ConfigError.of("--masks", expected=f"masks of {', '.join(packs)}", found=", ".join(masks))
        chosen = _evenly(list(packs), cfg.cameras)
        scene = _Scene(sequence, [packs[name] for name in chosen], [masks[name] for name in chosen], cfg)
        directions = sphere_directions(cfg.directions)
        seen = scene.look()
        light, said = estimate_light(scene.reach, seen, directions, kept=cfg.lights, least=cfg.least)
        inputs = {"meshes": args.meshes} | {f"frames.{i}": path for i, path in enumerate(args.frames)}
        inputs |= {f"masks.{i}": path for i, path in enumerate(args.masks)}
        write_light(args.out, light, run_record("light", config=to_mapping(cfg), inputs=inputs, extra={"light": said}))
        if args.picture:
            picture = light_picture(
                scene.shots(light, _SHOWN), light, scene.cameras[0].cam_from_world, cfg.picture_size
            )
            with atomic_write(args.picture) as temporary:
                Path(temporary).write_bytes(encode_png(picture, level=6))
    if "absent" in said:
        print(f"no light: {said['absent']}")
    else:
        share = f"{100 * said['explained']:.0f} %"
        print(f"{said['lights']} lights, which explain {share} of how skin changes in frames left out")


class _Scene:
    """The chosen frames, faces and cameras."""

    def __init__(
        self, sequence: MeshSequence, packs: list[FramePack], masks: list[FramePack], cfg: LightConfig
    ) -> None:
        self._sequence, self._packs, self._masks, self._side = sequence, packs, masks, cfg.side
        self.cameras = [camera_of(pack) for pack in packs]
        self._lenses = [Lens(camera, cfg.lines) for camera in self.cameras]
        rows = {row for pack in packs for row in sequence.index(pack.split("train"))}
        there = {row for row in rows if any(np.isfinite(part.verts[row]).all() for part in sequence.parts.values())}
        if not there:
            where = ", ".join(str(pack.path) for pack in packs)
            raise DataError.of(where, "split", expected="a training frame with a mesh", found="none")
        self._rows = _evenly(sorted(there), cfg.frames)
        self._labels = np.concatenate([np.full(len(p.faces), _label(name)) for name, p in sequence.parts.items()])
        # The shell comes last. It is more solid than hair, so it neither tells light nor throws shadows.
        self._solid = sum(len(part.faces) for name, part in sequence.parts.items() if name != SHELL)
        self._faces = np.sort(np.random.default_rng(0).permutation(self._solid)[: cfg.faces])
        self._place = np.full(len(self._labels), -1)
        self._place[self._faces] = np.arange(len(self._faces))

    def look(self) -> Brightness:
        """Brightness of the chosen faces in the chosen frames."""
        shape = len(self._rows), len(self._faces)
        seen = Brightness(np.zeros(shape), np.zeros(shape))
        for n, row in enumerate(progress(self._rows, "brightness", len(self._rows))):
            frame = self._sequence.frames[row]
            verts, faces, numbers = self._meshes(row)
            for index in range(len(self._packs)):
                if frame not in self._packs[index].split("train"):
                    continue
                face, image, usable = self._shot(index, frame, verts, faces, numbers)
                add_picture(seen, n, image, usable, face, self._place[numbers])
        return seen

    def reach(self, directions: np.ndarray) -> np.ndarray:
        """Incidence of far lights (K, 3) on the chosen faces in the chosen frames, float32 (N, K, F)."""
        incident = np.zeros((len(self._rows), len(directions), len(self._faces)), np.float32)
        for n, row in enumerate(progress(self._rows, f"shadows of {len(directions)} lights", len(self._rows))):
            verts, faces, numbers = self._meshes(row)
            place = self._place[numbers]
            lit = np.flatnonzero(place >= 0)
            normals = _normals(verts, faces)[lit]
            incident[n][:, place[lit]] = incidence(
                verts, faces[lit], normals, directions, occluders=faces[numbers < self._solid], side=self._side
            )
        return incident

    def shots(self, light: Light, count: int) -> list[Shot]:
        """Photographs of the first camera, spread over its frames, with the meshes' shading in each."""
        frames = self._packs[0].split("train")
        rows = [row for row in self._rows if self._sequence.frames[row] in frames]
        found = []
        for row in _evenly(rows, count):
            verts, faces, numbers = self._meshes(row)
            face, image, _ = self._shot(0, self._sequence.frames[row], verts, faces, numbers)
            shine = np.ones(len(faces))
            if len(light.weights):
                normals = _normals(verts, faces)
                solid = faces[numbers < self._solid]
                shine = light.weights @ incidence(
                    verts, faces, normals, light.directions, occluders=solid, side=self._side
                )
            found.append(Shot(image, np.where(face >= 0, shine[face], np.nan)))
        return found

    def _meshes(self, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the parts that are there: vertices (V, 3) [m], faces (F, 3), and their numbers among all faces (F,)."""
        parts, numbers, first = [], [], 0
        for part in self._sequence.parts.values():
            if np.isfinite(part.verts[row]).all():
                parts.append((part.verts[row].astype(np.float64), part.faces))
                numbers.append(np.arange(first, first + len(part.faces)))
            first += len(part.faces)
        verts, faces, _ = joined_meshes(parts)
        return verts, faces, np.concatenate(numbers)

    def _shot(
        self, index: int, frame: str, verts: np.ndarray, faces: np.ndarray, numbers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Face in each pixel of a camera's reduced picture, the picture, and where it shows that face's part alone."""
        lens = self._lenses[index]
        image = lens.take(self._packs[index].read("rgb", frame), 0)
        label, alpha = (lens.take(self._masks[index].read(layer, frame), 0) for layer in ("label", "alpha"))
        face, _, _ = rasterize_mesh(
            verts, faces, lens.K, lens.width, lens.height, cam_from_world=self.cameras[index].cam_from_world
        )
        usable = (face >= 0) & (label == self._labels[numbers][face]) & (alpha >= _COVERED)
        return face, image, usable


def _label(part: str) -> int:
    """Label of a part in masks; hair off the mesh counts as head."""
    return 1 if part == SHELL else PARTS.index(part) + 1


def _normals(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (F, 3), as the avatar has them."""
    import torch

    from nbavatar.mesh.frames import face_frames

    return face_frames(torch.from_numpy(verts), torch.from_numpy(np.asarray(faces, np.int64))).R[..., 2].numpy()


def _evenly(items: list[Any], count: int) -> list[Any]:
    """At most `count` of the items, evenly spread, the first and last among them."""
    if not items:
        return []
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int))]
