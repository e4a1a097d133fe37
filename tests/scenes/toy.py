"""A toy scene on disk: an octahedron 'head' and a tetrahedron 'hand' seen by three cameras, a few frames of motion."""

from pathlib import Path

import numpy as np

from nbavatar.data.sequences import MeshSequence, Part, write_sequence
from nbavatar.io.arrays import write_arrays
from nbavatar.io.framepack import FramePack, FramePackWriter

SIZE = 32
FRAMES = ["f0", "f1", "f2", "f3"]
OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float32)
OCTAHEDRON_FACES = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], dtype=np.int64
)
TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float32)
TETRAHEDRON_FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], dtype=np.int64)


def camera(index: int) -> np.ndarray:
    """World-to-camera transform of a ring of cameras that look at the origin from 1 m."""
    angle = 0.7 * (index - 1)
    forward = np.array([-np.sin(angle), 0.0, np.cos(angle)])
    right = np.array([np.cos(angle), 0.0, np.sin(angle)])
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, [0.0, 0.0, 1.0]
    return matrix


def sequence() -> MeshSequence:
    """Head at rest; the hand approaches it frame by frame."""
    head, hand = 0.15 * OCTAHEDRON, 0.06 * TETRAHEDRON + np.array([0.25, 0.0, 0.0], dtype=np.float32)
    step = np.arange(len(FRAMES), dtype=np.float32)[:, None, None]
    moved = hand - 0.03 * step * np.array([1.0, 0.2, 0.0], dtype=np.float32)
    parts = {
        "head": Part(OCTAHEDRON_FACES, head, np.repeat(head[None], len(FRAMES), 0)),
        "right_hand": Part(TETRAHEDRON_FACES, hand, moved.astype(np.float32)),
    }
    return MeshSequence(list(FRAMES), parts, {})


def draw(meshes: MeshSequence, row: int, view: np.ndarray, K: np.ndarray, size: int) -> tuple[np.ndarray, ...]:
    """Filled discs where the parts are, coloured by part and place: rgb, alpha, label."""
    y, x = np.mgrid[0:size, 0:size] + 0.5
    rgb = np.full((size, size, 3), 40, np.uint8)
    label = np.zeros((size, size), np.uint8)
    for number, part in enumerate(meshes.parts.values(), start=1):
        points = part.verts[row] @ view[:3, :3].T + view[:3, 3]
        pixels = points[:, :2] / points[:, 2:] * K[0, 0] + K[:2, 2]
        centre, radius = pixels.mean(0), 0.75 * np.abs(pixels - pixels.mean(0)).max()
        inside = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2
        label[inside] = number
        shade = np.clip(128 + 90 * (x - centre[0]) / radius, 0, 255)
        rgb[inside] = np.stack([shade, np.full_like(shade, 80 * number), 255 - shade], -1)[inside].astype(np.uint8)
    return rgb, np.where(label > 0, 255, 0).astype(np.uint8), label


def write_scene(folder: Path, *, size: int = SIZE, empty: bool = False, meshes: MeshSequence | None = None) -> dict:
    """Write packs, meshes and spectral coordinates; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    meshes = meshes or sequence()
    write_sequence(folder / "meshes.npz", meshes, {})
    coords = {f"{name}.coords": np.clip(part.rest * 6, -1, 1) for name, part in meshes.parts.items()}
    write_arrays(folder / "spectral.npz", coords, {})
    K = np.array([[1.9 * size, 0, 0.52 * size], [0, 1.9 * size, 0.47 * size], [0, 0, 1]])
    packs = []
    for index in range(3):
        view = camera(index)
        manifest = {
            "stage": "crop", "subject": "toy", "camera": f"cam{index}", "width": size, "height": size,
            "K": K.tolist(), "cam_from_world": view.tolist(), "distortion": None, "frames": meshes.frames,
            "split": {f: "test" if f == "f3" and len(meshes.frames) > 1 else "train" for f in meshes.frames},
            "segments": [[0, len(meshes.frames) - 1]], "layers": {"rgb": "", "alpha": "", "label": ""}, "record": {},
        }  # fmt: skip
        packs.append(folder / f"cam{index}.zip")
        with FramePackWriter(packs[-1], manifest) as writer:
            for row, frame in enumerate(meshes.frames):
                rgb, alpha, label = draw(meshes, row, view, K, size)
                writer.add("rgb", frame, rgb)
                writer.add("alpha", frame, alpha * (not empty))
                writer.add("label", frame, label * (not empty))
    return {"packs": packs, "meshes": folder / "meshes.npz", "spectral": folder / "spectral.npz"}


def rewritten(source, target, frames, *, hide=(), shown_as=lambda rgb, alpha: rgb, prefix=""):
    """A copy of a pack with some frames only, all to train on, some of them showing nobody; its path."""
    with FramePack(source) as pack:
        manifest = {**pack.manifest, "frames": [prefix + frame for frame in frames]}
        manifest["segments"] = [[0, len(frames) - 1]]
        manifest["split"] = dict.fromkeys(manifest["frames"], "train")
        with FramePackWriter(target, manifest) as writer:
            for frame in frames:
                rgb, alpha = pack.read("rgb", frame), pack.read("alpha", frame)
                alpha = alpha * (frame not in hide)
                writer.add("rgb", prefix + frame, shown_as(rgb, alpha))
                writer.add("alpha", prefix + frame, alpha)
                writer.add("label", prefix + frame, pack.read("label", frame) * (frame not in hide))
    return str(target)
