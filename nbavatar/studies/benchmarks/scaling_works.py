"""The kinds of work that `nbavatar bench scaling` measures: each makes a call for a size."""

import contextlib
import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from nbavatar.camera.pinhole import Camera
from nbavatar.config.geometry import AlignConfig
from nbavatar.config.yamlfiles import read_yaml
from nbavatar.data.sequences import PARTS, MeshSequence, Part
from nbavatar.data.synthetic.scene import full_scene
from nbavatar.data.views import ViewStore, shuffled, views_of
from nbavatar.fitting.align import align_block
from nbavatar.fitting.bend import bend_block, smooth_basis
from nbavatar.io.framepack import FramePack, FramePackWriter
from nbavatar.mesh.zbuffer import joined_meshes, rasterize_mesh
from nbavatar.methods.billboards.unet import UNet
from nbavatar.planning import units
from nbavatar.planning.run import Plan, read_plan
from nbavatar.rendering.billboards.functional import render_billboards
from nbavatar.studies.benchmarks.fit_scene import FOCAL, HEIGHT, arc
from nbavatar.studies.benchmarks.raster_scene import make_scene
from nbavatar.studies.benchmarks.step_scene import StepScene, training_options

__all__ = ["WORKS", "Work"]

_SIDE = 256  # where billboards grow [px]
_SMALL = 64  # of the frames of a pack [px]
_FEW, _ALIGNED = 8, 4  # frames of a camera where cameras grow
_Call = Callable[[], Any]


class Work(NamedTuple):
    """A kind of work.

    Attributes:
        unit: what `sizes` count.
        prepare: size, run's file, a folder of its own -> the call to be measured.
    """

    unit: str
    sizes: Sequence[int]
    prepare: Callable[[int, str, str], _Call]


def _rasterize(side: int, billboards: int | None) -> _Call:
    scene = make_scene(size=side, billboards=billboards)
    inputs = [tensor.requires_grad_(True) for tensor in scene.billboards]

    def call() -> None:
        features, alpha = render_billboards(*inputs, scene.viewmat, scene.K, side, side)
        torch.autograd.grad(features.sum() + alpha.sum(), inputs)

    return call


def _raster_billboards(count: int, config: str, folder: str) -> _Call:
    return _rasterize(_SIDE, count)


def _raster_pixels(pixels: int, config: str, folder: str) -> _Call:
    return _rasterize(round(pixels**0.5), None)


def _decoder(pixels: int, config: str, folder: str) -> _Call:
    options = training_options(config).own
    side = round(pixels**0.5)
    unet = UNet(options.channels + 1, **dataclasses.asdict(options.unet)).to(memory_format=torch.channels_last).eval()
    features = torch.rand(1, options.channels + 1, side, side).contiguous(memory_format=torch.channels_last)

    def call() -> None:
        with torch.inference_mode():
            unet(features)

    return call


def _step(side: int, config: str, sequence: MeshSequence | None) -> _Call:
    options = training_options(config)
    whole = dataclasses.replace(options, billboards=dataclasses.replace(options.own, roi=False))
    return StepScene(side, whole, "cpu", sequence).stepping()


def _step_pixels(pixels: int, config: str, folder: str) -> _Call:
    return _step(round(pixels**0.5), config, None)


def _step_billboards(count: int, config: str, folder: str) -> _Call:
    return _step(_SIDE, config, _with_faces(full_scene(4, dents=False), count))


def _with_faces(sequence: MeshSequence, count: int) -> MeshSequence:
    """The scene with about so many faces: every n-th of them, or all divided into four as often as it takes."""
    while sum(len(part.faces) for part in sequence.parts.values()) < 0.7 * count:
        divided = {name: _divided(part) for name, part in sequence.parts.items()}
        sequence = dataclasses.replace(sequence, parts=divided)
    stride = max(1, round(sum(len(part.faces) for part in sequence.parts.values()) / count))
    parts = {name: dataclasses.replace(part, faces=part.faces[::stride]) for name, part in sequence.parts.items()}
    return dataclasses.replace(sequence, parts=parts)


def _divided(part: Part) -> Part:
    """Each triangle as four, by the middles of its edges."""
    pairs = np.sort(part.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, place = np.unique(pairs, axis=0, return_inverse=True)
    ab, bc, ca = (place.reshape(-1, 3) + len(part.rest)).T
    a, b, c = part.faces.T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    faces = np.concatenate([np.stack(three, axis=1) for three in corners])

    def refined(points: np.ndarray) -> np.ndarray:
        return np.concatenate([points, points[..., edges, :].mean(-2)], axis=-2).astype(points.dtype)

    return Part(faces, refined(part.rest), refined(part.verts))


def _manifest(camera: str, names: list[str], *layers: str) -> dict[str, Any]:
    """Of a frame pack of small pictures."""
    return {
        "stage": "ingest", "subject": "s", "camera": camera, "width": _SMALL, "height": _SMALL, "K": np.eye(3).tolist(),
        "cam_from_world": np.eye(4).tolist(), "distortion": None, "frames": names, "split": {}, "segments": [],
        "layers": dict.fromkeys(layers, ""), "record": {},
    }  # fmt: skip


def _picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (_SMALL, _SMALL, 3), dtype=np.uint8)


def _frames(count: int, config: str, folder: str) -> _Call:
    names = [f"{number:06d}" for number in range(count)]
    picture, manifest = _picture(), _manifest("c", names, "rgb")
    path = os.path.join(folder, f"{count}.zip")

    def call() -> None:
        with FramePackWriter(path, manifest) as writer:
            for name in names:
                writer.add("rgb", name, picture)
        with FramePack(path) as pack:
            for name in names:
                pack.read("rgb", name)

    return call


def _cameras(count: int, config: str, folder: str) -> _Call:
    names = [f"{number:06d}" for number in range(_FEW)]
    paths = [os.path.join(folder, f"{count}_{camera}.zip") for camera in range(count)]
    picture = _picture()
    for path in paths:
        with FramePackWriter(path, _manifest(os.path.basename(path), names, "rgb", "alpha")) as writer:
            for name in names:
                writer.add("rgb", name, picture)
                writer.add("alpha", name, picture[..., 0])

    def call() -> None:
        with contextlib.ExitStack() as stack:
            packs = [stack.enter_context(FramePack(path)) for path in paths]
            views = views_of(packs, names, [names] * count, ("rgb", "alpha"))
            store = ViewStore(packs, views, PARTS, cache_bytes=1 << 30)
            for step in range(len(views)):
                store.sample(shuffled(step, len(views), seed=0))

    return call


def _align_cameras(count: int, config: str, folder: str) -> _Call:
    """Meshes moved and bent to pictures and masks of so many cameras on an arc before the face."""
    sequence = full_scene(_ALIGNED, dents=False)
    verts = {name: np.asarray(part.verts, np.float64) for name, part in sequence.parts.items()}
    faces = {name: part.faces for name, part in sequence.parts.items()}
    rest = {name: part.rest for name, part in sequence.parts.items()}
    focal = FOCAL * _SIDE / HEIGHT
    K = np.array([[focal, 0, _SIDE / 2], [0, focal, _SIDE / 2], [0, 0, 1.0]])
    poses = arc(verts["head"].mean((0, 1)), count, np.random.default_rng(0))
    cameras = [Camera(str(number), _SIDE, _SIDE, K, pose) for number, pose in enumerate(poses)]
    labels = {name: place for place, name in enumerate(verts, start=1)}
    owner = np.repeat(list(labels.values()), [len(faces[name]) for name in verts]).astype(np.uint8)
    masks = {}
    for row in range(_ALIGNED):
        merged, joined, _ = joined_meshes([(verts[name][row], faces[name]) for name in verts])
        for camera in cameras:
            face, _, _ = rasterize_mesh(merged, joined, K, _SIDE, _SIDE, cam_from_world=camera.cam_from_world)
            label = np.where(face >= 0, owner[face], np.uint8(0))
            masks[camera.name, row] = label, np.where(label > 0, np.uint8(255), np.uint8(0))
    picture = np.random.default_rng(0).integers(0, 256, (_SIDE, _SIDE, 3), dtype=np.uint8)
    options = AlignConfig(iterations=6, modes=12)
    basis = {name: smooth_basis(rest[name], faces[name], options.modes) for name in verts}

    def read(camera: str, row: int) -> np.ndarray:
        return picture

    def mask(camera: str, row: int) -> tuple[np.ndarray, np.ndarray]:
        return masks[camera, row]

    def call() -> None:
        align_block(verts, faces, cameras, read, options)
        bend_block(verts, faces, rest, basis, labels, cameras, read, mask, options)

    return call


def _subjects(count: int, config: str, folder: str) -> _Call:
    plan = _plan_of(count, os.path.dirname(os.path.dirname(config)))

    def call() -> None:
        for everything in (units.views, units.crops, units.judged_crops, units.videos):
            everything(plan)
        for avatar in units.avatars(plan):
            units.trained_on(plan, avatar.subject, avatar.variant)
            units.meshes_of(plan, avatar.subject, avatar.variant)
        for one in units.judged(plan):
            units.judged_on(plan, one.subject, one.protocol)
        for table in units.tables(plan):
            units.rows_of_table(plan, table.table)

    return call


def _plan_of(count: int, base: str) -> Plan:
    """The paper's plan with so many subjects, each with the rows of the one that has most."""
    mapping = dict(read_yaml(os.path.join(base, "config/paper.yaml"), "a run's configuration"))
    for key, default in (("subjects", "tsv"), ("runs", "tsv"), ("tables", "yaml"), ("figures", "yaml")):
        mapping[key] = os.path.join(base, mapping.get(key) or f"config/{key}.{default}")
    plan = read_plan(mapping)
    own = list(plan.subjects.values())
    made = {f"P{i}": dataclasses.replace(own[i % len(own)], name=f"P{i}") for i in range(count)}
    most = max(([row for row in plan.rows if row.subject == one.name] for one in own), key=len)
    rows = [dataclasses.replace(row, subject=name) for name in made for row in most]
    run = dataclasses.replace(plan.run, reenact=[])
    return dataclasses.replace(plan, run=run, subjects=made, rows=rows)


_PIXELS = [64**2, 128**2, 256**2, 512**2, 1024**2]
WORKS = {
    "raster.billboards": Work("billboards", [1_000, 10_000, 100_000], _raster_billboards),
    "raster.pixels": Work("pixels", _PIXELS, _raster_pixels),
    "decoder.pixels": Work("pixels", _PIXELS, _decoder),
    "step.billboards": Work("billboards", [1_151, 11_514, 46_056], _step_billboards),
    "step.pixels": Work("pixels", _PIXELS[:4], _step_pixels),
    "frames": Work("frames", [10, 100, 1_000], _frames),
    "cameras": Work("cameras", [1, 10, 100, 1_000], _cameras),
    "align.cameras": Work("cameras", [2, 8, 32], _align_cameras),
    "subjects": Work("subjects", [1, 10, 100, 1_000], _subjects),
}
