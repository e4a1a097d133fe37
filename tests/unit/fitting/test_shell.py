"""What the mesh lacks, carved from masks: solids whose surface is known, hands in front, poses that jitter."""

from dataclasses import dataclass

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from nbavatar.camera.pinhole import Camera
from nbavatar.config.geometry import ShellConfig
from nbavatar.data.sequences import Part
from nbavatar.fitting.evidence import Lens, evidence_of
from nbavatar.fitting.hull import BACKGROUND, NOTHING, PART, UNEXPLAINED, Silhouette, count_views, grid_over
from nbavatar.fitting.shell import Shell, _in_neck, carried, carve_shell, rest_of, ride
from nbavatar.mesh.zbuffer import rasterize_mesh

SIZE, FRAMES = 160, 4
CFG = ShellConfig(reach=0.25, voxel=0.06, cells=100_000)


def _cameras(count: int, distance: float, arc: float = 320.0) -> list[Camera]:
    """On an arc around the origin, at changing heights."""
    cameras = []
    for i, angle in enumerate(np.radians(np.linspace(-arc / 2, arc / 2, count))):
        eye = distance * np.array([np.sin(angle), 0.35 * (-1) ** i, np.cos(angle)])
        z = -eye / np.linalg.norm(eye)
        x = np.cross([0, -1.0, 0], z)
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([x, np.cross(z, x), z])
        pose[:3, 3] = -pose[:3, :3] @ eye
        K = np.array([[300.0, 0, 79.0], [0, 300.0, 82.0], [0, 0, 1]])
        cameras.append(Camera(f"c{i}", SIZE, SIZE, K, pose))
    return cameras


@dataclass
class Solid:
    """A ball for a head, and a smaller one off it that no mesh has; they turn and shift together. Lengths in `unit`."""

    bun: bool = True
    unit: float = 1.0
    jitter: float = 0.0
    hand: bool = False
    cameras: int = 7
    arc: float = 320.0

    def __post_init__(self) -> None:
        head = trimesh.creation.icosphere(3, radius=0.1)
        bun = trimesh.creation.icosphere(3, radius=0.03)
        self.centre = self.unit * np.array([0.03, 0.06, -0.12])
        self.head, self.faces = self.unit * head.vertices, np.asarray(head.faces)
        self.ball, self.ball_faces = self.unit * bun.vertices + self.centre, np.asarray(bun.faces)
        turns = Rotation.from_euler("xyz", [[6.0 * n, -9.0 * n, 4.0 * n] for n in range(FRAMES)], degrees=True)
        self.turns, self.shifts = turns.as_matrix(), self.unit * 0.004 * np.outer(np.arange(FRAMES), [1.0, -0.5, 0.3])
        rng = np.random.default_rng(0)
        error = self.unit * self.jitter * rng.standard_normal((FRAMES, 1, 3))
        self.verts = (self.head @ self.turns.swapaxes(1, 2) + self.shifts[:, None] + error).astype(np.float32)

    def carve(self, cfg: ShellConfig = CFG) -> tuple[Shell, object]:
        """The shell of all views."""
        cameras = _cameras(self.cameras, self.unit * 0.7, self.arc)
        rest = rest_of(self.head, self.faces, self.verts, range(FRAMES))
        views = [(camera, row) for camera in cameras for row in range(FRAMES)]

        def view(i: int) -> Silhouette:
            camera, row = views[i]
            turn, shift = self.turns[row], self.shifts[row]
            parts = [(self.head, self.faces)] + ([(self.ball, self.ball_faces)] if self.bun else [])
            seen = np.zeros((SIZE, SIZE), bool)
            for verts, faces in parts:
                placed = verts @ turn.T + shift
                face, _, _ = rasterize_mesh(placed, faces, camera.K, SIZE, SIZE, cam_from_world=camera.cam_from_world)
                seen |= face >= 0
            label = seen.astype(np.uint8)
            if (
                self.hand and row % 2
            ):  # in every second frame something covers the bun and its surroundings, in all views
                where = camera.cam_from_world[:3] @ np.append(turn @ self.centre + shift, 1.0)
                x, y = (camera.K @ where)[:2] / where[2]
                label[max(0, int(y) - 25) : int(y) + 25, max(0, int(x) - 25) : int(x) + 25] = 2 if i % 2 else 255
            alpha = np.where(label == 255, 0, 255 * (label > 0)).astype(np.uint8)
            evidence = evidence_of(
                label, alpha, 1, Lens(camera, SIZE), camera.cam_from_world,
                {"head": (self.verts[row].astype(np.float64), self.faces)}, "head", cfg.reach * rest.radius,
            )  # fmt: skip
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rest.rotation[row], rest.shift[row]
            return Silhouette(evidence, camera.K, camera.cam_from_world @ pose)

        return carve_shell(rest, self.faces, [row for _, row in views], view, cfg), rest

    def error(self, shell: Shell) -> np.ndarray:
        """Distance of the shell's vertices from the bun's surface, negative inside [unit]."""
        return (np.linalg.norm(shell.verts - self.centre, axis=1) - self.unit * 0.03) / self.unit


@pytest.mark.parametrize("solid", [Solid(), Solid(jitter=0.001), Solid(hand=True, jitter=0.001)], ids=str)
def test_shell_of_a_ball_off_the_mesh_lies_on_it(solid: Solid) -> None:
    shell, rest = solid.carve()
    assert rest.radius == pytest.approx(0.1, rel=0.01)
    error = solid.error(shell)
    # A cell is 6 mm and a pixel 2 mm; the hull of seven cameras lies outside the ball, and most at its foot.
    assert np.median(np.abs(error)) < 0.004 and np.abs(error).max() < 0.02
    assert np.abs(shell.verts @ solid.centre / np.linalg.norm(solid.centre) - 0.167).min() < 0.006  # its far end
    normals = np.cross(*(shell.verts[shell.faces[:, k]] - shell.verts[shell.faces[:, 0]] for k in (1, 2)))
    outwards = ((shell.verts[shell.faces].mean(1) - solid.centre) * normals).sum(1) > 0
    assert outwards.mean() > 0.95
    areas = np.linalg.norm(normals, axis=1)
    assert len(shell.faces) <= 2000 and areas.min() > 0


def test_shell_depends_on_no_unit_and_is_the_same_in_every_run() -> None:
    shell, _ = Solid().carve()
    again, _ = Solid().carve()
    assert np.array_equal(shell.verts, again.verts) and np.array_equal(shell.faces, again.faces)
    large, _ = Solid(unit=1000.0).carve()
    assert abs(len(large.faces) - len(shell.faces)) <= 2  # float32 vertices round alike in powers of two only
    assert np.abs(large.verts.mean(0) / 1000.0 - shell.verts.mean(0)).max() < 1e-3


def test_nothing_is_made_where_nothing_reaches_out_or_depth_is_unknown() -> None:
    assert "reaches beyond" in Solid(bun=False, jitter=0.001).carve()[0].said["absent"]
    assert "too alike" in Solid(cameras=1).carve()[0].said["absent"]
    assert not len(Solid(cameras=1).carve()[0].faces)


def test_two_directions_however_far_apart_tell_no_depth() -> None:
    """The wedge where two silhouettes cross is contradicted by no mask; a third camera between them cuts it."""
    two = Solid(cameras=2, arc=90.0).carve()[0]  # carved, the ball would be 0.23 m too long in the median
    assert "too alike" in two.said["absent"] and two.said["spread_deg"] < 35
    solid = Solid(cameras=3, arc=90.0)
    three = solid.carve()[0]
    assert three.said["spread_deg"] > 60 and np.abs(solid.error(three)).max() < 0.02


def test_counts_equal_a_plain_loop(rng) -> None:
    grid = grid_over(np.array([-0.2, -0.1, -0.15]), np.array([0.2, 0.2, 0.15]), 0.05, 10_000)
    views = []
    for _ in range(9):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=rng).as_matrix(), [0, 0, 0.3]  # some lie behind
        K = np.array([[40.0, 0, 15.0], [0, 40.0, 11.0], [0, 0, 1]])
        views.append(Silhouette(rng.integers(0, 4, (24, 30)).astype(np.uint8), K, pose))
    counts = count_views(grid, views, len(views), 1.0)
    plain = {NOTHING: [], BACKGROUND: [], PART: [], UNEXPLAINED: []}
    for index in np.ndindex(grid.shape):
        point = grid.low + (np.array(index) + 0.5) * grid.edge
        shown = []
        for view in views:
            x, y, z = view.K @ (view.cam_from_rest[:3] @ np.append(point, 1.0))
            column, row = int(np.floor(x / z)), int(np.floor(y / z))
            inside = z > 0 and 0 <= column < 30 and 0 <= row < 24
            shown.append(int(view.evidence[row, column]) if inside else NOTHING)
        for kind, found in plain.items():
            found.append(shown.count(kind))
    shape = grid.shape
    assert np.array_equal(counts.missed, np.reshape(plain[BACKGROUND], shape))
    assert np.array_equal(counts.unexplained, np.reshape(plain[UNEXPLAINED], shape))
    assert np.array_equal(counts.seen, len(views) - np.reshape(plain[NOTHING], shape))
    # What is dropped on the way could not have become part of the hull.
    dropped = count_views(grid, views, len(views), 0.2)
    hull = (c.missed <= 0.2 * c.seen for c in (counts, dropped))
    assert np.array_equal(*hull)


def test_shell_rides_with_the_skull_and_takes_the_skins_motion_along() -> None:
    solid = Solid()
    rest = rest_of(solid.head, solid.faces, solid.verts, range(FRAMES))
    shell = Shell(np.array([[0.0, 0.12, 0.09], [0.0, -0.15, 0.02]]), np.zeros((0, 3), np.int64), {})
    exact = shell.verts @ solid.turns.swapaxes(1, 2) + solid.shifts[:, None]
    assert np.abs(ride(shell, rest, solid.verts) - exact).max() < 1e-6
    # The lower third of the skin drops by 8 mm in one frame, which is no motion of the head; in another there is none.
    moved = solid.verts.copy()
    drop = np.where(solid.head[:, 1:2] < -0.03, 1.0, 0.0) * [0.0, -0.008, 0.0]
    moved[1] += (drop @ solid.turns[1].T).astype(np.float32)
    moved[3] = np.nan
    rest = rest_of(solid.head, solid.faces, moved, range(FRAMES))
    placed = ride(shell, rest, moved)
    shift = (placed[1] - exact[1]) @ solid.turns[1]
    assert np.abs(shift[0]).max() < 5e-4 and np.abs(shift[1] - [0, -0.008, 0]).max() < 8e-4
    assert np.isnan(placed[3]).all() and np.isfinite(placed[:3]).all()
    parts = [Part(f, v.astype(np.float32), np.zeros((FRAMES, *v.shape), np.float32))
             for f, v in ((shell.faces, shell.verts), (solid.faces, solid.head))]  # fmt: skip
    assert np.abs(carried(*parts, solid.verts).verts - exact).max() < 1e-5


def test_the_neck_goes_on_below_an_open_border_and_nowhere_else() -> None:
    """A ball that is cut open, turned and scaled: below the cut, as far around as is said, not beside or above it."""
    ball = trimesh.creation.icosphere(3, radius=1.0)
    faces = np.asarray(ball.faces)[(ball.vertices[ball.faces][..., 1] > -0.8).all(1)]
    # The border's vertices lie 0.5 to 0.7 from its middle.
    points = np.array([[0, -1.5, 0], [0, 0.0, 0], [0.75, -1.5, 0], [1.1, -1.5, 0], [0, -1.5, 1.1]])
    turn = Rotation.from_euler("xyz", [30, -50, 70], degrees=True).as_matrix()
    for scale in (1.0, 0.1):
        verts, placed = scale * ball.vertices @ turn.T, scale * points @ turn.T
        found = _in_neck(placed, verts, faces, scale, scale * 0.3)
        assert found.tolist() == [True, False, True, False, False]
    assert _in_neck(points, ball.vertices, faces, 1.0, np.inf).tolist() == [True, False, True, True, True]
    assert not _in_neck(points, ball.vertices, np.asarray(ball.faces), 1.0, 0.3).any()  # no border


def test_the_neck_is_as_wide_however_it_is_turned() -> None:
    ball = trimesh.creation.icosphere(3, radius=1.0)
    faces = np.asarray(ball.faces)[(ball.vertices[ball.faces][..., 1] > -0.8).all(1)]
    away = np.linspace(0.6, 1.4, 801)
    turns = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    points = np.stack(
        [away[:, None] * np.cos(turns), 0 * away[:, None] * turns - 1.5, away[:, None] * np.sin(turns)], -1
    )
    upright = _in_neck(points.reshape(-1, 3), ball.vertices, faces, 1.0, 0.3).reshape(len(away), -1)
    widths = away[upright.sum(0) - 1]
    assert (widths > 0.75).all() and (widths < 1.05).all()  # 0.3 beside a border that is 0.5 to 0.7 away
    for turn in Rotation.random(8, random_state=1).as_matrix():
        found = _in_neck(points.reshape(-1, 3) @ turn.T, ball.vertices @ turn.T, faces, 1.0, 0.3).reshape(len(away), -1)
        # One step of the scan, and the outline's chords in polar coordinates from another start.
        assert np.abs(away[found.sum(0) - 1] - widths).max() < 0.005


def _away(points: np.ndarray, verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distance of points from a surface, by libigl."""
    import igl

    return np.sqrt(igl.point_mesh_squared_distance(np.asarray(points), verts, faces.astype(np.int64))[0])


@pytest.mark.parametrize("hair", ["cap", "ponytail", "long"])
def test_loose_hair_of_a_synthetic_subject_is_found_to_millimetres(hair: str) -> None:
    """A subject in contact, whose hair stands off the head: labels drawn from what the cameras would see.

    A pixel is 3.5 mm wide there, a cell 3 mm, the pose a millimetre off; most cameras have the head before a ponytail.
    Long hair reaches lower than the mesh, whose neck ends at a collar. Of that, what cameras see is looked for.
    """
    from nbavatar.data.synthetic.capture import labels_of
    from nbavatar.data.synthetic.figure import build_figure, pose_figure
    from nbavatar.data.synthetic.scene import build_bodies, make_scene
    from nbavatar.data.synthetic.studio import lens_of, make_cameras

    frames, side = 6, 160
    scene = make_scene(build_bodies("tiny"), "S2", frames, 0, dents=False)
    human, rng = scene.bodies.human, np.random.default_rng(1)
    verts = (scene.head_rigid + 0.001 * rng.standard_normal((frames, 1, 3))).astype(np.float32)
    rest = rest_of(scene.canonical[0], human.head_faces, verts, range(frames))
    cameras = make_cameras(("084", "100", "102", "110", "111", "121", "122"), side, side, focal=2.3, distortion=0.0)
    views = [(name, row) for name in cameras for row in range(frames)]
    figure = build_figure(scene, hair)
    posed = [pose_figure(figure, scene, row)[0] for row in range(frames)]

    def view(i: int) -> Silhouette:
        name, row = views[i]
        camera = cameras[name]
        label, alpha = labels_of(lens_of(camera, 1), figure, posed[row])
        meshes = {"head": (verts[row].astype(np.float64), human.head_faces),
                  "right_hand": (scene.hand[row], human.hand_faces)}  # fmt: skip
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rest.rotation[row], rest.shift[row]
        lens, reach = Lens(camera, side), 0.25 * rest.radius
        evidence = evidence_of(label, alpha, 1, lens, camera.cam_from_world, meshes, "head", reach)
        return Silhouette(evidence, camera.K, camera.cam_from_world @ pose)

    shell = carve_shell(rest, human.head_faces, [row for _, row in views], view, ShellConfig(reach=0.25))
    if hair == "cap":
        assert not len(shell.faces)
        return
    distances = {}
    part, faces = figure.piece(5)
    for row in (0, frames - 1):
        true, found = posed[row][part], ride(shell, rest, verts)[row].astype(np.float64)
        seen = np.zeros(len(figure.faces), bool)
        for camera in cameras.values():
            face, _, _ = rasterize_mesh(
                posed[row], figure.faces, camera.K, side, side, cam_from_world=camera.cam_from_world
            )
            seen[face[face >= 0]] = True
        points, of = trimesh.sample.sample_surface(trimesh.Trimesh(true, faces, process=False), 1500, seed=0)
        off = _away(points, scene.head_rigid[row], human.head_faces) > 0.25 * rest.radius
        if hair == "long":
            off &= seen[len(figure.faces) - len(faces) :][of]
        distances[row] = [
            np.median(_away(found, true, faces)),
            _away(points[off], found, shell.faces).mean(),
        ]
    assert np.max(list(distances.values())) < 5e-3, distances
