"""The memory of a kernel's worker, as derived from its table of buffers: no overlaps, all aligned, all there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import typeof, types

from nbavatar.rendering.billboards import cpu_gather, cpu_scratch
from nbavatar.rendering.gaussians import cpu_kernels
from nbavatar.rendering.scratch import ALIGNMENT, FORWARD, REPLAY, layout, scratch_bytes, scratch_type, scratch_views

BILLBOARDS = st.builds(
    cpu_scratch.Sizes, rows=st.sampled_from([1, 2, 8, 32]), capacity=st.integers(1, 70), channels=st.integers(0, 25),
    bundles=st.integers(0, 300), texels=st.integers(1, 9),
)  # fmt: skip
GAUSSIANS = st.builds(cpu_kernels.Sizes, rows=st.integers(1, 32), longest=st.integers(0, 50))
TABLES = {
    "tiles": (cpu_scratch.Scratch, cpu_scratch.BUFFERS, BILLBOARDS),
    "gather": (cpu_gather.GatherScratch, cpu_gather.GATHER_BUFFERS, BILLBOARDS),
    "gaussians": (cpu_kernels.Scratch, cpu_kernels.BUFFERS, GAUSSIANS),
}


@pytest.mark.parametrize("name", list(TABLES))
@given(data=st.data())
def test_buffers_do_not_overlap_and_are_aligned(name, data):
    group, buffers, sizes = TABLES[name]
    sizes = data.draw(sizes)
    real, replay = data.draw(st.sampled_from([np.float32, np.float64])), data.draw(st.booleans())
    places, size = layout(buffers, sizes, real, replay)
    assert list(places) == list(group._fields)
    intervals = sorted((p.offset, p.offset + p.count * p.dtype.itemsize) for p in places.values())
    assert all(end <= start for (_, end), (start, _) in zip(intervals, intervals[1:], strict=False))
    assert intervals[-1][1] <= size == scratch_bytes(buffers, sizes, real, replay)
    assert all(place.offset % ALIGNMENT == 0 for place in places.values())
    for buffer in buffers:
        needed = buffer.only in ("", REPLAY if replay else FORWARD)
        assert places[buffer.name].count == (buffer.count(sizes) if needed else 0)


@pytest.mark.parametrize("name", list(TABLES))
@pytest.mark.parametrize("replay", [False, True])
def test_what_is_written_to_one_buffer_stays_out_of_the_others(name, replay):
    group, buffers, _ = TABLES[name]
    sizes = cpu_kernels.Sizes(3, 5) if name == "gaussians" else cpu_scratch.Sizes(4, 20, 9, 7, 3)
    memory = np.full(scratch_bytes(buffers, sizes, np.float32, replay), 255, np.uint8)
    views = scratch_views(group, buffers, sizes, np.float32, replay, memory)
    for number, view in enumerate(views):
        view[:] = number
    for number, view in enumerate(views):
        assert (view == number).all()
    assert typeof(views) == scratch_type(group, buffers, types.float32)
