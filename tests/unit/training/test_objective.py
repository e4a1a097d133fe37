"""The loss of a step: the paper's stays the paper's; L1 and D-SSIM on coarse pictures and pixels without truth."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from nbavatar.config.core import from_mapping
from nbavatar.config.training import TrainConfig
from nbavatar.data.sequences import read_sequence
from nbavatar.data.views import Sample, View
from nbavatar.errors import ConfigError
from nbavatar.methods.billboards import training as training
from nbavatar.methods.billboards.avatar import compose
from nbavatar.methods.billboards.losses import loss_delta, loss_dice, loss_knn
from nbavatar.methods.billboards.objective import step_loss
from nbavatar.methods.create import create_method
from nbavatar.optimization.schedule import Plan
from nbavatar.rendering.billboards.functional import render_billboards
from tests.scenes.training import train_config, train_options
from tests.unit.methods.billboards.test_losses import plain_dssim
from tests.unit.training.test_loop import run, same

PAPER = yaml.safe_load((Path(__file__).parents[3] / "config/paper.yaml").read_text())["stages"]["train"]
SMALL = {
    "steps": 6, "texels": 4, "previews": 0, "checkpoint_seconds": 0.0,
    "unet": {"width": 4, "depth": 3, "max_width": 8, "convs": 1},
}  # fmt: skip


def distance(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Stands for LPIPS."""
    return (x - y).abs().mean().reshape(1)


def papers_loss(avatar, sample, anchor, neighbours, lpips, plan, config, random):
    """Sections 3.3, 3.4 and 4.1, restated: squared error, LPIPS, Dice, neighbours, offsets."""
    background = torch.rand(3, generator=random)
    torch.rand(2, generator=random)
    posed, keep = avatar.place(anchor)
    view = sample.view
    window = avatar.window(posed, keep, view.viewmat, sample.K, sample.width, sample.height)
    region = window.region
    planes = torch.zeros(5, 64, 64)  # wide enough for any window here
    height, width = sample.pixels.shape[-2:]
    planes[:, 16 + sample.y0 : 16 + sample.y0 + height, 16 + sample.x0 : 16 + sample.x0 + width] = sample.pixels
    planes = planes[
        :, 16 + region.y0 : 16 + region.y0 + region.height, 16 + region.x0 : 16 + region.x0 + region.width
    ].contiguous()
    truth = planes[:3] + (1 - planes[3]) * background[:, None, None]
    image = compose(window.colour, window.alpha, background)
    share = min(1.0, region.height * region.width / (sample.width * sample.height))
    padded = [torch.nn.functional.pad(x, (0, 32 - region.width, 0, 32 - region.height))[None] for x in (image, truth)]
    missed = sample.pixels[3].square().sum() - planes[3].square().sum()
    terms = {
        "mse": (image - truth).square().sum() / (3 * sample.width * sample.height),
        "lpips": 0.1 * (share * lpips(*padded)[0]),
        "nb": 0.1 * loss_dice(window.nb_alpha, planes[3], missed=missed.clamp_min(0.0)),
        "knn": 0.1 * loss_knn(posed.means, posed.quats, posed.half_extents, neighbours),
        "delta": 0.001 * loss_delta(avatar.billboards.mu),
    }
    return torch.stack(list(terms.values())).sum(), {k: v.detach() for k, v in terms.items()}, window


def test_training_by_papers_options_has_the_papers_loss_to_the_bit(scene, tmp_path, monkeypatch) -> None:
    config = from_mapping(TrainConfig, {**PAPER, **train_options(SMALL)}, "train")
    ours, _ = run(scene, config, tmp_path / "ours", lpips=distance)
    monkeypatch.setattr(training, "step_loss", papers_loss)
    papers, _ = run(scene, config, tmp_path / "papers", lpips=distance)
    assert same(ours, papers)
    monkeypatch.undo()
    other, _ = run(scene, train_config(config, weight_l1=0.8, weight_dssim=0.2), tmp_path / "other", lpips=distance)
    assert not same(ours, other)


def test_l1_and_dssim_are_those_of_the_whole_picture_whatever_the_window_and_the_stage(scene, rng) -> None:
    """20 x 13 px, as a coarse stage may have: the window reaches over the border; a block has no truth."""
    config = train_config(
        texels=4, unet={"width": 4, "depth": 3, "max_width": 8, "convs": 1}, init="random", weight_mse=0.0,
        weight_l1=0.8, weight_dssim=0.2, weight_lpips=0.0, weight_nb=0.0, weight_knn=0.0, weight_delta=0.0,
        deferred=False,
    )  # fmt: skip
    meshes, _ = read_sequence(scene["meshes"])
    avatar = create_method(meshes, {}, [], config).avatar
    width, height = 20, 13
    K = torch.tensor([[38.0, 0, 6.0], [0, 38.0, 6.0], [0, 0, 1]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = 1.0
    pixels = torch.from_numpy(rng.uniform(size=(5, height, width))).float()
    pixels[:3] *= pixels[3]
    pixels[4] = 0.0
    pixels[:, 2:6, 1:7] = 0.0
    pixels[4, 2:6, 1:7] = 1.0
    sample = Sample(View(0, "c", "f", 0, width, height, K, viewmat), pixels, 0, 0, width, height, K)
    anchor = avatar.anchor({name: torch.from_numpy(part.verts[0]) for name, part in meshes.parts.items()})
    plan = Plan(1, 1.0, None, False)
    total, terms, window = step_loss(avatar, sample, anchor, None, None, plan, config, torch.Generator().manual_seed(3))
    background = torch.rand(3, generator=torch.Generator().manual_seed(3)).double().numpy()[:, None, None]
    posed, _ = avatar.place(anchor)
    features, opacity = avatar.textures()
    colour, alpha = render_billboards(*posed.planes, features, opacity, viewmat, K, width, height)
    image = colour.detach().double().numpy() + (1 - alpha.detach().double().numpy()) * background
    planes = pixels.double().numpy()
    truth = planes[:3] + (1 - planes[3]) * background
    image = np.where(planes[4] > 0, truth, image)
    assert terms["l1"].item() == pytest.approx(np.abs(image - truth).mean(), rel=1e-5)
    assert terms["dssim"].item() == pytest.approx(plain_dssim(image, truth, width * height), rel=1e-4)
    assert total.item() == pytest.approx(0.8 * terms["l1"].item() + 0.2 * terms["dssim"].item(), rel=1e-6)
    slope = torch.autograd.grad(total, window.nb_alpha)[0]
    x0, y0 = window.region.x0, window.region.y0
    inside = torch.zeros_like(slope, dtype=torch.bool)
    inside[max(0, -y0) : height - y0, max(0, -x0) : width - x0] = True
    inside[2 - y0 : 6 - y0, 1 - x0 : 7 - x0] = False
    assert slope[inside].abs().max() > 0
    assert (slope[~inside] == 0).all()  # neither pixels without truth nor what lies beyond the picture say anything


def test_without_any_weight_of_colour_training_is_refused(scene) -> None:
    meshes, _ = read_sequence(scene["meshes"])
    with pytest.raises(ConfigError, match=r"weight_mse.*one above 0"):
        create_method(meshes, {}, [], train_config(weight_mse=0.0, init="random"))
    with pytest.raises(ConfigError, match=r"billboards\.gloss: expected false without `normals`, found true"):
        create_method(meshes, {}, [], train_config(gloss=True, init="random"))
