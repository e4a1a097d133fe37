"""The U-Net's convolution: the gradients of torch's own, in another layout, and the same bits every time."""

import copy

import pytest
import torch
from torch.nn import functional

from nbavatar.methods.billboards import convolution
from nbavatar.methods.billboards.convolution import Convolution, convolve, worthwhile
from nbavatar.methods.billboards.unet import UNet


def _scene(stride: int, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, ...]:
    random = torch.Generator().manual_seed(3)
    pixels = torch.randn(2, 32, 18, 22, generator=random, dtype=torch.float64)
    weight, bias = torch.randn(64, 32, 3, 3, generator=random), torch.randn(64, generator=random)
    values = [v.to(dtype).contiguous(memory_format=torch.channels_last) for v in (pixels, weight)]
    return *(v.requires_grad_() for v in values), bias.to(dtype).requires_grad_()


@pytest.mark.parametrize("stride", [1, 2])
def test_values_and_gradients_are_those_of_torch_in_float64(stride) -> None:
    pixels, weight, bias = _scene(stride)
    result = convolve(pixels, weight, bias, stride)
    pull = torch.randn(result.shape, generator=torch.Generator().manual_seed(1))
    result.backward(pull)
    exact = [v.detach().double().contiguous().requires_grad_() for v in (pixels, weight, bias)]
    functional.conv2d(*exact, stride, 1).backward(pull.double())
    for found, wanted in zip((pixels, weight, bias), exact, strict=True):
        # Sums of up to 800 products in float32: a relative error of a few 1e-6 of the largest.
        assert torch.allclose(found.grad.double(), wanted.grad, atol=5e-6 * float(wanted.grad.abs().max()), rtol=0)


def test_result_is_the_ordinary_convolutions_to_the_bit() -> None:
    pixels, weight, bias = _scene(1)
    assert torch.equal(convolve(pixels, weight, bias, 1), functional.conv2d(pixels, weight, bias, 1, 1))


def test_what_needs_no_gradient_gets_none() -> None:
    pixels, weight, _ = _scene(1)
    convolve(pixels.detach(), weight, None, 1).sum().backward()
    alone = weight.grad.clone()
    weight.grad = None
    convolve(pixels, weight, None, 1).sum().backward()
    assert torch.equal(alone, weight.grad)


def test_wide_layers_of_large_pictures_take_it_while_training(monkeypatch) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    layer = Convolution(32, 64, bias=False).to(memory_format=torch.channels_last)
    large = torch.rand(1, 32, 64, 64).contiguous(memory_format=torch.channels_last)
    assert worthwhile(large, layer.weight)
    assert not worthwhile(large[..., :32], layer.weight)
    assert not worthwhile(large.contiguous(), layer.weight)  # channels first already
    assert not worthwhile(large[:, :16], layer.weight[:, :16])
    calls = []
    monkeypatch.setattr(convolution, "convolve", lambda *args: calls.append(args) or convolve(*args))
    layer(large).sum().backward()
    layer.eval()(large).sum().backward()
    with torch.no_grad():
        layer.train()(large)
    assert len(calls) == 1


def test_a_training_step_of_the_unet_has_the_gradients_of_the_plain_one(monkeypatch) -> None:
    torch.manual_seed(0)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    network = UNet(5, width=32, depth=2, max_width=64, convs=1).to(memory_format=torch.channels_last)
    plain = copy.deepcopy(network)
    features = torch.rand(1, 5, 128, 128).contiguous(memory_format=torch.channels_last)
    for one, fast in ((network, True), (plain, False)):
        monkeypatch.setattr(convolution, "worthwhile", worthwhile if fast else lambda *_: False)
        colour, opacity = one(features)
        (colour.square().mean() + opacity.mean()).backward()
    for (name, found), wanted in zip(network.named_parameters(), plain.parameters(), strict=True):
        scale = float(wanted.grad.abs().max())
        # Sums of 16,384 products in float32, in two orders.
        assert torch.allclose(found.grad, wanted.grad, atol=1e-4 * scale + 1e-9, rtol=0), name
    assert any(not torch.equal(a.grad, b.grad) for a, b in zip(network.parameters(), plain.parameters(), strict=True))


def test_gradients_are_the_same_bits_every_time() -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        found = []
        for _ in range(5):
            pixels, weight, bias = _scene(1)
            convolve(pixels, weight, bias, 1).square().sum().backward()
            found.append(weight.grad)
        assert all(torch.equal(found[0], other) for other in found[1:])
    finally:
        torch.set_num_threads(threads)
