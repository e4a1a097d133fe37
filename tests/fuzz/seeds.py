"""Good files of every kind that is read, small; the damage is done to copies (`tests.fuzz.mutations`)."""

import json
import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import scipy.sparse
import torch
from PIL import Image

from nbavatar.data.synthetic.models import load_human
from tests.scenes import toy
from tests.unit.data import tiny

HEAD_FACES = tiny.HEAD_VERTS
PICTURE = (24, 16)
WEIGHTS = b"weights " * 50
CONFIG = Path(__file__).parents[2] / "config"


def arrays(folder: Path, save: Callable[..., None]) -> Path:
    path = folder / "a.npz"
    rng = np.random.default_rng(0)
    save(path, verts=rng.normal(size=(20, 3)).astype(np.float32), faces=np.arange(30).reshape(10, 3), text=["a", "b"])
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("record.json", json.dumps({"command": "x", "units": {"length": "m"}}))
    return path


def mesh_sequence(folder: Path) -> Path:
    from nbavatar.data.sequences import write_sequence

    write_sequence(folder / "meshes.npz", toy.sequence(), {"command": "x"})
    return folder / "meshes.npz"


def frame_pack(folder: Path) -> Path:
    return Path(toy.write_scene(folder, size=16)["packs"][0])


def vertex_maps(folder: Path) -> Path:
    from nbavatar.io.exr import write_vertex_maps

    values = np.random.default_rng(0).normal(size=(3, 7, 3)).astype(np.float32)
    path = folder / "out.exr.zip"
    write_vertex_maps(path, {"head.position": values, "head.displacement": 0.1 * values}, ["a", "b", "c"], {"x": 1})
    return path


def avatar(folder: Path, method: str) -> Path:
    from nbavatar.methods.storage import save_avatar

    save_avatar(folder / "model.pt", _avatar(method))
    return folder / "model.pt"


def _avatar(method: str) -> Any:
    from nbavatar.methods.billboards.architecture import Architecture
    from nbavatar.methods.billboards.avatar import Avatar
    from nbavatar.methods.billboards.billboards import Billboards
    from nbavatar.methods.billboards.refine import Refinement
    from nbavatar.methods.gaussian_avatars.avatar import GaussianAvatars
    from nbavatar.methods.interact_avatar.avatar import InteractAvatar
    from nbavatar.methods.interact_avatar.posture import learn_posture
    from nbavatar.methods.splatting_avatar.avatar import SplattingAvatar

    faces = {"head": torch.from_numpy(toy.OCTAHEDRON_FACES)}
    if method == "gaussian_avatars":
        return GaussianAvatars(faces, {"head": 6}, colour=torch.zeros(8, 3), opacity=0.1, sh_degree=1)
    if method == "interact_avatar":
        posture = learn_posture(toy.OCTAHEDRON, toy.OCTAHEDRON[None], 2)
        parts = ("head", "right_hand")
        return InteractAvatar(
            dict.fromkeys(parts, faces["head"]), dict.fromkeys(parts, 6), postures=dict.fromkeys(parts, posture),
            width=2, features=2, points=3, reach=0.1, colour=torch.zeros(16, 3), opacity=0.1, sh_degree=1,
        )  # fmt: skip
    if method == "splatting_avatar":
        return SplattingAvatar(
            faces, {"head": 6}, rest=torch.from_numpy(toy.OCTAHEDRON), face=torch.arange(8),
            bary=torch.full((8, 3), 1 / 3), log_scale=torch.full((8, 3), -4.0), opacity=0.1, sh_degree=0, mode="paper",
        )  # fmt: skip
    billboards = Billboards(torch.full((8, 2), 0.7), torch.randn(8, 2, 2, 4), torch.randn(8, 2, 2))
    refinement = Refinement(["a", "b"], {"head": torch.randn(6, 2)}, rigid=True)
    architecture = Architecture(4, 2, True, 2, 1, 16, 1, True, 0.1, "ray")
    return Avatar(architecture, faces, {"head": 6}, billboards, refinement=refinement, record={"command": "x"})


def state(folder: Path) -> Path:
    from nbavatar.training.state import RunFolder

    run = RunFolder(folder / "model.pt.state", {"key": 1})
    model = _avatar("gaussian_avatars")
    run.save(
        {
            "model": model.state_dict(),
            "method": {},
            "optimizer": {"m": [torch.zeros(3)]},
            "muon": {"momentum": {0: torch.zeros(2, 3)}},
            "step": 5,
            "seconds": 1.0,
        }
    )
    for step in (1, 3, 7):
        run.log({"step": step, "loss": 0.5, "psnr": 20.0})
    return run.path / "state.pt"


def pickled(folder: Path, protocol: int) -> Path:
    rng = np.random.default_rng(0)
    value = {
        "084": {"K": rng.normal(size=(3, 3)), "list": [1, (2, "x"), None, 2.5, 1 << 70, {3, 4}]},
        7: OrderedDict(a=np.float32(2.5), b=np.arange(5)[::2], c=np.asfortranarray(rng.normal(size=(2, 3)))),
        "sparse": scipy.sparse.csc_matrix(np.eye(3)),
        "tensor": torch.arange(6).reshape(2, 3),
        "bytes": b"\x00\xff",
        "objects": np.array([{"x": 1}, "t", None], dtype=object),
    }
    path = folder / "a.pkl"
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    return path


def npy(folder: Path) -> Path:
    np.save(folder / "a.npy", np.random.default_rng(0).normal(size=(4, 3)))
    return folder / "a.npy"


def npy_objects(folder: Path) -> Path:
    np.save(folder / "o.npy", np.array({"a": np.arange(4), "b": torch.ones(2)}, dtype=object), allow_pickle=True)
    return folder / "o.npy"


def _small_decaf(folder: Path) -> Path:
    if not (folder / "assets").is_dir():
        tiny.write_decaf(folder)
    return folder


def decaf(folder: Path, name: str) -> Path:
    return _small_decaf(folder) / "train" / name


def flame(folder: Path) -> Path:
    return _model(folder, [tiny.ROOT, 0, 1, 1, 1])


def mano(folder: Path) -> Path:
    return _model(folder, [tiny.ROOT, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14])


def _model(folder: Path, parents: list) -> Path:
    directions = 305 if len(parents) == 5 else 10
    content = tiny.model(np.random.default_rng(9), parents, 12, directions, 0.1) | {"tip_vertices": np.arange(5)}
    if len(parents) == 16:
        content |= {"hands_mean": np.zeros(45), "hands_components": np.eye(45), "hands_coeffs": np.zeros((2, 45))}
    path = folder / "model.pkl"
    path.write_bytes(pickle.dumps(content, protocol=2))
    return path


def landmarks(folder: Path) -> Path:
    return _small_decaf(folder) / "assets" / "landmark_embedding.npy"


def picture(folder: Path, suffix: str) -> Path:
    y, x = np.mgrid[0 : PICTURE[1], 0 : PICTURE[0]]
    pixels = np.stack([10 * x, 10 * y, 5 * (x + y)], -1).astype(np.uint8)
    path = folder / f"p.{suffix}"
    exif = Image.Exif()
    exif[0x0112] = 1
    Image.fromarray(pixels).save(path, exif=exif)
    return path


def mask(folder: Path) -> Path:
    image = Image.fromarray((np.arange(PICTURE[0] * PICTURE[1]).reshape(PICTURE[::-1]) % 4).astype(np.uint8), mode="P")
    image.putpalette(bytes(range(12)))
    image.save(folder / "m.png")
    return folder / "m.png"


def video(folder: Path) -> Path:
    path = folder / "v.mp4"
    tiny.write_video(path, [tiny.frame_image(i) for i in range(4)])
    return path


def capture(folder: Path, name: str) -> Path:
    if not (folder / "cameras.json").is_file():
        tiny.write_capture(folder, frames=2, width=24, height=20)
        cameras = json.loads((folder / "cameras.json").read_text())
        cameras["left"]["distortion"] = [0.1, -0.05, 0.001, 0.002]
        (folder / "cameras.json").write_text(json.dumps(cameras))
        splits = {
            "frames": ["t0", "t1"],
            "train": ["t0"],
            "test": ["t1"],
            "cuts": [["t0", "t1"]],
            "test_camera": "left",
        }
        (folder / "splits.json").write_text(json.dumps(splits))
    return folder / name


def config(folder: Path, name: str, entries: int = 0) -> Path:
    """One of the project's own files, or its first entries only: YAML takes its time."""
    lines = (CONFIG / name).read_text(encoding="utf-8").splitlines()
    tops = [number for number, line in enumerate(lines) if line[:1].isalpha()]
    kept = lines[: tops[entries]] if entries else lines
    (folder / name).write_text("\n".join(kept) + "\n", encoding="utf-8")
    return folder / name


def options(folder: Path) -> Path:
    from nbavatar.config.core import to_mapping
    from nbavatar.config.training import TrainConfig

    (folder / "o.json").write_text(json.dumps(to_mapping(TrainConfig())))
    return folder / "o.json"


def evaluation() -> dict[str, Any]:
    values = {"psnr": 20.5, "ssim": 0.9, "lpips_alex": 0.1, "lpips_vgg": 0.2, "psnr_fg": None, "ssim_fg": 0.8}
    training = {
        "method": "billboards",
        "mode": None,
        "steps": 10,
        "train_seconds": 3.5,
        "primitives": 8,
        "model_bytes": 99,
    }
    protocol = {"name": "nv1024", "split": "novel_view", "crop": "center", "background": [1, 1, 1], "precision": "fp32"}
    return {
        "kind": "evaluation", "format": 1, "subject": "S1", "variant": "full", "protocol": protocol,
        "protocol_hash": "abc", "cameras": ["084"], "training": training, "train_cameras": ["100", "102"],
        "size": [32, 32], "count": 1, "frames": "f00", "metrics": values, "trivial": {"mean_image": values},
        "per_image": [{"camera": "084", "frame": "a", **values}],
        "record": {"code": "x", "config": {}, "git": {"commit": "c", "dirty": False}, "device": "cpu", "seed": 0,
                   "inputs": {}, "versions": {}},
    }  # fmt: skip


def timing() -> dict[str, Any]:
    speed = {"ms": {"raster": 1.5, "renderer_bf16": 2.0, "total_fp32": 4.0, "total_bf16": 3.5}, "fps": {"total": 250.0}}
    speed |= {"size": [32, 32], "primitives": 8, "method": "billboards", "model_mb": 0.1, "peak_memory_mb": 90.0}
    return {"command": "speed", "config": {}, "device": "cpu", "code": "x", "git": None, "speed": speed}


def evaluation_file(folder: Path) -> Path:
    return _result(folder, evaluation())


def timing_file(folder: Path) -> Path:
    return _result(folder, timing())


def _result(folder: Path, content: dict[str, Any]) -> Path:
    place = folder / "S1"
    place.mkdir(exist_ok=True)
    config(place, "tables.yaml", 2)
    (place / "full.json").write_text(json.dumps(content))
    return place / "full.json"


def history(folder: Path) -> Path:
    place = folder / "S1" / "full"
    place.mkdir(parents=True, exist_ok=True)
    lines = [
        {"step": i, "loss": 0.5 / i, "psnr": 20.0 + i, "rate": 1e-3, "shrink": 1, "seconds": 2.0 * i} for i in (1, 5, 9)
    ]
    (place / "history.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    return place / "history.jsonl"


def sweep(folder: Path, kind: str) -> Path:
    row = {"stage": "fit", "knob": "cameras", "meaning": "m", "value": 2, "error_mm": 1.0, "ms": 3.0}
    content = {
        "tradeoff": {
            "device": "cpu", "size": [32, 32], "images": 4, "complete": True, "paragraphs": {"order": "text"},
            "presets": {"fast": {"label": "order=center", "why": "it is"}}, "points": [],
        },
        "savings": {"rows": [{"saving": "roi", "scene": "small", "faster": 2.5}]},
        "offline": {"rows": [row]},
    }[kind]  # fmt: skip
    (folder / f"{kind}.json").write_text(json.dumps({"kind": kind, "format": 1, **content}))
    return folder / f"{kind}.json"


def _point(label: str, ms: float) -> dict[str, Any]:
    from nbavatar.config.core import to_mapping
    from nbavatar.config.tradeoff import SettingConfig

    values = {"psnr": 30.0, "lpips": 0.1, "speedup": 1.5, "ms": {"total": ms}, "steady_ms": ms, "exact_ms": 6.0}
    return {"model": "full", "label": label, "setting": to_mapping(SettingConfig()), "values": values}


def presets(folder: Path) -> Path:
    points = [_point("exact", 6.0), _point("fast", 3.0)]
    entry = {"device": "cpu", "size": [32, 32], "points": points, "importance": [1.0, 2.0],
             "presets": {"fast": points[1] | {"why": "it is the fastest", "speedup": 2.0}}}  # fmt: skip
    content = {"kind": "nbavatar presets", "format": 1, "model": "m", "measured": [entry]}
    (folder / "presets.json").write_text(json.dumps(content))
    return folder / "presets.json"


def points(folder: Path) -> Path:
    lines = [json.dumps({"key": f"k{i}", **_point(f"p{i}", 2.0 + i)}) for i in range(3)]
    (folder / "points.jsonl").write_text("\n".join(lines) + "\n")
    return folder / "points.jsonl"


def mesh_file(folder: Path, suffix: str) -> Path:
    import trimesh

    trimesh.Trimesh(toy.OCTAHEDRON, toy.OCTAHEDRON_FACES, process=False).export(folder / f"m.{suffix}")
    return folder / f"m.{suffix}"


def foreign(folder: Path, what: str, name: str) -> Path:
    from tests.scenes import foreign as written

    def heads(*, teeth: bool = False) -> tuple[list, list]:
        """Heads that need no other package; where they are does not matter here."""
        verts = load_human("tiny").head
        parameters = [written.flame_parameters(time, len(verts), teeth=teeth) for time in range(written.TIMES)]
        return parameters, [verts + 0.001 * time for time in range(written.TIMES)]

    root = folder / what
    if not root.is_dir():
        with mock.patch.object(written, "heads", heads):
            _write_foreign(root, what)
    found = sorted(root.rglob(name))
    assert found, (what, name)
    return found[0]


def _write_foreign(root: Path, what: str) -> None:
    from tests.scenes import foreign as written

    if what == "vhap":
        written.write_vhap(root)
        written.write_flame(root / "flame.pkl")
    elif what == "nerfstudio":
        written.write_nerfstudio(root, lens=written.LENS)
    else:
        written.write_colmap(root, binary="text" not in what)
    (root / "IS").write_text(what)


def wheel(folder: Path) -> Path:
    from nbavatar.data import detector_models as models

    path = folder / "mediapipe.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for file, _ in models._FILES.values():
            archive.writestr(f"{models._FOLDER}/{file}", WEIGHTS)
    return path
