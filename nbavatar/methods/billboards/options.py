"""Options of the paper's method. Defaults are the paper's."""

from dataclasses import dataclass

from nbavatar.config.core import option

__all__ = ["BillboardsConfig", "RatesConfig", "RefineConfig", "UNetConfig"]


@dataclass(frozen=True)
class UNetConfig:
    """The deferred renderer R."""

    width: int = option(48, "Channels at full resolution; level i has min(width 2^i, max_width).", min=1)
    depth: int = option(5, "Number of stride-2 stages.", min=1, max=8)
    max_width: int = option(512, "Most channels of any level.", min=1)
    convs: int = option(2, "Convolutions a level.", min=1, max=4)
    form: str = option(
        "paper", "The paper's, or lean: on the way up 1x1 before the upsampling, and skips added.",
        choices=("paper", "lean"),
    )  # fmt: skip


@dataclass(frozen=True)
class RatesConfig:
    """Learning rates (supplement, 'Optimization details')."""

    renderer: float = option(1e-3, "U-Net.", min=0)
    features: float = option(5e-4, "Neural textures.", min=0)
    alpha: float = option(5e-4, "Opacity textures.", min=0)
    colour: float = option(2.5e-3, "Textures when they hold RGB (without deferred rendering).", min=0)
    rotation: float = option(1e-3, "Billboard quaternions.", min=0)
    scale: float = option(5e-3, "Billboard log half extents.", min=0)
    position: float = option(1.6e-4, "Billboard offsets, at the start.", min=0)
    offset: float = option(
        0.0, "Smooth offsets along the normals, shared by all frames (hair); 0 for none, as in the paper [m].", min=0
    )
    position_final: float = option(
        0.01, "Factor on the rates of the offsets at the end, reached exponentially.", min=0, max=1
    )


@dataclass(frozen=True)
class RefineConfig:
    """Compensation of fitting errors on training frames (not part of the paper; off in its protocol)."""

    modes: int = option(0, "Smooth displacement modes per frame and part; 0 leaves the meshes as they are.", min=0)
    rigid: bool = option(True, "Also refine each part's rigid pose per frame (only with modes > 0).")
    rate: float = option(2e-4, "Adam rate of the displacement coefficients [m] and rigid motions [m, rad].", min=0)
    weight: float = option(10.0, "Weight of the squared displacement [1/m^2].", min=0)


@dataclass(frozen=True)
class BillboardsConfig:
    """Neural billboards and their U-Net (the paper's method)."""

    channels: int = option(6, "Feature channels C of the neural textures.", min=1, max=64)
    texels: int = option(16, "Texels a side T of every texture.", min=1, max=64)
    deferred: bool = option(True, "Decode features by the U-Net; false: billboards hold RGB (ablation 'w/o DNR').")
    normals: bool = option(
        False,
        "The U-Net also sees the normal of each billboard's face in the world: it learns how a light that stands "
        "still shades what turns; not part of the paper.",
    )
    gloss: bool = option(
        False,
        "The U-Net also sees where each face would mirror the camera's line of sight to, and learns gloss, which "
        "wanders as the camera moves; only with `normals`; not part of the paper.",
    )
    shading: bool = option(
        True,
        "The U-Net also sees how much of the studio's light reaches each face, shadows included, where a training is "
        "given that light (`nbavatar light`); not part of the paper, whose trainings are given none.",
    )
    init: str = option("spectral", "Initial features.", choices=("spectral", "random"))
    unet: UNetConfig = option(UNetConfig, "The deferred renderer.")
    extent_margin: float = option(1.5, "Half extents at the start, in boxes around the triangle.", min=0.1)
    alpha_sigma: float = option(0.5, "Standard deviation of the initial opacity, border at 1.", min=1e-3)
    alpha_peak: float = option(0.9, "Initial opacity at the centre.", min=1e-6, max=0.999999)
    alpha_floor: float = option(0.005, "Smallest initial opacity.", min=1e-9, max=0.999999)
    neighbours: int = option(3, "K of the neighbour regulariser.", min=1)
    include_self: bool = option(True, "A billboard is its own first neighbour (as in GART and HAHA).")
    weight_mse: float = option(1.0, "Weight of the squared error of colours (the paper's term).", min=0)
    weight_l1: float = option(0.0, "Weight of the absolute error of colours; not part of the paper.", min=0)
    weight_dssim: float = option(
        0.0, "Weight of 1 - SSIM in an 11 px window, at the resolution of the stage; not part of the paper.", min=0
    )
    weight_lpips: float = option(0.1, "Weight of LPIPS, lambda_lpips.", min=0)
    weight_nb: float = option(0.1, "Weight of the Dice loss of the billboards' silhouette, lambda_NB.", min=0)
    weight_knn: float = option(0.1, "Weight of the neighbour regulariser, lambda_KNN.", min=0)
    weight_delta: float = option(0.001, "Weight of the offsets, lambda_Delta.", min=0)
    dice: str = option("milletari", "Form of the Dice loss.", choices=("milletari", "haha"))
    rates: RatesConfig = option(RatesConfig, "Learning rates.")
    unet_optimizer: str = option(
        "adam",
        "How the weights of the U-Net's convolutions learn, but for the last ones: adam, as in the paper, or muon, "
        "which moves all directions of a weight matrix alike (captures: about as good after half as many steps). "
        "Steps have the same size.",
        choices=("adam", "muon"),
    )
    texel_sharing: float = option(
        0.0, "Texels also take the mean gradient of their billboard, so many times; 0 for none, as in the paper.", min=0
    )
    clip: float = option(
        0.0, "Largest gradient norm of the renderer, with muon of its matrices and of the rest; 0 = no clipping.", min=0
    )
    refine: RefineConfig = option(RefineConfig, "Compensation of fitting errors.")
    roi: bool = option(True, "Decode only a window around the avatar.")
    roi_margin: float = option(0.15, "Margin of that window, in its own size (hair has no mesh).", min=0)
    order: str = option("ray", "Compositing order of the rasterizer: ray, kbuffer(n) or center.")
    precision: str = option("fp32", "Arithmetic of the U-Net (autocast).", choices=("fp32", "bf16"))
    prune_margin: float | None = option(
        None,
        "After training, leave out billboards that no training view shows, nor one turned by so many degrees about the "
        "avatar; none by default.",
        min=0,
        max=90,
    )
    texture_density: float | None = option(
        None,
        "After training, keep every texture at so many texels a pixel of its largest footprint in the training views; "
        "all stay at `texels` a side by default [1/px].",
        min=0.01,
        max=64,
    )
