"""Avatars that begin with the values of another one: what is copied, what is not, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nbavatar.cli import main
from nbavatar.cli import train as verb
from nbavatar.config.core import to_mapping
from nbavatar.config.training import TrainConfig
from nbavatar.data.sequences import MeshSequence, Part, read_sequence
from nbavatar.data.views import views_of
from nbavatar.errors import DataError
from nbavatar.io.framepack import FramePack
from nbavatar.io.records import canonical_json
from nbavatar.math.rotations import axis_angle_to_matrix, matrix_to_quaternion, quaternion_multiply
from nbavatar.methods.create import create_method
from nbavatar.methods.gaussian_avatars.options import GaussianAvatarsConfig
from nbavatar.methods.gaussians.density import densify
from nbavatar.methods.splatting_avatar.options import SplattingAvatarConfig
from nbavatar.methods.start import start_from
from nbavatar.methods.storage import load_avatar, save_avatar
from nbavatar.optimization.adam import Adam
from nbavatar.provenance import file_digest
from tests.scenes.toy import OCTAHEDRON_FACES, TETRAHEDRON, TETRAHEDRON_FACES, sequence, write_scene
from tests.scenes.training import train_config

SMALL = {"texels": 4, "unet": {"width": 4, "depth": 3, "max_width": 8, "convs": 1}}
BILLBOARDS = train_config(
    steps=4, previews=0, checkpoint_seconds=0.0, prefetch=2, coarse_side=16, weight_lpips=0.0, **SMALL
)
GAUSSIAN_AVATARS = replace(BILLBOARDS, method="gaussian_avatars")
SPLATTING_AVATAR = replace(
    BILLBOARDS,
    method="splatting_avatar",
    splatting_avatar=SplattingAvatarConfig(samples=120, weight_lpips=0.0),
)
INTERACT_AVATAR = replace(BILLBOARDS, method="interact_avatar")
EVERY = [BILLBOARDS, GAUSSIAN_AVATARS, INTERACT_AVATAR, SPLATTING_AVATAR]
ALL = pytest.mark.parametrize("config", EVERY, ids=lambda c: c.method)


def person(stretch: float, shell: np.ndarray, *, turn: np.ndarray | None = None) -> MeshSequence:
    """The toy with a head of its own and a shell, whose faces are given; `turn` rotates everything (3, 3)."""
    meshes = sequence()
    head = meshes.parts["head"]
    factors = np.array([1.0, stretch, 1.0], np.float32)
    hull = np.repeat((0.05 * TETRAHEDRON + np.array([0, 0.2, 0], np.float32))[None], len(meshes.frames), 0)
    parts = {
        "head": Part(head.faces, head.rest * factors, head.verts * factors),
        "right_hand": meshes.parts["right_hand"],
        "shell": Part(shell, hull[0], hull),
    }
    if turn is not None:
        matrix = turn.astype(np.float32)
        parts = {name: Part(p.faces, p.rest @ matrix.T, p.verts @ matrix.T) for name, p in parts.items()}
    return MeshSequence(meshes.frames, parts, {})


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Two people on disk; their shells have the same vertices and other faces."""
    folder = tmp_path_factory.mktemp("people")
    meshes = {"one": person(1.0, TETRAHEDRON_FACES), "two": person(1.2, TETRAHEDRON_FACES[:3])}
    return {name: write_scene(folder / name, meshes=mesh) for name, mesh in meshes.items()}


def method_of(scene: dict, config: TrainConfig):
    torch.set_num_threads(1)
    meshes, _ = read_sequence(scene["meshes"])
    coords = {k[: -len(".coords")]: v for k, v in np.load(scene["spectral"]).items() if k.endswith(".coords")}
    packs = [FramePack(path) for path in scene["packs"]]
    views = views_of(packs, meshes.frames, [pack.split("train") for pack in packs], layers=("rgb", "alpha"))
    return create_method(meshes, coords, views, config)


def trained(scene: dict, config: TrainConfig, seed: int = 3):
    """An avatar whose values are nobody's initial ones; Gaussians were split, so their number is another one too."""
    method = method_of(scene, config)
    avatar = method.avatar
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=random)
    if config.method != "billboards":
        groups = [{**group, "lr": 0.0} for group in method.parameter_groups()]
        gradient = torch.rand(avatar.primitives, generator=random)
        size = torch.rand(avatar.primitives, generator=random)
        densify(avatar, Adam(groups), gradient, size, random, threshold=0.5, split_above=0.5)
    return avatar


def rows_of(avatar, part: str) -> torch.Tensor:
    """Primitives of a part."""
    faces = getattr(avatar, avatar.FACE) if hasattr(avatar, "FACE") else torch.arange(len(avatar.faces))
    of = avatar.face_ranges()[part]
    return ((faces >= of.start) & (faces < of.stop)).nonzero().squeeze(1)


def values(avatar) -> dict[str, torch.Tensor]:
    """What has one row a primitive, by name."""
    source = avatar if hasattr(avatar, "FACE") else avatar.billboards
    names = (
        (*avatar.PARAMETERS, *avatar.BUFFERS) if hasattr(avatar, "FACE") else [n for n, _ in source.named_parameters()]
    )
    return {name: getattr(source, name).detach() for name in names}


@ALL
def test_parts_with_the_same_faces_are_copied_and_others_start_as_without(scenes, tmp_path, config) -> None:
    other = trained(scenes["one"], config)
    save_avatar(tmp_path / "start.pt", other)
    method, without = method_of(scenes["two"], config), method_of(scenes["two"], config).avatar
    taken = start_from(method, load_avatar(tmp_path / "start.pt"), "start.pt")
    assert taken.over[:2] == ["head", "right_hand"] and taken.left == ["shell (another mesh)"]
    avatar = method.avatar
    for part, source in (("head", other), ("right_hand", other), ("shell", without)):
        rows, its = rows_of(avatar, part), rows_of(source, part)
        assert len(rows) == len(its) > 0
        for name, value in values(avatar).items():
            expected = values(source)[name][its]
            # Sizes and turns of SplattingAvatar count from the rest pose, which two heads do not share (test below).
            if config.method == "splatting_avatar" and part == "head" and name in ("quat", "log_scale"):
                continue
            assert torch.equal(value[rows], expected), (part, name)
    if config.method == "billboards":
        assert "U-Net" in taken.over
        ours, theirs = avatar.unet.state_dict(), other.unet.state_dict()
        assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    else:
        assert len(method.statistics.views) == avatar.primitives != without.primitives
        assert sum(len(rows_of(avatar, part)) for part in avatar.parts) == avatar.primitives
    assert all(parameter.requires_grad and parameter.is_leaf for parameter in avatar.parameters())
    grouped = [id(p) for group in method.parameter_groups() for p in group["params"]]
    assert sorted(grouped) == sorted(map(id, avatar.parameters())), "Adam steps what was put in place"


@ALL
def test_an_avatar_of_the_same_meshes_is_taken_over_whole(scenes, config) -> None:
    other, method = trained(scenes["one"], config), method_of(scenes["one"], config)
    taken = start_from(method, other, "start.pt")
    assert taken.over[:3] == ["head", "right_hand", "shell"] and not taken.left
    ours, theirs = method.avatar.state_dict(), other.state_dict()
    if config.method != "billboards":  # part by part: the rows come in another order
        order = torch.cat([rows_of(other, part) for part in other.parts])
        names = (*other.PARAMETERS, *other.BUFFERS)
        theirs = {name: value[order] if name in names else value for name, value in theirs.items()}
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)


@pytest.mark.parametrize(
    ("change", "left", "fresh"),
    [
        ({"texels": 5}, ["textures (texels 4, here 5)"], {"features", "alpha_logit"}),
        (
            {"channels": 5},
            ["features (channels 6, here 5)", "U-Net (channels 6, here 5)"],
            {"features", "unet"},
        ),
        ({"deferred": False}, ["features (deferred True, here False, channels 6, here 3)"], {"features", "unet"}),
        (
            {"unet": {"width": 6, "depth": 3, "max_width": 8, "convs": 1, "form": "lean"}},
            ["U-Net (unet_width 4, here 6, unet_form paper, here lean)"],
            {"unet"},
        ),
    ],
    ids=["texels", "channels", "deferred", "unet"],
)
def test_billboards_of_other_sizes_keep_what_does_not_fit(scenes, change, left, fresh) -> None:
    other = trained(scenes["one"], BILLBOARDS)
    config = train_config(BILLBOARDS, **change)
    method, without = method_of(scenes["one"], config), method_of(scenes["one"], config).avatar
    taken = start_from(method, other, "start.pt")
    assert taken.left == left and ("U-Net" in taken.over) == ("unet" not in fresh)
    for name, value in values(method.avatar).items():
        assert torch.equal(value, values(without if name in fresh else other)[name]), name
    if method.avatar.unet is not None and "unet" in fresh:
        ours, initial = method.avatar.unet.state_dict(), without.unet.state_dict()
        assert all(torch.equal(ours[name], initial[name]) for name in ours)


def test_colours_are_no_features_however_many_there_are(scenes) -> None:
    other = trained(scenes["one"], train_config(BILLBOARDS, channels=3))
    method = method_of(scenes["one"], train_config(BILLBOARDS, deferred=False))
    assert start_from(method, other, "x").left == ["features (deferred True, here False)"]
    assert not method.avatar.billboards.features.any(), "grey, as colours are at the start"


def test_what_was_learnt_about_single_frames_stays_behind(scenes) -> None:
    refined = train_config(BILLBOARDS, refine={"modes": 3})
    other = trained(scenes["one"], refined)
    assert other.refinement.get_parameter("bend_head").any()
    for config in (refined, BILLBOARDS):
        method = method_of(scenes["one"], config)
        assert start_from(method, other, "x").left == ["refinement (of other frames)"]
    method = method_of(scenes["one"], refined)
    start_from(method, other, "x")
    assert not any(values.any() for values in method.avatar.refinement.parameters())


def test_smooth_offsets_move_the_billboards_that_were_taken_over(scenes) -> None:
    config = train_config(BILLBOARDS, rates={"offset": 1e-3})
    method, other = method_of(scenes["one"], config), trained(scenes["one"], config)
    start_from(method, other, "x")
    method.avatar.billboards.mu.square().sum().backward()
    assert method.offsets.coefficients.grad.any()
    with torch.no_grad():
        method.offsets.coefficients.fill_(0.01)
    method.offsets.apply()
    assert not torch.equal(method.avatar.billboards.mu[:, 2], other.billboards.mu[:, 2])


def test_a_part_that_is_not_there_is_named(scenes) -> None:
    head, both = replace(BILLBOARDS, parts=["head"]), replace(BILLBOARDS, parts=["head", "right_hand"])
    taken = start_from(method_of(scenes["two"], both), trained(scenes["one"], head), "x")
    assert taken.over == ["head", "U-Net"] and taken.left == ["right_hand (not there)"]


@ALL
def test_a_part_comes_to_where_it_is_here_and_one_that_is_only_there_is_named(scenes, config) -> None:
    """The hand's faces come after the head's there, and are the first here."""
    other, method = trained(scenes["one"], config), method_of(scenes["two"], replace(config, parts=["right_hand"]))
    taken = start_from(method, other, "x")
    assert taken.over[0] == "right_hand" and taken.left == ["head (only there)", "shell (only there)"]
    rows, count = rows_of(other, "right_hand"), len(TETRAHEDRON_FACES)
    assert method.avatar.primitives == len(rows)
    face = getattr(method.avatar, "FACE", None)
    for name, value in values(method.avatar).items():
        expected = values(other)[name][rows]
        if name == face:
            expected = expected - len(OCTAHEDRON_FACES)
            assert set(value.tolist()) <= set(range(count)) and len(set(value.tolist())) > 1
        assert torch.equal(value, expected), name


def test_embedded_gaussians_keep_their_place_on_a_body_that_rests_elsewhere(tmp_path) -> None:
    """The same person, at rest in another direction and twice as large: pictures of it are the same."""
    turn = axis_angle_to_matrix(torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64))
    meshes = person(1.0, TETRAHEDRON_FACES)
    moved = person(1.0, TETRAHEDRON_FACES, turn=2.0 * turn.numpy())
    other = trained(write_scene(tmp_path / "a", meshes=meshes), SPLATTING_AVATAR)
    method = method_of(write_scene(tmp_path / "b", meshes=moved), SPLATTING_AVATAR)
    start_from(method, other, "x")
    order = torch.cat([rows_of(other, part) for part in other.parts])
    verts, large = ({n: torch.from_numpy(p.verts[2]) for n, p in m.parts.items()} for m in (meshes, moved))
    before, after = other.pose(other.anchor(verts)), method.avatar.pose(method.avatar.anchor(large))
    heights = other.uvd[order, 2:]  # they stay in metres
    assert heights.abs().max() > 0.1
    quats = quaternion_multiply(matrix_to_quaternion(turn).float(), before.quats[order])
    aligned = torch.where((quats * after.quats).sum(1, keepdim=True) < 0, -after.quats, after.quats)
    # float32: two products of rotations, and areas from differences of coordinates of 0.1 m.
    torch.testing.assert_close(aligned, quats, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.scales, 2.0 * before.scales[order], atol=0, rtol=1e-4)


def test_a_part_without_a_gaussian_keeps_its_initial_ones(scenes) -> None:
    other = trained(scenes["one"], SPLATTING_AVATAR)
    kept = torch.cat([rows_of(other, part) for part in ("head", "shell")])
    state = {n: v[kept] if n in (*other.PARAMETERS, *other.BUFFERS) else v for n, v in other.state_dict().items()}
    other.restore(state)
    method, without = method_of(scenes["one"], SPLATTING_AVATAR), method_of(scenes["one"], SPLATTING_AVATAR).avatar
    taken = start_from(method, other, "x")
    assert taken.over == ["head", "shell"] and taken.left == ["right_hand (no Gaussian there)"]
    rows, its = rows_of(method.avatar, "right_hand"), rows_of(without, "right_hand")
    assert len(rows) == len(its) > 0 and torch.equal(method.avatar.bary[rows], without.bary[its])


@pytest.mark.parametrize(("there", "here"), [(3, 1), (1, 3)])
def test_harmonics_are_taken_over_up_to_the_degree_that_there_is(scenes, there, here) -> None:
    options = [
        replace(GAUSSIAN_AVATARS, gaussian_avatars=GaussianAvatarsConfig(sh_degree=degree)) for degree in (there, here)
    ]
    other = trained(scenes["one"], options[0])
    other.degree.fill_(there)
    method = method_of(scenes["one"], options[1])
    taken = start_from(method, other, "x")
    assert taken.left == (["harmonics above degree 1"] if there > here else [])
    order = torch.cat([rows_of(other, part) for part in other.parts])
    ours, theirs = method.avatar.colour_rest, other.colour_rest[order]
    assert torch.equal(ours[:, :3], theirs[:, :3]) and not ours[:, 3:].any()
    assert int(method.avatar.degree) == 1, "as many are in use from the first step"


def test_the_degree_in_use_grows_as_without_a_start_and_never_falls(scenes) -> None:
    method = method_of(scenes["one"], GAUSSIAN_AVATARS)
    degrees = []
    for now in (0.0, 999.0, 1000.0, 3500.0, 9000.0):
        method.calendar.now = now
        method.between_steps(None, 0, torch.Generator())
        degrees.append(int(method.avatar.degree))
    assert degrees == [0, 0, 1, 3, 3]


def test_values_that_are_not_finite_are_refused(scenes) -> None:
    other = trained(scenes["one"], BILLBOARDS)
    with torch.no_grad():
        other.billboards.quat[1, 2] = float("nan")
    with pytest.raises(DataError, match=r"^x: billboards.quat: expected finite numbers, found NaN or infinity$"):
        start_from(method_of(scenes["one"], BILLBOARDS), other, "x")


def words(scene: dict, out, config: TrainConfig, start="") -> list[str]:
    options = to_mapping(replace(config, start=str(start)))
    return [
        "train", "--frames", *map(str, scene["packs"]), "--meshes", str(scene["meshes"]), "--spectral",
        str(scene["spectral"]), "--out", str(out), "--device", "cpu", "--cfg", canonical_json(options),
    ]  # fmt: skip


class Stopped:
    """Tells a training to stop before its third step."""

    def __init__(self) -> None:
        self.asked = 0

    def is_set(self) -> bool:
        self.asked += 1
        return self.asked > 2


@ALL
def test_a_training_says_what_it_took_over_and_goes_on_after_a_kill(
    scenes, tmp_path, capsys, monkeypatch, config
) -> None:
    start = tmp_path / "start.pt"
    save_avatar(start, trained(scenes["one"], config))
    assert main(words(scenes["two"], tmp_path / "whole.pt", config, start)) == 0
    nets = {"billboards": ["U-Net"], "interact_avatar": ["networks of right_hand", "networks of the face"]}
    over = ["head", "right_hand", *nets.get(config.method, [])]
    line = f"{start}: took over {', '.join(over)}; not shell (another mesh)\n"
    assert line in capsys.readouterr().err
    whole = load_avatar(tmp_path / "whole.pt")
    assert whole.record["inputs"]["start"] == file_digest(start)
    assert whole.record["start"] == {"over": over, "left": ["shell (another mesh)"]}

    out = tmp_path / "cut.pt"
    with monkeypatch.context() as patch:
        patch.setattr(verb, "_TerminationFlag", Stopped)
        assert main(words(scenes["two"], out, config, start)) == 143
    assert line in capsys.readouterr().err
    moved = start.rename(tmp_path / "moved.pt")  # the same content
    assert main([*words(scenes["two"], out, config, start), "--start", str(moved)]) == 0
    shown = capsys.readouterr().err
    assert "took over" not in shown and "moved to" not in shown, "it goes on, and begins with nothing again"
    cut = load_avatar(out)
    ours, theirs = cut.state_dict(), whole.state_dict()
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert cut.record["start"] == whole.record["start"]

    assert main([*words(scenes["two"], tmp_path / "without.pt", config, start), "--start"]) == 0
    assert "took over" not in capsys.readouterr().err
    without = load_avatar(tmp_path / "without.pt")
    assert "start" not in without.record and "start" not in without.record["inputs"]
    assert without.primitives != whole.primitives or not torch.equal(
        *(next(avatar.parameters()) for avatar in (without, whole))
    )


def test_another_start_is_another_training(scenes, tmp_path, capsys, monkeypatch) -> None:
    start, out = tmp_path / "start.pt", tmp_path / "model.pt"
    save_avatar(start, trained(scenes["one"], BILLBOARDS))
    with monkeypatch.context() as patch:
        patch.setattr(verb, "_TerminationFlag", Stopped)
        assert main(words(scenes["two"], out, BILLBOARDS, start)) == 143
    save_avatar(start, trained(scenes["one"], BILLBOARDS, seed=4))
    assert main(words(scenes["two"], out, BILLBOARDS, start)) == 0
    assert "an earlier state belongs to other inputs" in capsys.readouterr().err


def _missing(scenes, path):
    return "expected a file (--start), found no such file"


def _folder(scenes, path):
    path.mkdir()
    return "expected a file (--start), found no such file"


def _damaged(scenes, path):
    save_avatar(path, trained(scenes["one"], BILLBOARDS))
    path.write_bytes(path.read_bytes()[:-400])
    return "expected an avatar (model.pt), found a damaged or foreign file"


def _hostile(scenes, path):
    torch.save({"kind": Hostile()}, path)
    return "expected tensors, numbers and text only, found"


def _other_kind(scenes, path):
    torch.save({"kind": "nothing of ours"}, path)
    return "kind: expected 'nbavatar avatar', found something else"


def _other_method(scenes, path):
    save_avatar(path, trained(scenes["one"], GAUSSIAN_AVATARS))
    return "method: expected billboards, found gaussian_avatars; start from an avatar of the same method"


def _other_meshes(scenes, path):
    meshes = sequence()
    head = meshes.parts["head"]
    parts = {"head": Part(head.faces[:, [1, 2, 0]], head.rest, head.verts)}  # turned: other corners come first
    scene = write_scene(path.parent / "others", meshes=MeshSequence(meshes.frames, parts, {}))
    save_avatar(path, trained(scene, BILLBOARDS))
    return (
        "parts: expected one with the faces that it has here: head (8 faces), right_hand (4 faces), shell (3 faces), "
        "found head (8 faces); start from"
    )


def _itself(scenes, path):
    save_avatar(path, trained(scenes["one"], BILLBOARDS))
    return "--out: expected a file to write, found the option start; name another file"


class Hostile:
    def __reduce__(self):
        import os

        return os.mkdir, ("owned",)


@pytest.mark.parametrize(
    "make", [_missing, _folder, _damaged, _hostile, _other_kind, _other_method, _other_meshes, _itself]
)
def test_what_is_no_start_is_refused_in_one_line(scenes, tmp_path, capsys, monkeypatch, make) -> None:
    monkeypatch.chdir(tmp_path)
    start = tmp_path / "start.pt"
    message = make(scenes, start)
    out = start if make is _itself else tmp_path / "out.pt"
    assert main(words(scenes["two"], out, BILLBOARDS, start)) == 2
    shown = capsys.readouterr()
    assert message in shown.err and len(shown.err.strip().splitlines()) == 1 and "Traceback" not in shown.err
    assert not list(tmp_path.glob("out.pt*")) and not (tmp_path / "owned").exists()
