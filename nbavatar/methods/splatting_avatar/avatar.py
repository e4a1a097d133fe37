"""SplattingAvatar (Shao et al., CVPR 2024): 3D Gaussians embedded in the surface of a mesh.

A Gaussian sits at (k, b, d): triangle, barycentric coordinates, height along the interpolated normal.

    x = b . v + d n       n = b . vertex normals, normalised
    q = (b . q_v) q_l     q_v = area-weighted mean of the rotations of the faces around a vertex, from rest to pose

What is trained is (u, v, d): u and v are added to the first two barycentric coordinates. Between the steps, u and v are
walked off along the surface (`walking.py`) and set to 0, so that a Gaussian may change its triangle.

    mode      embedding                                      scale                      blended rotations
    paper     u and v act on the position and are learned    sqrt(area ratio) exp(s)    signs aligned
    released  u and v act on nothing, so nothing is walked   exp(area ratio s)          as they come

`released` is how the public code behaves (its area ratio adds 1e-4 m^2 to both areas). A ratio is posed to rest area.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from nbavatar.math.rotations import matrix_to_quaternion, normalize_quaternion, quaternion_multiply
from nbavatar.mesh.frames import face_frames
from nbavatar.methods.gaussians.avatar import LOG_SCALE_RANGE, GaussianAvatar, PosedGaussians
from nbavatar.methods.splatting_avatar.walking import Surface, make_surface, tangents, walk

__all__ = ["EmbeddedAnchor", "SplattingAvatar"]

MODES = ("paper", "released")
_DAMPING = 1e-4  # of the released area ratio [m^2]
_TINY = 1e-12


class EmbeddedAnchor(NamedTuple):
    """The mesh of one frame.

    Attributes:
        verts: of all parts [m], (V, 3).
        normals: of the vertices, unit, (V, 3).
        quats: rotations of the vertices from rest to pose, unit, wxyz (V, 4).
        ratio: posed to rest area, (F,).
        shown: whether a face's part is there, bool (F,), or None for all.
    """

    verts: Tensor
    normals: Tensor
    quats: Tensor
    ratio: Tensor
    shown: Tensor | None


class SplattingAvatar(GaussianAvatar):
    """Gaussians embedded in a surface.

    Attributes:
        mode: paper or released.
        uvd: steps u, v in barycentric coordinates and heights d [m], (N, 3).
        face: triangle of each Gaussian, int64 (N,).
        bary: barycentric coordinates in it, (N, 3).
        rest: vertices in the pose that rotations and areas are compared with [m], (V, 3).
    """

    method: ClassVar[str] = "splatting_avatar"
    PARAMETERS: ClassVar[tuple[str, ...]] = ("uvd", *GaussianAvatar.PARAMETERS)
    BUFFERS: ClassVar[tuple[str, ...]] = ("face", "bary")
    FACE: ClassVar[str] = "face"
    face: Tensor
    bary: Tensor
    rest: Tensor

    def __init__(
        self,
        faces: Mapping[str, Tensor],
        vertex_counts: Mapping[str, int],
        *,
        rest: Tensor,
        face: Tensor,
        bary: Tensor,
        log_scale: Tensor,
        opacity: float,
        sh_degree: int,
        mode: str,
        record: Mapping[str, Any] | None = None,
    ) -> None:
        """Args: as of `GaussianAvatar`; all colours grey, heights 0."""
        super().__init__(
            faces,
            vertex_counts,
            log_scale=log_scale,
            colour=torch.zeros(len(face), 3),
            opacity=opacity,
            sh_degree=sh_degree,
            record=record,
        )
        if mode not in MODES:
            raise ValueError(f"mode {mode!r} is none of {', '.join(MODES)}")
        self.mode = mode
        self.degree.fill_(sh_degree)
        self.uvd = nn.Parameter(torch.zeros(len(face), 3))
        self.register_buffer("face", face.clone())
        self.register_buffer("bary", bary.clone())
        self.register_buffer("rest", rest.clone())
        self._surface: Surface | None = None
        self._still: tuple[Tensor, Tensor, Tensor] | None = None

    @property
    def surface(self) -> Surface:
        """The rest mesh, laid out for walking."""
        if self._surface is None:
            self._surface = make_surface(self.rest.cpu().double().numpy(), self.faces.cpu().numpy())
        return self._surface

    def anchor(self, verts: Mapping[str, Tensor], frame: str | None = None) -> EmbeddedAnchor:
        """See `MeshAvatar.anchor`."""
        points, keep = self.merged(verts)
        rotation, area, first = self._at_rest()
        cross = _face_cross(points, self.faces)
        normals = torch.zeros_like(points)
        turned = face_frames(points, self.faces).R @ rotation.transpose(1, 2)
        per_face = matrix_to_quaternion(turned)
        quats = points.new_zeros((len(points), 4))
        for corner in range(3):
            ids = self.faces[:, corner]
            normals = normals.index_add(0, ids, cross)
            around = per_face
            if self.mode == "paper":  # q and -q are one rotation: without this they may cancel
                around = _aligned(per_face, per_face[first[ids]])
            quats = quats.index_add(0, ids, area[:, None] * around)
        posed_area = 0.5 * cross.norm(dim=1)
        damping = _DAMPING if self.mode == "released" else _TINY
        shown = None
        if keep is not None:
            shown = torch.zeros(len(self.faces), dtype=torch.bool, device=self.faces.device)
            shown[keep] = True
        return EmbeddedAnchor(
            points,
            torch.nn.functional.normalize(normals, dim=1, eps=_TINY),
            normalize_quaternion(quats),
            (posed_area + damping) / (area + damping),
            shown,
        )

    def pose(self, anchor: EmbeddedAnchor) -> PosedGaussians:
        """See `GaussianAvatar.pose`."""
        rows, face, bary, uvd = None, self.face, self.coordinates(), self.uvd
        quat, log_scale = self.quat, self.log_scale
        if anchor.shown is not None:
            rows = anchor.shown[face].nonzero().squeeze(1)
            face, bary, uvd, quat, log_scale = (x[rows] for x in (face, bary, uvd, quat, log_scale))
        corners = self.faces[face]
        base = _blend(bary, anchor.verts[corners])
        normal = torch.nn.functional.normalize(_blend(bary, anchor.normals[corners]), dim=1, eps=_TINY)
        around = anchor.quats[corners]
        if self.mode == "paper":
            around = _aligned(around, around[:, :1])
        turn = quaternion_multiply(normalize_quaternion(_blend(bary, around)), normalize_quaternion(quat))
        ratio = anchor.ratio[face][:, None]
        if self.mode == "paper":
            scales = ratio.sqrt() * log_scale.clamp(*LOG_SCALE_RANGE).exp()
        else:
            scales = (ratio * log_scale).clamp(*LOG_SCALE_RANGE).exp()
        return PosedGaussians(base + uvd[:, 2:] * normal, turn, scales, rows)

    def coordinates(self) -> Tensor:
        """Barycentric coordinates with the steps u, v that are not walked yet, (N, 3); they may leave the triangle."""
        if self.mode == "released":
            return self.bary
        u, v = self.uvd[:, 0], self.uvd[:, 1]
        return self.bary + torch.stack((u, v, -u - v), dim=1)

    def pending_change(self) -> Tensor:
        """Change of the barycentric coordinates that u and v stand for, (N, 3)."""
        return (self.coordinates() - self.bary).detach()

    def walked(self, rows: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
        """Faces and coordinates after walks from the embeddings of some Gaussians.

        Args:
            rows: which Gaussians, int64 (M,).
            change: of their barycentric coordinates, (M, 3).
        """
        faces = self.face[rows].cpu().numpy()
        step = tangents(self.surface, faces, change.detach().double().cpu().numpy())
        return self._landed(faces, rows, step)

    def offspring(self, rows: Tensor, noise: Tensor) -> dict[str, Tensor]:
        """A child lands where the tangential part of its random offset in the rest pose takes it; its height stays."""
        corners = self.rest[self.faces[self.face[rows]]]
        faces = self.face[rows].cpu().numpy()
        axes = face_frames(self.rest, self.faces).R[self.face[rows]]
        # In the rest pose the vertices' rotations are identities: local axes are the world's.
        step = self.local_offsets(rows, noise)
        normal = axes[:, :, 2]
        step = step - (step * normal).sum(1, keepdim=True) * normal
        step = step + torch.einsum("nc,ncd->nd", self.pending_change()[rows], corners)
        face, bary = self._landed(faces, rows, step.detach().double().cpu().numpy())
        height = torch.cat((torch.zeros_like(self.uvd[rows, :2]), self.uvd[rows, 2:]), 1)
        return {"face": face, "bary": bary, "uvd": height}

    def adapted(self, other: "SplattingAvatar", rows: Tensor, faces: Tensor) -> dict[str, Tensor]:
        """Rotations and sizes where the rest poses differ: they count from there, and shall stay as to the triangle.

        q' = q(R' R^T) q and s' = s + 1/2 log(A' / A), with the triangle's axes R, R' and areas A, A' in the rest poses
        of the other avatar and of this one. Heights stay in metres.
        """
        before = other.face[rows]
        if torch.equal(other.rest[other.faces[before]], self.rest[self.faces[faces]]):
            return {}
        (axes_before, area_before, _), (axes, area, _) = other._at_rest(), self._at_rest()
        turn = matrix_to_quaternion(axes[faces] @ axes_before[before].transpose(1, 2))
        ratio = area[faces].clamp_min(_TINY) / area_before[before].clamp_min(_TINY)
        return {
            "quat": quaternion_multiply(turn, normalize_quaternion(other.quat[rows])),
            "log_scale": other.log_scale[rows] + 0.5 * ratio.log()[:, None],
        }

    def content(self) -> dict[str, Any]:
        """Mode and degree of the harmonics."""
        return {"sh_degree": self.sh_degree, "mode": self.mode}

    @classmethod
    def rebuild(
        cls, content: Mapping[str, Any], state: Mapping[str, Tensor], record: Mapping[str, Any]
    ) -> "SplattingAvatar":
        """See `MeshAvatar.rebuild`."""
        faces = sum(len(part) for part in content["faces"].values())
        if len(state["face"]) and not (0 <= int(state["face"].min()) and int(state["face"].max()) < faces):
            raise ValueError(f"face names faces beyond the {faces} there are")
        return cls(
            content["faces"],
            content["vertex_counts"],
            rest=torch.zeros_like(state["rest"]),
            face=torch.zeros(1, dtype=torch.int64),
            bary=torch.zeros(1, 3),
            log_scale=torch.zeros(1, 3),
            opacity=0.1,
            sh_degree=int(content["sh_degree"]),
            mode=content["mode"],
            record=record,
        )

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """See `MeshAvatar.restore`."""
        super().restore(state)
        self._surface = self._still = None

    def _landed(self, faces: Any, rows: Tensor, step: Any) -> tuple[Tensor, Tensor]:
        new_face, new_bary = walk(self.surface, faces, self.bary[rows].cpu().numpy(), step)
        device = self.face.device
        return torch.from_numpy(new_face).to(device), torch.from_numpy(new_bary).to(device, self.bary.dtype)

    def _at_rest(self) -> tuple[Tensor, Tensor, Tensor]:
        """Rotations (F, 3, 3) and areas (F,) of the rest pose, and one face of every vertex (V,)."""
        if self._still is None or self._still[0].device != self.rest.device:
            first = torch.zeros(len(self.rest), dtype=torch.int64)
            order = torch.arange(len(self.faces) - 1, -1, -1)
            first[self.faces.cpu()[order].flatten()] = order.repeat_interleave(3)
            area = 0.5 * _face_cross(self.rest, self.faces).norm(dim=1)
            self._still = face_frames(self.rest, self.faces).R, area, first.to(self.rest.device)
        return self._still


def _blend(weights: Tensor, values: Tensor) -> Tensor:
    """Sums of values at the corners (N, 3, D) with weights (N, 3)."""
    return (weights[..., None] * values).sum(1)


def _aligned(quats: Tensor, reference: Tensor) -> Tensor:
    """Quaternions with the sign that is nearer to a reference; orthogonal ones keep theirs."""
    return torch.where((quats * reference).sum(-1, keepdim=True) < 0, -quats, quats)


def _face_cross(points: Tensor, faces: Tensor) -> Tensor:
    """Normals of the faces, as long as twice their areas, (F, 3)."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    return torch.linalg.cross(b - a, c - a)
