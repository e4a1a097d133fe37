"""Inference engines give torch's picture; which one is taken, and when torch decodes after all."""

import importlib.util

import numpy as np
import pytest
import torch

from nbavatar.config.evaluation import AUTO, EAGER
from nbavatar.errors import ConfigError, DependencyError
from nbavatar.methods.billboards import engine
from nbavatar.methods.billboards.compression.reduce import keep_parts
from nbavatar.methods.billboards.engine import RUNNERS, DecoderEngine, chosen_engine, installed_engines
from nbavatar.methods.billboards.unet import FORMS, UNet
from tests.unit.methods.billboards.test_model import make_avatar, render

# `make install` brings all engines, so these run in CI; only an environment without the extra `engine` lacks some.
_ABSENT = pytest.mark.skip("an optional engine that is not installed: pip install 'nbavatar[engine,export]'")
INSTALLED = [pytest.param(kind, marks=[] if kind in installed_engines() else _ABSENT) for kind in RUNNERS]


def unet(form: str = "paper", convs: int = 1) -> UNet:
    torch.manual_seed(1)
    net = UNet(5, width=8, depth=3, max_width=24, convs=convs, form=form).to(memory_format=torch.channels_last)
    with torch.no_grad():
        for value in net.parameters():
            value.mul_(1.5)  # away from the middle of the sigmoids
    return net.eval()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", INSTALLED)
def test_an_engine_decodes_as_torch_whatever_the_size_and_again_to_the_bit(kind: str, form: str) -> None:
    net, own = unet(form, convs=2), DecoderEngine(kind)
    with torch.no_grad():
        for height, width in ((16, 24), (72, 40), (16, 24)):
            features = torch.randn(1, 5, height, width).contiguous(memory_format=torch.channels_last)
            assert own.takes(features, net)
            expected, found = net(features), own(net, features)
            for a, b in zip(found, expected, strict=True):
                assert a.shape == b.shape
                # Sums in another order, some with approximated exponentials: 1e-5 is what OpenVINO's sigmoid leaves.
                np.testing.assert_allclose(a, b, atol=2e-5)
                assert float(b.std()) > 0.02
            for a, b in zip(found, own(net, features), strict=True):
                assert torch.equal(a, b)


@pytest.mark.parametrize("kind", INSTALLED[-1:])
def test_weights_that_change_are_taken_over(kind: str) -> None:
    net, own = unet(), DecoderEngine(kind)
    features = torch.randn(1, 5, 16, 16)
    with torch.no_grad():
        before = own(net, features)[0]
        net.stem[0].weight.mul_(-1.0)
        after = own(net, features)[0]
        np.testing.assert_allclose(after, net(features)[0], atol=2e-5)
    assert not torch.allclose(before, after, atol=1e-3)


@pytest.mark.parametrize("kind", INSTALLED[-1:])
def test_torch_decodes_what_an_engine_does_not(kind: str) -> None:
    net, own = unet(), DecoderEngine(kind)
    features = torch.randn(1, 5, 16, 16)
    assert not own.takes(features, net)  # with gradients
    with torch.no_grad():
        assert own.takes(features, net)
        assert not own.takes(features.double(), net)
        assert not own.takes(torch.randn(1, 5, 8, 64), net)  # one row of pixels at the deepest level


def test_avatars_use_an_engine_in_float32_only_and_say_which() -> None:
    avatar, calls = make_avatar(), []

    class Recorded:
        name = "recorded 1.0"

        def takes(self, features, net):
            return not torch.is_grad_enabled()

        def __call__(self, net, features):
            calls.append(features.shape)
            return net(features)

    assert avatar.use_engine(EAGER) == EAGER and avatar.engine is None
    avatar.engine = Recorded()
    features, alpha = torch.rand(4, 16, 16), torch.rand(16, 16)
    with torch.no_grad():
        avatar.decode(features, alpha)
        assert len(calls) == 1
        avatar.decode(features, alpha, "bf16")
        avatar.decode(features, alpha, engine=False)
    avatar.decode(features, alpha)
    assert len(calls) == 1
    assert make_avatar(deferred=False).use_engine(AUTO) == EAGER


@pytest.mark.parametrize("kind", INSTALLED[-1:])
def test_a_smaller_avatar_made_of_one_is_decoded_by_its_engine(kind: str) -> None:
    avatar = make_avatar()
    avatar.use_engine(kind)
    render(keep_parts(avatar, ["head"]))
    assert avatar.engine.decoded == 1


def test_the_best_that_is_installed_is_chosen_and_what_is_not_is_refused(monkeypatch) -> None:
    there = {"onnx", "onnxruntime"}
    find = importlib.util.find_spec

    def spec(name):
        return (name in there or None) if name in {"onnx", *RUNNERS} else find(name)

    monkeypatch.setattr(engine.importlib.util, "find_spec", spec)
    assert chosen_engine(AUTO) == "onnxruntime"
    there.add("openvino")
    assert chosen_engine(AUTO) == "openvino"
    there.discard("onnx")  # the graph is made with it
    assert chosen_engine(AUTO) == EAGER == chosen_engine(EAGER)
    with pytest.raises(ConfigError, match="--engine"):
        chosen_engine("tensorrt")
    assert chosen_engine(AUTO, "cuda") == EAGER == chosen_engine(EAGER, "cuda")
    with pytest.raises(ConfigError, match="auto or eager on a GPU"):
        chosen_engine("openvino", "cuda")

    def missing(name):
        raise ImportError(f"No module named '{name}'")

    monkeypatch.setattr("nbavatar.errors.importlib.import_module", missing)
    with pytest.raises(DependencyError, match="package 'onnx' cannot be imported"):
        chosen_engine("openvino")
