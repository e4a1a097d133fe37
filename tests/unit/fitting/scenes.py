"""Synthetic capture of a moving head and hand by cameras on an arc, with noise, outliers and gaps."""

import dataclasses
import functools

import numpy as np

from nbavatar.camera.distortion import distort_pixels
from nbavatar.data.sequences import Part
from nbavatar.data.synthetic.scene import Bodies as SyntheticBodies
from nbavatar.data.synthetic.scene import Scene, build_bodies, make_scene
from nbavatar.fitting.stage import Bodies

FOCAL, WIDTH, HEIGHT, DISTANCE = 3132.0, 1920, 1080, 1.7
DISTORTION = np.array([-0.12, 0.08, 4e-4, -3e-4, 0.01])


@dataclasses.dataclass(frozen=True)
class Take:
    """A scene, the extras a dataset would bring, and the true meshes."""

    scene: Scene
    bodies: Bodies
    extras: dict[str, np.ndarray]
    frames: list[str]

    @property
    def truth(self) -> dict[str, np.ndarray]:
        return {"head": self.scene.head_rigid, "right_hand": self.scene.hand}

    def parts(self) -> dict[str, Part]:
        return {}


@functools.cache
def bodies(mesh: str) -> SyntheticBodies:
    """Body models, built once."""
    return build_bodies(mesh)


@functools.cache
def scene(mesh: str, frames: int, name: str = "S2") -> Scene:
    """Motion without dents, built once."""
    return make_scene(bodies(mesh), name, frames, 0, dents=False)


def arc(centre: np.ndarray, count: int, seed: int = 1) -> np.ndarray:
    """`cam_from_world` of cameras on an arc in front of the face, `[M, 4, 4]`; the world has z up."""
    rng = np.random.default_rng(seed)
    poses = []
    for angle in np.deg2rad(np.linspace(-80, 80, count) if count > 1 else [0]):
        towards = np.array([np.sin(angle), -np.cos(angle), 0.2 * rng.normal()])
        towards /= np.linalg.norm(towards)
        right = np.cross(-towards, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-towards, right), -towards])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (centre + DISTANCE * towards)
        poses.append(pose)
    return np.stack(poses)


def make_take(
    mesh: str = "tiny",
    frames: int = 20,
    cameras: int = 8,
    *,
    noise: float = 0.0,
    outliers: float = 0.0,
    missing: float = 0.0,
    parameters: bool = False,
    distortion: bool = False,
    seed: int = 5,
) -> Take:
    """Films a scene: keypoints with Gaussian noise [px], shares of gross outliers and of missing ones."""
    one = scene(mesh, frames)
    rng = np.random.default_rng(seed)
    # With distortion the cameras aim above the head: near the image centre a lens distorts nothing.
    poses = arc(one.head_rigid.mean((0, 1)) + [0, 0, 0.2 * distortion], cameras)
    K = np.array([[FOCAL, 0, WIDTH / 2 + 7], [0, FOCAL, HEIGHT / 2 - 5], [0, 0, 1.0]])
    extras: dict[str, np.ndarray] = {"segments": np.array(one.motion.segments)}
    for m, pose in enumerate(poses):
        name = f"{100 + m}"
        extras |= {f"camera.{name}.K": K, f"camera.{name}.cam_from_world": pose}
        extras[f"camera.{name}.size"] = np.array([WIDTH, HEIGHT])
        extras[f"camera.{name}.distortion"] = DISTORTION if distortion else np.zeros(12)
        for part, points in (("head", one.landmarks), ("right_hand", one.joints)):
            camera = points @ pose[:3, :3].T + pose[:3, 3]
            image = camera @ K.T
            pixels = image[..., :2] / image[..., 2:]
            if distortion:
                pixels = distort_pixels(pixels, K, DISTORTION)
            pixels = pixels + noise * rng.normal(size=pixels.shape)
            wrong = rng.random(pixels.shape[:2]) < outliers
            pixels[wrong] += rng.uniform(-150, 150, (wrong.sum(), 2))
            confidence = np.where(rng.random(pixels.shape[:2]) < missing, 0.0, 1.0)
            extras[f"keypoints.{part}.{name}"] = np.concatenate([pixels, confidence[..., None]], 2)
    if parameters:
        extras |= dataset_parameters(one)
    models = Bodies(one.bodies.flame, {"right": one.bodies.mano})
    return Take(one, models, extras, [f"{n:06d}" for n in range(frames)])


def dataset_parameters(one: Scene) -> dict[str, np.ndarray]:
    """The scene's true parameters under the names of the tracks."""
    names = {
        "head": {"shape_params": "shape", "expression_params": "expression", "global_orient": "global_orient",
                 "transl": "transl"},
        "right_hand": {"betas": "betas", "hand_pose": "hand_pose", "global_orient": "global_orient",
                       "transl": "transl"},
    }  # fmt: skip
    extras = {
        f"param.{part}.{ours}": one.parameters[f"{part}.{theirs}"].copy()
        for part, pairs in names.items()
        for theirs, ours in pairs.items()
    }
    extras["param.head.jaw"] = one.parameters["head.pose_params"][:, 3:].copy()
    return extras


def vertex_error_mm(found: np.ndarray, truth: np.ndarray) -> float:
    """Median distance of vertices [mm]."""
    return float(1e3 * np.median(np.linalg.norm(found - truth, axis=-1)))
