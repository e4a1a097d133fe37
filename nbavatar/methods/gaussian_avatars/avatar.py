"""GaussianAvatars (Qian et al., CVPR 2024): 3D Gaussians bound to the triangles of a mesh, and nothing else.

How they are bound is `nbavatar.methods.gaussians.bound`.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from nbavatar.methods.gaussians.bound import BoundGaussians, check_binding

__all__ = ["GaussianAvatars"]


class GaussianAvatars(BoundGaussians):
    """Gaussians bound to triangles."""

    method: ClassVar[str] = "gaussian_avatars"

    @classmethod
    def rebuild(
        cls, content: Mapping[str, Any], state: Mapping[str, Tensor], record: Mapping[str, Any]
    ) -> "GaussianAvatars":
        """See `MeshAvatar.rebuild`."""
        avatar = cls(
            content["faces"],
            content["vertex_counts"],
            colour=torch.zeros(1, 3),
            opacity=0.1,
            sh_degree=int(content["sh_degree"]),
            record=record,
        )
        check_binding(content, state)
        return avatar
