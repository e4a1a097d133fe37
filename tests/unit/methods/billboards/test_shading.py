"""The studio's light as a channel of the decoder: values, files, parts that are absent, faces that were pruned."""

import dataclasses

import numpy as np
import pytest
import torch

from nbavatar.data.lights import Light
from nbavatar.data.sequences import Part
from nbavatar.errors import DataError
from nbavatar.math.directions import sphere_directions
from nbavatar.mesh.incidence import incidence
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.compression.reduce import keep_billboards, keep_parts
from nbavatar.methods.billboards.initial import initial_avatar
from nbavatar.methods.billboards.refine import Refinement
from nbavatar.methods.billboards.shading import Shading
from nbavatar.methods.storage import load_avatar, save_avatar
from tests.scenes.toy import sequence
from tests.unit.mesh.shapes import face_normals
from tests.unit.methods.billboards.test_model import VERTS, make_avatar, render
from tests.unit.training.test_loop import CONFIG

LIGHT = Light(sphere_directions(5).astype(np.float32), np.array([0.5, 0.0, 1.5, 1.2, 0.8], np.float32))
# The hand lies between one of the head's faces and the strongest of the lights.
FACE = 0.05 * torch.sign(torch.from_numpy(LIGHT.directions[2]))
HAND = FACE + 0.15 * torch.from_numpy(LIGHT.directions[2]) - torch.tensor([0.2, 0.0, 0.0])
CLOSE = {"head": VERTS["head"], "right_hand": VERTS["right_hand"] + HAND}


def lit_avatar(*, normals: bool = True) -> Avatar:
    """`make_avatar` with a decoder that is told of the light."""
    avatar = make_avatar()
    shape = dataclasses.replace(avatar.architecture, normals=normals, shading=True)
    lit = Avatar(shape, avatar.part_faces(), avatar.vertex_counts, avatar.billboards, shading=Shading(LIGHT))
    return lit.eval()


def _told(avatar: Avatar, verts) -> torch.Tensor:
    with torch.no_grad():
        return avatar.pose(verts)[0].light


@pytest.mark.parametrize("normals", [False, True])
def test_the_decoder_is_told_how_much_light_each_face_gets(normals: bool) -> None:
    avatar = lit_avatar(normals=normals)
    told = _told(avatar, CLOSE)
    assert told.shape == (12, 4 if normals else 1) and not told.requires_grad
    points, faces = torch.cat(list(CLOSE.values())).numpy().astype(float), avatar.faces.numpy()
    unit = face_normals(points, faces)
    reached = LIGHT.weights.astype(float) @ incidence(points, faces, unit, LIGHT.directions)
    # Normals of float32 vertices.
    np.testing.assert_allclose(((told[:, -1].numpy() + 1) / 2) ** 2.2, reached, atol=2e-6)
    if normals:
        np.testing.assert_allclose(told[:, :3].numpy(), unit, atol=1e-6)
    window = avatar.window(*avatar.pose(CLOSE), torch.eye(4), torch.eye(3), 16, 16, roi=False)
    assert window.features.shape[0] == 4 + told.shape[1]


def test_a_hand_throws_its_shadow_only_where_it_is() -> None:
    avatar = lit_avatar()
    both = _told(avatar, CLOSE)
    with torch.no_grad():
        posed, keep = avatar.pose({"head": CLOSE["head"]})
    gone = CLOSE | {"right_hand": torch.full_like(CLOSE["right_hand"], torch.nan)}
    assert keep is not None and torch.equal(posed.light, _told(avatar, gone))
    head = avatar.face_ranges()["head"]
    # The map of shadows spans both where both are there: 0.05 for its pixels.
    assert (both[head, -1] < posed.light[:, -1] + 0.05).all() and (both[head, -1] < posed.light[:, -1] - 0.1).any()


def test_what_is_remembered_is_what_would_be_computed() -> None:
    avatar = lit_avatar()
    once = _told(avatar, CLOSE)
    elsewhere = _told(avatar, VERTS)
    assert not torch.equal(once, elsewhere)
    assert torch.equal(once, _told(avatar, CLOSE)) and torch.equal(once, _told(lit_avatar(), CLOSE))
    avatar.shading.weights.copy_(avatar.shading.weights.flip(0))
    assert not torch.equal(once, _told(avatar, CLOSE))


def test_what_is_pruned_still_throws_shadows(tmp_path) -> None:
    avatar = lit_avatar()
    whole = _told(avatar, CLOSE)
    kept = torch.tensor([0, 2, 5, 7, 9])
    few = keep_billboards(keep_billboards(avatar, torch.tensor([0, 1, 2, 5, 7, 9, 10])), torch.tensor([0, 2, 3, 4, 5]))
    torch.testing.assert_close(_told(few, CLOSE), whole[kept], atol=1e-6, rtol=0)
    save_avatar(tmp_path / "few.pt", few)
    assert torch.equal(_told(load_avatar(tmp_path / "few.pt"), CLOSE), _told(few, CLOSE))
    # A part that is gone for good is gone with its shadow.
    head = keep_parts(avatar, ["head"])
    torch.testing.assert_close(_told(head, CLOSE), _told(avatar, {"head": CLOSE["head"]}), atol=1e-6, rtol=0)


def _occluders(vertex: int) -> dict[str, torch.Tensor]:
    faces = torch.tensor([[0, 1, 2], [1, 2, vertex]], dtype=torch.int32)
    return {"shading.occluders_head": faces, "shading.occluders_right_hand": faces[:1]}


def test_what_is_refined_is_lit_as_it_came() -> None:
    refinement = Refinement(["a"], {part: torch.randn(len(v), 2) for part, v in VERTS.items()}, rigid=True)
    with torch.no_grad():
        for value in refinement.parameters():
            value += 0.05 * torch.randn(value.shape)
    avatar = lit_avatar()
    avatar.refinement = refinement
    with torch.no_grad():
        plain, refined = avatar.pose(CLOSE)[0], avatar.pose(CLOSE, "a")[0]
    assert not torch.equal(plain.means, refined.means) and torch.equal(plain.light, refined.light)


def test_light_is_stored_with_the_avatar(tmp_path) -> None:
    avatar = lit_avatar()
    save_avatar(tmp_path / "model.pt", avatar)
    for a, b in zip(render(avatar, CLOSE), render(load_avatar(tmp_path / "model.pt"), CLOSE), strict=True):
        assert torch.equal(a, b)
    for change in (
        lambda c: c["state"].pop("shading.weights"),
        lambda c: c["state"].update({"shading.weights": torch.ones(4)}),
        lambda c: c["state"].update({"shading.weights": -torch.ones(5)}),
        lambda c: c["state"].update({"shading.directions": torch.full((5, 3), torch.nan)}),
        lambda c: c["state"].update({"shading.occluders_head": torch.zeros(2, 3, dtype=torch.int32)}),
        lambda c: c["state"].update(_occluders(6)),
        lambda c: c["state"].update(_occluders(-1)),
        lambda c: c["architecture"].update(shading=False),
    ):
        content = torch.load(tmp_path / "model.pt", weights_only=True)
        change(content)
        torch.save(content, tmp_path / "broken.pt")
        with pytest.raises(DataError, match=r"broken\.pt"):
            load_avatar(tmp_path / "broken.pt")


def test_a_shell_is_lit_and_throws_no_shadow(tmp_path) -> None:
    """Carved from silhouettes it is more solid than hair: skin between its locks is lit."""
    meshes = sequence()
    coords = {name: 6 * part.rest for name, part in meshes.parts.items()}
    # A larger head around the head keeps all light from it, if anything does.
    head = meshes.parts["head"]
    meshes.parts["shell"] = Part(head.faces, 1.5 * head.rest, 1.5 * head.verts)
    config = dataclasses.replace(CONFIG, billboards=dataclasses.replace(CONFIG.billboards, shading=True))
    verts = {name: torch.from_numpy(part.verts[0]) for name, part in meshes.parts.items()}
    covered = initial_avatar(meshes, coords | {"shell": coords["head"]}, meshes.frames, config, LIGHT)
    told = _told(covered, verts)[:, -1]
    del meshes.parts["shell"]
    bare = _told(initial_avatar(meshes, coords, meshes.frames, config, LIGHT), verts)[:, -1]
    # The map of shadows spans the shell too, so borders of shadows move by a pixel of it.
    assert (told[: len(bare)] - bare).abs().mean() < 0.02
    shell = covered.face_ranges()["shell"]
    assert (told[shell] > -0.9).any()
    save_avatar(tmp_path / "model.pt", covered)
    assert torch.equal(_told(load_avatar(tmp_path / "model.pt"), verts)[:, -1], told)
    solid = load_avatar(tmp_path / "model.pt")
    solid.shading = Shading(LIGHT)
    assert (_told(solid, verts)[: len(bare), -1] - bare).abs().mean() > 0.2
    kept = torch.arange(1, covered.primitives, 2)
    torch.testing.assert_close(_told(keep_billboards(covered, kept), verts)[:, -1], told[kept], atol=1e-6, rtol=0)
