"""What an as-published connection makes of messages that may be kept copies or news."""

from __future__ import annotations

from pebble.transports import Message
from pebble.transports.mqtt_as_published import AsPublished


def kept(payload: bytes, topic: str = "flag") -> Message:
    return Message(topic, payload, retain=True)


def test_what_we_said_comes_back_as_an_echo_until_somebody_says_otherwise() -> None:
    memory = AsPublished()
    memory.say(kept(b"true"))
    assert memory.is_echo(kept(b"true"))
    assert not memory.is_echo(kept(b"false"))
    assert not memory.is_echo(kept(b"true"))
    memory.say(kept(b"true"))
    memory.begin()
    assert memory.is_echo(kept(b"true"))
    assert not memory.is_echo(kept(b"true", "other"))


def test_a_copy_is_a_repeat_only_when_one_is_due() -> None:
    memory = AsPublished()
    assert not memory.is_repeat(kept(b"1"))
    assert not memory.is_repeat(kept(b"1"))  # somebody said the same again: that is news
    memory.subscribe_again("#")
    assert memory.is_repeat(kept(b"1"))
    assert not memory.is_repeat(kept(b"1"))


def test_news_that_overtakes_a_due_copy_is_delivered() -> None:
    memory = AsPublished()
    memory.is_repeat(kept(b"1"))
    memory.is_repeat(kept(b"1", "elsewhere"))
    memory.subscribe_again("flag")
    assert not memory.is_repeat(kept(b"2"))
    assert memory.is_repeat(kept(b"2"))
    assert not memory.is_repeat(kept(b"1", "elsewhere"))


def test_a_new_connection_starts_afresh() -> None:
    memory = AsPublished()
    memory.is_repeat(kept(b"1"))
    memory.subscribe_again("#")
    memory.begin()
    assert not memory.is_repeat(kept(b"1"))
