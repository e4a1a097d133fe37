"""The studio's light from the brightness of faces: known lights, and cases that have none."""

import numpy as np
from scipy.spatial.transform import Rotation

from nbavatar.data.lights import Light
from nbavatar.fitting.light import Brightness, add_picture, estimate_light
from nbavatar.io.images import linear_light
from nbavatar.math.directions import sphere_directions
from nbavatar.mesh.incidence import incidence
from nbavatar.mesh.zbuffer import joined_meshes
from tests.unit.mesh.shapes import face_normals, sphere

FRAMES = 12
LIGHTS = sphere_directions(96)
# Two lamps that are none of the lights tried.
LAMPS = np.array([[0.6, 0.64, 0.48], [-0.8, 0.0, 0.6]])


class _Turning:
    """Two balls that turn, one around the other, in a light that stands still, or turns with them.

    Attributes:
        shine: true light on the faces, 1 in the mean when hidden by nothing (N, F).
        albedo: (F,).
    """

    def __init__(self, *, still: bool = True, frames: int = FRAMES) -> None:
        rng = np.random.default_rng(4)
        head, hand = sphere(3, 0.1), sphere(2, 0.04)
        shine: list[np.ndarray] = []
        self._posed = []
        for n in range(frames):
            turn = Rotation.from_euler("xyz", [13.0 * n, 17.0 * n, -7.0 * n], degrees=True).as_matrix()
            own = Rotation.from_euler("xyz", [0.0, 25.0 * n, 40.0 * n], degrees=True).as_matrix()
            place = np.array([0.13 * np.cos(0.4 * n), 0.1 * np.sin(0.4 * n), 0.09])
            verts, faces, _ = joined_meshes([(head[0] @ turn.T, head[1]), (hand[0] @ own.T + place, hand[1])])
            normals = face_normals(verts, faces)
            self._posed.append((verts, faces, normals))
            lamps = LAMPS if still else LAMPS @ turn.T
            lit = 0.02 * incidence(verts, faces, normals, sphere_directions(40), side=128).sum(0)
            shine.append(lit + np.array([1.9, 1.3]) @ incidence(verts, faces, normals, lamps, side=128))
        self.shine = np.asarray(shine)
        self.dimmed = np.ones_like(self.shine)
        self.albedo = rng.uniform(0.05, 0.9, self.shine.shape[1])
        self.pixels = rng.integers(0, 6, self.shine.shape).astype(float)
        noise = 1.0 + 0.02 * rng.standard_normal(self.shine.shape)
        self.seen = Brightness(self.pixels * self.albedo * self.shine * noise, self.pixels)

    def reach(self, directions: np.ndarray) -> np.ndarray:
        """Incidence of far lights (N, K, F), times `dimmed` (N, F)."""
        found = [incidence(*posed, directions, side=128) for posed in self._posed]
        return np.asarray(found, np.float32) * self.dimmed[:, None].astype(np.float32)

    def error(self, light: Light) -> float:
        """Root mean square error of a light on the faces, in units of the mean of the true one."""
        shine = np.einsum("k,nkf->nf", light.weights, self.reach(light.directions.astype(np.float64)))
        scale = (shine * self.shine).sum() / (shine**2).sum()
        return float(np.sqrt(((scale * shine - self.shine) ** 2).mean()) / self.shine.mean())


def test_known_lamps_are_found() -> None:
    scene = _Turning()
    light, said = estimate_light(scene.reach, scene.seen, LIGHTS, kept=24, least=0.1)
    assert said["explained"] > 0.9 and said["lights"] == len(light.weights) <= 24
    np.testing.assert_allclose(light.weights.sum(), 4.0, rtol=1e-6)
    assert scene.error(light) < 0.05
    # The lamps are 3 and 12 degrees from the nearest of the lights tried first. Most of the light comes from close to
    # them, and in the mean from where they are.
    near = light.directions @ LAMPS.T > np.cos(np.radians(8.0))
    assert light.weights[near.any(1)].sum() > 0.7 * light.weights.sum()
    for lamp, some in zip(LAMPS, near.T, strict=True):
        mean = light.weights[some] @ light.directions[some]
        assert mean @ lamp / np.linalg.norm(mean) > np.cos(np.radians(2.0))


def test_what_no_light_explains_does_not_move_the_lamps() -> None:
    """One face in four changes as if its light turned with the head; of the light on all faces that costs nothing."""
    scene, turning = _Turning(), _Turning(still=False)
    odd = np.random.default_rng(2).permutation(scene.shine.shape[1])[::4]
    scene.seen.light[:, odd] = scene.pixels[:, odd] * scene.albedo[odd] * turning.shine[:, odd]
    light, _ = estimate_light(scene.reach, scene.seen, LIGHTS, kept=24, least=0.1)
    assert scene.error(light) < 0.05


def test_faces_in_the_dark_do_not_outweigh_all_others() -> None:
    """The inside of an ear: lit by its surroundings alone in the frames of the fit, by a lamp in another one."""
    scene = _Turning()
    fit = np.arange(FRAMES) % 3 != 1
    known, said = estimate_light(scene.reach, scene.seen, LIGHTS, kept=24, least=0.1)
    ear = np.arange(0, 60, 20)
    scene.dimmed[np.ix_(fit, ear)] = 1e-3
    scene.seen.pixels[:, ear] = 5.0
    scene.seen.light[:, ear] = 5.0 * 0.15
    light, judged = estimate_light(scene.reach, scene.seen, LIGHTS, kept=24, least=0.1)
    assert abs(judged["explained"] - said["explained"]) < 0.02
    np.testing.assert_allclose(light.weights @ light.directions, known.weights @ known.directions, atol=0.2)


def test_brightness_that_does_not_follow_a_light_is_none() -> None:
    scene = _Turning()
    flat = Brightness(scene.pixels * scene.albedo, scene.pixels)
    rng = np.random.default_rng(0)
    noisy = Brightness(flat.light * rng.uniform(0.8, 1.2, flat.light.shape), flat.pixels)
    for seen in (flat, noisy):
        light, said = estimate_light(scene.reach, seen, LIGHTS, kept=24, least=0.1)
        assert len(light.weights) == 0 and "a light that stands still explains" in said["absent"]
    # Lamps that turn with the head: what they do to the hand has something of lamps that stand still, and no more.
    turning = _Turning(still=False)
    assert estimate_light(turning.reach, turning.seen, LIGHTS, kept=24, least=0.6)[1]["explained"] < 0.5


def test_what_tells_too_little_is_no_light() -> None:
    few = _Turning(frames=5)
    light, said = estimate_light(few.reach, few.seen, LIGHTS, kept=24, least=0.1)
    assert len(light.weights) == 0 and "of 5 frames" in said["absent"]
    scene = _Turning(frames=8)
    dark = Brightness(np.zeros_like(scene.seen.light), scene.seen.pixels)
    nothing = Brightness(*np.zeros((2, *scene.seen.light.shape)))
    for seen in (dark, nothing):
        light, said = estimate_light(scene.reach, seen, LIGHTS, kept=24, least=0.1)
        assert len(light.weights) == 0 and said["absent"].startswith("0 faces")


def test_pictures_add_up_by_face() -> None:
    seen = Brightness(np.zeros((2, 2)), np.zeros((2, 2)))
    rgb = np.array([[[255, 255, 255], [0, 0, 0]], [[188, 188, 188], [255, 0, 0]]], np.uint8)
    face = np.array([[3, 3], [0, -1]])
    chosen = np.array([0, -1, -1, 1])
    for _ in range(2):
        add_picture(seen, 1, rgb, np.array([[True, True], [True, True]]), face, chosen)
    add_picture(seen, 0, rgb, np.array([[True, False], [False, True]]), face, chosen)
    assert seen.pixels.tolist() == [[0, 1], [2, 4]]
    # sRGB's 188 is half the light (IEC 61966-2-1): ((188/255 + 0.055) / 1.055)^2.4 = 0.5029.
    np.testing.assert_allclose(seen.light, [[0.0, 1.0], [2 * 0.5029, 2.0]], atol=1e-4)
    np.testing.assert_allclose(
        linear_light(np.array([[255, 0, 0], [10, 10, 10]], np.uint8)).mean(-1), [1 / 3, 0.003035], atol=1e-6
    )
