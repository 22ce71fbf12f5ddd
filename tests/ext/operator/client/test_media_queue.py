"""What a page receives of a robot's pictures: freshness on slow connections, and never half of a row of differences."""

from __future__ import annotations

import random

import pytest

from pebble.extensions.operator.client.media_request.offer import Medium, best
from pebble.extensions.operator.client.media_request.queue import (
    MAX_FRAMES,
    THIN_ACK_S,
    Frame,
    ViewerQueue,
    assess,
)

ALL = frozenset({"h264", "pbvd", "json", "jpeg"})


def frame(seq: int, keyframe: bool = False, encoding: str = "pbvd", size: int = 3000) -> Frame:
    return Frame(seq, bytes(size), encoding, keyframe)


def drained(queue: ViewerQueue, now: float = 0.0) -> list[int]:
    """Take and acknowledge everything."""
    seqs = []
    while (one := queue.take(now)) is not None:
        queue.acknowledge(one.seq, now)
        seqs.append(one.seq)
    return seqs


def show(viewer: ViewerQueue, seq: int, at: float, acknowledged: float) -> None:
    """A key frame on its way to a page, by the rescue stream if it gets that."""
    one = frame(seq, keyframe=True, encoding="jpeg" if viewer.rescued else "pbvd")
    if viewer.rescued:
        viewer.offer_rescue(one)
    else:
        viewer.offer_direct(one, at)
    assert viewer.take(at)
    viewer.acknowledge(seq, acknowledged)


def offered(viewer: ViewerQueue, seq: int, at: float) -> bool:
    """Whether it is rescued after this key frame."""
    viewer.offer_direct(frame(seq, keyframe=True), at)
    return viewer.rescued


def test_two_are_under_way_and_one_when_acknowledgements_are_late() -> None:
    queue = ViewerQueue(ALL, 0.0)
    for seq in range(4):
        queue.offer(frame(seq, keyframe=seq == 0))
    assert [queue.take(0.0), queue.take(0.0), queue.take(0.0)] == [frame(0, keyframe=True), frame(1), None]
    queue.acknowledge(0, 0.2)
    assert queue.window == 1
    assert queue.take(0.2) is None
    queue.acknowledge(1, 0.3)
    assert queue.take(0.3) == frame(2)
    assert queue.take(0.3) is None
    queue.acknowledge(2, 0.35)
    assert queue.window == 2


def test_a_key_frame_replaces_what_waits_for_a_slow_page_only() -> None:
    fast, slow = ViewerQueue(ALL, 0.0), ViewerQueue(ALL, 0.0)
    for queue, took in ((fast, 0.01), (slow, 0.5)):
        queue.offer(frame(0, keyframe=True))
        queue.take(0.0)
        queue.acknowledge(0, took)
        for one in (frame(1), frame(2), frame(3, keyframe=True)):
            queue.offer(one)
    assert drained(fast) == [1, 2, 3]
    assert drained(slow) == [3]


@pytest.mark.parametrize("seed", range(20))
def test_what_is_sent_can_always_be_decoded(seed: int) -> None:
    """Whatever happens: after each frame comes the next one, or a key frame; and bounds hold."""
    chance, queue, last, now, under_way = random.Random(seed), ViewerQueue(ALL, 0.0), None, 0.0, []
    for seq in range(2000):
        now += chance.random() / 10
        queue.offer_direct(frame(seq, keyframe=chance.random() < 0.15, size=chance.randrange(1 << 20)), now)
        if chance.random() < 0.02:
            queue.lost(now)
        while (one := queue.take(now)) is not None:
            assert one.keyframe or one.seq == last + 1
            last = one.seq
            under_way.append(one.seq)
        assert len(under_way) <= 2
        while under_way and chance.random() < 0.4:
            queue.acknowledge(under_way.pop(0), now)


def test_an_unknown_acknowledgement_is_ignored() -> None:
    queue = ViewerQueue(ALL, 0.0)
    queue.offer(frame(0, keyframe=True))
    queue.take(0.0)
    assert queue.acknowledge(7, 9.0) is None
    assert queue.acknowledge(0, 0.1) == frame(0, keyframe=True)
    assert queue.acknowledge(0, 9.0) is None
    assert queue.ack_s == 0.1


def test_a_page_that_did_not_draw_waits_unless_a_key_frame_is_on_its_way() -> None:
    queue = ViewerQueue(ALL, 0.0)
    queue.offer_direct(frame(0, keyframe=True), 0.0)
    queue.offer_direct(frame(1), 0.0)
    queue.take(0.0)
    queue.acknowledge(0, 0.0)
    queue.note_keyframe_request(0.0)
    assert queue.waiting
    queue.offer_direct(frame(2, keyframe=True), 0.1)
    queue.take(0.1)
    queue.note_keyframe_request(0.1)
    assert not queue.waiting


# -- between viewers


def viewers(count: int, *, waiting: int = 0, now: float = 0.0) -> list[ViewerQueue]:
    """A group of pages of which the last ``waiting`` are too slow."""
    made = [ViewerQueue(ALL, now) for _ in range(count)]
    for index, viewer in enumerate(made):
        viewer.offer_direct(frame(0, keyframe=True, encoding="h264"), now)
        if index >= count - waiting:
            overflow(viewer, now)
    return made


def overflow(viewer: ViewerQueue, now: float) -> None:
    for seq in range(1, MAX_FRAMES + 3):
        viewer.offer_direct(frame(seq, encoding="h264"), now)
    assert viewer.overflowed


def test_a_sole_viewer_and_half_of_them_get_a_key_frame() -> None:
    assert assess(viewers(1, waiting=1), "h264", 0.1, can_rescue=True)
    assert assess(viewers(2, waiting=1), "h264", 0.1, can_rescue=True)
    assert not assess(viewers(2), "h264", 0.1, can_rescue=True)
    assert not assess([], "h264", 0.1, can_rescue=True)


def test_a_slow_viewer_among_fast_ones_gets_the_rescue_stream() -> None:
    some = viewers(3, waiting=1)
    assert not assess(some, "h264", 0.1, can_rescue=True)
    assert [viewer.rescued for viewer in some] == [False, False, True]
    assert not assess(viewers(3, waiting=1), "h264", 0.1, can_rescue=False)


def test_a_new_viewer_among_others_gets_one_key_frame_and_then_the_rescue_stream() -> None:
    some = viewers(4)
    new = ViewerQueue(ALL, 1.0)
    assert assess([*some, new], "h264", 1.0, can_rescue=True)
    new.unserved = False  # it was requested
    assert not assess([*some, new], "h264", 1.5, can_rescue=True)
    assert not new.rescued
    assess([*some, new], "h264", 3.0, can_rescue=True)
    assert new.rescued
    new.offer_direct(frame(9, keyframe=True, encoding="h264"), 3.5)
    assert not new.rescued


def test_what_cannot_be_decoded_is_rescued_until_it_can() -> None:
    viewer = ViewerQueue(frozenset({"json", "jpeg"}), 0.0)
    assert not assess([viewer], "h264", 0.1, can_rescue=True)
    assert viewer.rescued
    viewer.offer_rescue(frame(1, keyframe=True, encoding="jpeg"))
    viewer.offer_rescue(frame(2, keyframe=True, encoding="jpeg"))
    assert drained(viewer) == [2]
    viewer.offer_direct(frame(3, keyframe=True, encoding="h264"), 0.2)
    assert viewer.rescued
    viewer.offer_direct(frame(4, keyframe=True, encoding="json"), 0.3)
    assert not viewer.rescued
    viewer.cannot_decode("json")
    assess([viewer], "json", 0.4, can_rescue=True)
    assert viewer.rescued


def test_over_a_thin_connection_small_pictures_come_from_the_rescue_stream() -> None:
    viewer, now = ViewerQueue(ALL, 0.0), 0.0
    for seq in range(2):
        show(viewer, seq, now, now + THIN_ACK_S + 0.1)
        assert not viewer.rescued
        now += THIN_ACK_S + 0.1
        assert not assess([viewer], "pbvd", now, can_rescue=True)
    assert viewer.rescued
    assert offered(viewer, 2, now + 59)
    assert not offered(viewer, 3, now + 61)


def test_small_pictures_that_are_late_as_well_do_not_put_off_the_return() -> None:
    viewer = ViewerQueue(ALL, 0.0)
    for seq in range(18):
        show(viewer, seq, seq / 2, seq / 2 + 0.5)
        assess([viewer], "pbvd", seq / 2 + 0.5, can_rescue=True)
        assert viewer.rescued == (seq > 0)
    assert not offered(viewer, 18, 61.0)


# -- the encoding

OFFERED, BOTH, PCM = ("json", "pbvd", "h264"), frozenset({"opus", "pcm"}), frozenset({"pcm"})


@pytest.mark.parametrize(
    ("medium", "encodings", "viewers", "wanted"),
    [
        ("video", OFFERED, [ALL], "h264"),
        ("video", OFFERED, [ALL, ALL - {"h264"}], "pbvd"),
        ("video", OFFERED, [ALL - {"h264"}, ALL - {"h264", "pbvd"}], "json"),
        ("video", (), [ALL], None),  # such a robot sends what it sends
        ("audio", ("pcm", "opus"), [BOTH, BOTH], "opus"),
        ("audio", ("pcm", "opus"), [BOTH, PCM], "pcm"),
        ("audio", ("opus",), [PCM], "opus"),  # there is no other
        ("audio", ("flac",), [BOTH], None),
    ],
)
def test_the_best_encoding_of_all(
    medium: Medium, encodings: tuple[str, ...], viewers: list[frozenset[str]], wanted: str | None
) -> None:
    assert best(medium, encodings, viewers) == wanted
