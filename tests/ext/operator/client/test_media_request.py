"""Pictures and sound of a robot: what is requested, what is received, and what a page gets of it.

A page on a slow connection gets fresh pictures, and never half of a row of differences.
"""

from __future__ import annotations

import asyncio
import random
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import STATUS
from pebble.errors import PebbleError
from pebble.extensions.operator.client.broker import Broker
from pebble.extensions.operator.client.media_receiver import MediaReceiver
from pebble.extensions.operator.client.media_request import shared
from pebble.extensions.operator.client.media_request.offer import Medium, best
from pebble.extensions.operator.client.media_request.queue import (
    MAX_FRAMES,
    THIN_ACK_S,
    Frame,
    ViewerQueue,
    assess,
)
from pebble.extensions.operator.client.media_request.request import ViewerRequest
from pebble.extensions.operator.client.media_request.shared import SharedRequest
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.page.media import robots
from tests.ext.recordings.playing import DRIVE, FRED, MEDIA, contents
from tests.support import until

BASE = "pebble/robots/goob"
REQUEST, FLAG, CAMERA = (
    f"{BASE}/{topic}" for topic in ("incoming/front-camera", "incoming/flags/mqtt-video", "outgoing/front-camera")
)
VIDEO = {"available": True, "controls": True, "topic": CAMERA, "encodings": ["json", "h264"]}
ON, H264, OFF = (
    (REQUEST, b"{%s}" % text) for text in (b'"enabled":true', b'"enabled":true,"encoding":"h264"', b'"enabled":false')
)
UP, DOWN = (FLAG, b'{"value":true}'), (FLAG, b'{"value":false}')
Sent = list[tuple[str, bytes]]


def request(**section: Any) -> ViewerRequest:
    return ViewerRequest(BASE, "video", {"video": VIDEO | section})


def sent(messages: list[Message]) -> Sent:
    return [(message.topic, message.payload) for message in messages]


def sent_until(one: ViewerRequest, end: float, arrives: list[tuple[float, str, bytes]] = [], at: float = 0.0) -> Sent:  # noqa: B006
    """What is sent from ``at`` on, in steps of 0.1 s, while messages arrive at their times."""
    found: Sent = []
    for step in range(round(10 * at), round(10 * end)):
        for when, topic, payload in arrives:
            if when == step / 10:
                one.receive(Message(topic, payload), when)
        found += sent(one.tick(step / 10))
    return found


@pytest.mark.parametrize(
    ("encoding", "arrives", "asked", "ended"),
    [
        ("h264", [], [UP, H264], [OFF, DOWN]),
        (None, [], [UP, ON], [OFF, DOWN]),
        ("h264", [(0.0, FLAG, b"true")], [H264], [OFF]),  # whoever has raised it lowers it
        ("h264", [(0.5, FLAG, b"false")], [UP, H264], [OFF]),  # by another operator: it stays down
        (None, [(0.0, FLAG, b"true"), (0.1, CAMERA, b"a picture")], [], []),  # another has requested it
        ("h264", [(0.0, FLAG, b"true"), (0.1, CAMERA, b"a picture")], [H264], [OFF]),
    ],
)
def test_what_is_asked_and_taken_back(
    encoding: str | None, arrives: list[tuple[float, str, bytes]], asked: Sent, ended: Sent
) -> None:
    one = request()
    one.want(encoding, 0.0)
    assert sent_until(one, 1.0, arrives) == asked
    assert one.settled
    assert sent(one.end()) == ended
    assert one.end() == []


LIFTED, PICTURE, OTHERS = (0.0, FLAG, b"true"), (0.1, CAMERA, b"a picture"), b'{"enabled": true}'
#: What arrives, what is asked within three seconds, and how it is ended by who shares a stream with others.
SHARED: dict[str, tuple[list[tuple[float, str, bytes]], Sent, Sent]] = {
    "a stream of others": ([LIFTED, PICTURE, (1.5, CAMERA, b"")], [], []),
    "one that they have ended": ([LIFTED, PICTURE, (1.5, REQUEST, b'{"enabled": false}')], [H264], [OFF]),
    "one that they have left without a word": ([LIFTED, PICTURE], [ON], [OFF]),
    "others who come later": ([(1.0, CAMERA, b""), (1.5, REQUEST, OTHERS), (2.0, CAMERA, b"")], [UP, H264], []),
    "others who lower the flag": ([(1.0, REQUEST, OTHERS), (2.9, FLAG, b"false")], [UP, H264, ON], [OFF]),
    "who only looks on": ([(1.0, REQUEST, b'{"enabled": true, "keyframe": true}')], [UP, H264, H264], [OFF, DOWN]),
    "nonsense": ([(1.0, CAMERA, b""), (1.5, REQUEST, b"{"), (2.0, CAMERA, b"")], [UP, H264], [OFF, DOWN]),
}


@pytest.mark.parametrize(("arrives", "asked", "ended"), SHARED.values(), ids=SHARED)
def test_a_stream_that_is_shared_keeps_its_encoding_and_is_left_to_others(
    arrives: list[tuple[float, str, bytes]], asked: Sent, ended: Sent
) -> None:
    one = ViewerRequest(BASE, "video", {"video": VIDEO}, shares=True)
    one.want("h264", 0.0)
    assert sent_until(one, 3.0, arrives) == asked
    assert sent(one.end()) == ended


def test_it_is_repeated_while_nothing_comes_and_changed_at_once() -> None:
    one = request()
    one.want(None, 0.0)
    assert sent_until(one, 5.0, [(2.0, CAMERA, b"a picture")]) == [UP, ON, ON]
    one.want("h264", 5.0)
    assert sent_until(one, 5.1, at=5.0) == [H264]


def test_what_is_not_offered_is_an_error() -> None:
    with pytest.raises(PebbleError, match="goob offers no video"):
        request(controls=False).want(None, 0.0)
    with pytest.raises(PebbleError, match="only as json, h264"):
        request().want("pbvd", 0.0)


def test_nothing_goes_to_another_robot() -> None:
    assert request(command_topic="pebble/robots/fred/incoming/front-camera").control_topic == REQUEST


def test_a_key_frame_is_requested_once_a_second() -> None:
    one = request()
    one.want("h264", 0.0)
    keyframe = (REQUEST, b'{"enabled":true,"encoding":"h264","keyframe":true}')
    assert [sent(one.keyframe("h264", at)) for at in (0.0, 0.9, 1.0)] == [[keyframe], [], [keyframe]]


# -- shared by pages: the event loop may be late, and the broker away


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


class Requested:
    """A robot that sends nothing by itself, and a request for its pictures that runs."""

    def __init__(self) -> None:
        self.robot = robots.PictureRobot()
        self.robot.mute = True
        self.broker = robots.broker_on(self.robot.hub)
        self.received: list[bytes] = []
        self.view = RobotView(BASE)
        self.view.capabilities = {"video": VIDEO}
        self.request = SharedRequest(self.broker, BASE, "video", self.received.append)

    def status(self, camera: str) -> None:
        self.view.receive(STATUS, Message(STATUS.topic(BASE), robots.status_of(camera)), 0.0, 0.0)

    async def step(self) -> None:
        await self.request.follow(self.view, "json")


@pytest.mark.anyio
async def test_it_is_withdrawn_once_there_is_a_broker_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "LINGER_S", 0.0)
    there, one = [True], Requested()
    monkeypatch.setattr(Broker, "connected", property(lambda _: there[0]))
    await one.broker.open()
    one.request.want(True)
    task = asyncio.create_task(one.request.run(one.step))
    await robots.until(lambda: one.robot.requests)
    there[0] = False
    one.request.want(False)
    await asyncio.sleep(0.5)
    assert one.robot.encodings == ["json"]
    there[0] = True
    await robots.until(lambda: one.robot.encodings == ["json", None])
    one.request.close()
    await task
    await one.broker.close()
    one.robot.close()


@pytest.mark.anyio
async def test_nothing_is_asked_of_a_robot_that_waits() -> None:
    one = Requested()
    one.status("held")
    await one.broker.open()
    one.request.want(True)
    for _ in range(3):
        await one.step()
    await one.request.request_keyframe("json")
    assert one.request.waits == "Pictures wait for driving"
    assert one.robot.published == []
    one.status("running")
    await one.step()
    await robots.until(lambda: one.robot.encodings == ["json"])
    one.status("held")
    await one.step()
    await one.request.request_keyframe("json")
    one.request.close()
    await one.request.run(one.step)
    await robots.until(lambda: one.robot.encodings == ["json", None])
    await one.broker.close()
    one.robot.close()


# -- what is received of a recorded robot


def recorded(path: Path, topic: str) -> list[bytes]:
    return [payload for name, payload in contents(path) if name == topic]


def test_every_recorded_picture_and_sound_is_received() -> None:
    """Four encodings of pictures and two of sound, one after another, as the robot sent them."""
    hub, pictures, sounds = MemoryHub(), [], []
    camera, microphone = f"{FRED}/outgoing/front-camera", f"{FRED}/outgoing/audio"
    capabilities_topic = f"{FRED}/outgoing/capabilities"
    with MemoryTransport("robot", hub) as robot, MemoryTransport("viewer", hub) as viewer:
        robot.publish(capabilities_topic, recorded(DRIVE, capabilities_topic)[0], qos=QoS.DELIVERED, retain=True)
        receiver = MediaReceiver(viewer, FRED)
        receiver.on_picture = pictures.append  # type: ignore[method-assign]
        receiver.on_sound = sounds.append  # type: ignore[method-assign]
        receiver.wait_for_capabilities(5)
        receiver.request("video")
        receiver.request("audio")
        for topic, received in ((camera, pictures), (microphone, sounds)):
            for number, payload in enumerate(recorded(MEDIA, topic), 1):
                robot.publish(topic, payload)
                assert until(lambda received=received, number=number: len(received) == number)  # type: ignore[misc]
        receiver.close()
    assert list(dict.fromkeys(one.encoding for one in pictures)) == ["json", "pbvd", "pbvz", "h264"]
    sent = recorded(MEDIA, microphone)
    assert [one.sequence for one in sounds] == [int.from_bytes(payload[12:16]) for payload in sent]
    assert [one.encoding for one in sounds] == [{1: "pcm", 2: "opus"}[payload[5]] for payload in sent]


# -- what a page receives


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


def viewers(count: int, *, waiting: int = 0) -> list[ViewerQueue]:
    """A group of pages of which the last ``waiting`` are too slow."""
    made = [ViewerQueue(ALL, 0.0) for _ in range(count)]
    for index, viewer in enumerate(made):
        viewer.offer_direct(frame(0, keyframe=True, encoding="h264"), 0.0)
        for seq in range(1, MAX_FRAMES + 3) if index >= count - waiting else ():
            viewer.offer_direct(frame(seq, encoding="h264"), 0.0)
        assert viewer.overflowed == (index >= count - waiting)
    return made


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
