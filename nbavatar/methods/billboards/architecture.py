"""The numbers that fix an avatar's tensors, and whether the tensors of a file agree with them."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from nbavatar.methods.billboards.unet import FORMS, UNet

__all__ = ["Architecture", "check_stored"]

_MOST_TEXELS, _DEEPEST = 64, 16  # the options allow no more


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Numbers that fix an avatar's tensors and how it is rendered; see `nbavatar.config.training.TrainConfig`."""

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
    unet_form: str = "paper"  # what files hold that were written before there was another
    normals: bool = False  # in files of before, too
    shading: bool = False  # as well
    gloss: bool = False  # as well; only with normals

    @property
    def decoded_channels(self) -> int:
        """Channels that the U-Net takes: features; normals, light and gloss where it sees them; alpha."""
        return self.channels + 3 * self.normals + self.shading + 3 * self.gloss + 1

    def renderer(self) -> UNet:
        """The U-Net of these numbers, its weights still random."""
        return UNet(
            self.decoded_channels, width=self.unet_width, depth=self.unet_depth, max_width=self.unet_max_width,
            convs=self.unet_convs, form=self.unet_form,
        )  # fmt: skip


def check_stored(
    a: Architecture,
    refinement: Mapping[str, Any] | None,
    state: Mapping[str, Tensor],
    vertex_counts: Mapping[str, int],
) -> None:
    """Compares the sizes that a file names with the tensors that are there, before anything is made of such a size.

    Raises:
        ValueError: they disagree.
    """
    if not (0 < a.texels <= _MOST_TEXELS and 0 < a.unet_depth <= _DEEPEST and 0 < a.unet_convs <= _DEEPEST):
        raise ValueError(f"{a.texels} texels, {a.unet_depth} stages of {a.unet_convs} convolutions")
    if a.unet_form not in FORMS:
        raise ValueError(f"a U-Net of the form {a.unet_form!r}")
    if a.deferred:
        with torch.device("meta"):  # shapes without memory
            unet = a.renderer()
        for name, value in unet.state_dict().items():
            if state[f"unet.{name}"].shape != value.shape:
                raise ValueError(f"unet.{name} of {list(state[f'unet.{name}'].shape)} instead of {list(value.shape)}")
    if a.gloss and not a.normals:
        raise ValueError("gloss without normals")
    if a.shading:
        _check_light(state, vertex_counts)
    if refinement is not None:
        for name, value in state.items():
            if name.startswith("refinement.bend_") and len(value) != len(refinement["frames"]):
                raise ValueError(f"{name} of {len(value)} frames instead of {len(refinement['frames'])}")


def _check_light(state: Mapping[str, Tensor], vertex_counts: Mapping[str, int]) -> None:
    """Lights of the studio, and the faces that throw shadows: of every part, or of none."""
    directions, weights = state["shading.directions"], state["shading.weights"]
    if list(directions.shape) != [len(weights), 3] or weights.ndim != 1:
        raise ValueError(f"lights of {list(directions.shape)} with weights of {list(weights.shape)}")
    if not bool((weights >= 0).all() and torch.isfinite(weights).all() and torch.isfinite(directions).all()):
        raise ValueError("a light of a negative weight, or that is no number")
    start = "shading.occluders_"
    occluders = {name.removeprefix(start): value for name, value in state.items() if name.startswith(start)}
    if occluders and set(occluders) != set(vertex_counts):
        raise ValueError(f"shadows of {', '.join(occluders)} for {', '.join(vertex_counts)}")
    for part, faces in occluders.items():
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.is_floating_point():
            raise ValueError(f"{start}{part} of {faces.dtype} {list(faces.shape)}")
        if faces.numel() and not 0 <= int(faces.min()) <= int(faces.max()) < vertex_counts[part]:
            raise ValueError(f"{start}{part} from {int(faces.min())} to {int(faces.max())}")
