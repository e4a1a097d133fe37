"""What the pixels of a labelled picture say about a part: there, not there, or nothing.

The pictures of a capture are as recorded; here they are reduced and freed of the lens, so that a hull is carved by
plain pinholes. Nothing is said by what another part or anything else (label 255) covers, with a rim of some pixels for
the error of labels, and by what the camera did not record.
"""

from collections.abc import Mapping

import numpy as np

from nbavatar.camera.distortion import undistortion_map
from nbavatar.camera.pinhole import Camera, scale_intrinsics
from nbavatar.fitting.hull import BACKGROUND, NOTHING, PART, UNEXPLAINED
from nbavatar.mesh.zbuffer import rasterize_mesh

__all__ = ["Lens", "evidence_of"]

_COVERED = 128  # coverage from which a pixel shows the part [1/255]
_OUTSIDE = 254  # stands where the lens took no picture: neither background nor a part, like a pixel without truth
_RIM = 0.005  # rim of other parts that says nothing, as a share of the picture's height


class Lens:
    """Maps one camera's pictures to those of a smaller pinhole.

    Attributes:
        K: of the pinhole [px]; width, height: of its pictures [px].
    """

    def __init__(self, camera: Camera, lines: int) -> None:
        """For a camera, with pictures of at most `lines` rows."""
        scale = min(1.0, lines / camera.height)
        self.width, self.height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
        self.K = scale_intrinsics(camera.K, self.width / camera.width, self.height / camera.height)
        bent = np.zeros(4) if camera.distortion is None else camera.distortion
        self._maps = undistortion_map(camera.K, bent, self.K, self.width, self.height)

    def take(self, image: np.ndarray, outside: int) -> np.ndarray:
        """The nearest pixel of a recorded image, uint8 (H, W), at each pixel of the pinhole; `outside` beyond it."""
        import cv2

        return cv2.remap(image, *self._maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)


def evidence_of(
    label: np.ndarray,
    alpha: np.ndarray,
    own: int,
    lens: Lens,
    cam_from_world: np.ndarray,
    meshes: Mapping[str, tuple[np.ndarray, np.ndarray]],
    part: str,
    reach: float,
) -> np.ndarray:
    """What each pixel of one view shows of a part.

    Args:
        label, alpha: labels and coverage as recorded, uint8 (H, W).
        own: label of the part.
        lens: of the camera.
        cam_from_world: (4, 4).
        meshes: vertices (V, 3) [m, world] and faces (F, 3) of the parts that are in the frame.
        part: name of the part.
        reach: how far from its mesh a part is still explained by it [m].

    Returns:
        uint8 (h, w) of the pinhole: `NOTHING`, `BACKGROUND`, `PART`, or `UNEXPLAINED` where the part is farther than
        `reach`, at its mean depth, from the outline of all meshes.
    """
    import cv2

    seen, coverage = lens.take(label, _OUTSIDE), lens.take(alpha, 0)
    result = np.where((seen == own) & (coverage >= _COVERED), PART, BACKGROUND).astype(np.uint8)
    drawn = np.ones((lens.height, lens.width), np.uint8)
    for verts, faces in meshes.values():
        face, _, _ = rasterize_mesh(verts, faces, lens.K, lens.width, lens.height, cam_from_world=cam_from_world)
        drawn[face >= 0] = 0
    away = cv2.distanceTransform(drawn, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    depth = float((meshes[part][0] @ cam_from_world[2, :3] + cam_from_world[2, 3]).mean())
    if depth > 0:
        result[(result == PART) & (away * depth > reach * 0.5 * (lens.K[0, 0] + lens.K[1, 1]))] = UNEXPLAINED
    other = ((seen != own) & (seen != 0)).astype(np.uint8)
    rim = max(1, round(_RIM * lens.height))
    result[cv2.dilate(other, np.ones((2 * rim + 1, 2 * rim + 1), np.uint8)) > 0] = NOTHING
    return result
