"""The window over planes against torch's convolution, which knows nothing of how it is computed here."""

import pytest
import torch
from torch.nn import functional as F

from nbavatar.math.blur import blur
from nbavatar.math.blur_kernels import blur_rows


def convolved(planes: torch.Tensor, taps: torch.Tensor) -> torch.Tensor:
    """The whole two-dimensional window at once, zeros beyond the planes, in float64."""
    window = torch.outer(taps, taps).double()[None, None]
    return F.conv2d(planes.double()[:, None], window, padding=len(taps) // 2)[:, 0]


@pytest.mark.parametrize("size", [(1, 1), (3, 40), (37, 5), (64, 91)])
@pytest.mark.parametrize("count", [1, 3, 11])
def test_equals_a_convolution_in_value_and_gradient(size: tuple[int, int], count: int) -> None:
    random = torch.Generator().manual_seed(3)
    half = torch.rand(count // 2 + 1, generator=random, dtype=torch.float64)
    taps = torch.cat((half, half[:-1].flip(0)))
    planes = torch.randn(4, *size, generator=random, dtype=torch.float64, requires_grad=True)
    adjoint = torch.randn(4, *size, generator=random, dtype=torch.float64)
    found, expected = blur(planes, taps), convolved(planes, taps)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    by_kernel, by_torch = (torch.autograd.grad(values, planes, adjoint)[0] for values in (found, expected))
    torch.testing.assert_close(by_kernel, by_torch, rtol=1e-12, atol=1e-12)
    # In float32 the sum of some hundred products, each rounded.
    narrow = blur(planes.detach().float(), taps.float())
    assert narrow.dtype == torch.float32
    torch.testing.assert_close(narrow.double(), expected.detach(), rtol=1e-4, atol=1e-5)


def test_planes_that_lie_otherwise_in_memory_and_any_number_of_threads_give_the_same_bits() -> None:
    taps = torch.tensor([0.25, 0.5, 0.25])
    planes = torch.randn(19, 23, 2, generator=torch.Generator().manual_seed(4)).permute(2, 0, 1)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results += [blur(planes, taps), blur(planes.contiguous(), taps)]
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(result, results[0]) for result in results)
    assert len(blur_rows.signatures) <= 2  # those that `prepare_kernels` declares, float32 and float64, and no other
