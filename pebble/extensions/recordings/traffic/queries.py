"""The SQL queries of an analysis, for one robot's rows of the index."""
# ruff: noqa: S608  (what is put into queries are constants of this project, numbers, and names of files in quotes)

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pebble.contract import channels as c
from pebble.extensions.recordings.files.recorded import FOREVER_NS
from pebble.extensions.recordings.traffic import results as traffic
from pebble.extensions.recordings.traffic.activity import SESSION
from pebble.extensions.recordings.traffic.duck import parquet, quoted
from pebble.extensions.recordings.traffic.index import PICTURE, SOUND

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

_BINS, _FINEST_MS = 60, 0.5  # of histograms
_LINUX_ONLY: Final = ", ".join(
    quoted(channel.metric) for channel in (c.LOGS, c.MEDIA_STATUS, c.SOUNDBOARD_FILES, c.AUTONOMY_FILES)
)


def _percentile(value: str, share: float) -> str:
    """Return SQL for the quantile ``share`` of ``value``, interpolated linearly.

    The queried table must have ``place``, a row's number in the order of the values from 0, and ``last``, the number of
    the last row. Equal to ``quantile_cont``, which would hold all values in memory; sorting can use files.
    """
    return f"sum({value} * greatest(0, 1 - abs(place - {share} * last)))"


_FAMILY: Final = f"""CASE
    WHEN direction = '{c.OUTGOING}' AND (medium = {PICTURE} OR metric = '{c.CAMERA.metric}') THEN '{traffic.VIDEO}'
    WHEN direction = '{c.OUTGOING}' AND (medium = {SOUND} OR metric = '{c.AUDIO.metric}') THEN '{traffic.AUDIO}'
    WHEN direction = '{c.OUTGOING}' AND metric IN ('{c.ONLINE.metric}', '{c.HEARTBEAT.metric}')
        THEN '{traffic.HEARTBEATS}'
    WHEN direction = '{c.OUTGOING}' THEN '{traffic.TELEMETRY}'
    WHEN medium = {SOUND} THEN '{traffic.VOICE}'
    WHEN metric = '{c.DRIVE.metric}' THEN '{traffic.DRIVING}'
    ELSE '{traffic.CONTROL}' END"""
_SECONDS: Final = f"""
    CREATE OR REPLACE TEMP TABLE seconds AS
    SELECT epoch_ns(ts) // 1000000000 AS second, {_FAMILY} AS family, count(*) AS messages,
           sum(size)::BIGINT AS bytes, bool_or(activity BETWEEN {SESSION[0]} AND {SESSION[-1]}) AS used
    FROM messages GROUP BY ALL
"""
_HEARTBEATS: Final = f"""
    CREATE OR REPLACE TEMP TABLE heartbeats AS
    WITH received AS (
        SELECT epoch_ns(ts) AS ns, epoch_ns(stamp) AS stamp_ns,
               epoch_ns(ts) - lag(epoch_ns(ts)) OVER (ORDER BY ts) AS before
        FROM messages WHERE direction = '{c.OUTGOING}' AND metric = ? AND online IS NOT FALSE
    )
    SELECT ns, (ns - stamp_ns) / 1e6 AS latency_ms,
           if(EXISTS (FROM breaks WHERE breaks.until_ns > ns - before AND breaks.since_ns < ns), NULL, before)
           AS interval_ns
    FROM received
"""
_ONLINE: Final = f"""
    CREATE OR REPLACE TEMP TABLE online AS
    WITH numbered AS (
        SELECT ns, sum((interval_ns IS NULL OR interval_ns > {traffic.OFFLINE_AFTER_S}e9)::INT)
            OVER (ORDER BY ns) AS number FROM heartbeats
    )
    SELECT min(ns) // 1000000000 AS since, max(ns) // 1000000000 + 1 AS until
    FROM numbered GROUP BY number ORDER BY since
"""
_SESSIONS: Final = f"""
    CREATE OR REPLACE TEMP TABLE sessions AS
    WITH active AS (SELECT DISTINCT second FROM seconds WHERE used),
    begun AS (SELECT *, second - lag(second) OVER (ORDER BY second) > {traffic.SESSION_GAP_S} AS new FROM active),
    numbered AS (SELECT *, sum(coalesce(new, true)::INT) OVER (ORDER BY second) AS number FROM begun)
    SELECT min(second) - {traffic.SESSION_MARGIN_S} AS since, max(second) + 1 + {traffic.SESSION_MARGIN_S} AS until
    FROM numbered GROUP BY number ORDER BY since
"""
_BANDWIDTH: Final = f"""
    WITH placed AS (
        SELECT seconds.*, CASE WHEN sessions.until > second THEN '{traffic.SESSION}'
                               WHEN online.until > second THEN '{traffic.IDLE}' ELSE 'offline' END AS time
        FROM seconds ASOF LEFT JOIN sessions ON second >= sessions.since ASOF LEFT JOIN online ON second >= online.since
    ), summed AS (
        SELECT family, time, messages, bytes FROM placed
        UNION ALL
        SELECT '{traffic.TOTAL}', any_value(time), sum(messages), sum(bytes) FROM placed GROUP BY second
    ), timed AS (
        SELECT family, unnest(['{traffic.ALL}', time]) AS time, messages, bytes, bytes * 8 / 1000 AS kbps FROM summed
    ), ranked AS (
        SELECT *, row_number() OVER (PARTITION BY family, time ORDER BY kbps) - 1 AS place,
               count(*) OVER (PARTITION BY family, time) - 1 AS last
        FROM timed
    )
    SELECT family, time, count(*), {_percentile("kbps", 0.5)}, {_percentile("kbps", 0.95)}, sum(messages)::BIGINT,
           sum(bytes)::BIGINT
    FROM ranked GROUP BY family, time
"""
_INTERVAL: Final = f"""
    WITH ranked AS (
        SELECT interval_ns / 1e6 AS ms, row_number() OVER (ORDER BY interval_ns) - 1 AS place,
               count(*) OVER () - 1 AS last
        FROM heartbeats WHERE interval_ns <= {traffic.OFFLINE_AFTER_S}e9
    )
    SELECT {_percentile("ms", 0.5)} FROM ranked
"""
_OUTAGES: Final = f"""
    SELECT ns - interval_ns, interval_ns / 1e6 - $median FROM heartbeats
    WHERE interval_ns / 1e6 > {traffic.OUTAGE_FACTOR} * $median AND interval_ns <= {traffic.OFFLINE_AFTER_S}e9
    ORDER BY ns
"""
_PLAUSIBLE: Final = f"abs(latency_ms) <= {traffic.LARGEST_LATENCY_S}e3"
_LATENCY: Final = f"""
    WITH ranked AS (
        SELECT latency_ms AS ms, row_number() OVER (ORDER BY latency_ms) - 1 AS place,
               count(*) OVER () - 1 AS last
        FROM heartbeats WHERE {_PLAUSIBLE}
    )
    SELECT count(*), {", ".join(_percentile("ms", share) for share in (0.01, 0.5, 0.95, 0.99))}
    FROM ranked
"""
_LATENCIES: Final = f"""
    SELECT greatest(0, least({_BINS - 1}, floor((latency_ms - $low) / $width)))::INT AS bin, count(*)
    FROM heartbeats WHERE {_PLAUSIBLE} GROUP BY bin
"""
_ABOUT: Final = f"""
    SELECT bool_or(direction = '{c.OUTGOING}' AND (metric IN ({_LINUX_ONLY}) OR medium IS NOT NULL)),
           bool_or(metric = '{c.ONLINE.metric}'), bool_or(metric IN ('{c.ONLINE.metric}', '{c.HEARTBEAT.metric}'))
    FROM indexed
"""
_TOTALS: Final = """
    SELECT count(*), coalesce(sum(size), 0)::BIGINT, coalesce(epoch_ns(min(ts)), 0), coalesce(epoch_ns(max(ts)), 0)
    FROM messages
"""


class RobotQueries:
    """The queries on one robot's rows. They need the table ``breaks`` (since_ns, until_ns)."""

    def __init__(self, connection: DuckDBPyConnection, robot: str) -> None:
        self._connection, self._robot = connection, robot
        self.machine = ""  # after :meth:`load`: as in RobotTraffic

    def load(self, indexes: Sequence[Path], since_ns: int, until_ns: int) -> None:
        """Create the tables of the messages in a period."""
        robot = f"SELECT * FROM {parquet(indexes)} WHERE robot = {quoted(self._robot)}"
        indexed = f"CREATE OR REPLACE TEMP VIEW indexed AS {robot}"
        inside = ["NOT retained"]  # a message that was retained is from an earlier time
        if since_ns:
            inside.append(f"ts >= make_timestamp_ns({since_ns})")
        if until_ns < FOREVER_NS:
            inside.append(f"ts < make_timestamp_ns({until_ns})")
        self._connection.execute(indexed)
        self._connection.execute(f"CREATE OR REPLACE TEMP VIEW messages AS FROM indexed WHERE {' AND '.join(inside)}")
        linux, has_online, has_heartbeats = self._row(_ABOUT)
        if linux:
            self.machine = traffic.LINUX
        else:
            self.machine = traffic.MCU if has_heartbeats else traffic.COMPONENT
        self._connection.execute(_SECONDS)
        self._connection.execute(_HEARTBEATS, [c.ONLINE.metric if has_online else c.HEARTBEAT.metric])
        self._connection.execute(_ONLINE)
        self._connection.execute(_SESSIONS)

    def totals(self) -> tuple[int, int, int, int]:
        """Return the numbers of messages and bytes, and the first and last message's times."""
        messages, size, first, last = self._row(_TOTALS)
        return messages, size, first, last

    def bandwidth(self) -> list[traffic.Bandwidth]:
        bandwidths = [traffic.Bandwidth(*row) for row in self._rows(_BANDWIDTH)]
        order = {name: number for number, name in enumerate((*traffic.FAMILIES, *traffic.TIMES))}
        listed = [bandwidth for bandwidth in bandwidths if bandwidth.time in order]
        return sorted(listed, key=lambda bandwidth: (order[bandwidth.family], order[bandwidth.time]))

    def sessions(self) -> list[traffic.Session]:
        return [traffic.Session(since, until) for since, until in self._rows("FROM sessions")]

    def interval_ms(self) -> float | None:
        """Return the median interval between heartbeats."""
        (median,) = self._row(_INTERVAL)
        return None if median is None else float(median)

    def outages(self, median_ms: float) -> list[traffic.Outage]:
        return [traffic.Outage(*row) for row in self._rows(_OUTAGES, {"median": median_ms})]

    def latency(self) -> traffic.Latency | None:
        count, p1, median, p95, p99 = self._row(_LATENCY)
        return traffic.Latency(count, median, p95, self._histogram(p1, p99)) if count else None

    def _histogram(self, p1_ms: float, p99_ms: float) -> traffic.Histogram:
        """Return the histogram of latencies, up to a little above the 99th percentile.

        The first bin begins at 0, or below if the robot's clock is ahead.
        """
        margin = 0.1 * (p99_ms - p1_ms)
        low, high = min(0.0, p1_ms - margin), p99_ms + margin
        width = _round_up(max(_FINEST_MS, (high - low) / _BINS))
        low = low // width * width
        counts = [0] * _BINS
        for place, count in self._rows(_LATENCIES, {"low": low, "width": width}):
            counts[place] = count
        return traffic.Histogram(low, width, counts)

    def _rows(self, query: str, parameters: Any = None) -> list[Any]:
        return self._connection.execute(query, parameters).fetchall()

    def _row(self, query: str) -> Any:
        return self._connection.execute(query).fetchone()


def _round_up(value: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 1e-3
    while True:
        for step in (1, 2, 5):
            if step * power >= value:
                return step * power
        power *= 10
