import copy

import torch

from nbavatar.optimization.adam import Adam


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


def test_replaced_rows_keep_or_lose_their_moments():
    # Rows of an elementwise optimizer are independent, so a row that was kept, moved or doubled must go on
    # as it does in an optimizer that only ever had that row.
    generator = torch.Generator().manual_seed(1)
    start, gradients = torch.randn(4, 3, generator=generator), torch.randn(6, 5, 3, generator=generator)
    whole = torch.nn.Parameter(start.clone())
    other = torch.nn.Parameter(torch.zeros(2))
    optimizer = Adam([{"params": [other], "lr": 1e-2}, {"params": [whole], "lr": 1e-2}])
    rows = {}
    for row in range(4):
        rows[row] = torch.nn.Parameter(start[row : row + 1].clone())
    alone = {row: Adam([{"params": [rows[row]], "lr": 1e-2}]) for row in rows}
    for step in range(3):
        whole.grad = gradients[step, :4].clone()
        optimizer.step()
        for row, parameter in rows.items():
            parameter.grad = gradients[step, row : row + 1].clone()
            alone[row].step()
    source, fresh = torch.tensor([3, 0, 1, 1]), torch.tensor([False, False, False, True])
    new = torch.nn.Parameter(whole.detach()[source].clone())
    optimizer.replace(whole, new, source, fresh)
    assert optimizer.param_groups[1]["params"] == [new] and optimizer.moments(other) is None
    moments = optimizer.moments(new)
    assert moments is not None and not moments[0][3].any() and not moments[1][3].any()
    for step in range(3, 6):
        new.grad = gradients[step, :4].clone()
        optimizer.step()
        for place, row in enumerate([3, 0, 1]):
            rows[row].grad = gradients[step, place : place + 1].clone()
            alone[row].step()
    for place, row in enumerate([3, 0, 1]):
        assert torch.equal(new[place], rows[row][0])
    # The fresh row shares the step count of the others, so it is not corrected for bias and takes another path.
    assert not torch.equal(new[3], new[2])
