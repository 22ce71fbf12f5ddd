"""Which packets the demo joins to one stretch of sound, and which robots it leaves to those who watch them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from pebble.contract import CAPABILITIES, VIDEO_CONTROL, codec
from pebble.contract.payloads import Capabilities, MediaRequest
from pebble.demo.media import MediaRecorder
from pebble.media.sound import ReceivedSound
from pebble.transports import Transport, create
from pebble.transports.memory import MemoryHub
from tests.support import until

RATE, CHUNK = 16_000, 320  # 20 ms


GOOB = "pebble/robots/goob"


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


@pytest.fixture
def recorder(hub: MemoryHub) -> Iterator[MediaRecorder]:
    with create("memory", "recorder", hub) as transport:
        yield MediaRecorder(transport, GOOB)


@pytest.fixture
def person(hub: MemoryHub, recorder: MediaRecorder) -> Iterator[Transport]:
    """Another client; the recorder knows what the robot offers, and notices requests."""
    with create("memory", "person", hub) as transport:
        video = {"available": True, "controls": True, "topic": f"{GOOB}/outgoing/camera"}
        capabilities = Capabilities(t=1, value={"video": video})
        transport.publish(CAPABILITIES.topic(GOOB), codec.encode(CAPABILITIES, capabilities), retain=True)
        recorder.wait_for_capabilities(5.0)
        recorder.watch_requests()
        yield transport


def chunk(sequence: int, captured_ms: int, encoding: str = "pcm") -> ReceivedSound:
    samples = np.full((CHUNK, 1), sequence, np.int16)
    return ReceivedSound(samples, RATE, 1, captured_ms, sequence, encoding)


def test_what_follows_is_one_stretch(recorder: MediaRecorder) -> None:
    for number in range(10):
        recorder.on_sound(chunk(number, 20 * number + number % 2))  # stamps are whole milliseconds
    assert len(recorder.take_sound("pcm")) == 10 * CHUNK
    assert len(recorder.take_sound("pcm")) == 0


@pytest.mark.parametrize(
    ("sequence", "late_ms"), [(1, 0), (0, 40)], ids=["a packet is missing", "the microphone missed"]
)
def test_after_a_gap_another_one_begins(recorder: MediaRecorder, sequence: int, late_ms: int) -> None:
    for number in range(10):
        gone = number >= 4
        recorder.on_sound(chunk(number + sequence * gone, 20 * number + late_ms * gone))
    received = recorder.take_sound("pcm")
    assert len(received) == 6 * CHUNK
    assert received[0] == 4 + sequence


def test_each_encoding_is_for_itself(recorder: MediaRecorder) -> None:
    for number in range(4):
        recorder.on_sound(chunk(number, 20 * number, "pcm" if number < 3 else "opus"))
    assert len(recorder.take_sound("pcm")) == 3 * CHUNK


def test_a_robot_that_a_person_watches_is_left_as_it_is(recorder: MediaRecorder, person: Transport) -> None:
    requests: list[MediaRequest] = []
    topic = VIDEO_CONTROL.topic(GOOB)
    person.subscribe(topic, lambda message: requests.append(codec.decode(VIDEO_CONTROL, message.payload)))
    recorder.viewer.request("video", "pbvz")
    assert until(lambda: len(requests) == 1)
    assert not until(lambda: recorder.watched, 0.1)
    person.publish(topic, codec.encode(VIDEO_CONTROL, MediaRequest(enabled=True, encoding="pbvz")))
    assert until(lambda: recorder.watched == {"video"})
    recorder.close()  # withdraws nothing that the person still watches
    assert not until(lambda: len(requests) > 2, 0.1)


def test_it_is_the_demos_again_when_the_person_has_seen_enough(recorder: MediaRecorder, person: Transport) -> None:
    for enabled in (True, False):
        person.publish(VIDEO_CONTROL.topic(GOOB), codec.encode(VIDEO_CONTROL, MediaRequest(enabled=enabled)))
        assert until(lambda: recorder.watched == ({"video"} if enabled else set()))  # noqa: B023 - at once
    assert recorder.disturbed == {"video"}  # a turn in which somebody watched is not assessed
