"""Memory that is used again is never memory that is still used."""

import numpy as np
import torch

from nbavatar.rendering import workspace

SIZE = workspace._SMALL


def test_memory_comes_back_once_nothing_refers_to_it(monkeypatch):
    monkeypatch.setattr(workspace, "_BLOCKS", [])
    first = workspace.empty((SIZE // 4,), np.dtype(np.float32))
    first[:] = 1.0
    second = workspace.empty((SIZE // 4,), np.dtype(np.float32))
    second[:] = 2.0
    tensor = torch.from_numpy(first).view(2, -1)[1:]  # refers to the memory alone
    place = first.ctypes.data
    del first
    third = workspace.empty((SIZE // 8,), np.dtype(np.float64))
    third[:] = 3.0
    assert bool((tensor == 1.0).all()) and (second == 2.0).all()
    assert len({place, second.ctypes.data, third.ctypes.data}) == 3
    del tensor
    assert workspace.empty((SIZE,), np.dtype(np.uint8)).ctypes.data == place
    assert place % 64 == 0


def test_released_blocks_are_those_that_nothing_uses(monkeypatch):
    monkeypatch.setattr(workspace, "_BLOCKS", [])
    used = [workspace.empty((factor * SIZE,), np.dtype(np.uint8)) for factor in (1, 5, 3)]
    used[1][:] = 7
    del used[2], used[0]
    workspace.release()
    assert [block.nbytes for block in workspace._BLOCKS] == [5 * SIZE]
    assert (used[0] == 7).all()


def test_blocks_that_nothing_uses_are_bounded(monkeypatch):
    monkeypatch.setattr(workspace, "_BLOCKS", [])
    monkeypatch.setattr(workspace, "_KEPT", 10 * SIZE)
    for factor in (1, 3, 7, 20, 9):
        workspace.empty((factor * SIZE,), np.dtype(np.uint8))
        assert sum(block.nbytes for block in workspace._BLOCKS) <= 10 * SIZE
    small = workspace.empty((3, 2), np.dtype(np.int32))
    assert small.shape == (3, 2) and all(block.nbytes >= SIZE for block in workspace._BLOCKS)
