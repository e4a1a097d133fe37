"""Synthetic captures with known answers, and what a dataset would bring of them."""

import dataclasses
import functools

import numpy as np

from nbavatar.data.synthetic.scene import Bodies as SyntheticBodies
from nbavatar.data.synthetic.scene import build_bodies
from nbavatar.fitting.stage import Bodies
from nbavatar.studies.benchmarks.fit_scene import FitScene, film, make_fit_scene

DISTORTION = np.array([-0.12, 0.08, 4e-4, -3e-4, 0.01])


@dataclasses.dataclass(frozen=True)
class Take:
    """A scene and the extras a dataset would bring."""

    scene: FitScene
    bodies: Bodies
    extras: dict[str, np.ndarray]
    frames: list[str]

    @property
    def truth(self) -> dict[str, np.ndarray]:
        return self.scene.verts


@functools.cache
def bodies(mesh: str) -> SyntheticBodies:
    """Body models, built once."""
    return build_bodies(mesh)


@functools.cache
def scene(mesh: str, frames: int) -> FitScene:
    """Motion, made once."""
    return make_fit_scene(bodies(mesh), frames)


def make_take(
    mesh: str = "tiny",
    frames: int = 20,
    cameras: int = 8,
    *,
    parameters: bool = False,
    distortion: bool = False,
    **noise,
) -> Take:
    """Films a scene: keypoints with Gaussian noise [px], shares of gross outliers and of missing ones."""
    one = scene(mesh, frames)
    extras = film(one, cameras, distortion=DISTORTION if distortion else None, seed=5, **noise)
    if parameters:
        extras |= {name: value.copy() for name, value in one.parameters.items()}
    models = Bodies(bodies(mesh).flame, {"right": bodies(mesh).mano})
    return Take(one, models, extras, [f"{n:06d}" for n in range(frames)])


def vertex_error_mm(found: np.ndarray, truth: np.ndarray) -> float:
    """Median distance of vertices [mm]."""
    return float(1e3 * np.median(np.linalg.norm(found - truth, axis=-1)))
