"""The kinds of work that `nbavatar bench scaling` measures: each makes a call for a size."""

import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from nbavatar.config.yamlfiles import read_yaml
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.data.synthetic.scene import full_scene
from nbavatar.io.framepack import FramePack, FramePackWriter
from nbavatar.methods.billboards.unet import UNet
from nbavatar.planning import units
from nbavatar.planning.run import Plan, read_plan
from nbavatar.rendering.billboards.functional import render_billboards
from nbavatar.studies.benchmarks.raster_scene import make_scene
from nbavatar.studies.benchmarks.step_scene import StepScene, training_options

__all__ = ["WORKS", "Work"]

_SIDE = 256  # where billboards grow [px]
_SMALL = 64  # of the frames of a pack [px]
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


def _frames(count: int, config: str, folder: str) -> _Call:
    random = np.random.default_rng(0)
    names = [f"{number:06d}" for number in range(count)]
    picture = random.integers(0, 256, (_SMALL, _SMALL, 3), dtype=np.uint8)
    manifest = {
        "stage": "ingest", "subject": "s", "camera": "c", "width": _SMALL, "height": _SMALL, "K": np.eye(3).tolist(),
        "cam_from_world": np.eye(4).tolist(), "distortion": None, "frames": names, "split": {}, "segments": [],
        "layers": {"rgb": "colour"}, "record": {},
    }  # fmt: skip
    path = os.path.join(folder, f"{count}.zip")

    def call() -> None:
        with FramePackWriter(path, manifest) as writer:
            for name in names:
                writer.add("rgb", name, picture)
        with FramePack(path) as pack:
            for name in names:
                pack.read("rgb", name)

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
    "subjects": Work("subjects", [1, 10, 100, 1_000], _subjects),
}
