"""The studio: calibrated cameras with lens distortion, two lights with shadow maps, and the picture that a camera
takes."""

import dataclasses

import numpy as np

from nbavatar.camera.distortion import undistort_pixels
from nbavatar.camera.pinhole import Camera
from nbavatar.data.synthetic.figure import Figure
from nbavatar.data.synthetic.room import draw_room
from nbavatar.data.synthetic.scene import STAGE_TO_WORLD
from nbavatar.data.synthetic.shading import shade
from nbavatar.mesh.zbuffer import rasterize_mesh

__all__ = ["Lens", "Lights", "lens_of", "light_up", "make_cameras", "photograph"]

_TARGET = np.array([-0.01, 0.775, 0.06])
# azimuth (positive: from the subject's left), elevation [degrees], distance [m]
_PLACES = {
    "084": (-52.0, 4.0, 1.32),
    "100": (-34.0, 16.0, 1.30),
    "102": (-17.0, -7.0, 1.28),
    "108": (1.0, 5.0, 1.30),
    "110": (17.0, -6.0, 1.29),
    "111": (-8.0, 24.0, 1.34),
    "121": (36.0, 12.0, 1.31),
    "122": (58.0, 3.0, 1.33),
}
# position on the stage [m], radius [m], colour
_LIGHTS = np.array(
    [
        [-1.15, 1.75, 1.75, 0.09, 1.28, 1.18, 1.05],
        [1.45, 1.15, 1.55, 0.22, 0.42, 0.46, 0.54],
    ]
)
_SHADOW_REACH = 0.42


@dataclasses.dataclass(frozen=True)
class Lens:
    """How one camera's picture is taken.

    Attributes:
        camera: what it records.
        width, height, K: ideal (undistorted) image that is drawn first, supersampled and with a margin.
        maps: x and y index maps (H s, W s) float32 from the recorded to the ideal image, or None.
        supersample: s.
        room: the empty room as this camera sees it, (height, width, 3) float32 linear light.
    """

    camera: Camera
    width: int
    height: int
    K: np.ndarray
    maps: tuple[np.ndarray, np.ndarray] | None
    supersample: int
    room: np.ndarray


@dataclasses.dataclass(frozen=True)
class Lights:
    """Lights of one frame: `lights` (L, 7), `k` (L, 4), `from_world` (L, 4, 4), `depth` (L, S, S) shadow maps [m]."""

    lights: np.ndarray
    k: np.ndarray
    from_world: np.ndarray
    depth: np.ndarray


def make_cameras(
    names: tuple[str, ...], width: int, height: int, *, focal: float = 2.9, distortion: float = 1.0, seed: int = 0
) -> dict[str, Camera]:
    """Cameras on an arc in front of the subject; the same id stands at the same place at every image size.

    Args:
        names: ids of the release.
        width, height: image size [px].
        focal: focal length as a multiple of the height.
        distortion: factor on the lens distortion; 0 gives ideal pinholes (distortion None).
        seed: of the small differences between cameras.
    """
    out = {}
    for name in names:
        rng = np.random.default_rng([seed, int(name), 41])
        azimuth, elevation, distance = _PLACES[name]
        a, e = np.deg2rad(azimuth + rng.normal(0, 0.5)), np.deg2rad(elevation + rng.normal(0, 0.5))
        eye = _TARGET + distance * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        camera = _look_at(eye, _TARGET + rng.normal(0, 0.006, 3), rng.normal(0, 0.01)) @ np.linalg.inv(STAGE_TO_WORLD)
        f = focal * height * (1 + rng.normal(0, 0.004))
        cx, cy = width * (0.5 + rng.normal(0, 0.008)), height * (0.5 + rng.normal(0, 0.008))
        K = np.array([[f, 0, cx], [0, f * (1 + rng.normal(0, 5e-4)), cy], [0, 0, 1]])
        k1, k2, p1, p2, k3 = -0.11, 0.16, 4e-4, -3e-4, 0.0
        lens = distortion * np.array([k1 + rng.normal(0, 0.01), k2 + rng.normal(0, 0.02), p1, p2, k3])
        out[name] = Camera(name, width, height, K, camera, lens if distortion > 0 else None)
    return out


def lens_of(camera: Camera, supersample: int) -> Lens:
    """Prepares the maps of one camera."""
    s = supersample
    if camera.distortion is None:
        K = np.diag([s, s, 1.0]) @ camera.K
        width, height = camera.width * s, camera.height * s
        return Lens(camera, width, height, K, None, s, _room(camera, K, width, height))
    import cv2

    # the maps are smooth: solve them on a coarse grid and interpolate
    nx, ny = max(2, min(camera.width, 241)), max(2, min(camera.height, 136))
    grid = np.stack(np.meshgrid(np.linspace(0, camera.width, nx), np.linspace(0, camera.height, ny)), -1)
    ideal = undistort_pixels(grid, camera.K, camera.distortion)
    x = (np.arange(camera.width * s) + 0.5) / s / camera.width * (nx - 1)
    y = (np.arange(camera.height * s) + 0.5) / s / camera.height * (ny - 1)
    gx, gy = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    low = np.floor(ideal.min((0, 1))) - 2
    high = np.ceil(ideal.max((0, 1))) + 2
    at = [cv2.remap(ideal[..., c].astype(np.float32), gx, gy, cv2.INTER_LINEAR) for c in range(2)]
    maps = ((at[0] - np.float32(low[0])) * s - 0.5, (at[1] - np.float32(low[1])) * s - 0.5)
    K = np.diag([s, s, 1.0]) @ np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]]) @ camera.K
    size = ((high - low) * s).astype(int)
    width, height = int(size[0]), int(size[1])
    return Lens(camera, width, height, K, maps, s, _room(camera, K, width, height))


def _room(camera: Camera, K: np.ndarray, width: int, height: int) -> np.ndarray:
    image = np.zeros((height, width, 3), np.float32)
    draw_room(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), camera.cam_from_world @ STAGE_TO_WORLD, image)
    return image


def light_up(verts: np.ndarray, faces: np.ndarray, resolution: int) -> Lights:
    """Shadow maps of one frame's mesh (world), `resolution` pixels a side."""
    to_world = np.linalg.inv(STAGE_TO_WORLD)
    lights, ks, poses, depths = [], [], [], []
    for light in _LIGHTS:
        pose = _look_at(light[:3], _TARGET, 0.0) @ to_world
        distance = np.linalg.norm(light[:3] - _TARGET)
        f = 0.5 * resolution / (_SHADOW_REACH / distance)
        K = np.array([[f, 0, resolution / 2], [0, f, resolution / 2], [0, 0, 1]])
        depth = rasterize_mesh(verts, faces, K, resolution, resolution, cam_from_world=pose, near=0.1)[2]
        position = STAGE_TO_WORLD[:3, :3] @ light[:3] + STAGE_TO_WORLD[:3, 3]
        lights.append(np.concatenate([position, light[3:]]))
        ks.append([f, f, resolution / 2, resolution / 2])
        poses.append(pose)
        depths.append(depth)
    return Lights(np.array(lights), np.array(ks), np.array(poses), np.array(depths))


def photograph(
    lens: Lens,
    figure: Figure,
    posed: tuple[np.ndarray, np.ndarray, np.ndarray],
    lights: Lights,
    *,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Takes one picture.

    Args:
        lens: the camera.
        figure: what is drawn.
        posed: vertices, normals, ambient of `figure.pose_figure`.
        lights: of the same frame.
        noise: standard deviation of the sensor's noise [grey levels].
        rng: its source.

    Returns:
        sRGB image (H, W, 3) uint8 and coverage of the whole person (H, W) uint8.
    """
    verts, normals, ambient = posed
    camera, looks, s = lens.camera, figure.looks, lens.supersample
    face_id, bary, _ = rasterize_mesh(
        verts, figure.faces, lens.K, lens.width, lens.height, cam_from_world=camera.cam_from_world, workers=1
    )
    image = lens.room.copy()
    eye = -camera.cam_from_world[:3, :3].T @ camera.cam_from_world[:3, 3]
    shade(
        face_id,
        bary,
        figure.faces,
        verts,
        normals,
        figure.rest,
        figure.dorsal,
        ambient,
        figure.material,
        eye,
        STAGE_TO_WORLD[:3, 1].copy(),
        lights.lights,
        lights.k,
        lights.from_world,
        lights.depth,
        looks.colours,
        looks.lips,
        looks.brow,
        looks.eyes,
        looks.nails,
        looks.knuckles,
        looks.seed,
        image,
    )
    person = (face_id >= 0).astype(np.float32)
    if lens.maps is not None:
        import cv2

        image = cv2.remap(image, *lens.maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        person = cv2.remap(person, *lens.maps, cv2.INTER_LINEAR)
    if s > 1:
        image = np.minimum(image, 1.5).reshape(camera.height, s, camera.width, s, 3).mean((1, 3))
        person = person.reshape(camera.height, s, camera.width, s).mean((1, 3))
    encoded = 255 * _tone(image)
    if noise > 0 and rng is not None:
        encoded += rng.standard_normal(encoded.shape, dtype=np.float32) * noise
    return (encoded.clip(0, 255) + 0.5).astype(np.uint8), (255 * person + 0.5).astype(np.uint8)


def _tone(x: np.ndarray) -> np.ndarray:
    """Film-like shoulder, then the sRGB curve."""
    x = x * (1 + x / 4.0) / (1 + x * 0.55)
    x = np.clip(x, 0, 1)
    return np.where(x < 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-9), np.float32(1 / 2.4)) - 0.055)


def _look_at(eye: np.ndarray, at: np.ndarray, roll: float) -> np.ndarray:
    """World-to-camera (4, 4) of a camera on the stage (y up), turned by `roll` [rad] about its axis."""
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotation
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, -rotation @ eye
    return out
