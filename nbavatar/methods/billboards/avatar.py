"""The avatar as one object: meshes' faces, billboards and renderer.

    features, nb_alpha = rasterize(billboards posed on the mesh)          paper, eq. 1
    colour, alpha      = R(features, nb_alpha)                            U-Net
    I                  = colour alpha + (1 - alpha) background            paper, eq. 2

Without deferred rendering (ablation 'w/o DNR') the textures hold RGB behind a sigmoid and the billboards' own
opacity is the picture's.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from nbavatar.config.evaluation import EAGER
from nbavatar.math.rotations import matrix_to_quaternion
from nbavatar.mesh.frames import FaceFrames, face_frames
from nbavatar.methods.base import MeshAvatar, Stages, compose
from nbavatar.methods.billboards.architecture import Architecture, check_stored
from nbavatar.methods.billboards.billboards import Billboards, Posed, mirrored_sight
from nbavatar.methods.billboards.compression.sized import SizedBillboards
from nbavatar.methods.billboards.engine import DecoderEngine
from nbavatar.methods.billboards.refine import Refinement
from nbavatar.methods.billboards.region import Region, full_region, paste, region_of, shift_camera
from nbavatar.methods.billboards.shading import Shading
from nbavatar.methods.billboards.unet import macs
from nbavatar.rendering.billboards.functional import render_billboards

__all__ = ["Anchor", "Avatar", "Window"]

_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


class Anchor(NamedTuple):
    """Where the billboards of one frame ride; independent of them, so it may be kept while they are trained.

    Attributes:
        frames: face frames of the parts that are there.
        quats: rotations of the frames, wxyz (F, 4).
        keep: indices of the faces whose part is there in this frame, or None for all.
        light: what the decoder is told of the light on these faces: normals, then shading, if any (F, L).
        penalty: of the refinement, scalar [m^2].
    """

    frames: FaceFrames
    quats: Tensor
    keep: Tensor | None
    light: Tensor
    penalty: Tensor


class Window(NamedTuple):
    """One rendered window of the image plane.

    Attributes:
        colour: I_R (without deferred rendering: colour divided by opacity), (3, h, w).
        alpha: I_alpha, (h, w).
        nb_alpha: opacity of the rasterized billboards I_alpha^NB, (h, w).
        features: premultiplied features I_f^NB (C, h, w); behind them what is told of the light (C + L, h, w).
        region: where the window lies.
    """

    colour: Tensor
    alpha: Tensor
    nb_alpha: Tensor
    features: Tensor
    region: Region


class Avatar(MeshAvatar):
    """Neural billboards on the faces of the parts, and the renderer.

    Attributes:
        billboards: one per face (`SizedBillboards` where textures have sizes of their own).
        unet: renderer R, or None without deferred rendering.
        refinement: compensation of fitting errors on training frames, or None.
        shading: the studio's light on the faces, or None where the decoder is not told.
        engine: what decodes in torch's place where it can, or None (`use_engine`).
    """

    method: ClassVar[str] = "billboards"

    def __init__(
        self,
        architecture: Architecture,
        faces: Mapping[str, Tensor],
        vertex_counts: Mapping[str, int],
        billboards: Billboards,
        *,
        refinement: Refinement | None = None,
        shading: Shading | None = None,
        record: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(faces, vertex_counts, record)
        self.architecture = architecture
        self.billboards = billboards
        unet = architecture.renderer() if architecture.deferred else None
        self.unet = None if unet is None else unet.to(memory_format=torch.channels_last)
        self.refinement = refinement
        self.shading = shading
        self.engine: DecoderEngine | None = None

    @property
    def primitives(self) -> int:
        """Number of billboards."""
        return len(self.billboards.mu)

    @property
    def fixed_anchors(self) -> bool:
        """Anchors stay as they are unless a refinement moves the meshes."""
        return self.refinement is None

    @property
    def multiple(self) -> int:
        """Alignment of rendered windows [px]."""
        return 2**self.architecture.unet_depth if self.unet is not None else 1

    def anchor(self, verts: Mapping[str, Tensor], frame: str | None = None) -> Anchor:
        """Face frames of one frame's meshes.

        Args:
            verts: vertices per part, float (V, 3) [m]; a part that is missing or not finite in this frame is left out.
            frame: id of a training frame, to use its refinement; None: as they are.

        Raises:
            DataError: a part has another number of vertices.
        """
        penalty = self.billboards.mu.new_zeros(())

        def refined(part: str, points: Tensor) -> Tensor:
            nonlocal penalty
            if self.refinement is None or frame is None:
                return points
            points, extra = self.refinement(part, points, frame)
            penalty = penalty + extra
            return points

        points, keep = self.merged(verts, refined)
        faces = self.faces if keep is None else self.faces[keep]
        frames = face_frames(points, faces)
        lit, normals = points, frames.R[..., 2].detach()
        if self.refinement is not None and frame is not None and (self.architecture.normals or self.shading):
            # A mesh that is refined moves to where it is seen, not to be lit.
            lit, _ = self.merged(verts)
            normals = face_frames(lit, faces).R[..., 2]
        light = self._light(lit, faces, normals, keep)
        return Anchor(frames, matrix_to_quaternion(frames.R), keep, light, penalty)

    def _light(self, points: Tensor, faces: Tensor, normals: Tensor, keep: Tensor | None) -> Tensor:
        """What the decoder is told of the light on these faces, (F, L)."""
        told = [normals] if self.architecture.normals else [normals[:, :0]]
        if self.shading is not None:
            groups = self.face_groups()
            shown = torch.unique(groups if keep is None else groups[keep.cpu()]).tolist()
            starts = [0, *accumulate(self.vertex_counts.values())]
            first = {self.parts[i]: starts[i] for i in shown}
            told.append(self.shading(points, faces, normals, first))
        return torch.cat(told, dim=1)

    def place(self, anchor: Anchor) -> tuple[Posed, Tensor | None]:
        """Billboards in world space, and the indices of those that are there (None: all)."""
        posed = self.billboards.pose(anchor.frames, anchor.quats, anchor.keep)
        return posed._replace(light=anchor.light), anchor.keep

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
        engine: bool = True,
    ) -> Window:
        """Rasterize and decode one view.

        Args:
            posed, keep: from `place` or `pose`.
            viewmat: world to camera (4, 4); K: intrinsics (3, 3) [px]; width, height: image size [px].
            precision: fp32, bf16 or fp16 for the U-Net.
            roi, order: override the avatar's own settings.
            engine: whether the avatar's engine may decode.
        """
        a = self.architecture
        features, alpha = self.textures(keep)
        region = full_region(width, height, self.multiple)
        if a.roi if roi is None else roi:
            region = region_of(posed, viewmat, K, width, height, multiple=self.multiple, margin=a.roi_margin)
        premultiplied, nb_alpha = render_billboards(
            *posed.planes,
            features,
            alpha,
            viewmat,
            shift_camera(K, region),
            region.width,
            region.height,
            order=order or a.order,
            uniform=self.light_and_gloss(posed, viewmat),
        )
        if a.gloss:
            # Whatever the loss would like gloss to be, billboards neither move nor fade for it: trainings that let them
            # lose detail everywhere (docs/decisions/015-gloss.md).
            premultiplied = torch.cat((premultiplied[:-3], premultiplied[-3:].detach()))
        colour, opacity = self.decode(premultiplied, nb_alpha, precision, engine=engine)
        return Window(colour, opacity, nb_alpha, premultiplied, region)

    def textures(self, keep: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Activated textures: features (F, T, T, C) and opacity (F, T, T); of the billboards `keep` (None: all)."""
        features, alpha = self.billboards.features, self.billboards.alpha()
        features = features if self.unet is not None else torch.sigmoid(features)
        return (features, alpha) if keep is None else (features[keep], alpha[keep])

    def light_and_gloss(self, posed: Posed, viewmat: Tensor) -> Tensor:
        """What is rasterized for the decoder beside the textures: light and gloss of each billboard (F, D).

        Not part of the paper. Where light stands still, how bright a surface is depends on its direction in the world
        and on what shadows it, and a texture that rides with the mesh cannot say so.
        """
        if not self.architecture.gloss:
            return posed.light
        sight = mirrored_sight(posed.light[:, :3], posed.means.detach(), viewmat)
        return torch.cat((posed.light, sight), dim=1)

    def use_engine(self, kind: str) -> str:
        """See `MeshAvatar.use_engine`."""
        self.engine = None if kind == EAGER or self.unet is None else DecoderEngine(kind)
        return EAGER if self.engine is None else self.engine.name

    def decode(
        self, features: Tensor, nb_alpha: Tensor, precision: str = "fp32", *, engine: bool = True
    ) -> tuple[Tensor, Tensor]:
        """Colour I_R (3, h, w) and opacity I_alpha (h, w) from rasterized features and alpha (h, w).

        Features are those of `Window.features`.
        """
        if self.unet is None:
            return features / nb_alpha.clamp_min(1e-6), nb_alpha
        stacked = torch.cat((features, nb_alpha[None]))[None].contiguous(memory_format=torch.channels_last)
        colour, opacity = self.run_unet(stacked, precision, engine=engine)
        return colour[0], opacity[0, 0]

    def run_unet(self, stacked: Tensor, precision: str = "fp32", *, engine: bool = True) -> tuple[Tensor, Tensor]:
        """`UNet.forward` of what it takes (1, `decoded_channels`, h, w), by the engine where it may and can."""
        assert self.unet is not None
        if precision == "fp32":
            if engine and self.engine is not None and self.engine.takes(stacked, self.unet):
                return self.engine(self.unet, stacked)
            return self.unet(stacked)
        with torch.autocast(stacked.device.type, dtype=_DTYPES[precision]):
            return self.unet(stacked)

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

    def panels(
        self,
        verts: Mapping[str, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        background: Tensor,
        frame: str | None = None,
    ) -> list[Tensor]:
        """Render, opacity of the billboards, and their first three features in false colours."""
        posed, keep = self.pose(verts, frame)
        window = self.window(posed, keep, viewmat, K, width, height)
        place = window.region, width, height
        image = compose(paste(window.colour, *place), paste(window.alpha, *place), background)
        nb_alpha = paste(window.nb_alpha, *place).expand(3, -1, -1)
        # Shifted so that zero is grey; fewer channels are repeated.
        shown = window.features[[min(i, len(window.features) - 1) for i in range(3)]]
        return [image, nb_alpha, paste(0.5 + 0.5 * torch.tanh(shown), *place, 0.5)]

    def stages(
        self,
        verts: Mapping[str, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        background: Tensor,
        precisions: Sequence[str],
    ) -> Stages:
        """Stages of the paper's timing table: pose, raster (neural textures, RGB), renderer, compose, total."""
        with torch.no_grad():
            posed, keep = self.pose(verts)
            features, alpha = self.textures(keep)
            window = self.window(posed, keep, viewmat, K, width, height)
            told = self.light_and_gloss(posed, viewmat)
            rgb = features[..., [min(i, features.shape[-1] - 1) for i in range(3)]].contiguous()
        region = window.region

        def raster(values: Tensor, uniform: Tensor | None = None) -> Callable[[], Any]:
            return lambda: render_billboards(
                *posed.planes, values, alpha, viewmat, shift_camera(K, region), region.width, region.height,
                order=self.architecture.order, uniform=uniform,
            )  # fmt: skip

        calls: dict[str, Callable[[], Any]] = {
            "pose": lambda: self.pose(verts),
            "raster": raster(features, told),
            "raster_rgb": raster(rgb),
            "compose": lambda: compose(window.colour, window.alpha, background),
        }
        kinds = {p: (p, False) for p in (precisions if self.unet is not None else ["fp32"])}
        if self.engine is not None:
            kinds["engine"] = "fp32", True
        for name, (precision, engine) in kinds.items():
            if self.unet is not None:
                calls[f"renderer_{name}"] = lambda p=precision, e=engine: self.decode(
                    window.features, window.nb_alpha, p, engine=e
                )
            calls[f"total_{name}"] = lambda p=precision, e=engine: self.render(
                verts, viewmat, K, width, height, background, precision=p, engine=e
            )[0]
        return Stages(calls, region.width * region.height / (width * height))

    def facts(self, width: int, height: int) -> dict[str, Any]:
        """Billboards, channels, texels, and multiply-adds of the renderer for a whole picture."""
        return {
            "billboards": self.primitives,
            "channels": self.architecture.channels,
            "texels": self.architecture.texels,
            "renderer_gmac": None if self.unet is None else round(macs(self.unet, height, width) / 1e9, 3),
        }

    def content(self) -> dict[str, Any]:
        """Architecture and refinement."""
        refinement = self.refinement
        return {
            "architecture": dataclasses.asdict(self.architecture),
            "refinement": None if refinement is None else {"frames": refinement.frames, "rigid": refinement.rigid},
        }

    @classmethod
    def rebuild(cls, content: Mapping[str, Any], state: Mapping[str, Tensor], record: Mapping[str, Any]) -> "Avatar":
        """An avatar of the stored shape, its values still to be loaded."""
        architecture = Architecture(**content["architecture"])
        check_stored(architecture, content["refinement"], state, content["vertex_counts"])
        if "billboards.sizes" in state:
            billboards = SizedBillboards.of_state(architecture.texels, state, "billboards.")
        else:
            billboards = Billboards(
                torch.ones_like(state["billboards.log_scale"]),
                state["billboards.features"],
                state["billboards.alpha_logit"],
            )
        return cls(
            architecture,
            content["faces"],
            content["vertex_counts"],
            billboards,
            refinement=_empty_refinement(content["refinement"], state),
            shading=Shading.of_state(state, "shading.") if architecture.shading else None,
            record=record,
        )


def _empty_refinement(described: Mapping[str, Any] | None, state: Mapping[str, Tensor]) -> Refinement | None:
    """Refinement of the stored shape, its values still to be loaded."""
    if described is None:
        return None
    prefix = "refinement.basis_"
    basis = {name[len(prefix) :]: value for name, value in state.items() if name.startswith(prefix)}
    frames: Sequence[str] = described["frames"]
    return Refinement(frames, basis, rigid=bool(described["rigid"]))
