"""What who wants a robot's pictures changes about it, and what stays as it was."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.errors import PebbleError
from pebble.extensions.operator.client.media_request.request import ViewerRequest
from pebble.transports import Message

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
