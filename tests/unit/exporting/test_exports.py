"""Exported files, read by independent readers: the format's own description, plyfile, trimesh, safetensors, ONNX."""

import dataclasses
import json
import struct

import numpy as np
import plyfile
import pytest
import safetensors
import torch
import trimesh
from torch.nn import functional

from nbavatar.cli import main
from nbavatar.data.lights import Light
from nbavatar.data.sequences import MeshSequence, read_sequence, write_sequence
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.shading import Shading
from nbavatar.methods.storage import load_avatar, save_avatar
from nbavatar.rendering.gaussians.functional import render_gaussians
from tests.scenes.toy import sequence
from tests.unit.methods.billboards.test_model import make_avatar
from tests.unit.methods.gaussians.test_avatars import bound, embedded
from tests.unit.methods.interact_avatar.scenes import made, stirred

VIEW = torch.eye(4)
VIEW[2, 3] = 1.0
K = torch.tensor([[90.0, 0, 24], [0, 90.0, 24], [0, 0, 1]])


@pytest.fixture
def meshes(tmp_path):
    """The toy scene with contact in one frame, and with a hand that is not in the last one."""
    toy = sequence()
    toy.parts["right_hand"].verts[3] = np.nan
    contact = {f"contact.{name}": np.zeros((4, len(part.rest)), bool) for name, part in toy.parts.items()}
    contact["contact.right_hand"][1, 2] = True
    path = tmp_path / "meshes.npz"
    write_sequence(path, MeshSequence(toy.frames, toy.parts, contact), {})
    return path


def export(*words) -> int:
    return main(["export", *map(str, words)])


def read_splats(path) -> dict[str, np.ndarray]:
    """A 3DGS file by the description of the format: a text header, then float32 rows."""
    content = path.read_bytes()
    header, body = content.split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    rows = struct.iter_unpack(f"<{len(names)}f", body)
    table = np.array(list(rows), np.float32)
    assert table.shape == (count, len(names))
    return dict(zip(names, table.T, strict=True))


@pytest.mark.parametrize("kind", ["bound", "touched", "paper", "released"])
def test_splats_are_what_viewers_of_3dgs_expect(tmp_path, meshes, kind) -> None:
    whole = sequence()
    if kind == "touched":
        avatar = stirred(made(whole)).avatar
    else:
        avatar = bound() if kind == "bound" else embedded(kind)
    avatar.degree.fill_(avatar.sh_degree)
    with torch.no_grad():
        avatar.colour.normal_()
        avatar.colour_rest.normal_()
        avatar.log_scale.sub_(1.0 if kind == "bound" else 0.0)
    save_avatar(tmp_path / "model.pt", avatar)
    out = tmp_path / "splats"
    assert export(tmp_path / "model.pt", "--to", "splats", "--meshes", meshes, "--out", out, "--frames", "f2") == 0
    assert [path.name for path in out.iterdir()] == ["f2.ply"]
    read = read_splats(out / "f2.ply")
    expected = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    assert list(read) == [*expected, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    again = plyfile.PlyData.read(out / "f2.ply")["vertex"]
    assert all(np.array_equal(again[name], value) for name, value in read.items())

    def table(name: str, count: int) -> torch.Tensor:
        return torch.from_numpy(np.stack([read[f"{name}_{i}"] for i in range(count)], 1))

    # Activations of the reference code; the higher harmonics lie colour by colour.
    harmonics = torch.cat((table("f_dc", 3)[:, None], table("f_rest", 45).reshape(-1, 3, 15).transpose(1, 2)), 1)
    means = torch.from_numpy(np.stack([read[axis] for axis in "xyz"], 1))
    picture = render_gaussians(
        means, table("rot", 4), table("scale", 3).exp(), torch.from_numpy(read["opacity"]).sigmoid(), harmonics,
        VIEW, K, 48, 48, sh_degree=3,
    )  # fmt: skip
    verts = {part: torch.from_numpy(whole.parts[part].verts[2]) for part in avatar.parts}
    with torch.no_grad():
        own, alpha, _ = avatar.render(verts, VIEW, K, 48, 48, torch.zeros(3))
    assert float(alpha.max()) > 0.05 and len(means) == avatar.primitives
    torch.testing.assert_close(picture.colour, own, atol=2e-5, rtol=0)


def glb(path) -> tuple[dict, list[np.ndarray]]:
    """Document and accessors of a .glb, by the specification of glTF 2.0."""
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    document = json.loads(content[20 : 20 + size])
    binary_size, binary_kind = struct.unpack_from("<I4s", content, 20 + size)
    assert (kind, binary_kind) == (b"JSON", b"BIN\0")
    binary = content[28 + size : 28 + size + binary_size]
    kinds = {5126: "<f4", 5125: "<u4"}
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
    arrays = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        count = accessor["count"] * width[accessor["type"]]
        values = np.frombuffer(binary, kinds[accessor["componentType"]], count, view["byteOffset"])
        arrays.append(values.reshape(accessor["count"], -1))
        if "min" in accessor:
            assert arrays[-1].min(0).tolist() == accessor["min"] and arrays[-1].max(0).tolist() == accessor["max"]
    return document, arrays


def test_animated_meshes_pass_through_every_frame(tmp_path, meshes) -> None:
    assert export("--to", "meshes", "--meshes", meshes, "--out", tmp_path / "m.glb", "--fps", 10) == 0
    document, arrays = glb(tmp_path / "m.glb")
    stored, _ = read_sequence(meshes)
    (animation,) = document["animations"]
    (sampler,) = animation["samplers"]
    np.testing.assert_allclose(arrays[sampler["input"]][:, 0], np.arange(4) / 10)
    weights = arrays[sampler["output"]].reshape(4, 3)
    assert [node["name"] for node in document["nodes"]] == ["head", "right_hand"]
    for node, mesh in zip(document["nodes"], document["meshes"], strict=True):
        (primitive,) = mesh["primitives"]
        base = arrays[primitive["attributes"]["POSITION"]]
        targets = np.stack([arrays[target["POSITION"]] for target in primitive["targets"]])
        shown = base + np.einsum("nk,kvi->nvi", weights, targets)
        verts = stored.parts[node["name"]].verts
        there = np.isfinite(verts).all((1, 2))
        np.testing.assert_allclose(shown[there], verts[there], atol=1e-7)
        assert np.ptp(shown[~there], axis=1).max(initial=0) == 0, "a part that is not there is a point"
        assert arrays[primitive["indices"]].reshape(-1, 3).tolist() == stored.parts[node["name"]].faces.tolist()
    colours = arrays[document["meshes"][1]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (colours[2] != colours[0]).any() and (colours[[0, 1, 3]] == colours[0]).all()
    scene = trimesh.load(tmp_path / "m.glb", process=False)
    np.testing.assert_allclose(scene.geometry["head"].vertices, stored.parts["head"].verts[0], atol=1e-7)


@pytest.mark.parametrize("kind", ["obj", "ply", "glb"])
def test_mesh_files_of_frames_are_read_by_trimesh(tmp_path, meshes, kind) -> None:
    out = tmp_path / "out"
    assert export("--to", "meshes", "--meshes", meshes, "--out", out, "--type", kind, "--frames", "1:4:2") == 0
    assert sorted(path.name for path in out.iterdir()) == [f"f1.{kind}", f"f3.{kind}"]
    stored, _ = read_sequence(meshes)
    for row in (1, 3):
        parts = [part for part in stored.parts.values() if np.isfinite(part.verts[row]).all()]
        scene = trimesh.load_scene(out / f"f{row}.{kind}", process=False)
        named = [scene.geometry[name] for name in ("head", "right_hand") if name in scene.geometry]
        mesh = trimesh.util.concatenate(named or list(scene.geometry.values()))
        np.testing.assert_allclose(mesh.vertices, np.concatenate([p.verts[row] for p in parts]), atol=1e-7)
        starts = np.cumsum([0, *(len(p.rest) for p in parts)])
        faces = np.concatenate([p.faces + start for p, start in zip(parts, starts)])
        assert np.array_equal(mesh.faces, faces)
        if row == 1 and kind != "glb":  # of which the animated file above is checked
            colours = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(int)
            assert [i for i in range(len(colours)) if abs(colours[i] - colours[0]).max() > 1] == [8]
    if kind == "ply":
        vertex = plyfile.PlyData.read(out / "f1.ply")["vertex"]
        assert np.flatnonzero(vertex["contact"]).tolist() == [8]


def test_billboards_as_quads_have_the_rasterizers_texels_and_places(tmp_path, meshes) -> None:
    avatar = make_avatar(deferred=False)
    save_avatar(tmp_path / "model.pt", avatar)
    assert export(tmp_path / "model.pt", "--to", "billboards", "--meshes", meshes, "--out", tmp_path / "b.glb") == 0
    document, arrays = glb(tmp_path / "b.glb")
    primitive = document["meshes"][0]["primitives"][0]
    assert document["materials"][0]["alphaMode"] == "BLEND" and len(primitive["targets"]) == 3
    mesh = trimesh.load(tmp_path / "b.glb", process=False, force="mesh")
    picture = mesh.visual.material.baseColorTexture
    texture = torch.from_numpy(np.array(picture)).float() / 255
    uv = torch.from_numpy(arrays[primitive["attributes"]["TEXCOORD_0"]].copy()).reshape(12, 4, 2)
    position = torch.from_numpy(arrays[primitive["attributes"]["POSITION"]].copy()).reshape(12, 4, 3)
    stored, _ = read_sequence(meshes)
    with torch.no_grad():
        posed, _ = avatar.pose({n: torch.from_numpy(p.verts[0]) for n, p in stored.parts.items()}, None)
        features, opacity = avatar.textures()
    torch.testing.assert_close(position.mean(1), posed.means, atol=1e-6, rtol=0)
    texels = torch.cat((features, opacity[..., None]), -1)
    support = 1 + 2 / (opacity.shape[1] - 1)
    sides = torch.stack(
        ((position[:, 1] - position[:, 0]).norm(dim=1), (position[:, 3] - position[:, 0]).norm(dim=1)), 1
    )
    torch.testing.assert_close(sides, 2 * support * posed.half_extents, atol=1e-6, rtol=1e-5)
    # Points of every quad: by the file's texture as a graphics card filters it, and as the rasterizer samples.
    place = torch.rand(12, 50, 2)
    at = uv[:, 0, None] + place * (uv[:, 2] - uv[:, 0])[:, None]
    shown = functional.grid_sample(texture.permute(2, 0, 1)[None], (2 * at - 1)[None], align_corners=False)[0]
    own = functional.grid_sample(texels.permute(0, 3, 1, 2), support * (2 * place - 1)[:, None], align_corners=True)
    torch.testing.assert_close(shown.permute(1, 2, 0), own[:, :, 0].transpose(1, 2), atol=1.5 / 255, rtol=0)


def test_tensors_build_the_avatar_again_by_the_schema(tmp_path, meshes) -> None:
    avatar = make_avatar()
    save_avatar(tmp_path / "model.pt", avatar)
    assert export(tmp_path / "model.pt", "--to", "tensors", "--out", tmp_path / "a.safetensors") == 0
    with safetensors.safe_open(tmp_path / "a.safetensors", "pt") as stored:
        facts, tensors = stored.metadata(), {name: stored.get_tensor(name) for name in stored.keys()}
    parts = json.loads(facts["parts"])
    content = {
        "kind": facts["kind"], "format": int(facts["format"]), "method": facts["method"],
        "faces": {part: tensors[f"faces.{part}"] for part in parts},
        "vertex_counts": json.loads(facts["vertex_counts"]), "record": facts["record"],
        "state": {n.removeprefix("state."): v for n, v in tensors.items() if n.startswith("state.")},
        **json.loads(facts["content"]),
    }  # fmt: skip
    torch.save(content, tmp_path / "again.pt")
    again = load_avatar(tmp_path / "again.pt")
    verts = {n: torch.from_numpy(p.verts[0]) for n, p in sequence().parts.items()}
    with torch.no_grad():
        pictures = [a.render(verts, VIEW, K, 48, 48, torch.ones(3))[0] for a in (avatar, again)]
    assert torch.equal(*pictures)


@pytest.mark.slow
@pytest.mark.parametrize(("form", "told"), [("paper", False), ("lean", False), ("lean", True)])
def test_decoder_gives_the_same_picture_in_onnxruntime(tmp_path, form: str, told: bool) -> None:
    import onnxruntime

    avatar = make_avatar()
    shape = dataclasses.replace(avatar.architecture, unet_form=form, normals=told, shading=told, gloss=told)
    light = Light(np.eye(3, dtype=np.float32), np.ones(3, np.float32))
    shading = Shading(light) if told else None
    avatar = Avatar(shape, avatar.part_faces(), avatar.vertex_counts, avatar.billboards, shading=shading).eval()
    save_avatar(tmp_path / "model.pt", avatar)
    assert export(tmp_path / "model.pt", "--to", "decoder", "--out", tmp_path / "d.onnx") == 0
    session = onnxruntime.InferenceSession(str(tmp_path / "d.onnx"), providers=["CPUExecutionProvider"])
    for height, width in ((16, 16), (40, 72)):
        features = torch.randn(1, 12 if told else 5, height, width)
        found = session.run(["colour", "opacity"], {"features": features.numpy()})
        with torch.no_grad():
            expected = avatar.unet(features)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b.numpy(), atol=2e-6)  # float32 sums in another order
    stated = session.get_modelmeta().custom_metadata_map
    assert [json.loads(stated[name]) for name in ("multiple", "channels")] == [8, 4]
    assert [json.loads(stated[name]) for name in ("normals", "shading", "gloss")] == [told] * 3


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--to", "splats", "--out", "x"], "--meshes: expected a mesh sequence for --to splats"),
        (["--to", "splats", "--meshes", "M", "--out", "x"], "billboards are no Gaussians"),
        (["--to", "billboards", "--meshes", "M", "--out", "x"], "viewers cannot run it"),
        (["--to", "meshes", "--meshes", "M", "--out", "x.ply"], "expected a folder for 4 frames"),
        (["--to", "meshes", "--meshes", "M", "--out", "x", "--frames", "f9"], "frame f9: expected a frame"),
        (["--to", "meshes", "--meshes", "M", "--out", "x", "--frames", "a:b"], "first:last:step in whole numbers"),
        (["--to", "tensors", "--out", "x.pt"], "expected a name that ends in .safetensors"),
    ],
)
def test_what_cannot_be_exported_is_one_line(tmp_path, meshes, capsys, words, line) -> None:
    save_avatar(tmp_path / "model.pt", make_avatar())
    words = [str(meshes) if w == "M" else str(tmp_path / w) if w.startswith("x") else w for w in words]
    assert export(tmp_path / "model.pt", *words) == 2
    printed = capsys.readouterr().err.strip()
    assert line in printed and "\n" not in printed
    assert not list(tmp_path.glob("x*"))
