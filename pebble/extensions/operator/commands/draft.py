"""A message to publish by hand, completed and checked by the contract."""

from dataclasses import dataclass
from pathlib import Path

from pebble.contract import OUTGOING, Channel, Kind, codec
from pebble.errors import PayloadError, PebbleError
from pebble.extensions.operator.client.names import Names
from pebble.transports.topics import check_topic

_NEVER_RETAINED = (Kind.COMMAND, Kind.ACTION, Kind.FEED)


@dataclass(frozen=True, slots=True)
class Draft:
    """A message to publish, with warnings for the user."""

    topic: str
    payload: bytes
    qos: int
    retain: bool
    warnings: tuple[str, ...]


def draft(names: Names, name: str, text: str, *, retain: bool | None, qos: int | None, force: bool) -> Draft:
    """Return a message completed by the contract. Raises PebbleError for a retained command, unless forced or empty."""
    topic = check_topic(names.topic(name))
    channel = names.channel(topic)
    payload = _payload(text)
    if channel is None:
        warnings: tuple[str, ...] = (f"{topic} is not in the contract",)
        return Draft(topic, payload, 1 if qos is None else qos, bool(retain), warnings)
    if retain and payload and channel.kind in _NEVER_RETAINED and not force:
        raise PebbleError(
            f"{channel.metric} is a command: robots refuse retained commands because they are stale; "
            "leave --retain out (--force sends it anyway)"
        )
    return Draft(
        topic,
        payload,
        channel.default_qos if qos is None else qos,
        channel.default_retain if retain is None else retain,
        tuple(_warnings(channel, payload)),
    )


def _payload(text: str) -> bytes:
    if not text.startswith("@"):
        return text.encode(errors="surrogateescape")  # bytes that are not UTF-8 stay unchanged
    try:
        return Path(text[1:]).read_bytes()
    except OSError as error:
        raise PebbleError(f"{text}: {error.strerror}") from None


def _warnings(channel: Channel, payload: bytes) -> list[str]:
    warnings = []
    if channel.direction == OUTGOING:
        warnings.append(f"{channel.metric} is published by robots; this message replaces the robot's")
    if channel.synonym_of is not None:
        warnings.append(f"{channel.metric} is an older name of {channel.synonym_of}")
    if payload:
        try:
            codec.decode(channel, payload, lambda _channel, _sender, text: warnings.append(text))
        except PayloadError as error:
            warnings.append(f"robots will refuse this: {error}")
    return warnings
