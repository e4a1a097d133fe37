"""The thread that draws: the latest request wins, small first, whole at rest."""

import threading

from nbavatar.viewer.worker import RenderWorker, Work


def test_the_latest_request_wins_and_things_at_rest_are_drawn_whole() -> None:
    drawn: list[Work] = []
    begun, go, rest = threading.Event(), threading.Event(), threading.Event()

    def draw(work: Work) -> None:
        drawn.append(work)
        begun.set()
        assert go.wait(30)
        if work.whole and work.request == "c":
            rest.set()

    worker = RenderWorker(draw, lambda *_: None)
    worker._per_pixel = 0.08 / 256**2
    worker.start()
    worker.submit(1, "a", 512)
    assert begun.wait(30)
    for request in ("b1", "b2", "b3", "c"):  # all of them while `a` is being drawn; none of these calls waits
        worker.submit(1, request, 512)
    go.set()
    assert rest.wait(30)
    worker.stop()
    assert [work.request for work in drawn] == ["a", "c", "c"]
    assert [work.whole for work in drawn] == [False, False, True]
    assert drawn[0].side == 256 and drawn[-1].side == 512


def test_two_clients_are_served_and_an_error_ends_nothing() -> None:
    drawn, failed = [], []
    done = threading.Event()

    def draw(work: Work) -> None:
        if work.request == "bad":
            raise ValueError("bad")
        drawn.append(work.client)
        if set(drawn) == {2, 3} and failed:
            done.set()

    worker = RenderWorker(draw, lambda client, error: failed.append((client, str(error))))
    worker.start()
    worker.submit(1, "bad", 32)
    worker.submit(2, "x", 32)
    worker.submit(3, "y", 32)
    assert done.wait(30)
    worker.stop()
    assert failed[0] == (1, "bad")
