"""Levels of a link, with the traffic that each allows. The robot publishes its level as ``outgoing/link``.

Source: measured over 64, 19.2 and 9.6 kbit/s (docs/thin-links.md).
"""

from collections.abc import Mapping
from typing import Final

from msgspec import Struct

from pebble.contract.payloads import LinkLevel

INTERVAL_S: Final = 1.0  # assumed between heartbeats: most robots send four a second


class Level(Struct, frozen=True, kw_only=True):
    """The traffic that one level allows. A QoS of None is the channel's own.

    At every level, a message that ends something (a zero, a release) is sent at once, with QoS 1.
    """

    drive_hz: float  # commands of one operator, a second
    drive_qos: int | None = None
    valid_ms: int = 400  # of a drive command, in milliseconds
    heartbeat_s: float = 0.0  # between two heartbeats, at least
    heartbeat_qos: int | None = None
    stream_hz: float | None = None  # of each stream, at most; None: all messages
    silent_s: float = 0.0  # a robot counts as silent after this at the earliest
    answer_s: float = 2.0  # a robot that has not answered by then will not answer
    stamped: bool = False  # drive commands have their own age, by ``t`` and ``key``


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
    """Return the seconds without a heartbeat after which a robot counts as silent.

    The robot sends a heartbeat every ``interval_s``; on the way it takes up to ``late_s``. ``link``: the level that the
    robot has published, if known.
    """
    return max(2 * interval_s, 4 * late_s, LEVELS[link].silent_s)
