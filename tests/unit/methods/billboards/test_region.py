"""Windows: they hold every visible pixel, are aligned, and pasting them changes nothing."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.methods.billboards.billboards import Posed
from nbavatar.methods.billboards.region import Region, full_region, paste, region_of, shift_camera
from nbavatar.rendering.billboards.functional import render_billboards

K = torch.tensor([[80.0, 0, 37.0], [0, 75.0, 29.0], [0, 0, 1]])
VIEW = torch.eye(4)


def _posed(count: int, seed: int, depth: float = 2.0, spread: float = 0.3) -> Posed:
    generator = torch.Generator().manual_seed(seed)
    means = spread * torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, depth])
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
    return Posed(means, quats, 0.02 + 0.1 * torch.rand(count, 2, generator=generator), torch.zeros_like(means))


@given(st.integers(0, 10_000), st.floats(0.1, 3.0), st.sampled_from([1, 8, 32]))
def test_region_contains_all_coverage(seed: int, depth: float, multiple: int) -> None:
    posed = _posed(6, seed, depth)
    width, height = 72, 56
    region = region_of(posed, VIEW, K, width, height, multiple=multiple, margin=0.0)
    assert region.width % multiple == 0 and region.height % multiple == 0
    _, alpha = render_billboards(
        *posed.planes, None, torch.full((6, 4, 4), 0.9), VIEW, K, width, height, backend="reference"
    )
    rows, columns, _, _ = region.overlap(width, height)
    inside = torch.zeros_like(alpha)
    inside[rows, columns] = 1.0
    assert float((alpha * (1 - inside)).max()) == 0.0


def test_region_rendering_equals_the_cut_of_the_whole() -> None:
    posed = _posed(6, 3)
    region = region_of(posed, VIEW, K, 96, 64, multiple=8, margin=0.1)
    features, alpha = torch.randn(6, 4, 4, 2), torch.rand(6, 4, 4)
    whole, _ = render_billboards(*posed.planes, features, alpha, VIEW, K, 96, 64, backend="reference")
    window, _ = render_billboards(
        *posed.planes, features, alpha, VIEW, shift_camera(K, region), region.width, region.height, backend="reference"
    )
    torch.testing.assert_close(paste(window, region, 96, 64), whole, atol=1e-4, rtol=0)


def test_region_of_nothing_visible_is_one_tile() -> None:
    behind = _posed(4, 0, depth=-3.0)
    region = region_of(behind, VIEW, K, 64, 64, multiple=32, margin=0.1)
    assert (region.width, region.height) == (32, 32)


def test_region_at_the_near_plane_is_the_whole_picture() -> None:
    middle = torch.tensor([[0.0, 0, 0.02]])
    close = Posed(middle, torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[0.1, 0.1]]), torch.zeros_like(middle))
    assert region_of(close, VIEW, K, 70, 40, multiple=32, margin=0.0) == full_region(70, 40, 32) == Region(0, 0, 96, 64)


@pytest.mark.parametrize("region", [Region(-8, -4, 32, 32), Region(20, 20, 32, 32), Region(4, 4, 8, 8)])
def test_paste_puts_pixels_where_they_belong(region: Region) -> None:
    window = torch.arange(region.width * region.height, dtype=torch.float32).reshape(1, region.height, region.width)
    image = paste(window, region, 40, 36, -1.0)
    for y in range(36):
        for x in range(40):
            u, v = x - region.x0, y - region.y0
            inside = 0 <= u < region.width and 0 <= v < region.height
            assert image[0, y, x] == (window[0, v, u] if inside else -1.0)
