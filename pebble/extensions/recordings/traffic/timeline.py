"""A day of one robot, in steps: its activity, sessions, outages and gaps."""
# ruff: noqa: S608  (what is put into queries are constants of this project and numbers)

from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field

from pebble.contract.channels import HEARTBEAT, ONLINE, OUTGOING
from pebble.extensions.recordings.traffic.activity import Activity
from pebble.extensions.recordings.traffic.analysis import recorder_events
from pebble.extensions.recordings.traffic.duck import connected
from pebble.extensions.recordings.traffic.index import PICTURE, SOUND
from pebble.extensions.recordings.traffic.queries import RobotQueries
from pebble.extensions.recordings.traffic.sources import Progress, sources

STEP_S: Final = 10
_MEMORY_MB: Final = 128
#: What a step may show, as bits.
ONLINE_BIT, DRIVE_BIT, LIGHTS_BIT, SOUND_BIT, SCRIPT_BIT, WARNING_BIT, PICTURES_BIT, VOICE_BIT = (
    1 << number for number in range(8)
)
_BITS: Final = {
    Activity.DRIVE: DRIVE_BIT,
    Activity.LIGHTS: LIGHTS_BIT,
    Activity.SOUND: SOUND_BIT,
    Activity.AUTONOMY: SCRIPT_BIT,
    Activity.WARNING: WARNING_BIT,
}


_CASES: Final = " ".join(f"WHEN {activity.value} THEN {bit}" for activity, bit in _BITS.items())
_ACTIVITY: Final = f"""
    SELECT epoch_ns(ts) // {STEP_S}000000000 AS step, bit_or(
        CASE activity {_CASES} ELSE 0 END
        | CASE WHEN direction = '{OUTGOING}' AND metric IN ('{ONLINE.metric}', '{HEARTBEAT.metric}')
                    AND online IS NOT FALSE THEN {ONLINE_BIT}
               WHEN direction = '{OUTGOING}' AND medium = {PICTURE} THEN {PICTURES_BIT}
               WHEN direction = '{OUTGOING}' AND medium = {SOUND} THEN {VOICE_BIT}
               ELSE 0 END)
    FROM messages GROUP BY step
"""


class Stretch(Struct, frozen=True):
    """A period in epoch milliseconds; ``why``: the cause of a gap."""

    since: float
    until: float
    why: str = ""


class Timeline(Struct, rename={"from_ms": "from"}):
    """A day. ``activity`` has a number for each step from ``from_ms`` (epoch milliseconds) on."""

    from_ms: int
    step: int = 1000 * STEP_S
    activity: list[int] = field(default_factory=list)
    gaps: list[Stretch] = field(default_factory=list)
    outages: list[Stretch] = field(default_factory=list)
    sessions: list[Stretch] = field(default_factory=list)


def timeline(
    paths: list[Path], scratch: Path, robot: str, since_ns: int, until_ns: int, progress: Progress
) -> Timeline:
    """Return a robot's day from the recordings ``paths``; missing indexes are made. Raises RecordingError."""
    indexed = sources(paths, scratch, progress)
    with connected(scratch, memory_mb=_MEMORY_MB) as connection:
        noted_gaps, _ = recorder_events(connection, indexed.indexes, since_ns, until_ns)
        gaps = [Stretch(_ms(gap.since_ns), _ms(gap.until_ns), gap.why) for gap in noted_gaps]
        if robot not in indexed.robots:
            return Timeline(since_ns // 10**6, gaps=gaps)
        queries = RobotQueries(connection, robot)
        queries.load(indexed.indexes, since_ns, until_ns)
        day = _day_of_activity(connection)
        day.gaps = gaps
        day.sessions = [Stretch(1000 * session.since_s, 1000 * session.until_s) for session in queries.sessions()]
        interval_ms = queries.interval_ms()
        for outage in () if interval_ms is None else queries.outages(interval_ms):
            day.outages.append(Stretch(_ms(outage.since_ns), _ms(outage.since_ns) + outage.length_ms))
    return day


def _day_of_activity(connection: Any) -> Timeline:
    """Return the day with its activity alone, from the first step with a message to the last."""
    activity = dict(connection.execute(_ACTIVITY).fetchall())
    if not activity:
        return Timeline(0)
    first = min(activity)
    count = max(activity) - first + 1
    day = Timeline(1000 * STEP_S * first)
    day.activity = [activity.get(first + number, 0) for number in range(count)]
    return day


def _ms(ns: int) -> float:
    return round(ns / 1e6, 3)
