"""A synthetic head and hand in motion, as keypoints of cameras on an arc: input with a known answer for the refit.

Shape, expression, jaw and finger motion are those of the synthetic dataset; the hand moves beside the face on a smooth
path of its own, without contact, so that a scene is made in a moment.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch

from nbavatar.bodymodels.flame import rotate_about_centroid
from nbavatar.bodymodels.mano import shorten_tips
from nbavatar.camera.distortion import distort_pixels
from nbavatar.data.synthetic.motion import make_motion, make_subject
from nbavatar.data.synthetic.scene import STAGE_TO_WORLD, Bodies
from nbavatar.math.rotations import axis_angle_to_matrix, matrix_to_axis_angle

__all__ = ["FOCAL", "HEIGHT", "WIDTH", "FitScene", "arc", "film", "make_fit_scene", "perturb"]

FOCAL, WIDTH, HEIGHT = 3132.0, 1920, 1080
_DISTANCE = 1.7


@dataclasses.dataclass(frozen=True)
class FitScene:
    """Truth of a scene, float64, world axes.

    Attributes:
        verts: part -> `[N, V, 3]` [m].
        keypoints: part -> `[N, 68 | 21, 3]` [m], fingertips shortened.
        parameters: `param.<part>.<name>` -> `[N, size]`, as in a mesh sequence.
        segments: first and last frame of each uncut run.
    """

    verts: dict[str, np.ndarray]
    keypoints: dict[str, np.ndarray]
    parameters: dict[str, np.ndarray]
    segments: list[tuple[int, int]]


def make_fit_scene(bodies: Bodies, frames: int, *, name: str = "S2", seed: int = 0) -> FitScene:
    """Poses one synthetic subject; `frames` at least 4."""
    subject = make_subject(name, seed)
    motion = make_motion(bodies.human, subject, frames)
    time = torch.linspace(0, 1, frames, dtype=torch.float64)
    stage = torch.from_numpy(STAGE_TO_WORLD)
    shape, betas = (torch.from_numpy(v)[None].expand(frames, -1) for v in (subject.shape, subject.betas))
    expression, jaw, pose, turn, shift = (
        torch.from_numpy(np.ascontiguousarray(v))
        for v in (motion.expression, motion.jaw, motion.hand_pose, motion.head_turn, motion.head_shift)
    )
    canonical = bodies.flame.forward(shape, expression, jaw).verts
    rotation = stage[:3, :3] @ axis_angle_to_matrix(turn)
    centre = canonical.mean(1)
    transl = (centre + shift) @ stage[:3, :3].mT + stage[:3, 3] - centre
    head = rotate_about_centroid(canonical, rotation, transl)
    swing = torch.stack([torch.sin(4 * time), 0.5 * torch.cos(3 * time), 0.7 * torch.sin(5 * time + 1)], 1)
    upright = axis_angle_to_matrix(torch.tensor([[0.0, 0.0, -1.3]], dtype=torch.float64))
    hand_rotation = stage[:3, :3] @ axis_angle_to_matrix(0.4 * swing) @ upright
    # The hand model's own place is arm's length from the head's: it is brought beside the cheek.
    beside = torch.tensor([-0.10, -0.06, 0.10], dtype=torch.float64) + 0.04 * swing
    place = (centre + beside) @ stage[:3, :3].mT + stage[:3, 3]
    wrist = bodies.mano.forward(betas, pose, torch.zeros_like(jaw)).joints[:, 0]
    orient = matrix_to_axis_angle(hand_rotation)
    hand = bodies.mano.forward(betas, pose, orient, place - wrist)
    parameters = {
        "param.head.shape": shape, "param.head.expression": expression, "param.head.jaw": jaw,
        "param.head.global_orient": matrix_to_axis_angle(rotation), "param.head.transl": transl,
        "param.right_hand.betas": betas, "param.right_hand.hand_pose": pose,
        "param.right_hand.global_orient": orient, "param.right_hand.transl": place - wrist,
    }  # fmt: skip
    assert bodies.flame.landmarks is not None
    landmarks = bodies.flame.landmarks(head).numpy()
    return FitScene(
        {"head": head.numpy(), "right_hand": hand.verts.numpy()},
        {"head": landmarks, "right_hand": shorten_tips(hand.joints).numpy()},
        {key: value.numpy().copy() for key, value in parameters.items()},
        [(int(a), int(b)) for a, b in motion.segments],
    )


def film(
    scene: FitScene,
    cameras: int,
    *,
    noise: float = 0.0,
    outliers: float = 0.0,
    missing: float = 0.0,
    distortion: np.ndarray | None = None,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Keypoints and cameras under the names of a mesh sequence's extras.

    Args:
        scene: what is filmed.
        cameras: how many, on an arc of 160 degrees in front of the face.
        noise: standard deviation of keypoints [px].
        outliers: share of keypoints moved by up to 150 px along x and y.
        missing: share of keypoints with confidence 0.
        distortion: lens coefficients; the cameras then aim above the head, where a lens distorts.
        seed: of noise and camera heights.
    """
    rng = np.random.default_rng(seed)
    K = np.array([[FOCAL, 0, WIDTH / 2 + 7], [0, FOCAL, HEIGHT / 2 - 5], [0, 0, 1]])
    extras: dict[str, np.ndarray] = {"segments": np.array(scene.segments)}
    aim = scene.verts["head"].mean((0, 1)) + [0, 0, 0.0 if distortion is None else 0.2]
    for m, pose in enumerate(arc(aim, cameras, rng)):
        name = f"{100 + m}"
        extras |= {f"camera.{name}.K": K, f"camera.{name}.cam_from_world": pose}
        extras[f"camera.{name}.size"] = np.array([WIDTH, HEIGHT])
        extras[f"camera.{name}.distortion"] = np.zeros(12) if distortion is None else distortion
        for part, points in scene.keypoints.items():
            pixels = distort_pixels(_project(points, K, pose), K, distortion)
            pixels = pixels + noise * rng.normal(size=pixels.shape)
            wrong = rng.random(points.shape[:2]) < outliers
            pixels[wrong] += rng.uniform(-150, 150, (int(wrong.sum()), 2))
            confidence = (rng.random(points.shape[:2]) >= missing).astype(np.float64)
            extras[f"keypoints.{part}.{name}"] = np.concatenate([pixels, confidence[..., None]], axis=2)
    return extras


def arc(target: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """`cam_from_world` `[M, 4, 4]` of cameras on an arc that look at `target` [m]; the world has z up, the face -y."""
    poses = np.zeros((count, 4, 4))
    poses[:, 3, 3] = 1
    for pose, angle in zip(poses, np.deg2rad(np.linspace(-80, 80, count)), strict=True):
        forward = -np.array([np.sin(angle), -np.cos(angle), 0.2 * rng.normal()])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ (target - _DISTANCE * forward)
    return poses


def perturb(
    parameters: Mapping[str, np.ndarray], *, millimetres: float, degrees: float, seed: int = 0
) -> dict[str, np.ndarray]:
    """Parameters moved and turned: translations, and rotations of the whole part and of every finger joint.

    Args:
        parameters: as in `FitScene.parameters`.
        millimetres: root mean square length of the shift.
        degrees: root mean square angle of each turn.
        seed: of the directions.
    """
    rng = np.random.default_rng(seed)
    result = {}
    for name, value in parameters.items():
        last = name.rsplit(".", 1)[1]
        size = {"transl": millimetres / 1000, "global_orient": np.deg2rad(degrees), "hand_pose": np.deg2rad(degrees)}
        result[name] = value + size.get(last, 0.0) / 3**0.5 * rng.normal(size=value.shape)
    return result


def _project(points: np.ndarray, K: np.ndarray, pose: np.ndarray) -> np.ndarray:
    image = (points @ pose[:3, :3].T + pose[:3, 3]) @ K.T
    return image[..., :2] / image[..., 2:]
