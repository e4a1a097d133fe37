"""A complete synthetic dataset in the exact layout of the Decaf release, so that the readers run the code they run on
the real thing.

What the release has and people trip over is there too: subjects in two split folders, world-to-camera extrinsics as
4x4 lists, distortion under a further key, masks of the whole person as lossy video, boxes of -1, missing keypoints,
deformations in the canonical frame with the minus sign and rubbish at the neck, frame keys as text without zero
padding, pickles as Python 2 and 3.7 wrote them.
"""

import contextlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import Camera, project
from nbavatar.config.synthetic import RECORD, refuse_others
from nbavatar.data.decaf_files import Assets, DecafSubject, release_subject
from nbavatar.data.synthetic.capture import write_capture
from nbavatar.data.synthetic.figure import build_figure, pose_figure
from nbavatar.data.synthetic.legacy_pickle import dump_array, dump_legacy
from nbavatar.data.synthetic.models import Human, flame_content, landmark_content, mano_content, mirrored_mano_content
from nbavatar.data.synthetic.scene import Scene, build_bodies, make_scene
from nbavatar.data.synthetic.studio import lens_of, light_up, make_cameras, photograph
from nbavatar.errors import DataError
from nbavatar.io.atomic import atomic_write
from nbavatar.io.records import write_json
from nbavatar.io.video import VideoWriter

__all__ = ["detect", "write_assets", "write_dataset", "write_subject"]

T = TypeVar("T")
Progress = Callable[[Iterable[T], str, int], Iterable[T]]

FRAMES_PER_SECOND = 50.0


def write_dataset(
    root: Path,
    *,
    subjects: tuple[str, ...],
    cameras: tuple[str, ...],
    frames: int,
    width: int,
    height: int,
    supersample: int = 2,
    mesh: str = "full",
    layout: str = "decaf",
    hair: str = "cap",
    focal: float = 2.9,
    distortion: float = 1.0,
    press: float = 6e-3,
    mesh_noise: float = 1.0,
    keypoint_noise: float = 1.5,
    missing: float = 0.03,
    parameter_noise: float = 0.0,
    codec: str = "mp4v",
    seed: int = 0,
    workers: int = 1,
    progress: Progress = lambda items, _description, _total: items,
    record: dict[str, Any] | None = None,
) -> None:
    """Writes assets and subjects under `root`; a finished subject is left alone.

    Args:
        root: folder; made if absent.
        subjects: names S1..S8.
        cameras: ids of the release.
        frames: frames a subject.
        width, height: image size [px], even numbers.
        supersample: samples a pixel along each side.
        mesh: "full" or "tiny".
        layout: "decaf", or "capture" for one capture a subject, `root/<subject>` (`synthetic.capture`).
        hair: style, one of `nbavatar.config.synthetic.HAIR`.
        focal: focal length over image height.
        distortion: factor on the lens distortion.
        press: how deep the hand reaches into the undeformed face [m].
        mesh_noise: error of a capture's meshes, multiples of 1 mm and 0.3 degrees.
        keypoint_noise: standard deviation of keypoints [px of 1080 lines].
        missing: share of keypoints and boxes that are missing.
        parameter_noise: error of the stored parameters, multiples of 1 mm and 0.5 degrees.
        codec: FourCC code of the videos.
        seed: of everything random.
        workers: threads that render.
        progress: wraps the loops; called with items, a description and their number.
        record: provenance for `synthetic.json`.

    Raises:
        DataError: odd image size, or a codec that this OpenCV does not write.
        ConfigError: the folder holds files of others.
    """
    if width % 2 or height % 2:
        raise DataError.of(
            "synthesize", "width, height", expected="even numbers (video codecs need them)", found=f"{width}x{height}"
        )
    refuse_others(root)
    about = {"subjects": list(subjects), "cameras": list(cameras), "mesh": mesh, **(record or {})}
    write_json(root / RECORD, about | {"complete": False})
    bodies = build_bodies(mesh)
    if layout == "decaf":
        write_assets(root, bodies.human)
    for name in subjects:
        scene = make_scene(
            bodies,
            name,
            frames,
            seed,
            press=press,
            progress=lambda items, name=name: progress(items, f"{name} motion", frames),
        )
        bent = distortion if layout == "decaf" else 0.0
        rig = make_cameras(cameras, width, height, focal=focal, distortion=bent, seed=seed)
        if layout == "capture":
            write_capture(
                root / name,
                scene,
                rig,
                hair=hair,
                supersample=supersample,
                mesh_noise=mesh_noise,
                seed=seed,
                workers=workers,
                progress=progress,
                record=record,
            )
            continue
        write_subject(
            root,
            scene,
            rig,
            hair=hair,
            supersample=supersample,
            keypoint_noise=keypoint_noise * height / 1080,
            missing=missing,
            parameter_noise=parameter_noise,
            codec=codec,
            seed=seed,
            workers=workers,
            progress=progress,
        )
    write_json(root / RECORD, about | {"complete": True})


def write_assets(root: Path, human: Human) -> None:
    """Writes the body models and index files that a user of the release has to bring along, licence-free."""
    assets = Assets(root / "assets")
    right = mano_content(human)
    _bytes(assets.flame, dump_legacy(flame_content(human), python2=True))
    _bytes(assets.landmarks, dump_array(landmark_content(human)))
    _bytes(assets.mano(), dump_legacy(right, python2=True))
    _bytes(assets.mano("left"), dump_legacy(mirrored_mano_content(right), python2=True))
    _save(assets.folder / "left_right_face_corresps.npy", human.flip)
    _save(assets.neck_of_dents, human.neck())
    _save(assets.neck_of_contacts, human.neck(0.008))
    _bytes(assets.folder / "default_mesh.ply", _ply(human.head, human.head_faces))


def write_subject(
    root: Path,
    scene: Scene,
    cameras: dict[str, Camera],
    *,
    hair: str = "cap",
    supersample: int,
    keypoint_noise: float,
    missing: float,
    parameter_noise: float,
    codec: str,
    seed: int,
    workers: int = 1,
    progress: Progress = lambda items, _description, _total: items,
) -> None:
    """Writes all files of one subject; see `write_dataset` for the arguments (`keypoint_noise` here in pixels)."""
    name = scene.subject.name
    subject = release_subject(root, name)
    rng = np.random.default_rng([seed, scene.subject.seed, 53])
    human, count = scene.bodies.human, len(scene.head)

    stored = {key: value.copy() for key, value in scene.parameters.items()}
    for key, size in (("transl", 1e-3), ("global_orient", np.deg2rad(0.5))):
        for part in ("head", "right_hand"):
            stored[f"{part}.{key}"] += rng.normal(0, parameter_noise * size, (count, 3))
    # text keys without zero padding: sorted as text, frame 10 would come before frame 2
    frames = {
        str(n): {
            part: {
                key.split(".")[1]: value[n].astype(np.float32)
                for key, value in stored.items()
                if key.startswith(part + ".")
            }
            for part in ("head", "right_hand")
        }
        for n in range(count)
    }
    _bytes(subject.parameters, dump_legacy(frames))
    rig = {
        camera: {
            "intrinsic": c.K,
            "extrinsic": c.cam_from_world.tolist(),
            "distortion": np.zeros(5) if c.distortion is None else c.distortion,
        }
        for camera, c in cameras.items()
    }
    _bytes(subject.calibration, dump_legacy(rig))
    segments = scene.motion.segments
    cuts = [(int(a[1]), int(b[0])) for a, b in zip(segments, segments[1:], strict=False)]
    _bytes(subject.cut_file, dump_legacy(cuts))
    shape = {
        "head": {"shape_params": scene.subject.shape.astype(np.float32)},
        "right_hand": {"betas": scene.subject.betas.astype(np.float32)},
    }
    _bytes(subject.own_shape, dump_legacy(shape))

    rotation = _rotations(scene)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = scene.head_rigid.mean(1) - np.einsum("nij,nj->ni", rotation, scene.canonical.mean(1))
    _save(subject.head_poses, poses)
    # stored with the minus sign and in the canonical frame; ids on the neck hold what the release calls invalid
    deform = -np.einsum("nji,nvj->nvi", rotation, scene.offset)
    neck = human.neck()
    deform[:, neck] = rng.normal(0, 2e-3, (count, len(neck), 3))
    _save(subject.deformations, deform.astype(np.float32))
    contacts = subject.contacts("head").parent
    _save(subject.contacts("head"), scene.contact_head.astype(np.float32))
    _save(subject.contacts("right_hand"), scene.contact_hand.astype(np.float32))
    _save(contacts / "contacts_lh.npy", scene.contact_hand.astype(np.float32))
    _save(contacts / "contacts_head_flipped.npy", scene.contact_head[:, human.flip].astype(np.float32))

    for camera_name, camera in cameras.items():
        seen = np.random.default_rng([seed, scene.subject.seed, int(camera_name), 59])
        for part, points, verts in (("head", scene.landmarks, scene.head), ("right_hand", scene.joints, scene.hand)):
            keys, boxes = detect(camera, points, verts, seen, noise=keypoint_noise, missing=missing)
            _save(subject.keypoints(part, camera_name), keys)
            _save(subject.boxes(part, camera_name), boxes)
    _write_videos(subject, scene, cameras, hair, supersample, codec, seed, workers, progress)


def detect(
    camera: Camera, points: np.ndarray, verts: np.ndarray, rng: np.random.Generator, *, noise: float, missing: float
) -> tuple[np.ndarray, np.ndarray]:
    """What detectors would report: keypoints with confidence and boxes, in pixels of the distorted image.

    Args:
        camera: with distortion.
        points: (N, L, 3) keypoints, world [m].
        verts: (N, V, 3) mesh of the part, world [m].
        rng: source of errors.
        noise: standard deviation [px]; a tenth as many points err four times as much, with low confidence.
        missing: share of points with confidence 0 and of frames without a box (all -1).

    Returns:
        (N, L, 3) float32 x, y, confidence and (N, 4) float32 x0 y0 x1 y1.
    """
    count, size = points.shape[:2]
    pixels = _image_points(camera, points)
    poor = rng.random((count, size)) < 0.1
    error = rng.normal(0, noise, pixels.shape) * np.where(poor, 4.0, 1.0)[..., None]
    confidence = np.where(poor, rng.uniform(0.2, 0.5, (count, size)), rng.uniform(0.75, 1.0, (count, size)))
    lost = rng.random((count, size)) < missing
    lost |= (rng.random(count) < missing / 2)[:, None]  # now and then a detector fails altogether
    keys = np.concatenate([pixels + error, confidence[..., None]], -1)
    keys[lost] = 0.0
    outline = _image_points(camera, verts)
    margin = 0.03 * (outline.max(1) - outline.min(1)).max(1, keepdims=True)
    boxes = np.concatenate([outline.min(1) - margin, outline.max(1) + margin], 1) + rng.normal(0, noise, (count, 4))
    boxes[:, [0, 2]] = boxes[:, [0, 2]].clip(0, camera.width - 1)
    boxes[:, [1, 3]] = boxes[:, [1, 3]].clip(0, camera.height - 1)
    flat = (boxes[:, 2] - boxes[:, 0] < 2) | (boxes[:, 3] - boxes[:, 1] < 2)
    boxes[flat | (rng.random(count) < missing)] = -1.0
    return keys.astype(np.float32), boxes.astype(np.float32)


def _image_points(camera: Camera, points: np.ndarray) -> np.ndarray:
    return distort_pixels(project(points, camera.K, camera.cam_from_world)[0], camera.K, camera.distortion)


def _rotations(scene: Scene) -> np.ndarray:
    import torch

    from nbavatar.math.rotations import axis_angle_to_matrix

    return axis_angle_to_matrix(torch.from_numpy(scene.parameters["head.global_orient"])).numpy()


def _write_videos(
    subject: DecafSubject,
    scene: Scene,
    cameras: dict[str, Camera],
    hair: str,
    supersample: int,
    codec: str,
    seed: int,
    workers: int,
    progress: Progress,
) -> None:
    """Renders frame by frame, all cameras at once, so that a frame's shadow maps are made once."""
    from concurrent.futures import ThreadPoolExecutor

    name, figure = scene.subject.name, build_figure(scene, hair)
    lenses = [lens_of(camera, supersample) for camera in cameras.values()]
    resolution = int(np.clip(lenses[0].camera.height, 256, 1024))
    paths = [(subject.video(c), subject.matte(c)) for c in cameras]
    with _Videos([p for pair in paths for p in pair], codec) as videos, ThreadPoolExecutor(workers) as pool:
        for n in progress(range(len(scene.head)), f"{name} images", len(scene.head)):
            posed = pose_figure(figure, scene, n)
            lights = light_up(posed[0], figure.faces, resolution)

            def take(index: int, posed: Any = posed, lights: Any = lights, n: int = n) -> tuple[np.ndarray, np.ndarray]:
                rng = np.random.default_rng([seed, scene.subject.seed, index, n])
                return photograph(lenses[index], figure, posed, lights, noise=0.8, rng=rng)

            for index, (image, person) in enumerate(pool.map(take, range(len(lenses)))):
                videos.write(2 * index, image)
                videos.write(2 * index + 1, np.repeat(person[..., None], 3, 2))


class _Videos:
    """Several video files that appear under their names only when all are whole."""

    def __init__(self, paths: list[Path], codec: str) -> None:
        if len(codec) != 4:
            raise DataError.of("synthesize", "codec", expected="four letters such as mp4v", found=codec)
        self._writers = [VideoWriter(path, FRAMES_PER_SECOND, codec) for path in paths]
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> "_Videos":
        with contextlib.ExitStack() as opening:
            for writer in self._writers:
                opening.enter_context(writer)
            self._stack = opening.pop_all()
        return self

    def write(self, index: int, frame: np.ndarray) -> None:
        """Appends a frame, uint8 RGB `[H, W, 3]`, to one of them."""
        self._writers[index].add(frame)

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        with self._stack:
            if error is not None:
                raise error
            for writer in self._writers:
                writer.finish()


def _bytes(path: Path, content: bytes) -> None:
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _save(path: Path, array: np.ndarray) -> None:
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        np.save(stream, array, allow_pickle=False)


def _ply(verts: np.ndarray, faces: np.ndarray) -> bytes:
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(verts)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), dtype=[("n", "u1"), ("ids", "<i4", 3)])
    rows["n"], rows["ids"] = 3, faces
    return header.encode("ascii") + verts.astype("<f4").tobytes() + rows.tobytes()
