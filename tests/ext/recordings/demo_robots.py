"""Recordings of the demo's robots in tests/data, and what is in them, read without the parts under test.

``drive.mcap``: four robots that are driven and stopped, from their start on, without pictures and sound.
``media.mcap``: Fred's pictures in json, pbvd, pbvz and h264, and its sound in PCM and Opus, a part of each.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pebble.extensions.recordings.files.recorded import Recorded
from pebble.extensions.recordings.library import merged
from pebble.transports import Message, QoS

_FOLDER = Path(__file__).parents[2] / "data" / "recordings"
DRIVE, MEDIA = _FOLDER / "drive.mcap", _FOLDER / "media.mcap"
ROBOTS = tuple(f"pebble/robots/{name}" for name in ("goob", "fred", "minilamp", "benjr"))
GOOB, FRED, MINILAMP, BENJR = ROBOTS


def messages(path: Path) -> list[Recorded]:
    """All of a recording, in its order."""
    return list(merged([path]))


def recorded(path: Path, topic: str) -> list[bytes]:
    """The payloads of one topic, in their order."""
    return [message.payload for message in messages(path) if message.channel.topic == topic]


def received(path: Path) -> list[tuple[float, Message]]:
    """All of a recording as a subscriber received it, with the time in seconds since its first message."""
    found = messages(path)
    return [((one.log_ns - found[0].log_ns) / 1e9, _message(one)) for one in found]


def _message(one: Recorded) -> Message:
    flags = one.channel.metadata
    return Message(one.channel.topic, one.payload, QoS(int(flags["qos"])), retain=flags.get("retained") == "1")


def values(path: Path, topic: str) -> list[dict[str, Any]]:
    """The JSON objects of one topic, in their order."""
    return [json.loads(payload) for payload in recorded(path, topic)]
