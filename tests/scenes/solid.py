"""A capture of a lopsided person: nothing about it is symmetric, so that a wrong reading of its cameras shows."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from nbavatar.mesh.zbuffer import rasterize_mesh

CAMERAS = ("low", "high", "side", "near")
FRAMES = ("f0", "f1", "f2", "f3")
_PLACES = ((-0.25, -0.1, 0.8), (0.1, 0.25, 0.7), (0.45, 0.0, 0.75), (0.0, 0.05, 0.6))


def _ball(radii: Sequence[float], rows: int = 8, columns: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """An ellipsoid, closed, counter-clockwise seen from outside."""
    polar, round_ = np.meshgrid(
        np.pi * np.arange(1, rows) / rows, 2 * np.pi * np.arange(columns) / columns, indexing="ij"
    )
    ring = np.stack([np.sin(polar) * np.cos(round_), np.cos(polar), np.sin(polar) * np.sin(round_)], -1).reshape(-1, 3)
    verts = np.concatenate([ring, [[0, 1, 0], [0, -1, 0]]]) * radii
    faces = []
    for column in range(columns):
        after = (column + 1) % columns
        faces.append([column, len(ring), after])
        last = (rows - 2) * columns
        faces.append([last + column, last + after, len(ring) + 1])
        for row in range(rows - 2):
            a, b = row * columns + column, row * columns + after
            faces += [[a, b, a + columns], [b, b + columns, a + columns]]
    return verts, np.array(faces)


def _person(frame: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Head with a nose and a long chin, y up, face towards +z; a long hand at its side, which comes nearer."""
    head, head_faces = _ball((0.075, 0.11, 0.09))
    nose = np.exp(-((head[:, :2] - [0.01, 0.0]) ** 2).sum(1) / 0.03**2) * (head[:, 2] > 0)
    head[:, 2] += 0.035 * nose
    head[:, 1] -= 0.03 * (head[:, 1] < -0.08)
    hand, hand_faces = _ball((0.025, 0.08, 0.02))
    turned = hand @ Rotation.from_euler("z", 25 + 6 * frame, degrees=True).as_matrix().T
    return (
        {"head": head, "right_hand": turned + [-0.13 + 0.008 * frame, -0.04, 0.03]},
        {"head": head_faces, "right_hand": hand_faces},
    )


def write_solid(
    root: Path, *, size: int = 64, cameras: Sequence[str] = CAMERAS, frames: Sequence[str] = FRAMES
) -> Path:
    """Images, exact label masks, meshes; `cameras` and `frames` are names, up to four of each."""
    (root / "meshes").mkdir(parents=True)
    rig, faces = {}, {}
    K = np.array([[1.9 * size, 0, 0.52 * size], [0, 1.9 * size, 0.47 * size], [0, 0, 1]])
    for name, place in zip(cameras, _PLACES):
        z = -np.array(place) / np.linalg.norm(place)  # towards the head; y down
        x = np.cross([0.05, -1.0, 0.0], z)
        R = np.stack([x / np.linalg.norm(x), np.cross(z, x / np.linalg.norm(x)), z])
        t = -R @ np.array(place)
        rig[name] = {"width": size, "height": size, "K": K.tolist(), "R": R.tolist(), "t": t.tolist()}
    for number, frame in enumerate(frames):
        verts, faces = _person(number)
        np.savez(root / "meshes" / f"{frame}.npz", **{part: value.astype(np.float32) for part, value in verts.items()})
        joined = np.concatenate([faces["head"], faces["right_hand"] + len(verts["head"])])
        points = np.concatenate([verts["head"], verts["right_hand"]])
        for name, entry in rig.items():
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = entry["R"], entry["t"]
            face, _, _ = rasterize_mesh(points, joined, K, size, size, cam_from_world=pose)
            label = np.where(face < 0, 0, np.where(face < len(faces["head"]), 1, 2)).astype(np.uint8)
            shade = 120 + 100 * np.sin(40 * points[joined[face]].mean(-2))  # colours that stick to the surface
            image = np.where((face >= 0)[..., None], shade, 60).astype(np.uint8)
            for kind, picture in (("images", image), ("masks", label)):
                (root / kind / name).mkdir(parents=True, exist_ok=True)
                Image.fromarray(picture).save(root / kind / name / f"{frame}.png")
    np.savez(root / "meshes" / "topology.npz", **{f"{part}_faces": value for part, value in faces.items()})
    (root / "cameras.json").write_text(json.dumps(rig))
    (root / "splits.json").write_text(json.dumps({"frames": list(frames)}))
    return root
