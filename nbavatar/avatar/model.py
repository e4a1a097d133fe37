"""The avatar as one object: meshes' faces, billboards, renderer, and one file that holds them all.

    features, nb_alpha = rasterize(billboards posed on the mesh)          paper, eq. 1
    colour, alpha      = R(features, nb_alpha)                            U-Net
    I                  = colour alpha + (1 - alpha) background            paper, eq. 2

`model.pt` opens with ``torch.load(..., weights_only=True)``: tensors, numbers and text, nothing executable.
Without deferred rendering (ablation 'w/o DNR') the textures hold RGB behind a sigmoid and the billboards' own
opacity is the picture's.
"""

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from nbavatar.avatar.billboards import Billboards, Posed, anchor_quaternions
from nbavatar.avatar.refine import Refinement
from nbavatar.avatar.region import Region, full_region, paste, region_of, shift_camera
from nbavatar.avatar.unet import UNet
from nbavatar.errors import DataError
from nbavatar.io.atomic import atomic_write
from nbavatar.mesh.frames import FaceFrames, face_frames
from nbavatar.raster.functional import render_billboards

__all__ = ["Anchor", "Architecture", "Avatar", "Window", "compose", "load_avatar", "save_avatar"]

FORMAT = 1
_KIND = "nbavatar avatar"
_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Numbers that fix an avatar's tensors and how it is rendered; see `nbavatar.config.avatar.TrainConfig`."""

    channels: int
    texels: int
    deferred: bool
    unet_width: int
    unet_depth: int
    unet_max_width: int
    unet_convs: int
    roi: bool
    roi_margin: float
    order: str


class Anchor(NamedTuple):
    """Where the billboards of one frame ride; independent of them, so it may be kept while they are trained.

    Attributes:
        frames: face frames of all parts.
        quats: rotations of the frames, wxyz (F, 4).
        keep: indices of the faces whose part is there in this frame, or None for all.
        penalty: of the refinement, scalar [m^2].
    """

    frames: FaceFrames
    quats: Tensor
    keep: Tensor | None
    penalty: Tensor


class Window(NamedTuple):
    """One rendered window of the image plane.

    Attributes:
        colour: I_R (without deferred rendering: colour divided by opacity), (3, h, w).
        alpha: I_alpha, (h, w).
        nb_alpha: opacity of the rasterized billboards I_alpha^NB, (h, w).
        features: premultiplied features I_f^NB, (C, h, w).
        region: where the window lies.
    """

    colour: Tensor
    alpha: Tensor
    nb_alpha: Tensor
    features: Tensor
    region: Region


def compose(colour: Tensor, alpha: Tensor, background: Tensor) -> Tensor:
    """I = I_R I_alpha + (1 - I_alpha) C_bg (paper, eq. 2); (3, H, W), (H, W), (3,) or (3, H, W)."""
    behind = background[:, None, None] if background.ndim == 1 else background
    return colour * alpha + (1.0 - alpha) * behind


class Avatar(nn.Module):
    """Neural billboards on the faces of the parts, and the renderer.

    Attributes:
        parts: names of the parts in order; vertices and faces are concatenated in this order.
        vertex_counts, face_counts: vertices and faces of each part.
        billboards: one per face.
        unet: renderer R, or None without deferred rendering.
        refinement: compensation of fitting errors on training frames, or None.
        record: provenance.
    """

    faces: Tensor

    def __init__(
        self,
        architecture: Architecture,
        faces: Mapping[str, Tensor],
        vertex_counts: Mapping[str, int],
        billboards: Billboards,
        *,
        refinement: Refinement | None = None,
        record: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.architecture = architecture
        self.parts = list(faces)
        self.vertex_counts = {part: int(vertex_counts[part]) for part in self.parts}
        self.face_counts = {part: len(faces[part]) for part in self.parts}
        merged, first = [], 0
        for part in self.parts:
            merged.append(faces[part].to(torch.int64) + first)
            first += self.vertex_counts[part]
        self.register_buffer("faces", torch.cat(merged))
        self.billboards = billboards
        a = architecture
        self.unet = (
            UNet(
                a.channels + 1, width=a.unet_width, depth=a.unet_depth, max_width=a.unet_max_width, convs=a.unet_convs
            ).to(memory_format=torch.channels_last)
            if a.deferred
            else None
        )
        self.refinement = refinement
        self.record = dict(record or {})

    @property
    def multiple(self) -> int:
        """Alignment of rendered windows [px]."""
        return 2**self.architecture.unet_depth if self.unet is not None else 1

    def face_groups(self) -> Tensor:
        """Part index of every face, int64 [F]."""
        counts = torch.tensor([self.face_counts[part] for part in self.parts])
        return torch.repeat_interleave(torch.arange(len(self.parts)), counts)

    def anchor(self, verts: Mapping[str, Tensor], frame: str | None = None) -> Anchor:
        """Face frames of one frame's meshes.

        Args:
            verts: vertices per part, float (V, 3) [m]; a part that is missing or not finite in this frame is left out.
            frame: id of a training frame, to use its refinement; None: as they are.

        Raises:
            DataError: a part has another number of vertices.
        """
        present, shown = [], []
        penalty = self.billboards.mu.new_zeros(())
        for part in self.parts:
            points = verts.get(part)
            if points is not None and points.shape != (self.vertex_counts[part], 3):
                raise DataError.of(
                    "meshes", part, expected=f"{self.vertex_counts[part]} vertices", found=f"{list(points.shape)}"
                )
            there = points is not None and bool(torch.isfinite(points).all())
            if points is None or not there:
                points = self.faces.new_zeros((self.vertex_counts[part], 3), dtype=self.billboards.mu.dtype)
            elif self.refinement is not None and frame is not None:
                points, extra = self.refinement(part, points, frame)
                penalty = penalty + extra
            present.append(points)
            shown.append(there)
        frames = face_frames(torch.cat(present), self.faces)
        keep = None
        if not all(shown):
            keep = torch.tensor(shown)[self.face_groups()].nonzero().squeeze(1).to(self.faces.device)
        return Anchor(frames, anchor_quaternions(frames), keep, penalty)

    def place(self, anchor: Anchor) -> tuple[Posed, Tensor | None]:
        """Billboards in world space, and the indices of those that are there (None: all)."""
        posed = self.billboards.pose(anchor.frames, anchor.quats)
        if anchor.keep is None:
            return posed, None
        return Posed(*(values[anchor.keep] for values in posed)), anchor.keep

    def pose(self, verts: Mapping[str, Tensor], frame: str | None = None) -> tuple[Posed, Tensor | None]:
        """Pose the billboards on one frame's meshes: `anchor` and `place`."""
        return self.place(self.anchor(verts, frame))

    def window(
        self,
        posed: Posed,
        keep: Tensor | None,
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        *,
        precision: str = "fp32",
        roi: bool | None = None,
        order: str | None = None,
    ) -> Window:
        """Rasterize and decode one view.

        Args:
            posed, keep: from `place` or `pose`.
            viewmat: world to camera (4, 4); K: intrinsics (3, 3) [px]; width, height: image size [px].
            precision: fp32, bf16 or fp16 for the U-Net.
            roi, order: override the avatar's own settings.
        """
        a = self.architecture
        features, alpha = self.textures()
        if keep is not None:
            features, alpha = features[keep], alpha[keep]
        region = full_region(width, height, self.multiple)
        if a.roi if roi is None else roi:
            region = region_of(posed, viewmat, K, width, height, multiple=self.multiple, margin=a.roi_margin)
        premultiplied, nb_alpha = render_billboards(
            posed.means,
            posed.quats,
            posed.half_extents,
            features,
            alpha,
            viewmat,
            shift_camera(K, region),
            region.width,
            region.height,
            order=order or a.order,
        )
        colour, opacity = self.decode(premultiplied, nb_alpha, precision)
        return Window(colour, opacity, nb_alpha, premultiplied, region)

    def textures(self) -> tuple[Tensor, Tensor]:
        """Activated textures: features (F, T, T, C) and opacity (F, T, T)."""
        features = self.billboards.features
        return (features if self.unet is not None else torch.sigmoid(features)), self.billboards.alpha()

    def decode(self, features: Tensor, nb_alpha: Tensor, precision: str = "fp32") -> tuple[Tensor, Tensor]:
        """Colour I_R (3, h, w) and opacity I_alpha (h, w) from rasterized features (C, h, w) and alpha (h, w)."""
        if self.unet is None:
            return features / nb_alpha.clamp_min(1e-6), nb_alpha
        stacked = torch.cat((features, nb_alpha[None]))[None].contiguous(memory_format=torch.channels_last)
        if precision == "fp32":
            colour, opacity = self.unet(stacked)
        else:
            with torch.autocast(stacked.device.type, dtype=_DTYPES[precision]):
                colour, opacity = self.unet(stacked)
        return colour[0], opacity[0, 0]

    def render(
        self,
        verts: Mapping[str, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        background: Tensor,
        *,
        frame: str | None = None,
        **options: Any,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Whole picture: image (3, H, W), alpha (H, W) and the billboards' alpha (H, W); options as in `window`."""
        posed, keep = self.pose(verts, frame)
        window = self.window(posed, keep, viewmat, K, width, height, **options)
        alpha = paste(window.alpha, window.region, width, height)
        nb_alpha = paste(window.nb_alpha, window.region, width, height)
        colour = paste(window.colour, window.region, width, height)
        return compose(colour, alpha, background), alpha, nb_alpha


def save_avatar(path: str | os.PathLike[str], avatar: Avatar) -> None:
    """Write an avatar to one file, atomically."""
    first = 0
    faces = {}
    offset = 0
    for part in avatar.parts:
        last = first + avatar.face_counts[part]
        faces[part] = (avatar.faces[first:last] - offset).cpu()
        first, offset = last, offset + avatar.vertex_counts[part]
    content = {
        "kind": _KIND,
        "format": FORMAT,
        "architecture": dataclasses.asdict(avatar.architecture),
        "faces": faces,
        "vertex_counts": avatar.vertex_counts,
        "refinement": None
        if avatar.refinement is None
        else {"frames": avatar.refinement.frames, "rigid": avatar.refinement.rigid},
        "record": json.dumps(avatar.record, sort_keys=True),
        # Detached clones: a view would drag its whole storage into the file.
        "state": {name: value.detach().cpu().clone() for name, value in avatar.state_dict().items() if name != "faces"},
    }
    with atomic_write(path) as temporary:
        torch.save(content, temporary)


def load_avatar(path: str | os.PathLike[str], device: str | torch.device = "cpu") -> Avatar:
    """Read an avatar.

    Raises:
        DataError: missing, damaged, not an avatar, or of another format version.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise DataError.of(path, expected="an avatar (model.pt)", found="no such file") from error
    except Exception as error:  # torch raises many kinds for damaged and for hostile files
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError.of(
            path, expected="an avatar (model.pt)", found=f"a damaged or foreign file ({reason})"
        ) from error
    if not isinstance(content, dict) or content.get("kind") != _KIND:
        raise DataError.of(path, "kind", expected=f"'{_KIND}'", found="something else")
    if content["format"] != FORMAT:
        raise DataError.of(
            path, "format", expected=FORMAT, found=content["format"], fix="train it again with this version"
        )
    try:
        state: dict[str, Tensor] = content["state"]
        billboards = Billboards(
            torch.ones_like(state["billboards.log_scale"]),
            state["billboards.features"],
            state["billboards.alpha_logit"],
        )
        avatar = Avatar(
            Architecture(**content["architecture"]),
            content["faces"],
            content["vertex_counts"],
            billboards,
            refinement=_empty_refinement(content["refinement"], state),
            record=json.loads(content["record"]),
        )
        avatar.load_state_dict({**state, "faces": avatar.faces})
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise DataError.of(path, expected="a whole avatar", found=f"contents that disagree ({error})") from error
    return avatar.to(device).eval()


def _empty_refinement(described: Mapping[str, Any] | None, state: Mapping[str, Tensor]) -> Refinement | None:
    """Refinement of the stored shape, its values still to be loaded."""
    if described is None:
        return None
    prefix = "refinement.basis_"
    basis = {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}
    frames: Sequence[str] = described["frames"]
    return Refinement(frames, basis, rigid=bool(described["rigid"]))
