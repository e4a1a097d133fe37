import copy

import torch

from nbavatar.training.adam import Adam


def _parameters():
    generator = torch.Generator().manual_seed(3)
    shapes = [(5, 4), (7,), (2, 3, 3, 3)]
    return [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in shapes]


def _gradients(parameters, step):
    generator = torch.Generator().manual_seed(step)
    for i, parameter in enumerate(parameters):
        # The last parameter has no gradient in every third step: its moments and its count then stand still.
        parameter.grad = None if i == 2 and step % 3 == 0 else torch.randn(parameter.shape, generator=generator)


def _groups(parameters):
    return [{"params": parameters[:1], "lr": 1e-2, "name": "a"}, {"params": parameters[1:], "lr": 3e-3, "name": "b"}]


def test_it_is_torchs_fused_adam_bit_for_bit():
    ours, theirs = _parameters(), _parameters()
    a, b = Adam(_groups(ours)), torch.optim.Adam(_groups(theirs), fused=True)
    for step in range(1, 12):
        for optimizer, parameters in ((a, ours), (b, theirs)):
            optimizer.param_groups[0]["lr"] = 1e-2 / step
            _gradients(parameters, step)
            optimizer.step()
    for mine, other in zip(ours, theirs, strict=True):
        assert torch.equal(mine, other)


def test_a_restored_state_continues_with_the_same_bits():
    straight, broken = _parameters(), _parameters()
    a, b = Adam(_groups(straight)), Adam(_groups(broken))
    for step in range(1, 9):
        if step == 5:
            kept = copy.deepcopy(b.state_dict())
            b = Adam(_groups(broken))
            b.load_state_dict(kept)
        for optimizer, parameters in ((a, straight), (b, broken)):
            _gradients(parameters, step)
            optimizer.step()
    for mine, other in zip(straight, broken, strict=True):
        assert torch.equal(mine, other)


def test_zero_grad_forgets_gradients():
    parameters = _parameters()
    _gradients(parameters, 1)
    Adam(_groups(parameters)).zero_grad()
    assert all(parameter.grad is None for parameter in parameters)
