"""What the demo counts of pictures and sound, and which robots it leaves to people who watch them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from pebble.contract import CAPABILITIES, VIDEO_CONTROL, codec
from pebble.contract.encodings import ALL_SOUND, ALL_VIDEO
from pebble.contract.payloads import Capabilities, MediaRequest
from pebble.extensions.lab.demo.media import CountedMedia
from pebble.extensions.media.decode import Decoded
from pebble.extensions.media.sound import ReceivedSound
from pebble.transports import Transport, create
from pebble.transports.memory import MemoryHub
from tests.support import until

GOOB = "pebble/robots/goob"


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


@pytest.fixture
def media(hub: MemoryHub) -> Iterator[CountedMedia]:
    with create("memory", "viewer", hub) as transport:
        yield CountedMedia(transport, GOOB)


@pytest.fixture
def person(hub: MemoryHub, media: CountedMedia) -> Iterator[Transport]:
    """Another client; the viewer knows what the robot offers, and notices requests."""
    with create("memory", "person", hub) as transport:
        video = {"available": True, "controls": True, "topic": f"{GOOB}/outgoing/camera"}
        capabilities = Capabilities(t=1, value={"video": video})
        transport.publish(CAPABILITIES.topic(GOOB), codec.encode(CAPABILITIES, capabilities), retain=True)
        media.wait_for_capabilities(5.0)
        media.watch_requests()
        yield transport


def test_an_encoding_of_which_nothing_arrives_is_missing(media: CountedMedia) -> None:
    black = np.zeros((2, 2, 3), np.uint8)
    for encoding in ALL_VIDEO[1:]:
        media.on_picture(Decoded(black, None, None, True, encoding))
    for encoding in ALL_SOUND[1:]:
        media.on_sound(ReceivedSound(np.zeros((320, 1), np.int16), 16_000, 1, 0, 0, encoding))
    assert media.missing() == [ALL_VIDEO[0], ALL_SOUND[0]]


def test_a_robot_that_a_person_watches_is_left_as_it_is(media: CountedMedia, person: Transport) -> None:
    requests: list[MediaRequest] = []
    topic = VIDEO_CONTROL.topic(GOOB)
    person.subscribe(topic, lambda message: requests.append(codec.decode(VIDEO_CONTROL, message.payload)))
    media.ask("video", "h264")
    assert until(lambda: len(requests) == 1)
    assert not until(lambda: media.watched, 0.1)
    person.publish(topic, codec.encode(VIDEO_CONTROL, MediaRequest(enabled=True, encoding="h264")))
    assert until(lambda: media.watched == {"video"})
    media.ask("video", "json")
    media.close()  # withdraws nothing that the person still watches
    assert not until(lambda: len(requests) > 2, 0.1)
    assert media.missing() == [], "people chose its encodings"
