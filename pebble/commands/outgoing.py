"""A message about to be published by hand: what the contract says about it, and what it will not allow."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pebble import codec
from pebble.commands.names import Names
from pebble.contract import OUTGOING, Channel, Kind
from pebble.errors import PayloadError, PebbleError
from pebble.transports.topics import check_topic

_NEVER_KEPT = (Kind.COMMAND, Kind.ACTION, Kind.FEED)


@dataclass(frozen=True, slots=True)
class Draft:
    """What is to be sent, and what the user should know before."""

    topic: str
    payload: bytes
    qos: int
    retain: bool
    doubts: tuple[str, ...]


def draft(names: Names, name: str, text: str, *, retain: bool | None, qos: int | None, force: bool) -> Draft:
    """Fill in what the contract says. Raises PebbleError for a kept command, unless forced or empty."""
    topic = check_topic(names.topic(name))
    channel = names.channel(topic)
    payload = _payload(text)
    if channel is None:
        doubts: tuple[str, ...] = (f"{topic} is not in the contract",)
        return Draft(topic, payload, 1 if qos is None else qos, bool(retain), doubts)
    if retain and payload and channel.kind in _NEVER_KEPT and not force:
        raise PebbleError(
            f"{channel.metric} is a command: a kept copy would be stale, and robots refuse it; "
            "leave --retain out (--force sends it all the same)"
        )
    return Draft(
        topic,
        payload,
        channel.default_qos if qos is None else qos,
        channel.default_retain if retain is None else retain,
        tuple(_doubts(channel, payload)),
    )


def _payload(text: str) -> bytes:
    if not text.startswith("@"):
        return text.encode(errors="surrogateescape")  # bytes of the command line that are not UTF-8 stay what they are
    try:
        return Path(text[1:]).read_bytes()
    except OSError as error:
        raise PebbleError(f"{text}: {error.strerror}") from None


def _doubts(channel: Channel, payload: bytes) -> list[str]:
    found = []
    if channel.direction == OUTGOING:
        found.append(f"{channel.metric} is what a robot says; you are speaking in its place")
    if channel.synonym_of is not None:
        found.append(f"{channel.metric} is an older name of {channel.synonym_of}")
    if payload:
        try:
            codec.decode(channel, payload)
        except PayloadError as error:
            found.append(f"robots will refuse this: {error}")
    return found
