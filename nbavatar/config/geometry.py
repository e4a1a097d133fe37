"""Options of the geometry stages: refit, spectral coordinates, contact deformation."""

import dataclasses

from nbavatar.config.core import option

__all__ = ["DeformConfig", "FitConfig", "SpectralConfig"]


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
    smooth_rotation_deg: float = option(2.0, "Typical angular acceleration, 0 for none [degrees / frame^2].", min=0.0)
    smooth_transl_mm: float = option(3.0, "Typical acceleration, 0 for no smoothness [mm / frame^2].", min=0.0)
    smooth_pose_deg: float = option(
        6.0, "Typical acceleration of finger and jaw angles, 0 for none [degrees / frame^2].", min=0.0
    )
    smooth_expression: float = option(
        0.5, "Typical acceleration of expression coefficients, 0 for none [1 / frame^2].", min=0.0
    )
    check_handedness: bool = option(True, "Whether to try the other hand's model too, and report which fits.")
    sheet_frames: int = option(4, "Frames on the contact sheet.", min=1, max=64)
    sheet_cameras: int = option(4, "Cameras on the contact sheet.", min=1, max=16)
    sheet_tile: int = option(360, "Height of a picture on the contact sheet [px].", min=64, max=2048)


@dataclasses.dataclass(frozen=True)
class SpectralConfig:
    """Spectral coordinates of the meshes."""

    modes: int = option(24, "Number of non-constant eigenvectors kept per part.", min=1, max=512)


@dataclasses.dataclass(frozen=True)
class DeformConfig:
    """Contact deformation of the head by the hand (XPBD)."""

    substeps: int = option(8, "Sub-steps per frame.", min=1)
