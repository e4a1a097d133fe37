"""Long sequences: a stream of views keeps its cache and the frames in flight in memory, however many there are."""

import tracemalloc

import numpy as np

from nbavatar.data.views import ViewStore, ViewStream, views_of

SIDE, FRAMES, CACHE, AHEAD = 128, 300, 1_000_000, 4
# A frame is decoded to 3 + 1 bytes a pixel and kept as 5; a sample takes 5 floats, and as much while it is made, twice.
DECODED, SAMPLE = (4 + 1 + 1 + 5) * SIDE**2, 3 * 20 * SIDE**2


class _Pack:
    """A camera whose every frame is full and differs from the others."""

    path, layers, cam_from_world = "made.zip", ("rgb", "alpha"), np.eye(4).tolist()
    manifest = {"camera": "c", "width": SIDE, "height": SIDE}

    def intrinsics(self, frame: str) -> list:
        return np.diag([SIDE, SIDE, 1.0]).tolist()

    def read(self, layer: str, frame: str) -> np.ndarray:
        shape = (SIDE, SIDE, 3) if layer == "rgb" else (SIDE, SIDE)
        return np.full(shape, 255 if layer == "alpha" else int(frame) % 256, np.uint8)


def test_memory_does_not_grow_with_the_sequence() -> None:
    names = [str(i) for i in range(FRAMES)]
    packs = [_Pack()]
    views = views_of(packs, names, [names])  # pyright: ignore[reportArgumentType]
    store = ViewStore(packs, views, ["head", "right_hand", "left_hand"], CACHE)  # pyright: ignore[reportArgumentType]
    stream = ViewStream(store, FRAMES, seed=0, ahead=AHEAD)
    tracemalloc.start()
    try:
        for step in range(FRAMES):
            sample = stream.get(step, 1)
            assert sample.pixels.shape == (5, SIDE, SIDE)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
        stream.close()
    assert store.decoded >= FRAMES - AHEAD and store.cached_bytes <= CACHE
    everything = FRAMES * 5 * SIDE**2
    bound = CACHE + (AHEAD + 2) * (DECODED + SAMPLE)
    assert bound < everything / 2, "the test would prove nothing"
    assert peak <= bound
