"""The avatar after InteractAvatar (Chen et al. 2025): bound Gaussians that networks change with pose and touch.

A Gaussian is bound to its triangle as in GaussianAvatars (`nbavatar.methods.gaussians.bound`). What it has of its own
is changed by the pose before it is placed:

    hand   x_l, s_l, q_l, c, o  +=  H(where it is at rest; pose of the hand)
    face   x_l, s_l, q_l, c, o  +=  n F(where it is at rest, n; poses of the hands, expression, points of the hands)

n says how near the closest point of a hand is to the triangle: 1 where they touch, 0 out of reach, so a face without a
hand near it is GaussianAvatars'. The first guess of the contact's deformation is in the meshes that the avatar is
given. Parts that are not there are left out: without a hand, or without a head, there is nothing to interact. The
choices that the publication leaves open are listed in docs/decisions/010-after-interactavatar.md.
"""
# pyright: reportArgumentType=false
# torch gives what a module holds by name as a tensor or a module; here they are postures.

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from nbavatar.data.sequences import PARTS
from nbavatar.mesh.frames import face_frames
from nbavatar.methods.base import Taken
from nbavatar.methods.gaussians.avatar import LOG_SCALE_RANGE, PosedGaussians
from nbavatar.methods.gaussians.bound import BoundAnchor, BoundGaussians, check_binding, placed
from nbavatar.methods.interact_avatar.hands import nearness, spread_points
from nbavatar.methods.interact_avatar.networks import APPEARANCE, GEOMETRY, Changes, PointFeatures, encoded
from nbavatar.methods.interact_avatar.posture import Posture

__all__ = ["InteractAnchor", "InteractAvatar"]

_HEAD = PARTS[0]
_PLACE = 27  # of `encoded`
_LARGEST = 4096  # of the sizes in a file


class InteractAnchor(NamedTuple):
    """Where the triangles of one frame are, and what the networks are told of it.

    Attributes:
        bound: the triangles.
        codes: pose of each part that has one, (K,), in the avatar's order; zero where the part is not there.
        centres, groups, near: of the hands' points, as in `PointFeatures`, (P, 3), (P, K, 3), (P,).
        touch: how near a hand is to each triangle of the head, 0 for other triangles, (F,).
    """

    bound: BoundAnchor
    codes: tuple[Tensor, ...]
    centres: Tensor
    groups: Tensor
    near: Tensor
    touch: Tensor


class InteractAvatar(BoundGaussians):
    """Bound Gaussians whose parts have poses.

    Attributes:
        postures: what the poses of head and hands are, by part.
        hands: networks of each hand, by part.
        face: network of the head, and `points`, features of the hands; None without a head or without a hand.
        reach: distance of a hand from which it does nothing to the face [m].
    """

    method: ClassVar[str] = "interact_avatar"

    def __init__(
        self,
        faces: Mapping[str, Tensor],
        vertex_counts: Mapping[str, int],
        *,
        postures: Mapping[str, Posture],
        width: int,
        features: int,
        points: int,
        reach: float,
        random: torch.Generator | None = None,
        **gaussians: Any,
    ) -> None:
        """Args: as of `BoundGaussians`; postures of the parts that have one; units of the hidden layers; features and
        number of points; reach [m]; generator of the weights.
        """
        super().__init__(faces, vertex_counts, **gaussians)
        self.width, self.features, self.count, self.reach = width, features, points, reach
        self.postures = nn.ModuleDict({part: postures[part] for part in self.parts if part in postures})
        hands = [part for part in self.postures if part != _HEAD]
        sizes = {part: posture.components for part, posture in self.postures.items()}
        self.hands = nn.ModuleDict({part: Changes(_PLACE, sizes[part], width, random) for part in hands})
        self.points: PointFeatures | None = None
        self.face: Changes | None = None
        if hands and _HEAD in self.postures:
            self.points = PointFeatures(features, random)
            self.face = Changes(_PLACE + 1, sum(sizes.values()) + features, width, random)
        self.register_buffer("owner", self.face_groups(), persistent=False)
        self._settle()

    def _settle(self) -> None:
        """What follows from the rest poses: where triangles are in their part's size, and the hands' points."""
        origin = torch.zeros(len(self.faces), 3)
        axes = torch.zeros(len(self.faces), 3, 3)
        faces, ranges = self.part_faces(), self.face_ranges()
        for part, posture in self.postures.items():
            rest, rows = posture.rest.cpu(), ranges[part]
            frames, size = face_frames(rest, faces[part]), _size(rest)
            origin[rows] = (frames.T - rest.mean(0)) / size
            axes[rows] = frames.R * (frames.k / size)[:, None, None]
        device = self.faces.device
        self.register_buffer("origin", origin.to(device), persistent=False)
        self.register_buffer("axes", axes.to(device), persistent=False)
        self.sampled: dict[str, tuple[Tensor, Tensor]] = {}
        if self.face is not None:
            for part in self.hands:
                self.sampled[part] = spread_points(self.postures[part].rest.cpu(), self.count)

    def networks(self) -> list[nn.Parameter]:
        """Weights of all networks, in a fixed order."""
        modules = [self.hands, *(module for module in (self.points, self.face) if module is not None)]
        return [parameter for module in modules for parameter in module.parameters()]

    @torch.no_grad()
    def adopt_networks(self, other: "InteractAvatar", parts: Sequence[str]) -> Taken:
        """Take another avatar's networks, and what poses are to them; the rest poses stay this one's.

        Args:
            other: whose networks.
            parts: those whose faces are the same in both.

        Returns:
            which networks were taken, and which were not.
        """
        ours, theirs = self.state_dict(), other.state_dict()
        shared = [part for part in self.postures if part in other.postures and part in parts]
        wanted = {f"networks of {part}": ((f"hands.{part}.",), [part]) for part in self.hands if part in shared}
        over, left = [], []
        if self.face is not None and _HEAD in shared:
            if set(shared) == set(self.postures) == set(other.postures):
                wanted["networks of the face"] = ("face.", "points."), shared
            else:
                left.append("networks of the face (other parts)")
        for words, (prefixes, posed) in wanted.items():
            names = [name for name in ours if name.startswith(prefixes)]
            names += [f"postures.{part}.{name}" for part in posed for name in ("mean", "basis", "scale")]
            if any(name not in theirs or theirs[name].shape != ours[name].shape for name in names):
                left.append(f"{words} (other sizes)")
                continue
            over.append(words)
            for name in names:
                ours[name].copy_(theirs[name])
        return Taken(over, left)

    @torch.no_grad()
    def anchor(self, verts: Mapping[str, Tensor], frame: str | None = None) -> InteractAnchor:
        """See `MeshAvatar.anchor`."""
        bound = super().anchor(verts, frame)
        there = {p: verts[p] for p in self.postures if p in verts and bool(torch.isfinite(verts[p]).all())}
        codes = [self.origin.new_zeros(posture.components) for posture in self.postures.values()]
        for i, (part, posture) in enumerate(self.postures.items()):
            if part in there:
                codes[i] = posture.describe(there[part]).to(self.origin)
        return InteractAnchor(bound, tuple(codes), *self._touches(bound, there))

    def _touches(self, bound: BoundAnchor, there: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The last four fields of an anchor; no points where there is no head or no hand."""
        touch = self.origin.new_zeros(len(self.faces))
        hands = [part for part in self.sampled if part in there]
        if self.face is None or _HEAD not in there or not hands:
            return touch.new_zeros(0, 3), touch.new_zeros(0, 1, 3), touch.new_zeros(0), touch
        points = torch.cat([there[part][self.sampled[part][0].to(touch.device)] for part in hands])
        head = self.owner == self.parts.index(_HEAD)
        touch[head] = nearness(bound.frames.T[head], points, self.reach).to(touch)
        near = nearness(points, there[_HEAD], self.reach).to(touch)
        posture = self.postures[_HEAD]
        _, moved = posture.laid(there[_HEAD], *(there[part] for part in hands))
        size, middle = _size(posture.rest), posture.rest.mean(0)
        centres, groups = [], []
        for part, verts in zip(hands, moved, strict=True):
            ids, members = (where.to(touch.device) for where in self.sampled[part])
            centres.append((verts[ids] - middle) / size)
            groups.append((verts[members] - verts[ids][:, None]) / size)
        return torch.cat(centres), torch.cat(groups), near, touch

    def pose(self, anchor: InteractAnchor) -> PosedGaussians:
        """See `GaussianAvatar.pose`."""
        rows, binding = None, self.binding
        own = (self.offset, self.log_scale, self.quat, self.colour, self.opacity_logit, self.colour_rest)
        if anchor.bound.shown is not None:
            rows = anchor.bound.shown[binding].nonzero().squeeze(1)
            binding, own = binding[rows], tuple(values[rows] for values in own)
        offset, log_scale, quat, colour, logit, rest = own
        change = self.change(anchor, binding, offset.detach())
        moved, grown, turned, tinted, opened = change.split((3, 3, 4, 3, 1), dim=1)
        scales = (log_scale + grown).clamp(*LOG_SCALE_RANGE).exp()
        where = placed(anchor.bound, binding, offset + moved, quat + turned, scales)
        harmonics = torch.cat((colour + tinted[:, None], rest), 1)
        return PosedGaussians(*where, rows, logit + opened.squeeze(1), harmonics, change)

    def change(self, anchor: InteractAnchor, binding: Tensor, offset: Tensor) -> Tensor:
        """What the networks add to Gaussians, (M, 14).

        Args:
            anchor: of the frame.
            binding: face of each Gaussian, int64 (M,); offset: its local position [k], (M, 3).
        """
        total = offset.new_zeros(len(binding), GEOMETRY + APPEARANCE)
        place = encoded(self.origin[binding] + torch.einsum("nij,nj->ni", self.axes[binding], offset))
        normals, owner = anchor.bound.frames.R[binding][:, :, 2], self.owner[binding]
        codes = dict(zip(self.postures, anchor.codes, strict=True))
        for part, network in self.hands.items():
            rows = (owner == self.parts.index(part)).nonzero().squeeze(1)
            if len(rows) > 0:
                total = total.index_copy(0, rows, network(place[rows], normals[rows], codes[part]))
        touch = anchor.touch[binding]
        rows = (touch > 0).nonzero().squeeze(1)
        if self.face is not None and self.points is not None and len(rows) > 0:
            code = torch.cat((*anchor.codes, self.points(anchor.centres, anchor.groups, anchor.near)))
            near = touch[rows, None]
            found = self.face(torch.cat((place[rows], near), 1), normals[rows], code)
            total = total.index_copy(0, rows, near * found)
        return total

    def facts(self, width: int, height: int) -> dict[str, Any]:
        """Those of all Gaussians, and the weights of the networks."""
        return super().facts(width, height) | {"network_weights": sum(p.numel() for p in self.networks())}

    def content(self) -> dict[str, Any]:
        """Degree of the harmonics, sizes of the networks, number of points, reach."""
        sizes = {"width": self.width, "features": self.features, "points": self.count, "reach": self.reach}
        return super().content() | sizes

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """See `MeshAvatar.restore`."""
        super().restore(state)
        self._settle()

    @classmethod
    def rebuild(
        cls, content: Mapping[str, Any], state: Mapping[str, Tensor], record: Mapping[str, Any]
    ) -> "InteractAvatar":
        """See `MeshAvatar.rebuild`."""
        sizes = {name: int(content[name]) for name in ("width", "features", "points")}
        for name, size in sizes.items():
            if not 1 <= size <= _LARGEST:
                raise ValueError(f"{name} {size}")
        reach = float(content["reach"])
        if not (math.isfinite(reach) and reach > 0):
            raise ValueError(f"reach {reach}")
        postures = {}
        for part in content["faces"]:
            if f"postures.{part}.basis" in state:
                postures[part] = Posture(
                    *(state[f"postures.{part}.{name}"].clone() for name in ("rest", "mean", "basis", "scale"))
                )
                if postures[part].rest.shape != (int(content["vertex_counts"][part]), 3):
                    raise ValueError(f"rest of {part}: {len(postures[part].rest)} vertices")
        avatar = cls(
            content["faces"],
            content["vertex_counts"],
            postures=postures,
            **sizes,
            reach=reach,
            colour=torch.zeros(1, 3),
            opacity=0.1,
            sh_degree=int(content["sh_degree"]),
            record=record,
        )
        check_binding(content, state)
        return avatar


def _size(rest: Tensor) -> Tensor:
    """Largest distance of a coordinate from its mean over the vertices, never zero, ()."""
    return (rest - rest.mean(0)).abs().amax().clamp_min(1e-9)
