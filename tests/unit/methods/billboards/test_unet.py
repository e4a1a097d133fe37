"""The renderer: sizes, ranges, structure of the supplement, guards."""

import pytest
import torch
from torch import nn
from torch.nn import functional

from nbavatar.methods.billboards.unet import FORMS, UNet, macs


@pytest.mark.parametrize(("height", "width"), [(32, 32), (64, 32), (96, 160)])
def test_unet_keeps_the_size_and_stays_in_the_unit_range(height: int, width: int) -> None:
    colour, opacity = UNet(7, width=4, max_width=16)(10.0 * torch.randn(2, 7, height, width))
    assert colour.shape == (2, 3, height, width)
    assert opacity.shape == (2, 1, height, width)
    for value in (colour, opacity):
        assert 0.0 <= value.min() and value.max() <= 1.0
        assert torch.isfinite(value).all()


def test_unet_refuses_sizes_that_do_not_divide() -> None:
    with pytest.raises(ValueError, match="multiples of 32, found 40x64"):
        UNet(7, width=4)(torch.zeros(1, 7, 40, 64))


def test_unet_has_the_layers_of_the_supplement() -> None:
    network = UNet(7, width=4, depth=5)
    strided = [m for m in network.modules() if isinstance(m, nn.Conv2d) and m.stride == (2, 2)]
    assert len(strided) == 5
    assert not any(isinstance(m, nn.ConvTranspose2d) for m in network.modules())
    assert any(isinstance(m, nn.InstanceNorm2d) for m in network.modules())
    upsample = next(m for m in network.modules() if isinstance(m, nn.Upsample))
    assert upsample.mode == "bilinear"


@pytest.mark.parametrize("form", FORMS)
def test_all_convolutions_but_the_last_are_hidden(form: str) -> None:
    network = UNet(7, width=4, depth=3, convs=2, form=form)
    last = [network.head] if form == "lean" else [network.colour, network.opacity]
    every = [id(m.weight) for m in network.modules() if isinstance(m, nn.Conv2d)]
    hidden = [id(weight) for weight in network.hidden_weights()]
    assert hidden == [weight for weight in every if weight not in {id(m.weight) for m in last}]
    assert len(hidden) == len(every) - len(last) and sum(m.weight.shape[0] for m in last) == 4


def test_unet_single_pixel_bottleneck_trains() -> None:
    network = UNet(3, width=2, depth=5).train()
    colour, opacity = network(torch.randn(1, 3, 32, 32))
    (colour.sum() + opacity.sum()).backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters() if p.grad is not None)


def test_unet_every_parameter_gets_a_gradient() -> None:
    network = UNet(3, width=2, depth=2)
    colour, opacity = network(torch.randn(1, 3, 16, 16))
    (colour.square().sum() + opacity.square().sum()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in network.parameters())


def test_unet_is_the_same_in_both_memory_formats() -> None:
    network = UNet(4, width=8, depth=3).eval()
    image = torch.randn(1, 4, 64, 64)
    plain = network(image)
    last = network.to(memory_format=torch.channels_last)(image.contiguous(memory_format=torch.channels_last))
    for a, b in zip(plain, last, strict=True):
        torch.testing.assert_close(a, b, atol=2e-5, rtol=0)


@pytest.mark.parametrize("layout", [torch.channels_last, torch.contiguous_format])
def test_unet_normalises_as_torch_s_own_instance_normalisation(
    monkeypatch: pytest.MonkeyPatch, layout: torch.memory_format
) -> None:
    torch.manual_seed(0)
    network = UNet(4, width=8, depth=3).to(memory_format=layout).double()
    image = torch.randn(1, 4, 64, 64, dtype=torch.float64)
    norm = type(next(m for m in network.modules() if isinstance(m, nn.InstanceNorm2d)))

    def values_and_gradients() -> list[torch.Tensor]:
        network.zero_grad()
        colour, opacity = network(image)
        (colour.square().sum() + opacity.sum()).backward()
        return [colour.detach(), opacity.detach(), *(p.grad.clone() for p in network.parameters())]

    network.train()
    training = values_and_gradients()
    network.eval()
    rendering = values_and_gradients()
    monkeypatch.setattr(norm, "forward", nn.InstanceNorm2d.forward)
    for a, b, c in zip(training, rendering, values_and_gradients(), strict=True):
        assert torch.equal(a, b)
        torch.testing.assert_close(b, c, atol=1e-9, rtol=1e-9)  # in float64 nothing but the order of sums is left


def test_unet_half_precision_stays_near() -> None:
    network = UNet(4, width=8, depth=3).eval()
    image = torch.randn(1, 4, 32, 32)
    with torch.no_grad():
        exact, _ = network(image)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            near, _ = network(image)
    # bfloat16 keeps 8 bits; ten layers of it stay within a few grey levels of the unit range.
    assert (exact - near).abs().mean() < 0.01


def test_macs_of_one_level_equal_hand_count() -> None:
    network = UNet(3, width=2, depth=1, convs=1)
    # stem 3>2, down 2>4 at half size, lift 4>2, merge 4>2, heads 2>3 and 2>1: 9 multiplications each
    full, half = 8 * 8, 4 * 4
    expected = 9 * (full * (3 * 2 + 4 * 2 + 4 * 2 + 2 * 3 + 2 * 1) + half * 2 * 4)
    assert macs(network, 8, 8) == expected
    assert macs(network, 16, 8) == 2 * expected


def test_the_lean_form_is_what_it_says() -> None:
    """Against plain operations, one after the other, in both memory layouts."""
    net = UNet(4, width=4, depth=2, max_width=8, convs=1, form="lean").double().eval()
    features = torch.randn(1, 4, 12, 8, dtype=torch.float64)

    def level(stage, value):
        return functional.leaky_relu(stage[1](stage[0](value)), 0.2)

    stem = functional.leaky_relu(net.stem[0](features), 0.2)
    first = level(net.down[0], stem)
    value = level(net.down[1], first)
    for lift, skip in zip(reversed(net.lift), (first, stem), strict=True):
        thin = torch.einsum("oi,bihw->bohw", lift.weight[:, :, 0, 0], value) + lift.bias[:, None, None]
        value = functional.interpolate(thin, scale_factor=2, mode="bilinear", align_corners=False) + skip
        merge = net.merge[1 if skip is first else 0]
        value = level(merge, value) if skip is first else functional.leaky_relu(merge[0](value), 0.2)
    expected = torch.sigmoid(net.head(value))
    for layout in (torch.contiguous_format, torch.channels_last):
        colour, opacity = net.to(memory_format=layout)(features.contiguous(memory_format=layout))
        torch.testing.assert_close(torch.cat((colour, opacity), 1), expected, rtol=1e-12, atol=1e-12)
    full = UNet(7, width=16, convs=1, max_width=96)
    lean = UNet(7, width=16, convs=1, max_width=96, form="lean")
    assert macs(lean, 256, 256) < 0.45 * macs(full, 256, 256)
