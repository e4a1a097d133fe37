"""One small subject in the folders that other programs write: VHAP's export, nerfstudio's and COLMAP's.

Written from descriptions of these formats. The subject is a licence-free head with FLAME's arrays; its cameras are made
in each format's own terms, and `expected_pixels` says, by OpenCV's lens, where a point has to be seen.
"""

import functools
import json
import pickle
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from nbavatar.data.synthetic.models import flame_content, load_human
from nbavatar.mesh.zbuffer import rasterize_mesh

WIDTH, HEIGHT = 56, 48
CAMERAS = ("222200036", "222200037", "222200038")
TIMES = 5
LENS = {"k1": 0.11, "k2": -0.06, "p1": 0.002, "p2": -0.001, "k3": 0.01}


def rig() -> list[dict]:
    """Cameras around the origin: focal lengths, principal point, world from camera with OpenCV's axes."""
    result = []
    for index, angle in enumerate((-25.0, 3.0, 28.0)):
        turn = Rotation.from_euler("yx", [180 + angle, 4.0 * index - 3], degrees=True).as_matrix()
        turn = turn @ np.diag([-1.0, -1.0, 1.0])  # y of the image points down
        centre = -0.55 * turn[:, 2]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, centre
        fx = 82.5 + index
        result.append({"fx": fx, "fy": fx + 0.75, "cx": WIDTH / 2 + 1.25, "cy": HEIGHT / 2 - 2.5, "pose": pose})
    return result


def expected_pixels(camera: dict, points: np.ndarray, lens: dict | None = None) -> np.ndarray:
    """Where OpenCV sees world points [px], pixel centres at +0.5."""
    view = np.linalg.inv(camera["pose"])
    K = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]])
    lens = lens or {}
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients = np.array([lens.get(key, 0.0) for key in order])
    rotation, _ = cv2.Rodrigues(view[:3, :3])
    return cv2.projectPoints(points, rotation, view[:3, 3], K, coefficients)[0].reshape(-1, 2)


@functools.cache
def flame() -> dict:
    """The content of a model file with FLAME's arrays, small."""
    content = flame_content(load_human("tiny"))
    return {key: value.x if hasattr(value, "x") else value for key, value in content.items()}


def write_flame(path: Path) -> Path:
    """A model file with FLAME's arrays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(flame(), protocol=2))
    return path


def flame_parameters(time: int, verts: int, *, teeth: bool = False) -> dict[str, np.ndarray]:
    """VHAP's arrays of one moment."""
    rng = np.random.default_rng(7)
    shape = (0.6 * rng.normal(size=300) * (np.arange(300) < 20)).astype(np.float32)
    static = (0.001 * rng.normal(size=(1, verts + 120 * teeth, 3))).astype(np.float32)
    rng = np.random.default_rng(100 + time)
    return {
        "shape": shape,
        "expr": (0.4 * rng.normal(size=(1, 100)) * (np.arange(100) < 10)).astype(np.float32),
        "rotation": np.array([[0.02 * time, 0.06 * time - 0.1, 0.01]], np.float32),
        "neck_pose": np.array([[0.05, -0.02 * time, 0.0]], np.float32),
        "jaw_pose": np.array([[0.04 * time, 0.0, 0.0]], np.float32),
        "eyes_pose": (0.1 * rng.normal(size=(1, 6))).astype(np.float32),
        "translation": np.array([[0.002 * time, -0.79, -0.02]], np.float32),
        "static_offset": static,
        "dynamic_offset": (0.0005 * rng.normal(size=static.shape)).astype(np.float32),
    }


def posed_head(parameters: dict[str, np.ndarray]) -> np.ndarray:
    """The vertices float64 `[V, 3]` of FLAME's published equations, written out joint by joint; no code of ours."""
    content = flame()
    values = {key: value.astype(np.float64).ravel() for key, value in parameters.items()}
    shaped = content["v_template"] + content["shapedirs"] @ np.concatenate([values["shape"], values["expr"]])
    for key in ("static_offset", "dynamic_offset"):
        if key in values:
            shaped = shaped + values[key].reshape(-1, 3)[: len(shaped)]
    joints = content["J_regressor"].toarray() @ shaped
    angles = np.concatenate([values[key] for key in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")]).reshape(5, 3)
    turns = Rotation.from_rotvec(angles).as_matrix()
    posed = shaped + content["posedirs"] @ (turns[1:] - np.eye(3)).ravel()
    moves: list[np.ndarray] = []
    for joint, parent in enumerate((None, 0, 1, 1, 1)):
        local = np.eye(4)
        local[:3, :3] = turns[joint]
        local[:3, 3] = joints[joint] - (0 if parent is None else joints[parent])
        moves.append(local if parent is None else moves[parent] @ local)
    result = np.zeros_like(posed)
    for joint, move in enumerate(moves):
        result += content["weights"][:, joint, None] * ((posed - joints[joint]) @ move[:3, :3].T + move[:3, 3])
    return result + values["translation"]


def head_faces() -> np.ndarray:
    """Faces int64 `[F, 3]`."""
    return load_human("tiny").head_faces.astype(np.int64)


def write_obj(path: Path, verts: np.ndarray, faces: np.ndarray) -> None:
    """With texture coordinates of a seam and full precision, as VHAP does."""
    lines = ["mtllib head.mtl", *(f"v {x!r} {y!r} {z!r}" for x, y, z in verts.tolist())]
    lines += ["vt 0.0 0.0", "vt 1.0 0.0", "vt 0.5 1.0", "vt 0.25 0.75", "usemtl skin"]
    lines += [
        f"f {a}/{1 + i % 4} {b}/{1 + (i + 1) % 4} {c}/{2 + i % 3}" for i, (a, b, c) in enumerate((faces + 1).tolist())
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def draw(camera: dict, verts: np.ndarray, faces: np.ndarray, time: int) -> tuple[np.ndarray, np.ndarray]:
    """A shaded head on grey, and its matte, both uint8."""
    view = np.linalg.inv(camera["pose"])
    K = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]])
    face, _, _ = rasterize_mesh(verts, faces, K, WIDTH, HEIGHT, cam_from_world=view)
    shade = (60 + (np.arange(len(faces)) * 37 % 150))[:, None] * np.array([1.0, 0.8, 0.7])
    image = np.where(face[..., None] >= 0, shade[face], 90 + time).astype(np.uint8)
    return image, np.where(face >= 0, 255, 0).astype(np.uint8)


def opengl(pose: np.ndarray) -> list[list[float]]:
    """World from camera with OpenGL's axes: y up, z back."""
    matrix = pose.copy()
    matrix[:, 1] = -pose[:, 1]
    matrix[:, 2] = -pose[:, 2]
    return matrix.tolist()


@functools.cache
def heads(*, teeth: bool = False) -> tuple[list[dict[str, np.ndarray]], list[np.ndarray]]:
    """Parameters and vertices of all moments."""
    count = len(load_human("tiny").head)
    parameters = [flame_parameters(time, count, teeth=teeth) for time in range(TIMES)]
    return parameters, [posed_head(values) for values in parameters]


def write_vhap(root: Path, *, mode: str = "param", teeth: bool = False, whole: bool = True) -> Path:
    """VHAP's export: held out are the second camera and the last moment."""
    parameters, posed = heads(teeth=teeth)
    faces, extra = head_faces(), np.zeros((0, 3))
    if teeth and mode == "mesh":  # two rows of triangles behind the lips, moving with the head's mean
        rng = np.random.default_rng(3)
        extra = 0.01 * rng.normal(size=(120, 3))
        faces = np.concatenate([faces, len(posed[0]) + np.arange(120).reshape(-1, 3)])
    frames = {"train": [], "val": [], "test": []}
    for time, verts in enumerate(posed):
        stem = f"{time:05d}"
        if mode == "param":
            path, key = f"flame_param/{stem}.npz", "flame_param_path"
            (root / "flame_param").mkdir(parents=True, exist_ok=True)
            np.savez(root / path, **parameters[time])
        else:
            path, key = f"meshes/{stem}.obj", "mesh_path"
            write_obj(root / path, np.concatenate([verts, extra + verts.mean(0)]), faces)
        for index, (name, camera) in enumerate(zip(CAMERAS, rig())):
            image, matte = draw(camera, verts, head_faces(), time)
            file = f"{stem}_{index:02d}.png"
            for folder, picture in (("images", image), ("fg_masks", matte)):
                (root / folder).mkdir(parents=True, exist_ok=True)
                Image.fromarray(picture).save(root / folder / file)
            frame = {
                "timestep_index": time, "timestep_index_original": 3 * time + 2, "timestep_id": f"{3 * time + 2:06d}",
                "camera_index": index, "camera_id": name, "fl_x": camera["fx"], "fl_y": camera["fy"],
                "cx": camera["cx"], "cy": camera["cy"], "w": WIDTH, "h": HEIGHT,
                "camera_angle_x": 2 * np.arctan(WIDTH / 2 / camera["fx"]), "transform_matrix": opengl(camera["pose"]),
                "file_path": f"images/{file}", "fg_mask_path": f"fg_masks/{file}", key: path,
            }  # fmt: skip
            frames["test" if time == TIMES - 1 else "val" if index == 1 else "train"].append(frame)
    if mode == "mesh":
        write_obj(root / "canonical.obj", np.concatenate([posed[0], extra + posed[0].mean(0)]), faces)
    everything = [frame for subset in frames.values() for frame in subset]
    last = {key: everything[-1][key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    files = {"": everything} if whole else {}
    for suffix, listed in {**files, **{f"_{name}": subset for name, subset in frames.items()}}.items():
        indices = {f"{kind}_indices": sorted({f[f"{kind}_index"] for f in listed}) for kind in ("timestep", "camera")}
        (root / f"transforms{suffix}.json").write_text(json.dumps({**last, **indices, "frames": listed}, indent=1))
    return root


def write_meshes(root: Path, *, kind: str = "obj", scale: float = 1.0, folder: str = "head") -> Path:
    """The head's meshes as files of their own, in units of `1 / scale` metres."""
    import trimesh

    for time, verts in enumerate(heads()[1]):
        path = root / folder / f"{time}.{kind}"
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "obj":
            write_obj(path, verts / scale, head_faces())
        else:
            trimesh.Trimesh(verts / scale, head_faces(), process=False).export(path)
    return root


def write_pictures(root: Path, *, masks: Path | None = None, pattern: str = "{camera}/{frame}.png") -> list[tuple]:
    """Pictures of all cameras and moments; (path below `root`, index of the camera, moment) of each."""
    written = []
    for time, verts in enumerate(heads()[1]):
        for index, camera in enumerate(rig()):
            image, matte = draw(camera, verts, head_faces(), time)
            file = pattern.format(camera=f"cam{index}", frame=f"{time:04d}")
            for folder, picture in ((root, image), (masks, matte)):
                if folder is not None:
                    (folder / file).parent.mkdir(parents=True, exist_ok=True)
                    Image.fromarray(picture).save(folder / file)
            written.append((file, index, time))
    return written


def write_nerfstudio(root: Path, *, lens: dict | None = None, scale: float = 1.0, moved: bool = False) -> Path:
    """transforms.json with one entry a picture; `moved`: with applied_transform and applied_scale."""
    transform, factor = np.eye(4), 1.0
    if moved:
        transform[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        transform[:3, 3], factor = [0.3, -0.2, 0.7], 0.37
    frames = []
    for file, index, _ in write_pictures(root / "images", masks=root / "masks"):
        camera = rig()[index]
        pose = camera["pose"].copy()
        pose[:3, 3] /= scale
        pose = transform @ pose
        pose[:3, 3] *= factor
        frames.append({
            "file_path": f"./images/{file}", "mask_path": f"masks/{file}", "transform_matrix": opengl(pose),
            "fl_x": camera["fx"], "fl_y": camera["fy"],
        })  # fmt: skip
    top = {"camera_model": "OPENCV" if lens else "PINHOLE", "w": WIDTH, "h": HEIGHT, **(lens or {}), "frames": frames}
    top |= {"cx": rig()[0]["cx"], "cy": rig()[0]["cy"]}
    if moved:
        top |= {"applied_transform": transform[:3].tolist(), "applied_scale": factor}
    (root / "transforms.json").write_text(json.dumps(top))
    return root


COLMAP_MODELS = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k1")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}


def write_colmap(
    root: Path, *, binary: bool = False, model: str = "PINHOLE", lens: dict | None = None, scale: float = 1.0,
    calibration_only: bool = False,
) -> Path:  # fmt: skip
    """A workspace: one lens a camera, one pose a picture; `calibration_only`: of one picture a camera."""
    number, keys = COLMAP_MODELS[model]
    pattern = "{camera}.png" if calibration_only else "{camera}/{frame}.png"
    pictures = write_pictures(root / "images", masks=root / "masks", pattern=pattern)
    if calibration_only:
        pictures = pictures[:3]
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    cameras, images = [], []
    for index, camera in enumerate(rig()):
        values = {
            **camera,
            "f": camera["fx"],
            **{f"k{i}": 0.0 for i in range(1, 7)},
            "p1": 0.0,
            "p2": 0.0,
            **(lens or {}),
        }
        cameras.append((10 + index, [float(values[key]) for key in keys]))
    for order, (file, index, _) in enumerate(pictures):
        view = np.linalg.inv(rig()[index]["pose"])
        x, y, z, w = Rotation.from_matrix(view[:3, :3]).as_quat()
        images.append((order + 1, [w, x, y, z, *(view[:3, 3] / scale)], 10 + index, file))
    if binary:
        content = struct.pack("<Q", len(cameras))
        for key, values in cameras:
            content += struct.pack(f"<iiQQ{len(values)}d", key, number, WIDTH, HEIGHT, *values)
        (folder / "cameras.bin").write_bytes(content)
        content = struct.pack("<Q", len(images))
        for key, pose, camera, file in images:
            content += struct.pack("<I7dI", key, *pose, camera) + file.encode() + b"\0"
            content += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.5, 2.5, -1, 3.5, 4.5, 7)
        (folder / "images.bin").write_bytes(content)
    else:
        lines = [f"{key} {model} {WIDTH} {HEIGHT} {' '.join(map(repr, values))}" for key, values in cameras]
        (folder / "cameras.txt").write_text("# Camera list\n" + "\n".join(lines) + "\n")
        lines = []
        for key, pose, camera, file in images:  # the second line of an image, its points, may be empty
            lines += [f"{key} {' '.join(repr(float(v)) for v in pose)} {camera} {file}"]
            lines += ["1.5 2.5 -1 3.5 4.5 7" if key % 2 else ""]
        (folder / "images.txt").write_text("# Image list\n" + "\n".join(lines) + "\n")
    return root


def edit(path: Path, change: Callable) -> None:
    """Changes a JSON file."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
