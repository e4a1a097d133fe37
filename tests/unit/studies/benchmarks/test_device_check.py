"""The check of a GPU, tried on the CPU: it finds right what is right, and what is wrong; its verdict is kept."""

import json
import re

import pytest
import torch

from nbavatar.cli import gpu_verdict, main
from nbavatar.errors import DependencyError, DeviceError
from nbavatar.rendering import plain
from nbavatar.rendering.billboards import functional
from nbavatar.rendering.billboards.projection import project_billboards
from nbavatar.rendering.billboards.reference import blend_reference
from nbavatar.rendering.gaussians import functional as gaussians
from nbavatar.studies.benchmarks import device_check, raster
from nbavatar.studies.benchmarks.device_check import CASES, check_device, verdict


def test_kernels_that_are_right_are_found_right_and_timed() -> None:
    found = check_device("cpu", size=64, repeats=1)
    assert found["right"] and len(found["cases"]) == len(CASES)
    assert found["frame_ms"] > 0 and found["decoder_ms"] > 0
    assert json.loads(json.dumps(found)) == found
    assert f"right in all {len(CASES)} scenes" in verdict(found) and "\n" not in verdict(found)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("values", "WRONG in ray, 6 x 6 texels.*value error"),
        ("gradients", "WRONG in ray, 6 x 6 texels.*gradient error"),
        ("nan", "WRONG in ray, 6 x 6 texels.*gradient error None"),
        ("stop", "WRONG in ray, 6 x 6 texels.*illegal memory access"),
    ],
)
def test_kernels_that_are_wrong_are_found_wrong(monkeypatch, fault: str, says: str) -> None:
    class Wrong(torch.autograd.Function):
        @staticmethod
        def forward(ctx, value):
            return value * (1.0 + 1e-3) if fault == "values" else value.clone()

        @staticmethod
        def backward(ctx, grad):
            return grad * {"gradients": 1.001, "nan": float("nan")}.get(fault, 1.0)

    right = raster.render_billboards

    def render(*scene, backend="auto", **options):
        if backend == "reference":
            return right(*scene, backend=backend, **options)
        if fault == "stop":
            raise RuntimeError("CUDA error: an illegal memory access was encountered\nmore lines")
        return tuple(Wrong.apply(value) for value in right(*scene, backend=backend, **options))

    monkeypatch.setattr(raster, "render_billboards", render)
    monkeypatch.setattr(device_check, "CASES", CASES[:1])
    found = check_device("cpu")
    assert not found["right"] and "frame_ms" not in found
    assert re.search(says, verdict(found))


def test_a_verdict_is_found_once_and_a_wrong_device_is_refused(monkeypatch, tmp_path) -> None:
    looked = []

    def check(device, **options):
        looked.append(device)
        times = dict.fromkeys(("raster_ms", "raster_backward_ms", "decoder_ms", "frame_ms"), 1.0)
        case = {"name": "ray", "right": right, "gradient_error": 1e-6}
        return {"device": "card", "right": right, "cases": [case], "size": 64, **times}

    monkeypatch.setattr(device_check, "check_device", check)
    monkeypatch.setattr(gpu_verdict, "cache_places", lambda: [tmp_path])
    right = True
    assert gpu_verdict.require_right_gpu("cpu") is not None
    assert gpu_verdict.require_right_gpu("cpu") is None and len(looked) == 1
    (kept,) = (tmp_path / "devices").iterdir()
    kept.write_text("{")  # cut short
    assert gpu_verdict.require_right_gpu("cpu") is not None and len(looked) == 2
    right = False
    assert gpu_verdict.gpu_verdict("cpu", again=True)[0]["right"] is False
    with pytest.raises(DeviceError, match="WRONG in ray"):
        gpu_verdict.require_right_gpu("cpu")
    monkeypatch.setattr(gpu_verdict, "cache_places", lambda: [])
    right = True
    assert gpu_verdict.require_right_gpu("cpu") is not None  # without a place to keep it, it is found each time


def test_the_verb_without_a_gpu_is_one_line(monkeypatch, capsys) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert main(["doctor", "--gpu"]) == 2
    assert "expected a CUDA device, found none" in capsys.readouterr().err


def test_without_a_compiler_of_kernels_plain_torch_draws_on_the_gpu_and_says_so_once(monkeypatch, capsys) -> None:
    real = __import__

    def without(name, *more):
        if name.endswith((".billboards.cuda", ".gaussians.cuda")):
            raise DependencyError("package 'numba-cuda' cannot be imported")
        return real(name, *more)

    monkeypatch.setattr("builtins.__import__", without)
    monkeypatch.setattr(plain, "_TOLD", set())
    monkeypatch.setattr(gaussians.importlib.util, "find_spec", lambda name: None)
    gpu = torch.device("cuda")
    for _ in range(2):
        project, blend = functional._backend("auto", gpu)
        assert project is project_billboards and blend.args == (blend_reference,)
        assert gaussians._resolve("auto", gpu) == "reference"
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and all("plain torch" in line and "numba-cuda" in line for line in lines)
    with pytest.raises(DependencyError):
        functional._backend("cuda", gpu)  # asked for by name it is not replaced
