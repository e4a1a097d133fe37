"""Tiny inputs of both layouts, written from scratch in a few milliseconds."""

import json
import os
import pickle
from pathlib import Path

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # FFmpeg looks once, when the first video is opened

import cv2
import numpy as np
import scipy.sparse
from PIL import Image
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FRAMES = 64, 48, 12
CAMERAS = ("084", "100")
HEAD_VERTS, HAND_VERTS = 40, 30
ROOT = np.uint32(2**32 - 1)


def save(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, content)
    else:
        path.write_bytes(pickle.dumps(content, protocol=2))


def write_video(path: Path, frames: list[np.ndarray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25, (frames[0].shape[1], frames[0].shape[0]))
    for frame in frames:
        writer.write(frame if frame.ndim == 3 else cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()


def model(rng: np.random.Generator, parents: list, verts: int, directions: int, scale: float) -> dict:
    joints = len(parents)
    regressor = rng.random((joints, verts)) + 0.1
    weights = rng.random((verts, joints)) ** 4
    return {
        "v_template": scale * rng.normal(size=(verts, 3)),
        "f": np.array([[i, (i + 1) % verts, (i + 2) % verts] for i in range(verts)], dtype=np.uint32),
        "shapedirs": 0.05 * scale * rng.normal(size=(verts, 3, directions)),
        "posedirs": 0.01 * scale * rng.normal(size=(verts, 3, 9 * (joints - 1))),
        "J_regressor": scipy.sparse.csc_matrix(regressor / regressor.sum(1, keepdims=True)),
        "kintree_table": np.stack([np.array(parents, dtype=np.uint32), np.arange(joints, dtype=np.uint32)]),
        "weights": weights / weights.sum(1, keepdims=True),
    }


def frame_image(index: int) -> np.ndarray:
    """A BGR picture that tells its own number by its brightness, and blue from red."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[...] = 10 + 18 * index
    image[:8, :8] = (255, 0, 0)
    return image


def write_decaf(root: Path, subject: str = "S2", folder: str = "train", *, keys: str = "int", cuts=((4, 5),)) -> Path:
    """One complete subject with two cameras of 12 frames, and the body models."""
    rng = np.random.default_rng(3)
    base = root / folder
    for n, camera in enumerate(CAMERAS):
        write_video(base / "videos" / subject / f"{camera}.mp4", [frame_image(i) for i in range(FRAMES)])
        matte = np.zeros((HEIGHT, WIDTH), np.uint8)
        matte[8:40, 10:50] = 255
        write_video(base / "segmentations" / subject / f"{camera}.mp4", [matte] * FRAMES)
        for part, count in (("head", 68), ("right_hand", 21)):
            points = rng.uniform(5, 40, (FRAMES, count, 3))
            points[..., 2] = 1
            boxes = np.tile([5.0 + n, 6, 40, 41], (FRAMES, 1))
            boxes[3] = -1
            boxes[4] = [5, 5, WIDTH + 9, 20]
            save(base / f"{part}_keys" / subject / f"{camera}.npy", points)
            save(base / f"{part}_bbs" / subject / f"{camera}.npy", boxes)
    pose = np.eye(4)
    pose[2, 3] = 1.0
    cameras = {
        camera: {"intrinsic": [[60.0, 0, 31], [0, 60.0, 25], [0, 0, 1]], "extrinsic": pose.tolist()}
        for camera in CAMERAS
    }
    cameras["100"]["dist_coeffs"] = [[0.1, -0.05, 0.001, 0.002, 0.0]]
    save(base / "cameras" / subject / "cameras.pkl", cameras)
    shape, betas = rng.normal(size=100), rng.normal(size=10)
    frames = {}
    for i in range(FRAMES):
        orient = rng.normal(size=3) * 0.4
        frames[{"int": i, "str": str(i)}[keys]] = {
            "head": {
                "transl": rng.normal(size=3) * 0.1,
                "global_orient": orient,
                "shape_params": shape,
                "expression_params": rng.normal(size=50) * 0.2,
                "pose_params": np.concatenate([orient, rng.normal(size=3) * 0.1]),
            },
            "right_hand": {
                "transl": rng.normal(size=3) * 0.1,
                "global_orient": rng.normal(size=3) * 0.3,
                "hand_pose": rng.normal(size=45) * 0.2,
                "betas": betas,
            },
        }
    if keys == "str":  # stored in the order of text, as a sort of the raw keys would give
        frames = {key: frames[key] for key in sorted(frames)}
    save(base / "params" / subject / "params_smoothed.pkl", frames)
    by_number = {int(k): v for k, v in frames.items()}
    save(base / "deformations" / subject / "deforms.npy", rng.normal(size=(FRAMES, HEAD_VERTS, 3)) * 0.01)
    save(
        base / "contacts" / subject / "contacts_head.npy", rng.integers(0, 2, (FRAMES, HEAD_VERTS)).astype(float) * 0.4
    )
    save(base / "contacts" / subject / "contacts_rh.npy", rng.integers(0, 2, (FRAMES, HAND_VERTS)))
    save(base / "cutIDs" / f"{subject}.pkl", list(cuts))
    assets = root / "assets"
    own = {"head": {"shape_params": shape}, "right_hand": {"betas": betas}}
    save(assets / "accurate_shapes" / f"{subject}.pkl", own)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec([by_number[i]["head"]["global_orient"] for i in range(FRAMES)]).as_matrix()
    save(assets / "transformation" / folder / f"{subject}_RT_FromCanToRef_wo_poseparams.npy", poses)
    save(assets / "FLAME_neck_idx.npy", np.array([0, 7]))
    save(assets / "neck_idx.npy", np.array([0, 1]))
    models = np.random.default_rng(9)
    landmarks = {}
    for name, lead in (("static", (51,)), ("dynamic", (79, 17)), ("full", (1, 68))):
        landmarks[f"{name}_lmk_faces_idx"] = rng.integers(0, HEAD_VERTS, lead)
        landmarks[f"{name}_lmk_bary_coords"] = rng.dirichlet(np.ones(3), size=lead)
    save(assets / "landmark_embedding.npy", np.array(landmarks, dtype=object))
    save(assets / "generic_model.pkl", model(models, [ROOT, 0, 1, 1, 1], HEAD_VERTS, 400, 0.1))
    hand = model(models, [ROOT, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14], HAND_VERTS, 10, 0.05)
    save(assets / "mano_v1_2" / "models" / "MANO_RIGHT.pkl", hand | {"tip_vertices": np.arange(5)})
    return root


def open_sphere(
    radius: float, centre: np.ndarray, axis: np.ndarray, cut: float = -0.7
) -> tuple[np.ndarray, np.ndarray]:
    """Sphere of rings, open where its height along `axis` is below `cut` radii; outward faces."""
    rings, sectors = 14, 24
    heights = np.linspace(cut, 0.999, rings)
    angles = np.arange(sectors) * 2 * np.pi / sectors
    flat = np.sqrt(1 - heights**2)
    verts = np.stack(
        [flat[:, None] * np.cos(angles), flat[:, None] * np.sin(angles), np.repeat(heights[:, None], sectors, 1)], -1
    ).reshape(-1, 3)
    top = np.array([[0, 0, 1.0]])
    verts = np.concatenate([verts, top])
    faces = []
    for r in range(rings - 1):
        for s in range(sectors):
            a, b = r * sectors + s, r * sectors + (s + 1) % sectors
            faces += [[a, b, b + sectors], [a, b + sectors, a + sectors]]
    last = (rings - 1) * sectors
    faces += [[last + s, last + (s + 1) % sectors, len(verts) - 1] for s in range(sectors)]
    rotation = Rotation.align_vectors([axis / np.linalg.norm(axis)], [[0, 0, 1.0]])[0].as_matrix()
    return (radius * verts @ rotation.T + centre).astype(np.float32), np.array(faces)


def capture_meshes(frame: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """A ball of a head, and a smaller ball of a hand that moves in front of it; y is down, as in the cameras."""
    head, head_faces = open_sphere(0.1, np.zeros(3), np.array([0, -1.0, 0]))
    hand, hand_faces = open_sphere(0.045, np.array([0.1 - 0.01 * frame, 0.05, -0.12]), np.array([-1.0, -0.3, 0]))
    return {"head": head, "right_hand": hand}, {"head": head_faces, "right_hand": hand_faces}


def write_capture(root: Path, frames: int = 5, *, width: int = 96, height: int = 80) -> Path:
    """A capture with two cameras, exact label masks, and heads with and without contact."""
    from nbavatar.mesh.zbuffer import rasterize_mesh

    ids = [f"t{i}" for i in range(frames)]
    cameras = {}
    for n, name in enumerate(("left", "right")):
        R = Rotation.from_euler("y", [25, -20][n], degrees=True).as_matrix()
        K = [[150.0, 0, width / 2 + 1.5], [0, 150.0, height / 2 - 2.25], [0, 0, 1]]
        cameras[name] = {"width": width, "height": height, "K": K, "R": R.tolist(), "t": [0, 0, 0.6]}
    root.mkdir(parents=True, exist_ok=True)
    (root / "cameras.json").write_text(json.dumps(cameras))
    (root / "splits.json").write_text(json.dumps({"frames": ids}))
    (root / "meshes").mkdir()
    for i, frame in enumerate(ids):
        verts, faces = capture_meshes(i)
        rigid = verts["head"].copy()
        verts["head"] = verts["head"] - np.array([0, 0, 0.001], np.float32) * (i > 1)
        np.savez(root / "meshes" / f"{frame}.npz", head_rigid=rigid, **verts)
        np.savez(root / "meshes" / "topology.npz", **{f"{part}_faces": f for part, f in faces.items()})
        for name, camera in cameras.items():
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = camera["R"], camera["t"]
            joined = np.concatenate([faces["head"], faces["right_hand"] + len(verts["head"])])
            points = np.concatenate([verts["head"], verts["right_hand"]])
            face, _, _ = rasterize_mesh(points, joined, np.array(camera["K"]), width, height, cam_from_world=pose)
            label = np.where(face < 0, 0, np.where(face < len(faces["head"]), 1, 2)).astype(np.uint8)
            image = np.array([[90, 90, 90], [220, 150, 120], [120, 150, 220]], np.uint8)[label]
            for kind, picture in (("images", image), ("masks", label)):
                path = root / kind / name / f"{frame}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(picture).save(path)
    return root
