"""Options of the geometry stages: refit, alignment, shell, light, spectral coordinates, contact deformation."""

import dataclasses
from typing import Any

from nbavatar.config.core import option, to_mapping

__all__ = ["AlignConfig", "DeformConfig", "FitConfig", "LightConfig", "ShellConfig", "SpectralConfig"]


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """Multi-view refit of the head and hand models."""

    start: str = option(
        "auto",
        "Where to start: the dataset's parameters, triangulated keypoints, or whichever there is (auto).",
        choices=("auto", "params", "keypoints"),
    )
    iterations: int = option(
        60, "Largest number of steps per part, each over all frames at once; 0 keeps the start.", min=0
    )
    inlier_px: float = option(
        8.0, "Error up to which a view may agree before the noise is known [px at 1080 image lines].", min=0.01
    )
    noise_floor_px: float = option(0.02, "Smallest keypoint noise assumed [px at 1080 image lines].", min=1.0e-6)
    contour_weight: float = option(1.0, "Confidence factor of the 17 contour landmarks.", min=0.0, max=10.0)
    shape_deviation: float = option(1.0, "Prior deviation of shape coefficients [1].", min=1.0e-6)
    expression_deviation: float = option(1.0, "Prior deviation of expression coefficients [1].", min=1.0e-6)
    jaw_deviation_deg: float = option(17.0, "Prior deviation of the jaw's angles [degrees].", min=1.0e-6)
    pose_floor_deg: float = option(
        1.0, "Smallest prior deviation of finger angles in any direction [degrees].", min=1.0e-6
    )
    anchor_deg: float = option(3.0, "Deviation expected of the dataset's finger angles [degrees].", min=1.0e-6)
    smooth_rotation_deg: float = option(2.0, "Typical angular acceleration, 0 for none [degrees / frame^2].", min=0.0)
    smooth_transl_mm: float = option(3.0, "Typical acceleration, 0 for no smoothness [mm / frame^2].", min=0.0)
    smooth_pose_deg: float = option(
        6.0, "Typical acceleration of finger and jaw angles, 0 for none [degrees / frame^2].", min=0.0
    )
    smooth_expression: float = option(
        0.5, "Typical acceleration of expression coefficients, 0 for none [1 / frame^2].", min=0.0
    )
    silhouette_weight: float = option(
        0.05, "Weight of a contour point against a keypoint; 0 leaves masks alone.", min=0.0, max=10.0
    )
    silhouette_frames: int = option(12, "Frames whose masks are used, spread over the sequence.", min=1)
    silhouette_lines: int = option(270, "Height that masks are reduced to [px].", min=16, max=2160)
    silhouette_band_px: float = option(
        20.0, "How far contours are drawn to the border of a mask [px at 1080 image lines].", min=0.0
    )
    silhouette_deviation_px: float = option(2.0, "Error of a mask's border [px at 1080 image lines].", min=0.01)
    check_handedness: bool = option(True, "Whether to try the other hand's model too, and report which fits.")
    sheet_frames: int = option(4, "Frames on the contact sheet.", min=1, max=64)
    sheet_cameras: int = option(4, "Cameras on the contact sheet.", min=1, max=16)
    sheet_tile: int = option(360, "Height of a picture on the contact sheet [px].", min=64, max=2048)


@dataclasses.dataclass(frozen=True)
class AlignConfig:
    """Alignment of a capture's meshes to its pictures, frame by frame: as a whole, then by smooth bending."""

    iterations: int = option(0, "Steps on each of two scales of detail; 0 leaves the stage out.", min=0, max=100)
    frames: str = option(
        "all", "Frames that are aligned: all, or only those that are trained on.", choices=("all", "train")
    )
    likeness_mm: float = option(
        10.0, "Frames in which a part lies this far apart still tell its colours, the nearer the more [mm].", min=0.1
    )
    shift_mm: float = option(5.0, "Shifts that are expected, about [mm].", min=1.0e-3)
    turn_deg: float = option(3.0, "Turns that are expected, about [degrees].", min=1.0e-3)
    modes: int = option(
        0, "Smooth functions on a part by which it is bent besides; 0 leaves it as it is but moved.", min=0, max=64
    )
    bend_mm: float = option(0.06, "Bending by each of them that is expected, about [mm].", min=1.0e-4)
    block: int = option(32, "Most frames that are aligned together; bounds the memory.", min=2)
    lines: int = option(512, "Height to which larger pictures are reduced [px].", min=16, max=2160)
    points: int = option(4000, "Most vertices of a part that are looked at.", min=3)


@dataclasses.dataclass(frozen=True)
class ShellConfig:
    """What the head's mesh lacks (hair), as a surface of its own. Lengths in radii of the head: the root mean square
    distance of its surface from its middle, about 0.1 m."""

    reach: float = option(
        0.0, "How far beyond the mesh a piece must reach to be modelled; 0 leaves the stage out [radius].", min=0.0
    )
    gap: float = option(0.1, "What is nearer to the mesh than this is left to the mesh [radius].", min=0.0, max=10.0)
    misses: float = option(
        0.02, "Share of the views of a point in which it may lie outside the part's mask, for the error of poses.",
        min=0.0, max=0.5,
    )  # fmt: skip
    support: float = option(
        0.05, "Share of the views of a point in which the mesh must be out of reach of what is seen there.",
        min=0.0, max=1.0,
    )  # fmt: skip
    spread_deg: float = option(
        35.0, "Three views have to differ from each other by so much in direction to tell depth [degrees].",
        min=0.0, max=180.0,
    )  # fmt: skip
    margin: float = option(2.0, "How far around the mesh hair is looked for [radius].", min=0.1, max=10.0)
    voxel: float = option(0.03, "Side of a cell, unless more than `cells` were needed [radius].", min=1.0e-3, max=1.0)
    cells: int = option(2_000_000, "Most cells; bounds memory and time.", min=1000, max=200_000_000)
    views: int = option(240, "Most views that are looked at, spread over cameras and frames.", min=1)
    lines: int = option(512, "Height to which larger masks are reduced [px].", min=16, max=2160)
    faces: int = option(2000, "Most faces of the surface; fewer where they would be smaller than the mesh's.", min=8)
    picture_size: int = option(320, "Side of one view in the picture [px].", min=64, max=4096)


@dataclasses.dataclass(frozen=True)
class LightConfig:
    """The light of a capture's studio, from how the brightness of skin changes between frames."""

    lights: int = option(
        0, "Most far lights that are kept, the strongest of those tried; 0 leaves the stage out.", min=0, max=4096
    )
    directions: int = option(
        256,
        "Lights that are tried first, evenly spread over all directions; the strongest get neighbours.",
        min=8,
        max=4096,
    )
    least: float = option(
        0.1, "Share of the change of brightness, in frames left out of the fit, that a light must explain to be kept.",
        min=0.0, max=1.0,
    )  # fmt: skip
    frames: int = option(32, "Most training frames that are looked at, evenly spread.", min=1)
    cameras: int = option(12, "Most cameras that are looked at, evenly spread.", min=1)
    faces: int = option(6000, "Most faces that are looked at; bounds memory.", min=1)
    lines: int = option(256, "Height to which larger pictures are reduced [px].", min=16, max=2160)
    side: int = option(192, "Side of a shadow map, which the meshes fill [px].", min=16, max=4096)
    picture_size: int = option(256, "Side of one tile in the picture [px].", min=64, max=4096)


@dataclasses.dataclass(frozen=True)
class SpectralConfig:
    """Spectral coordinates of the meshes."""

    modes: int = option(24, "Number of non-constant eigenvectors kept per part.", min=1, max=512)


@dataclasses.dataclass(frozen=True)
class DeformConfig:
    """Contact deformation of the head by the hands (XPBD). Stiffness 0 switches a term off."""

    stiffness: str = option(
        "auto",
        "Stiffness under the skin: the user's array `stiffness.head` in the meshes [N/m^3] (data), from the "
        "distance to a skull proxy (anatomical), or the same everywhere (uniform); auto takes data where there "
        "is some, else anatomical.",
        choices=("auto", "data", "anatomical", "uniform"),
    )
    modulus: float = option(1.0e4, "Young's modulus of soft tissue [Pa].", min=0.0, max=1.0e12)
    uniform_thickness: float = option(0.012, "Tissue thickness where stiffness is uniform [m].", min=1.0e-4, max=1.0)
    stretch: float = option(30.0, "Stiffness of an edge of the skin [N/m].", min=0.0, max=1.0e12)
    shear: float = option(
        300.0, "Stiffness by which neighbouring points of the skin move along with each other [N/m].",
        min=0.0, max=1.0e12,
    )  # fmt: skip
    bending: float = option(1.0e-5, "Flexural rigidity of the skin [N m].", min=0.0, max=1.0e12)
    volume: float = option(3.0e8, "Resistance of the pressed region to loss of volume [N/m^5].", min=0.0, max=1.0e18)
    friction: float = option(0.3, "Coulomb friction of a hand on skin.", min=0.0, max=10.0)
    reach: float = option(0.05, "How far from a contact the skin moves, along the surface [m].", min=0.0, max=1.0)
    max_dent: float = option(0.035, "Longest way a point of the skin may move [m].", min=0.0, max=1.0)
    hand_stiffness: float = option(1.0e4, "How firmly the track holds a hand's position [N/m].", min=0.0, max=1.0e12)
    hand_turn_stiffness: float = option(
        50.0, "How firmly the track holds a hand's rotation [N m].", min=0.0, max=1.0e12
    )
    hand_shift: float = option(0.004, "Bound of the correction of a hand's position; 0 keeps it [m].", min=0.0, max=0.1)
    hand_turn: float = option(0.05, "Bound of the correction of a hand's rotation; 0 keeps it [rad].", min=0.0, max=1.0)
    touch: float = option(0.002, "Nearer than this is contact [m].", min=0.0, max=0.1)
    tolerance: float = option(
        1.0e-4, "Depth up to which a vertex may be left inside the other part [m].", min=1.0e-6, max=0.01
    )
    step: float = option(0.003, "Longest step of a hand's path through a frame [m].", min=1.0e-4, max=0.1)
    max_steps: int = option(16, "Most steps of a hand's path through a frame.", min=1, max=1000)
    settle: int = option(4, "Steps after the hand has arrived.", min=0, max=1000)
    iterations: int = option(8, "Sweeps over all constraints in a step.", min=1, max=10000)
    time_step: float = option(0.002, "Time that a step stands for: longer is nearer to rest [s].", min=1.0e-6, max=1.0)
    contact_only: bool = option(
        True, "Whether only frames and regions that contact reaches are simulated; false simulates everything."
    )
    picture_size: int = option(480, "Side of one view of the validation picture [px].", min=64, max=4096)

    def contact_numbers(self) -> dict[str, Any]:
        """Arguments of `nbavatar.physics.contact.ContactNumbers`: all but the source of stiffness, and the picture."""
        own = ("stiffness", "modulus", "uniform_thickness", "picture_size")
        return {key: value for key, value in to_mapping(self).items() if key not in own}
