"""Pictures of a trained avatar under a protocol: which frames of which cameras, on which background."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nbavatar.config.evaluation import ProtocolConfig
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import View
from nbavatar.errors import DataError
from nbavatar.methods.base import MeshAvatar

__all__ = ["Picture", "check_parts", "posed_vertices", "render_views"]


class Picture(NamedTuple):
    """One rendered view: rgb on the protocol's background uint8 (H, W, 3), alpha and nb_alpha uint8 (H, W)."""

    view: View
    rgb: np.ndarray
    alpha: np.ndarray
    nb_alpha: np.ndarray


def check_parts(avatar: MeshAvatar, sequence: MeshSequence) -> None:
    """Assert that meshes fit an avatar.

    A pruned avatar rides on some of the faces only, in their order.

    Raises:
        DataError: a part is missing or has another number of vertices or other faces.
    """
    for part, own in avatar.part_faces().items():
        if part not in sequence.parts:
            raise DataError.of("meshes", part, expected="this part of the avatar", found=", ".join(sequence.parts))
        count = avatar.vertex_counts[part]
        kept = np.isin(_keys(sequence.parts[part].faces, count), _keys(own.numpy(), count))
        if not np.array_equal(sequence.parts[part].faces[kept], own.numpy()):
            expected = f"the {len(own)} faces the avatar was trained on"
            raise DataError.of("meshes", f"{part}.faces", expected=expected, found="other faces")


def posed_vertices(avatar: MeshAvatar, sequence: MeshSequence, row: int, device: str = "cpu") -> dict[str, Tensor]:
    """Vertices of one frame, by part of the avatar: float32 (V, 3) [m], NaN where the part is not in the frame."""
    return {
        part: torch.from_numpy(np.asarray(sequence.parts[part].verts[row], dtype=np.float32)).to(device)
        for part in avatar.parts
    }


def _keys(faces: np.ndarray, vertices: int) -> np.ndarray:
    """One number for each face (F, 3), different for different rows of indices below `vertices`."""
    return faces.astype(np.int64) @ np.array([vertices**2, vertices, 1])


def render_views(
    avatar: MeshAvatar, sequence: MeshSequence, views: Sequence[View], protocol: ProtocolConfig, *, device: str = "cpu"
) -> Iterator[Picture]:
    """Render views one by one.

    Refinement of fitting errors applies to the frames it was trained on only; any other frame is rendered on its mesh
    as given, so nothing is fitted to held-out poses.

    Args:
        avatar: trained, on `device`.
        sequence: meshes of the frames (`View.row` counts in it).
        views: what to render.
        protocol: background, precision, order, region of interest.
        device: where the avatar computes.
    """
    check_parts(avatar, sequence)
    background = torch.tensor(protocol.background, dtype=torch.float32, device=device)
    avatar.eval()
    # Frames of a reenactment may bear the names of training frames, and are none.
    refined = protocol.refined and "driver" not in sequence.extras
    for view in views:
        verts: Mapping[str, Tensor] = posed_vertices(avatar, sequence, view.row, device)
        with torch.no_grad():
            image, alpha, nb_alpha = avatar.render(
                verts,
                view.viewmat.to(device),
                view.K.to(device),
                view.width,
                view.height,
                background,
                frame=view.frame if refined else None,
                precision=protocol.precision,
                roi=protocol.roi,
                order=protocol.order,
            )
        yield Picture(view, _bytes(image.permute(1, 2, 0)), _bytes(alpha), _bytes(nb_alpha))


def _bytes(values: Tensor) -> np.ndarray:
    return (values.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).cpu().numpy()
