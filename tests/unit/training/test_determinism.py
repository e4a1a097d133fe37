"""Several threads give the bits of one: enough rows that torch divides the sums among threads."""

from collections.abc import Iterator

import pytest
import torch

from nbavatar.methods.billboards.losses import loss_knn
from nbavatar.training.determinism import sums_in_order
from tests.unit.training.test_loop import CONFIG, run

FACES = 11_514  # of a full-size head and hand; torch divides sums of more than 32,768 numbers


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def gradients() -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(0)
    means, quats, extents = (torch.randn(FACES, width, generator=generator).requires_grad_(True) for width in (3, 4, 2))
    neighbours = (torch.arange(FACES)[:, None] + torch.tensor([0, 1, 5])) % FACES
    return torch.autograd.grad(loss_knn(means, quats, extents, neighbours), (means, quats, extents))


def test_sums_over_neighbours_are_those_of_one_thread(threads) -> None:
    # Without the order, 8 passes in 10 differ; 12 passes make it sure that the test would see it.
    torch.set_num_threads(1)
    alone = gradients()
    torch.set_num_threads(2)
    with sums_in_order("cpu"):
        for _ in range(12):
            assert all(torch.equal(a, b) for a, b in zip(gradients(), alone, strict=True))


@pytest.mark.parametrize("before", [False, True])
def test_training_is_in_order_and_leaves_torch_as_it_was(scene, tmp_path, before: bool) -> None:
    seen = []
    torch.use_deterministic_algorithms(before)
    try:
        run(scene, CONFIG, tmp_path, on_step=lambda *_: seen.append(torch.are_deterministic_algorithms_enabled()))
        assert len(seen) == CONFIG.steps and all(seen)
        assert torch.are_deterministic_algorithms_enabled() is before
        assert torch.utils.deterministic.fill_uninitialized_memory
    finally:
        torch.use_deterministic_algorithms(False)
