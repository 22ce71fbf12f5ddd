"""What a robot and its operators send on a link of each level: the robot publishes the level as ``outgoing/link``.

Source: measured over 64, 19.2 and 9.6 kbit/s (docs/thin-links.md).
"""

from collections.abc import Mapping
from typing import Final

from msgspec import Struct

from pebble.contract import codec
from pebble.contract.channels import LINK
from pebble.contract.payloads import LinkLevel, LinkState
from pebble.errors import PayloadError

INTERVAL_S: Final = 1.0  # between heartbeats, of a robot of which it is not known: most send four a second


class Level(Struct, frozen=True, kw_only=True):
    """``drive_qos`` and ``heartbeat_qos`` None: as without levels. What ends something is QoS 1, at once, at each."""

    drive_hz: float  # commands of one operator, a second
    drive_qos: int | None = None
    valid_ms: int = 400  # of a drive command, in milliseconds
    heartbeat_s: float = 0.0  # at least, between two
    heartbeat_qos: int | None = None
    stream_hz: float | None = None  # of each stream at most, the newest; None: all of it
    silent_s: float = 0.0  # a robot is not called silent before
    answer_s: float = 2.0  # a robot that has not answered by then will not
    stamped: bool = False  # drive commands tell their own age, by ``t`` and ``key``


LEVELS: Mapping[LinkLevel, Level] = {
    "wide": Level(drive_hz=20),
    "narrow": Level(drive_hz=10, drive_qos=0, heartbeat_s=1.0, stream_hz=5, silent_s=3.0, answer_s=10.0, stamped=True),
    "thin": Level(
        drive_hz=4,
        drive_qos=0,
        valid_ms=750,
        heartbeat_s=1.0,
        heartbeat_qos=0,
        stream_hz=1,
        silent_s=5.0,
        answer_s=10.0,
        stamped=True,
    ),
}


def silent_after(interval_s: float = INTERVAL_S, link: LinkLevel = "wide", late_s: float = 0.0) -> float:
    """Return seconds without a heartbeat after which a robot counts as silent.

    ``interval_s`` is between its heartbeats, which come ``late_s`` late; ``link`` is what it publishes. Who has not
    heard of its link takes the default.
    """
    return max(2 * interval_s, 4 * late_s, LEVELS[link].silent_s)


def link_of(payload: bytes) -> LinkState | None:
    """Return what a message on ``outgoing/link`` reports; None where it is removed, or cannot be read."""
    try:
        return codec.decode(LINK, payload) if payload else None
    except PayloadError:
        return None
