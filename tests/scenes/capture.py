"""The toy scene as a capture of one's own."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from tests.scenes.toy import SIZE, camera, draw, sequence


def write_capture(root: Path) -> Path:
    """The toy scene in the layout of a capture: label masks, a hand that is missing in one frame, no alpha."""
    meshes = sequence()
    K = np.array([[SIZE * 1.5, 0, SIZE / 2 - 1.3], [0, SIZE * 1.5, SIZE / 2 + 0.7], [0, 0, 1]])
    cameras = {}
    for index in range(3):
        name, view = f"c{index}", camera(index)
        cameras[name] = {
            "width": SIZE, "height": SIZE, "K": K.tolist(), "R": view[:3, :3].tolist(), "t": view[:3, 3].tolist(),
        }  # fmt: skip
        for kind in ("images", "masks"):
            (root / kind / name).mkdir(parents=True)
        for row, frame in enumerate(meshes.frames):
            rgb, _, label = draw(meshes, row, view, K, SIZE)
            Image.fromarray(rgb).save(root / "images" / name / f"{frame}.png")
            Image.fromarray(label).save(root / "masks" / name / f"{frame}.png")
    (root / "cameras.json").write_text(json.dumps(cameras))
    (root / "splits.json").write_text(json.dumps({"frames": meshes.frames}))
    (root / "meshes").mkdir()
    topology = {f"{part}_faces": value.faces for part, value in meshes.parts.items()}
    np.savez(root / "meshes/topology.npz", **topology)
    for row, frame in enumerate(meshes.frames):
        there = [part for part in meshes.parts if not (row == 0 and part == "right_hand")]
        np.savez(root / "meshes" / f"{frame}.npz", **{part: meshes.parts[part].verts[row] for part in there})
    return root
