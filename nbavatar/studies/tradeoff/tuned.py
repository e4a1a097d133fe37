"""A trained avatar under a setting: the same picture, or one close to it, for less.

At the default setting the picture is the avatar's own, bit by bit; what a frame does not show is not worked on: parts
that are absent, and everything when no billboard is in the picture.
"""

import contextlib
import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from nbavatar.config.core import to_mapping
from nbavatar.config.tradeoff import SettingConfig
from nbavatar.errors import DataError
from nbavatar.methods.base import Stages, compose
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.billboards import Posed
from nbavatar.methods.billboards.compression.contribution import most_contributing
from nbavatar.methods.billboards.compression.footprint import footprints, texels_of
from nbavatar.methods.billboards.compression.reduce import avatar_bytes, keep_billboards, keep_parts, resize_textures
from nbavatar.methods.billboards.compression.textures import resample_textures
from nbavatar.methods.billboards.region import Region, full_region, paste, region_of, shift_camera, visible_box
from nbavatar.rendering.billboards.functional import render_billboards

__all__ = ["Laps", "TunedAvatar", "Work", "texels_needed"]

_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}
_SMALLEST_MIP = 2
_MIP_SHARE = 0.9  # of the billboards whose texels must not be larger than a pixel


class Laps(Protocol):
    """Told at the end of every stage of a picture: pose, raster, renderer, compose."""

    def __call__(self, stage: str) -> None:
        """Takes the name of the stage that has just ended."""
        ...


@dataclass
class Work:
    """What has been done so far, counted: it does not depend on the machine.

    Attributes:
        pictures: rendered.
        posed: billboards placed in the world.
        raster_calls, raster_pixels: calls of the rasterizer and pixels it filled.
        decoder_calls, decoded_pixels: calls of the U-Net and pixels it worked on.
        texels: opacity texels of the textures that the rasterizer was given.
    """

    pictures: int = 0
    posed: int = 0
    raster_calls: int = 0
    raster_pixels: int = 0
    decoder_calls: int = 0
    decoded_pixels: int = 0
    texels: int = 0


class _Scene(NamedTuple):
    """The avatar of the parts that are there, and its activated textures, largest first."""

    avatar: Avatar
    levels: list[tuple[Tensor, Tensor]]


class TunedAvatar:
    """Renders an avatar under a setting.

    Args:
        avatar: trained, of the method `billboards`; it is not changed.
        setting: what to do and what to leave out.
        importance: contribution of every billboard to some views (`contributions`), float (N, F); needed only where the
            setting keeps a share of the billboards.

    It stands in for the avatar where pictures are rendered and timed (`MeshAvatar`): faces and parts are those of the
    whole avatar, so that meshes are checked against it.

    Attributes:
        avatar: with the billboards and textures that the setting keeps.
        work: counted over all pictures so far.
    """

    def __init__(self, avatar: Avatar, setting: SettingConfig, *, importance: Tensor | None = None) -> None:
        if not isinstance(avatar, Avatar):
            found = getattr(avatar, "method", type(avatar).__name__)
            raise DataError.of("setting", expected="an avatar of billboards", found=f"method {found}")
        self.setting, self.work, self._whole = setting, Work(), avatar
        if setting.billboards < 1.0:
            if importance is None:
                raise DataError.of("setting", "billboards", expected="contributions to choose by", found="none")
            kept = most_contributing(importance, setting.billboards)
            avatar = keep_billboards(avatar, kept.to(avatar.faces.device))
        if setting.texels is not None:
            avatar = resize_textures(avatar, setting.texels)
        self.avatar = avatar
        self._unet = avatar.unet
        if avatar.unet is not None and not setting.channels_last:
            self._unet = copy.deepcopy(avatar.unet).to(memory_format=torch.contiguous_format).eval()
        self._scenes: dict[tuple[str, ...], _Scene] = {}

    @property
    def parts(self) -> list[str]:
        """Parts of the whole avatar."""
        return self._whole.parts

    @property
    def face_counts(self) -> dict[str, int]:
        """Faces of each part of the whole avatar."""
        return self._whole.face_counts

    @property
    def vertex_counts(self) -> dict[str, int]:
        """Vertices of each part."""
        return self._whole.vertex_counts

    @property
    def faces(self) -> Tensor:
        """Faces of the whole avatar, int64 (F, 3)."""
        return self._whole.faces

    def part_faces(self) -> dict[str, Tensor]:
        """Faces of each part in its own vertex numbers, int64 (F, 3)."""
        return self._whole.part_faces()

    @property
    def record(self) -> dict[str, Any]:
        """Provenance of the whole avatar."""
        return self._whole.record

    @property
    def method(self) -> str:
        """Kind of the avatar."""
        return self._whole.method

    @property
    def primitives(self) -> int:
        """Billboards that are kept."""
        return self.avatar.primitives

    def kept_bytes(self) -> int:
        """Memory between pictures [bytes]: the avatar's tensors, and textures made ready for the rasterizer."""
        own = {tensor.data_ptr() for tensor in self.avatar.parameters()}
        ready = (tensor for scene in self._scenes.values() for level in scene.levels for tensor in level)
        made = sum(tensor.numel() * tensor.element_size() for tensor in ready if tensor.data_ptr() not in own)
        return avatar_bytes(self.avatar) + made

    def eval(self) -> "TunedAvatar":
        """Itself: it is never trained."""
        return self

    def facts(self, width: int, height: int) -> dict[str, Any]:
        """As the avatar's, and the setting."""
        return self.avatar.facts(width, height) | {"setting": to_mapping(self.setting)}

    def stages(
        self,
        verts: Mapping[str, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        background: Tensor,
        *_: Any,
    ) -> Stages:
        """Stages of one view to time; arguments as in `render`."""
        s, size = self.setting, (width, height)
        calls: dict[str, Callable[[], Any]] = {
            f"total_{s.precision}": lambda: self.render(verts, viewmat, K, width, height, background)[0]
        }
        with torch.no_grad(), _threads(s.threads):
            scene = self._scene(verts)
            small, inner = self._inner(K, width, height)
            posed = None if scene is None else scene.avatar.pose(verts)[0]
            if scene is None or posed is None or visible_box(posed, viewmat, inner, *small) is None:
                return Stages(calls, 0.0)
            region = self._region(scene, posed, viewmat, inner, *small)
            features, nb_alpha = self._raster(scene, posed, viewmat, inner, region)
            colour, alpha = self._decode(features, nb_alpha)
        own: dict[str, Callable[[], Any]] = {
            "pose": lambda: scene.avatar.pose(verts),
            "raster": lambda: self._raster(scene, posed, viewmat, inner, region),
            f"renderer_{s.precision}": lambda: self._decode(features, nb_alpha),
            "compose": lambda: self._finish(colour, alpha, nb_alpha, region, small, size, background),
        }

        def timed(call: Callable[[], Any]) -> Callable[[], Any]:
            def run() -> Any:
                with torch.no_grad(), _threads(s.threads):
                    return call()

            return run

        window = region.width * region.height / (small[0] * small[1])
        return Stages({name: timed(call) for name, call in own.items()} | calls, window)

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
        laps: Laps | None = None,
        **_: Any,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One picture: image (3, H, W), alpha (H, W) and the billboards' alpha (H, W).

        Args:
            verts: vertices per part, float (V, 3) [m]; missing or not finite: the part is not there.
            viewmat: world to camera (4, 4); K: intrinsics (3, 3) [px]; width, height: picture [px].
            background: RGB (3,) in [0, 1].
            frame: id of a training frame, to use its refinement.
            laps: told after every stage.
        """
        s = self.setting
        with torch.no_grad(), _threads(s.threads):
            self.work.pictures += 1
            scene = self._scene(verts)
            small, inner = self._inner(K, width, height)
            posed, box = None, None
            if scene is not None:
                posed = scene.avatar.pose(verts, frame)[0]
                self.work.posed += len(posed.means)
                box = visible_box(posed, viewmat, inner, *small)
            _lap(laps, "pose")
            if scene is None or posed is None or box is None:
                for stage in ("raster", "renderer", "compose"):
                    _lap(laps, stage)
                nothing = background.new_zeros(height, width)
                return background[:, None, None].expand(3, height, width).clone(), nothing, nothing.clone()
            region = self._region(scene, posed, viewmat, inner, *small)
            features, nb_alpha = self._raster(scene, posed, viewmat, inner, region)
            _lap(laps, "raster")
            colour, alpha = self._decode(features, nb_alpha)
            _lap(laps, "renderer")
            result = self._finish(colour, alpha, nb_alpha, region, small, (width, height), background)
            _lap(laps, "compose")
        return result

    def _inner(self, K: Tensor, width: int, height: int) -> tuple[tuple[int, int], Tensor]:
        """Size [px] and intrinsics of the picture that is rendered, before it is enlarged."""
        share = self.setting.resolution
        small = max(1, round(share * width)), max(1, round(share * height))
        return small, K * K.new_tensor([small[0] / width, small[1] / height, 1.0])[:, None]

    def _scene(self, verts: Mapping[str, Tensor]) -> _Scene | None:
        present = tuple(p for p in self.avatar.parts if p in verts and bool(torch.isfinite(verts[p]).all()))
        if not present:
            return None
        if present not in self._scenes:
            avatar = self.avatar if len(present) == len(self.avatar.parts) else keep_parts(self.avatar, present)
            with torch.no_grad():
                levels = [avatar.textures()]
                while self.setting.mips and levels[-1][1].shape[-1] > _SMALLEST_MIP:
                    levels.append(resample_textures(*levels[0], (levels[-1][1].shape[-1] + 1) // 2))
            self._scenes[present] = _Scene(avatar, levels)
        return self._scenes[present]

    def _region(self, scene: _Scene, posed: Posed, viewmat: Tensor, K: Tensor, width: int, height: int) -> Region:
        a, s = scene.avatar.architecture, self.setting
        multiple = scene.avatar.multiple * (round(1 / s.decode) if self._unet is not None else 1)
        if not (a.roi if s.roi is None else s.roi):
            return full_region(width, height, multiple)
        margin = a.roi_margin if s.roi_margin is None else s.roi_margin
        return region_of(posed, viewmat, K, width, height, multiple=multiple, margin=margin)

    def _raster(self, scene: _Scene, posed: Posed, viewmat: Tensor, K: Tensor, region: Region) -> tuple[Tensor, Tensor]:
        s = self.setting
        features, alpha = scene.levels[0]
        if len(scene.levels) > 1:
            needed = texels_needed(posed, viewmat, K)
            features, alpha = next(
                (level for level in reversed(scene.levels) if level[1].shape[-1] >= needed), scene.levels[0]
            )
        self.work.raster_calls += 1
        self.work.raster_pixels += region.width * region.height
        self.work.texels += alpha.numel()
        return render_billboards(
            *posed.planes, features, alpha, viewmat, shift_camera(K, region), region.width, region.height,
            order=s.order or scene.avatar.architecture.order, alpha_min=s.alpha_min, t_min=s.t_min,
            low_pass=s.low_pass, uniform=scene.avatar.light_and_gloss(posed, viewmat),
        )  # fmt: skip

    def _decode(self, features: Tensor, nb_alpha: Tensor) -> tuple[Tensor, Tensor]:
        """Colour (3, h, w) and opacity (h, w) of the window."""
        if self._unet is None:
            return features / nb_alpha.clamp_min(1e-6), nb_alpha
        s = self.setting
        stacked = torch.cat((features, nb_alpha[None]))[None]
        shrink = round(1 / s.decode)
        if shrink > 1:
            stacked = functional.avg_pool2d(stacked, shrink)
        self.work.decoder_calls += 1
        self.work.decoded_pixels += stacked.shape[-1] * stacked.shape[-2]
        layout = torch.channels_last if s.channels_last else torch.contiguous_format
        stacked = stacked.contiguous(memory_format=layout)
        if self._unet is self.avatar.unet:
            colour, opacity = self.avatar.run_unet(stacked, s.precision)
        else:
            with torch.autocast(stacked.device.type, dtype=_DTYPES[s.precision], enabled=s.precision != "fp32"):
                colour, opacity = self._unet(stacked)
        both = torch.cat((colour, opacity), dim=1)
        if shrink > 1:
            both = functional.interpolate(both, scale_factor=shrink, mode="bilinear", align_corners=False)
        return both[0, :3], both[0, 3]

    def _finish(
        self, colour: Tensor, alpha: Tensor, nb_alpha: Tensor, region: Region, small: tuple[int, int],
        size: tuple[int, int], background: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        """The window in the picture, over the background."""
        if small == size:
            alpha, nb_alpha, colour = (paste(value, region, *size) for value in (alpha, nb_alpha, colour))
            return compose(colour, alpha, background), alpha, nb_alpha
        planes = torch.cat((colour * alpha, alpha[None], nb_alpha[None]))
        whole = paste(planes, region, *small)[None]
        whole = functional.interpolate(whole, (size[1], size[0]), mode="bilinear", align_corners=False)[0]
        return whole[:3] + (1.0 - whole[3]) * background[:, None, None], whole[3], whole[4]


def texels_needed(posed: Posed, viewmat: Tensor, K: Tensor) -> int:
    """Texels a side at which the texels of most billboards (90%) are no larger on screen than a pixel.

    Args:
        posed: billboards in world space.
        viewmat: world to camera (4, 4); K: intrinsics (3, 3) [px].
    """
    return int(texels_of(torch.quantile(footprints(posed, viewmat, K), _MIP_SHARE), 1.0))


@contextlib.contextmanager
def _threads(count: int | None) -> Iterator[None]:
    """Runs with this many threads, and puts the number back."""
    if count is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _lap(laps: Laps | None, stage: str) -> None:
    if laps is not None:
        laps(stage)
