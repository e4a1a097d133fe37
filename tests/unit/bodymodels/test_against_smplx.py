"""FLAME and MANO against smplx, values and gradients, where somebody has installed it.

Its licence forbids commercial use and redistribution, so no lock, extra or image of this project brings it:
`pip install smplx` and run this file to have the comparison. `test_bodymodels.py` compares with an oracle of our own.
"""

import pickle

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nbavatar.bodymodels.files import read_flame, read_landmarks, read_mano
from nbavatar.bodymodels.flame import Flame, contour_rows
from nbavatar.bodymodels.mano import Mano
from nbavatar.data.synthetic.legacy_pickle import Ch, Select, dump_array, dump_legacy
from nbavatar.data.synthetic.models import flame_content, landmark_content, load_human, mano_content

from .modelfiles import random_flame, random_landmarks, random_mano

smplx = pytest.importorskip("smplx", reason="its licence keeps it out of the lock; pip install smplx")

BATCH = 4


@pytest.fixture(scope="module")
def flame_dict():
    return random_flame()


@pytest.fixture(scope="module")
def mano_dict():
    return random_mano()


def _values(*sizes, scale=0.5, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    draw = [scale * torch.randn(BATCH, n, generator=generator, dtype=torch.float64) for n in sizes]
    return [value.to(dtype).requires_grad_() for value in draw]


def _assert_same(ours, theirs, inputs_ours, inputs_theirs, tolerance):
    """Values, and gradients of one random projection, relative to the largest entry."""
    generator = torch.Generator().manual_seed(9)
    loss_ours = loss_theirs = torch.zeros((), dtype=ours[0].dtype)
    for a, b in zip(ours, theirs, strict=True):
        assert (a - b).abs().max() <= tolerance * b.abs().max()
        cotangent = torch.randn(a.shape, generator=generator, dtype=torch.float64).to(a.dtype)
        loss_ours, loss_theirs = loss_ours + (a * cotangent).sum(), loss_theirs + (b * cotangent).sum()
    for a, b in zip(
        torch.autograd.grad(loss_ours, inputs_ours), torch.autograd.grad(loss_theirs, inputs_theirs), strict=True
    ):
        assert (a - b).abs().max() <= tolerance * b.abs().max()


# float32 of either side carries about 1e-6; smplx's Rodrigues formula adds 1e-8 to the angle, which float64 shows.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 2e-6), (torch.float32, 1e-5)])
def test_flame_equals_smplx(flame_dict, tmp_path, dtype, tolerance):
    (tmp_path / "FLAME_NEUTRAL.pkl").write_bytes(pickle.dumps(flame_dict, protocol=2))
    embedding = random_landmarks(3, len(flame_dict["f"]))
    static = {"lmk_face_idx": embedding["static_lmk_faces_idx"], "lmk_b_coords": embedding["static_lmk_bary_coords"]}
    (tmp_path / "flame_static_embedding.pkl").write_bytes(pickle.dumps(static, protocol=2))
    theirs = smplx.FLAME(str(tmp_path), num_betas=100, num_expression_coeffs=50, batch_size=BATCH, dtype=dtype)
    ours = Flame.build(read_flame(tmp_path / "FLAME_NEUTRAL.pkl"), dtype=dtype)
    names = ("betas", "expression", "jaw_pose", "global_orient", "neck_pose", "eyes")
    a = dict(zip(names, _values(100, 50, 3, 3, 3, 6, dtype=dtype), strict=True))
    b = {name: value.detach().clone().requires_grad_() for name, value in a.items()}
    verts, joints = ours.forward(
        a["betas"], a["expression"], a["jaw_pose"], root=a["global_orient"], neck=a["neck_pose"], eyes=a["eyes"]
    )
    eyes = b["eyes"]
    reference = theirs(
        betas=b["betas"], expression=b["expression"], jaw_pose=b["jaw_pose"], global_orient=b["global_orient"],
        neck_pose=b["neck_pose"], leye_pose=eyes[:, :3], reye_pose=eyes[:, 3:],
    )  # fmt: skip
    _assert_same(
        [verts, joints], [reference.vertices, reference.joints[:, :5]], list(a.values()), list(b.values()), tolerance
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 2e-6), (torch.float32, 1e-5)])
def test_mano_equals_smplx(mano_dict, tmp_path, dtype, tolerance):
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(pickle.dumps(mano_dict, protocol=2))
    theirs = smplx.MANO(
        str(tmp_path / "MANO_RIGHT.pkl"), use_pca=False, flat_hand_mean=True, batch_size=BATCH, dtype=dtype
    )
    ours = Mano.build(read_mano(tmp_path / "MANO_RIGHT.pkl"), dtype=dtype)
    a = _values(10, 45, 3, 3, dtype=dtype)
    b = [value.detach().clone().requires_grad_() for value in a]
    verts, joints = ours.forward(*a)
    reference = theirs(betas=b[0], hand_pose=b[1], global_orient=b[2], transl=b[3])
    # smplx appends the tips in an order of its own; they are vertices, compared as such.
    tips = reference.vertices[:, list(ours.tips)]
    _assert_same([verts, joints], [reference.vertices, torch.cat([reference.joints[:, :16], tips], 1)], a, b, tolerance)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_full_size_files_equal_smplx(tmp_path, dtype):
    """The synthetic subject's model files, at the counts of the originals, through the unpickler and through smplx."""
    human = load_human("full")
    head, hand = flame_content(human), mano_content(human)
    (tmp_path / "generic_model.pkl").write_bytes(dump_legacy(head, python2=True))
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(dump_legacy(hand, python2=True))
    (tmp_path / "landmark_embedding.npy").write_bytes(dump_array(landmark_content(human)))
    # smplx cannot open such files without chumpy: it gets the same arrays unwrapped.
    for name, content in (("FLAME_NEUTRAL.pkl", head), ("MANO_PLAIN_RIGHT.pkl", hand)):
        plain = {k: v.x if isinstance(v, Ch) else v.a.x if isinstance(v, Select) else v for k, v in content.items()}
        (tmp_path / name).write_bytes(pickle.dumps(plain, protocol=2))
    embedding = landmark_content(human)
    static = {"lmk_face_idx": embedding["static_lmk_faces_idx"], "lmk_b_coords": embedding["static_lmk_bary_coords"]}
    (tmp_path / "flame_static_embedding.pkl").write_bytes(pickle.dumps(static, protocol=2))
    arrays = read_flame(tmp_path / "generic_model.pkl")
    ours = Flame.build(arrays, read_landmarks(tmp_path / "landmark_embedding.npy", len(arrays.faces)), dtype=dtype)
    theirs = smplx.FLAME(str(tmp_path), num_betas=100, num_expression_coeffs=50, batch_size=BATCH, dtype=dtype)
    a = _values(100, 50, 3, dtype=dtype)
    b = [value.detach().clone().requires_grad_() for value in a]
    verts = ours.forward(*a).verts
    reference = theirs(betas=b[0], expression=b[1], jaw_pose=b[2])
    assert verts.shape == (BATCH, 5023, 3)
    found = [verts, ours.landmarks(verts)[:, 17:]]
    _assert_same(found, [reference.vertices, reference.joints[:, 5:56]], a, b, 1e-5)
    mano = Mano.build(read_mano(tmp_path / "MANO_RIGHT.pkl"), dtype=dtype)
    theirs = smplx.MANO(
        str(tmp_path / "MANO_PLAIN_RIGHT.pkl"), use_pca=False, flat_hand_mean=True, batch_size=BATCH, dtype=dtype
    )
    a = _values(10, 45, 3, 3, dtype=dtype)
    b = [value.detach().clone().requires_grad_() for value in a]
    verts, joints = mano.forward(*a)
    reference = theirs(betas=b[0], hand_pose=b[1], global_orient=b[2], transl=b[3])
    assert verts.shape == (BATCH, 778, 3)
    _assert_same([verts, joints[:, :16]], [reference.vertices, reference.joints[:, :16]], a, b, 1e-5)


def test_contour_rows_equal_smplx():
    yaw = np.linspace(-89, 89, 179)
    rng = np.random.default_rng(2)
    tilt = np.stack([0.2 * rng.normal(size=179), np.deg2rad(yaw), 0.2 * rng.normal(size=179)], 1)
    matrices = torch.tensor(Rotation.from_euler("ZYX", tilt[:, ::-1]).as_matrix())
    table = torch.arange(79)[:, None].expand(79, 17).contiguous()
    # Their function starts from axis-angle poses of a chain; the chain of one joint is the rotation itself.
    pose = torch.tensor(Rotation.from_matrix(matrices.numpy()).as_rotvec())
    rows, _ = smplx.lbs.find_dynamic_lmk_idx_and_bcoords(
        torch.zeros(179, 1, 3).double(), pose, table, torch.zeros(79, 17, 3).double(), torch.tensor([0])
    )
    ours = contour_rows(matrices)
    assert ours.min() >= 0 and ours.max() <= 78 and len(set(ours.tolist())) == 79
    # Their mask sends yaw beyond -39 degrees to the same last row.
    assert (ours == rows[:, 0]).all()
