"""Muon: singular values in float64 as the oracle, torch's own for whole steps, and what a checkpoint keeps."""

import copy

import pytest
import torch

from nbavatar.optimization.muon import Muon, orthogonalized


def _quintic(values: torch.Tensor) -> torch.Tensor:
    """What the rounds make of singular values, one by one."""
    for _ in range(5):
        values = 3.4445 * values - 4.7750 * values**3 + 2.0315 * values**5
    return values


@pytest.mark.parametrize("shape", [(6, 40), (40, 6), (16, 16), (1, 9), (9, 1), (96, 864)])
@pytest.mark.parametrize("least", [-1.5, -8.0])
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-9), (torch.float32, 1e-3)])
def test_only_singular_values_change_and_as_the_quintic_says(shape, least, dtype, atol) -> None:
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    values = torch.logspace(0, least, len(values), dtype=torch.float64)
    matrix = left @ torch.diag(values) @ right
    expected = _quintic(values / values.norm())
    seen = values / values.norm() > 0.0015
    assert (expected[seen] > 0.68).all() and (expected < 1.21).all()
    # Squares are gathered: in each round a rounding error of a small one grows by 3.4445 squared.
    found = orthogonalized((100.0 * matrix).to(dtype))
    torch.testing.assert_close(found.double(), left @ torch.diag(expected) @ right, rtol=0, atol=atol)


def test_a_zero_matrix_stays_zero_and_noise_stays_small() -> None:
    assert not orthogonalized(torch.zeros(3, 5)).any()
    noise = 1e-12 * torch.randn(3, 5, generator=torch.Generator().manual_seed(4))
    assert orthogonalized(noise).abs().max() < 0.2
    rank_one = torch.outer(torch.tensor([3.0, 4.0]), torch.tensor([1.0, 2.0, 2.0])) / 15.0
    expected = float(_quintic(torch.ones((), dtype=torch.float64)))
    torch.testing.assert_close(orthogonalized(rank_one), expected * rank_one, rtol=0, atol=1e-3)


def test_steps_are_those_of_torch() -> None:
    """torch's own takes matrices, in bfloat16: single steps agree to a few hundredths of their size."""
    generator = torch.Generator().manual_seed(2)
    start = torch.randn(12, 30, generator=generator)
    ours, theirs = torch.nn.Parameter(start.clone().reshape(12, 10, 3)), torch.nn.Parameter(start.clone())
    a = Muon([{"params": [ours], "lr": 1e-2}])
    b = torch.optim.Muon([theirs], lr=1e-2, weight_decay=0.0, momentum=0.95, adjust_lr_fn="match_rms_adamw")
    for _ in range(8):
        gradient = torch.randn(12, 30, generator=generator)
        before = ours.detach().clone(), theirs.detach().clone()
        ours.grad, theirs.grad = gradient.reshape(12, 10, 3), gradient
        a.step()
        b.step()
        mine, other = (ours - before[0]).reshape(12, 30), theirs - before[1]
        assert (mine - other).norm() < 0.05 * other.norm()
        # As large as Adam's: a fifth of the rate, root mean square.
        assert 0.1e-2 < float(mine.detach().square().mean().sqrt()) < 0.25e-2


def test_a_restored_state_continues_with_the_same_bits() -> None:
    generator = torch.Generator().manual_seed(3)
    weights = [torch.nn.Parameter(torch.randn(4, 3, 3, 3, generator=generator)) for _ in range(2)]
    straight, broken = copy.deepcopy(weights), copy.deepcopy(weights)
    a, b = Muon([{"params": straight, "lr": 1e-2}]), Muon([{"params": broken, "lr": 1e-2}])
    for step in range(1, 9):
        if step == 5:
            kept = copy.deepcopy(b.state_dict())
            b = Muon([{"params": broken, "lr": 1e-2}])
            b.load_state_dict(kept)
        gradients = [
            None if i and step % 3 == 0 else torch.randn(w.shape, generator=generator) for i, w in enumerate(weights)
        ]
        for optimizer, parameters in ((a, straight), (b, broken)):
            optimizer.zero_grad()
            assert all(parameter.grad is None for parameter in parameters)
            for parameter, gradient in zip(parameters, gradients, strict=True):
                parameter.grad = gradient
            optimizer.step()
    for mine, other in zip(straight, broken, strict=True):
        assert torch.equal(mine, other)
