"""Every reader of files that come from outside, with good files to damage.

A reader is called on one damaged file in a folder that is whole otherwise, and whatever it returns is used as the
product uses it: what is only found later counts too.
"""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tests.fuzz import seeds

__all__ = ["READERS", "Reader"]


@dataclasses.dataclass(frozen=True)
class Reader:
    """One kind of file.

    Attributes:
        write: makes the good file in a folder (with whatever belongs beside it); its path.
        read: reads and uses it.
        kind: how it is damaged (`tests.fuzz.mutations`).
        refuses: whether damage is refused; damaged lines of a log are skipped, and the key of a training that is
            another one moves its folder aside.
        heavy: whether a file takes tens of milliseconds, because YAML is parsed in Python, whole tables are built of
            what was read, or a body model is loaded beside it; a tenth of the files has to do for it in the tests.
    """

    write: Callable[[Path], Path]
    read: Callable[[Path], Any]
    kind: str
    refuses: bool = True
    heavy: bool = False


def _arrays(path: Path) -> None:
    from nbavatar.io.arrays import read_arrays

    arrays, record = read_arrays(path)
    assert all(isinstance(array, np.ndarray) for array in arrays.values()) and isinstance(record, dict)


def _sequence(path: Path) -> None:
    from nbavatar.data.sequences import read_sequence

    sequence, _ = read_sequence(path)
    sequence.subset(sequence.frames[:1])


def _frame_pack(path: Path) -> None:
    from nbavatar.data.views import views_of
    from nbavatar.io.framepack import FramePack

    with FramePack(path) as pack:
        for frame in pack.frames[:2]:
            pack.intrinsics(frame), pack.unseen(frame)
            for layer in pack.layers:
                pack.read(layer, frame)
        views_of([pack], pack.frames, [pack.split("train")])


def _vertex_maps(path: Path) -> None:
    from nbavatar.io.exr import read_vertex_maps

    read_vertex_maps(path)


def _avatar(path: Path) -> None:
    from nbavatar.methods.storage import load_avatar

    load_avatar(path)


def _state(path: Path) -> None:
    from nbavatar.training.state import RunFolder

    state = RunFolder(path.parent, {"key": 1}).load()
    assert state is None or "step" in state
    for stale in path.parent.parent.glob("*.stale-*"):  # whose key is another
        shutil.rmtree(stale)


def _pickle(path: Path) -> None:
    from nbavatar.io.pickles import read_pickle

    repr(read_pickle(path))


def _array(path: Path) -> None:
    from nbavatar.io.pickles import read_array

    repr(read_array(path))


def _flame(path: Path) -> None:
    from nbavatar.bodymodels.files import read_flame
    from nbavatar.bodymodels.flame import Flame

    Flame.build(read_flame(path), shape_count=10, expression_count=5)


def _mano(path: Path) -> None:
    from nbavatar.bodymodels.files import read_mano
    from nbavatar.bodymodels.mano import Mano

    Mano.build(read_mano(path))


def _landmarks(path: Path) -> None:
    from nbavatar.bodymodels.files import read_landmarks

    read_landmarks(path, seeds.HEAD_FACES)


def _decaf(path: Path) -> None:
    from nbavatar.data import decaf
    from nbavatar.data.decaf_files import find_subject
    from nbavatar.data.splits import runs_from_cuts

    subject = find_subject(_root(path), "S2")
    if path.name == "cameras.pkl":
        for camera in ("084", "100"):
            decaf.read_camera(subject, camera)
    elif path.name == "params_smoothed.pkl":
        decaf.read_parameters(subject)
    elif path.name == "S2.pkl":
        runs_from_cuts(decaf.read_cuts(subject), 12, str(path))
    else:
        decaf.check_counts(decaf.frame_counts(subject, ["084"]))
        decaf.read_keypoints(subject, "head", "084")


def _root(path: Path) -> Path:
    return next(parent for parent in path.parents if (parent / "assets").is_dir())


def _colours(path: Path) -> None:
    from nbavatar.io.pictures import read_colours

    read_colours(path, seeds.PICTURE)


def _plane(path: Path) -> None:
    from nbavatar.io.pictures import read_plane

    read_plane(path, seeds.PICTURE)


def _decoded(path: Path) -> None:
    from nbavatar.io.images import decode_image

    decode_image(path.read_bytes(), str(path))


def _video(path: Path) -> None:
    from nbavatar.io.video import read_video

    for number, frame in enumerate(read_video(path, indices=range(3))):
        assert frame.ndim == 3 and number < 3


def _capture(path: Path) -> None:
    from nbavatar.data.capture import open_capture, read_mesh, read_topology
    from nbavatar.data.frame_plan import plan_capture

    root = path.parent.parent if path.parent.name == "meshes" else path.parent
    capture = open_capture(root)
    plan = plan_capture(capture, start=0, every=1, max_frames=0, test_fraction=0.2, test_blocks=1)
    topology = read_topology(root)
    for frame in plan.frames[:1]:
        read_mesh(capture, frame, topology)
    for camera in capture.cameras.values():
        np.linalg.inv(camera.cam_from_world)


def _subjects(path: Path) -> None:
    from nbavatar.config.sheets import read_subjects

    read_subjects(path, "data")


def _captures(path: Path) -> None:
    from nbavatar.config.sheets import capture_subjects

    capture_subjects(str(path.parent), "")


def _rows(path: Path) -> None:
    from nbavatar.config.sheets import read_rows

    read_rows(path, [f"S{number}" for number in range(1, 10)])


def _tables(path: Path) -> None:
    from nbavatar.config.tables import read_tables

    for table in read_tables(path).values():
        repr((table.variants, table.protocols, table.speeds))


def _figures(path: Path) -> None:
    from nbavatar.config.figures import read_figures

    read_figures(path)


def _run(path: Path) -> None:
    from nbavatar.cli.common import read_mapping
    from nbavatar.config.run import load_run, stage_options

    run = load_run(read_mapping(str(path), "--configfile"), str(path))
    json.dumps([stage_options(run, "train", name) for name in run.variants], sort_keys=True)


def _sheet(path: Path) -> None:
    from nbavatar.cli.common import read_mapping
    from nbavatar.config.tradeoff import read_sheet

    read_sheet(read_mapping(str(path), "--sheet"), "--sheet")


def _options(path: Path) -> None:
    from nbavatar.cli.common import read_mapping
    from nbavatar.config.core import from_mapping
    from nbavatar.config.training import TrainConfig

    from_mapping(TrainConfig, read_mapping(str(path), "--cfg"), "--cfg")


def _printed(path: Path) -> None:
    from nbavatar.cli.table import _read_printed
    from nbavatar.reporting.printed import deviating_marks, deviating_means

    cells = _read_printed(str(path))
    for table in cells["table"].unique():
        deviating_means(cells, table, ["S1", "S2"]), deviating_marks(cells, table, second=True)


def _table(path: Path) -> None:
    from nbavatar.cli.results import read_results
    from nbavatar.config.tables import read_tables
    from nbavatar.reporting.cells import Source
    from nbavatar.reporting.formats import to_csv, to_latex, to_markdown
    from nbavatar.reporting.printed import read_printed
    from nbavatar.reporting.results import tidy_results
    from nbavatar.reporting.tables import build_table

    results = read_results([str(path)])
    tidy_results(results)
    printed = read_printed(["table,row,column,value,mark,note"], "printed")
    for name, layout in read_tables(path.with_name("tables.yaml")).items():
        table = build_table(name, layout, printed, results, printed_source=Source("printed", "0"))
        to_csv(table), to_markdown(table), to_latex(table)


def _report(path: Path) -> None:
    from nbavatar.cli.results import read_evaluation
    from nbavatar.reporting.page import pareto_section, provenance_section

    content = read_evaluation(str(path))
    pareto_section([content], [("full", seeds.timing())])
    provenance_section([(str(path), content)])


def _speeds(path: Path) -> None:
    from nbavatar.cli.results import read_timing
    from nbavatar.reporting.page import pareto_section, provenance_section

    content = read_timing(str(path))
    pareto_section([seeds.evaluation()], [("full", content)])
    provenance_section([(str(path), content)])


def _histories(path: Path) -> None:
    from nbavatar.cli.results import read_histories
    from nbavatar.reporting.page import curves_section

    curves_section(read_histories([str(path)]))


def _sweep(path: Path) -> None:
    from nbavatar.cli.results import read_sweep
    from nbavatar.studies.tradeoff.section import offline_section, savings_section, tradeoff_section

    kind, content = read_sweep(path)
    {"tradeoff": tradeoff_section, "savings": savings_section, "offline": offline_section}[kind](content, "| a |")


def _presets(path: Path) -> None:
    from nbavatar.studies.tradeoff.presets import budget_setting, preset_setting

    preset_setting(path, "fast", model="m", device="cpu")
    budget_setting(path, model="m", device="cpu", size=(32, 32), max_ms=5.0, min_psnr=None)


def _points(path: Path) -> None:
    from nbavatar.studies.tradeoff.front import Point
    from nbavatar.studies.tradeoff.sweep import PointLog

    known = PointLog(path).get("k0")
    if known is not None:
        point = Point.of(known, str(path))
        repr((point.ms, point.speedup))


def _mesh_file(path: Path) -> None:
    from nbavatar.io.meshfiles import read_mesh_file

    read_mesh_file(path)


def _imported(path: Path) -> None:
    from nbavatar.data.foreign.colmap import read_colmap
    from nbavatar.data.foreign.nerfstudio import read_nerfstudio
    from nbavatar.data.foreign.source import grid
    from nbavatar.data.foreign.vhap import read_vhap

    root = next(parent for parent in path.parents if (parent / "IS").is_file())
    what = (root / "IS").read_text()
    if what == "vhap":
        source = read_vhap(root, flame=root / "flame.pkl", within=None, pixel_center=0.5)
    else:
        read = read_nerfstudio if what == "nerfstudio" else read_colmap
        source, _ = read(root, names=None, within=None, pixel_center=0.5)
    grid(source)
    if source.meshes is not None:
        source.meshes.topology()
        source.meshes.vertices(source.shots[0].frame)


def _wheel(path: Path) -> None:
    from nbavatar.data import detector_models as models

    # The digests of the good file instead of MediaPipe's: what comes after them is to be seen too.
    files = {name: (file, hashlib.sha256(seeds.WEIGHTS).hexdigest()) for name, (file, _) in models._FILES.items()}
    with mock.patch.dict(models._FILES, files):
        models.read_detector_models(path)


READERS = {
    "arrays, stored": Reader(lambda d: seeds.arrays(d, np.savez), _arrays, "zip"),
    "arrays, compressed": Reader(lambda d: seeds.arrays(d, np.savez_compressed), _arrays, "zip"),
    "arrays, raw damage": Reader(lambda d: seeds.arrays(d, np.savez_compressed), _arrays, "bytes"),
    "mesh sequence": Reader(seeds.mesh_sequence, _sequence, "zip"),
    "frame pack": Reader(seeds.frame_pack, _frame_pack, "zip"),
    "vertex maps": Reader(seeds.vertex_maps, _vertex_maps, "zip"),
    "model.pt, billboards": Reader(lambda d: seeds.avatar(d, "billboards"), _avatar, "zip"),
    "model.pt, GaussianAvatars": Reader(lambda d: seeds.avatar(d, "gaussian_avatars"), _avatar, "zip"),
    "model.pt, after InteractAvatar": Reader(lambda d: seeds.avatar(d, "interact_avatar"), _avatar, "zip"),
    "model.pt, SplattingAvatar": Reader(lambda d: seeds.avatar(d, "splatting_avatar"), _avatar, "zip"),
    "state.pt": Reader(seeds.state, _state, "zip"),
    "events.jsonl of a training": Reader(lambda d: seeds.state(d).with_name("events.jsonl"), _state, "json", False),
    "key.json of a training": Reader(lambda d: seeds.state(d).with_name("key.json"), _state, "json", False),
    **{f"pickle, protocol {p}": Reader(lambda d, p=p: seeds.pickled(d, p), _pickle, "bytes") for p in (0, 2, 4, 5)},
    "array.npy": Reader(seeds.npy, _array, "bytes"),
    "array.npy of objects": Reader(seeds.npy_objects, _array, "bytes"),
    "FLAME model": Reader(seeds.flame, _flame, "bytes"),
    "MANO model": Reader(seeds.mano, _mano, "bytes"),
    "landmarks": Reader(seeds.landmarks, _landmarks, "bytes"),
    "Decaf cameras.pkl": Reader(lambda d: seeds.decaf(d, "cameras/S2/cameras.pkl"), _decaf, "bytes"),
    "Decaf params.pkl": Reader(lambda d: seeds.decaf(d, "params/S2/params_smoothed.pkl"), _decaf, "bytes"),
    "Decaf cuts": Reader(lambda d: seeds.decaf(d, "cutIDs/S2.pkl"), _decaf, "bytes"),
    "Decaf keypoints": Reader(lambda d: seeds.decaf(d, "head_keys/S2/084.npy"), _decaf, "bytes"),
    "picture, png": Reader(lambda d: seeds.picture(d, "png"), _colours, "bytes"),
    "picture, jpeg": Reader(lambda d: seeds.picture(d, "jpg"), _colours, "bytes"),
    "picture, webp": Reader(lambda d: seeds.picture(d, "webp"), _colours, "bytes"),
    "mask, png": Reader(seeds.mask, _plane, "bytes"),
    "picture of a result": Reader(lambda d: seeds.picture(d, "png"), _decoded, "bytes"),
    "video": Reader(seeds.video, _video, "bytes"),
    "cameras.json": Reader(lambda d: seeds.capture(d, "cameras.json"), _capture, "json"),
    "splits.json": Reader(lambda d: seeds.capture(d, "splits.json"), _capture, "json"),
    "topology.npz": Reader(lambda d: seeds.capture(d, "meshes/topology.npz"), _capture, "zip"),
    "mesh of a frame": Reader(lambda d: seeds.capture(d, "meshes/t0.npz"), _capture, "zip"),
    "captures of a run": Reader(lambda d: seeds.capture(d, "cameras.json"), _captures, "json"),
    "subjects.tsv": Reader(lambda d: seeds.config(d, "subjects.tsv"), _subjects, "text"),
    "runs.tsv": Reader(lambda d: seeds.config(d, "runs.tsv"), _rows, "text"),
    "tables.yaml": Reader(lambda d: seeds.config(d, "tables.yaml", 2), _tables, "text", heavy=True),
    "figures.yaml": Reader(lambda d: seeds.config(d, "figures.yaml"), _figures, "text", heavy=True),
    "run.yaml": Reader(lambda d: seeds.config(d, "smoke.yaml"), _run, "text", heavy=True),
    "tradeoff.yaml": Reader(lambda d: seeds.config(d, "tradeoff.yaml"), _sheet, "text", heavy=True),
    "options.json": Reader(seeds.options, _options, "json"),
    "reported.csv": Reader(lambda d: seeds.config(d, "reported.csv"), _printed, "text", heavy=True),
    "evaluation for a table": Reader(seeds.evaluation_file, _table, "json", heavy=True),
    "timing for a table": Reader(seeds.timing_file, _table, "json", heavy=True),
    "evaluation for a report": Reader(seeds.evaluation_file, _report, "json"),
    "timing for a report": Reader(seeds.timing_file, _speeds, "json"),
    "history.jsonl": Reader(seeds.history, _histories, "json"),
    "tradeoff.json": Reader(lambda d: seeds.sweep(d, "tradeoff"), _sweep, "json"),
    "savings.json": Reader(lambda d: seeds.sweep(d, "savings"), _sweep, "json"),
    "offline.json": Reader(lambda d: seeds.sweep(d, "offline"), _sweep, "json"),
    "presets.json": Reader(seeds.presets, _presets, "json"),
    "points.jsonl": Reader(seeds.points, _points, "json"),
    "mesh.obj": Reader(lambda d: seeds.mesh_file(d, "obj"), _mesh_file, "text"),
    "mesh.ply": Reader(lambda d: seeds.mesh_file(d, "ply"), _mesh_file, "bytes"),
    "nerfstudio transforms.json": Reader(
        lambda d: seeds.foreign(d, "nerfstudio", "transforms.json"), _imported, "json"
    ),
    "VHAP transforms.json": Reader(
        lambda d: seeds.foreign(d, "vhap", "transforms.json"), _imported, "json", heavy=True
    ),
    "VHAP flame_param": Reader(lambda d: seeds.foreign(d, "vhap", "flame_param/*.npz"), _imported, "zip", heavy=True),
    "COLMAP cameras.bin": Reader(lambda d: seeds.foreign(d, "colmap", "cameras.bin"), _imported, "bytes"),
    "COLMAP images.bin": Reader(lambda d: seeds.foreign(d, "colmap", "images.bin"), _imported, "bytes"),
    "COLMAP cameras.txt": Reader(lambda d: seeds.foreign(d, "colmap text", "cameras.txt"), _imported, "text"),
    "COLMAP images.txt": Reader(lambda d: seeds.foreign(d, "colmap text", "images.txt"), _imported, "text"),
    "wheel of the detector": Reader(seeds.wheel, _wheel, "zip"),
}
