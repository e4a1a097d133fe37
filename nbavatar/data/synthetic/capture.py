"""Synthetic subjects as captures of one's own: pinhole cameras, images, labels, coverage, and meshes as a tracker has
them.

Hair is in images and masks and in no mesh, as with captures of real people. The meshes' error is that of a tracker:
each part as a whole a little off in every frame, another way each time.
"""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nbavatar.camera.pinhole import Camera
from nbavatar.data.synthetic.figure import Figure, build_figure, pose_figure
from nbavatar.data.synthetic.scene import Scene
from nbavatar.data.synthetic.shading import ARM, CLOTH, HAND
from nbavatar.data.synthetic.studio import Lens, lens_of, light_up, photograph
from nbavatar.io.arrays import write_arrays
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import UNSEEN
from nbavatar.io.images import encode_png
from nbavatar.io.records import write_json
from nbavatar.mesh.zbuffer import rasterize_mesh

__all__ = ["labels_of", "write_capture"]

T = TypeVar("T")
Progress = Callable[[Iterable[T], str, int], Iterable[T]]

_HEAD, _HAND = 1, 2


def write_capture(
    root: Path,
    scene: Scene,
    cameras: dict[str, Camera],
    *,
    hair: str = "cap",
    supersample: int = 2,
    mesh_noise: float = 1.0,
    seed: int = 0,
    workers: int = 1,
    progress: Progress = lambda items, _description, _total: items,
    record: dict[str, Any] | None = None,
) -> None:
    """Writes one subject as the folder `root`, in the layout that resources/README.md describes.

    Args:
        root: folder of the capture; made if absent.
        scene: the posed subject.
        cameras: pinholes, all of one size.
        hair: style, one of `nbavatar.config.synthetic.HAIR`.
        supersample: samples a pixel along each side.
        mesh_noise: error of the meshes, multiples of 1 mm and 0.3 degrees.
        seed: of noise.
        workers: threads that render.
        progress: wraps the loop; called with items, a description and their number.
        record: provenance, for `synthetic.json`.
    """
    from concurrent.futures import ThreadPoolExecutor

    figure = build_figure(scene, hair)
    lenses = {name: lens_of(camera, supersample) for name, camera in cameras.items()}
    frames = [f"{n:05d}" for n in range(len(scene.head))]
    resolution = int(np.clip(max(camera.height for camera in cameras.values()), 256, 1024))
    with ThreadPoolExecutor(workers) as pool:
        for n in progress(range(len(frames)), f"{scene.subject.name} images", len(frames)):
            posed = pose_figure(figure, scene, n)
            lights = light_up(posed[0], figure.faces, resolution)

            def take(entry: tuple[int, str], posed: Any = posed, lights: Any = lights, n: int = n) -> None:
                index, name = entry
                rng = np.random.default_rng([seed, scene.subject.seed, index, n])
                image, _ = photograph(lenses[name], figure, posed, lights, noise=0.8, rng=rng)
                label, alpha = labels_of(lenses[name], figure, posed[0])
                for kind, picture in (("images", image), ("masks", label), ("alpha", alpha)):
                    _write(root / kind / name / f"{frames[n]}.png", encode_png(picture, level=6))

            list(pool.map(take, enumerate(lenses)))
    _write_meshes(root, scene, frames, mesh_noise, seed)
    rig = {
        name: {
            "width": c.width, "height": c.height, "K": c.K.tolist(),
            "R": c.cam_from_world[:3, :3].tolist(), "t": c.cam_from_world[:3, 3].tolist(),
        }
        for name, c in cameras.items()
    }  # fmt: skip
    _write(root / "splits.json", json.dumps({"frames": frames}, indent=1).encode())
    write_json(root / "synthetic.json", {"subject": scene.subject.name, "hair": hair, **(record or {})})
    write_json(root / "cameras.json", rig)


def labels_of(lens: Lens, figure: Figure, verts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact labels and coverage of head with hair and of the hand, uint8 (H, W), for posed vertices (V, 3) [m].

    Where cloth or the arm hides one of them the label is 255.
    """
    camera, s = lens.camera, lens.supersample
    other = np.isin(figure.material, (CLOTH, ARM))
    face, own = (
        rasterize_mesh(verts, faces, lens.K, lens.width, lens.height, cam_from_world=camera.cam_from_world, workers=1)[
            0
        ]
        for faces in (figure.faces, figure.faces[~other])
    )
    owner = np.select([other, figure.material == HAND], [0, _HAND], _HEAD)
    part = np.where(face >= 0, owner[face], 0)
    part[(face >= 0) & (part == 0) & (own >= 0)] = UNSEEN
    shares = ((part == p).reshape(camera.height, s, camera.width, s).mean((1, 3)) for p in (_HEAD, _HAND, UNSEEN))
    head, hand, hidden = shares
    label = np.where(hidden > 0, UNSEEN, 0)
    label = np.where(head + hand >= 0.5, np.where(head >= hand, _HEAD, _HAND), label).astype(np.uint8)
    return label, np.round(255 * (head + hand)).astype(np.uint8)


def _write_meshes(root: Path, scene: Scene, frames: list[str], noise: float, seed: int) -> None:
    """Meshes that no tracker would place better."""
    from scipy.spatial.transform import Rotation

    human = scene.bodies.human
    rng = np.random.default_rng([seed, scene.subject.seed, 61])
    topology = {"head_faces": human.head_faces, "right_hand_faces": human.hand_faces}
    write_arrays(root / "meshes" / "topology.npz", {**topology, "head_rest": scene.canonical[0].astype(np.float32)}, {})
    for n, frame in enumerate(frames):
        placed = {}
        states = {"head": ("head", "head_rigid"), "right_hand": ("right_hand",)}
        given = {"head": scene.head[n], "head_rigid": scene.head_rigid[n], "right_hand": scene.hand[n]}
        for part, names in states.items():
            turn = Rotation.from_rotvec(np.radians(0.3 * noise) * rng.standard_normal(3)).as_matrix()
            shift, centre = 1e-3 * noise * rng.standard_normal(3), given[part].mean(0)
            placed |= {name: ((given[name] - centre) @ turn.T + centre + shift).astype(np.float32) for name in names}
        write_arrays(root / "meshes" / f"{frame}.npz", placed, {})


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        Path(temporary).write_bytes(content)
