"""The masks of the synthetic dataset's videos against its exact geometry."""

import json

import cv2
import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.io.framepack import FramePack

WIDTH, HEIGHT, FRAMES, CAMERAS = 320, 180, 6, ("084", "108")


def exact_labels(mesh):
    """Labels drawn from the meshes that the videos were drawn from: head and hair 1, hand 2, cloth and arm 0."""
    from nbavatar.data.synthetic.figure import build_figure, pose_figure
    from nbavatar.data.synthetic.scene import build_bodies, make_scene
    from nbavatar.data.synthetic.shading import ARM, CLOTH, HAND
    from nbavatar.data.synthetic.studio import lens_of, make_cameras
    from nbavatar.mesh.zbuffer import rasterize_mesh

    scene = make_scene(build_bodies(mesh), "S2", FRAMES, 0)
    figure = build_figure(scene)
    owner = np.select([np.isin(figure.material, (CLOTH, ARM)), figure.material == HAND], [0, 2], 1).astype(np.uint8)
    rig = make_cameras(CAMERAS, WIDTH, HEIGHT, seed=0)
    for camera in CAMERAS:
        lens = lens_of(rig[camera], 2)
        for n in range(FRAMES):
            verts = pose_figure(figure, scene, n)[0]
            face, _, _ = rasterize_mesh(
                verts, figure.faces, lens.K, lens.width, lens.height, cam_from_world=rig[camera].cam_from_world
            )
            label = np.where(face >= 0, owner[face], 0)
            shares = []
            for part in (1, 2):
                drawn = cv2.remap((label == part).astype(np.float32), *lens.maps, cv2.INTER_LINEAR)
                shares.append(drawn.reshape(HEIGHT, 2, WIDTH, 2).mean((1, 3)))
            yield camera, n, np.where(sum(shares) >= 0.5, np.argmax(shares, axis=0) + 1, 0)


@pytest.mark.slow
def test_masks_of_lossy_distorted_videos_are_close_to_the_exact_ones(tmp_path):
    cfg = {
        "mesh": "tiny", "subjects": ["S2"], "cameras": CAMERAS, "width": WIDTH, "height": HEIGHT, "frames": FRAMES,
    }  # fmt: skip
    assert main(["synthesize", "--out", str(tmp_path / "root"), "--cfg", json.dumps(cfg)]) == 0
    common = ["--layout", "decaf", "--root", str(tmp_path / "root"), "--subject", "S2"]
    assert main(["tracks", *common, "--out", str(tmp_path / "t.npz")]) == 0
    found = {}
    for camera in CAMERAS:
        pack, out = tmp_path / f"{camera}.zip", tmp_path / f"m{camera}.zip"
        assert main(["ingest", *common, "--camera", camera, "--out", str(pack)]) == 0
        assert main(["masks", "--frames", str(pack), "--meshes", str(tmp_path / "t.npz"), "--out", str(out)]) == 0
        found[camera] = FramePack(out)
    scores = {1: [], 2: []}
    for camera, n, truth in exact_labels("tiny"):
        label = found[camera].read("label", f"{n:06d}")
        for part, values in scores.items():
            values.append(((label == part) & (truth == part)).sum() / ((label == part) | (truth == part)).sum())
    # Measured: worst frame 0.961 and 0.936; at 960 x 540 with full meshes the means are 0.989 and 0.981.
    assert np.mean(scores[1]) > 0.97 and np.mean(scores[2]) > 0.97
    assert min(scores[1]) > 0.94 and min(scores[2]) > 0.93
