"""The analysis of recordings' traffic by their index, robot by robot."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, Final

from pebble.extensions.recordings.files.recorded import FOREVER_NS, RecordingError
from pebble.extensions.recordings.traffic.duck import connected, parquet
from pebble.extensions.recordings.traffic.queries import RobotQueries
from pebble.extensions.recordings.traffic.results import Gap, RobotTraffic, Traffic
from pebble.extensions.recordings.traffic.sources import Progress, Sources

_MEMORY_MB: Final = 192
_THREADS: Final = 2
_EVENTS: Final = """
    WITH noted AS (
        SELECT ts, event->>'$.event' AS name, event FROM {events} WHERE event IS NOT NULL AND json_valid(event)
    )
    SELECT name, epoch_ns(ts), (try_cast(event->>'$.since' AS DOUBLE) * 1e6)::BIGINT,
           (try_cast(event->>'$.until' AS DOUBLE) * 1e6)::BIGINT, event->>'$.why',
           coalesce(try_cast(event->>'$.messages' AS BIGINT), 0)
    FROM noted ORDER BY ts
"""


def analyse(
    sources: Sources,
    scratch: Path,
    *,
    since_ns: int = 0,
    until_ns: int = FOREVER_NS,
    robots: Collection[str] = (),
    progress: Progress = lambda _what, _share: None,
) -> Traffic:
    """Return the traffic from ``since_ns`` to before ``until_ns``, of the named robots or of all.

    Temporary files are made below ``scratch``. Raises RecordingError, also if there is no message.
    """
    with connected(scratch, memory_mb=_MEMORY_MB, threads=_THREADS) as connection:
        gaps, dropped = recorder_events(connection, sources.indexes, since_ns, until_ns)
        results, spans = list[RobotTraffic](), list[int]()
        names = [name for name in sources.robots if not robots or name in robots]
        for number, name in enumerate(names):
            progress(name, number / len(names))
            queries = RobotQueries(connection, name)
            queries.load(sources.indexes, since_ns, until_ns)
            messages, size, first_ns, last_ns = queries.totals()
            if messages:
                spans += [first_ns, last_ns]
                results.append(_robot(queries, name, messages, size))
        progress("", 1.0)
    if not results:
        raise RecordingError("there is no message of a robot in this period: see pebble recordings list")
    return Traffic(
        since_ns=min(spans), until_ns=max(spans), recordings=len(sources.indexes), missing=sources.missing,
        dropped=dropped, gaps=gaps, robots=results, unread=sources.unread,
    )  # fmt: skip


def _robot(queries: RobotQueries, name: str, messages: int, size: int) -> RobotTraffic:
    interval_ms = queries.interval_ms()
    return RobotTraffic(
        robot=name, machine=queries.machine, messages=messages, bytes=size, bandwidth=queries.bandwidth(),
        sessions=queries.sessions(), interval_ms=interval_ms,
        outages=[] if interval_ms is None else queries.outages(interval_ms), latency=queries.latency(),
    )  # fmt: skip


def recorder_events(connection: Any, indexes: Sequence[Path], since_ns: int, until_ns: int) -> tuple[list[Gap], int]:
    """Return the gaps that recorders noted in a period, and how many messages they dropped.

    Create the table ``breaks`` that `RobotQueries` needs: times across which no heartbeat interval can be measured.
    """
    gaps, breaks, dropped = list[Gap](), list[tuple[int, int]](), 0
    rows = connection.execute(_EVENTS.format(events=parquet(indexes))).fetchall() if indexes else []
    for event, ns, since, until, why, messages in rows:
        if event == "gap" and since is not None and until is not None and since < until_ns and until >= since_ns:
            gaps.append(Gap(since, until, why or ""))
            breaks.append((since, until))
            dropped += messages
        elif event in ("start", "clock"):
            breaks.append((ns, ns))  # nothing is known of the time before
        elif event == "dropped" and since_ns <= ns < until_ns:
            dropped += messages
    connection.execute("CREATE TEMP TABLE breaks (since_ns BIGINT, until_ns BIGINT)")
    for times in breaks:
        connection.execute("INSERT INTO breaks VALUES (?, ?)", times)
    return gaps, dropped
