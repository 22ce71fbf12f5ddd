"""Between two machines: round trips to an echo, and one-way times as precise as the two clocks allow.

The offset between the clocks, and its error, is estimated from the messages. None can arrive before it is sent. So the
far clock is ahead by at most t2 - t1 (if the way there took no time) and by at least t3 - t4 (if the way back took
none). Each exchange gives these bounds; the fastest ones give the tightest. How the remaining time is divided between
the two ways is unknown: that is the error.
"""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from typing import NamedTuple

from rich.console import Console

from pebble.bench.comparison import Case, Run
from pebble.bench.control import ends
from pebble.bench.control.ends import ROUND_TRIP, Clock, Desk, Exchange, Sender, SliceSpec
from pebble.bench.results import Cell, percentile, rounded
from pebble.bench.tables import LOST, Grid, percentile_column, single_column
from pebble.client.connection import password
from pebble.client.url import settings_of as url_settings
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports import MqttSettings, create

VARIANT = "mqtt"
THERE, BACK = "one-way there", "one-way back"
#: The largest relative drift: quartz is within 50 ppm on each side unless NTP slews it.
DRIFT = 100e-6
LEAST = 8  # exchanges, to compare two clocks
_WARM_UP, ANSWER_S = 10, 10.0  # messages


def settings_of(url: str) -> MqttSettings:
    """Raises PebbleError for another kind of URL."""
    _, settings = url_settings(url, password=password(None))
    if not isinstance(settings, MqttSettings):
        raise PebbleError(f"{url}: between machines only MQTT is measured: mqtt://HOST[:PORT] or mqtts://HOST[:PORT]")
    return settings


def opened(url: str, what: str, desk: Desk) -> ends.Connection:
    """Each run has a client id of its own: several may share one broker. Raises PebbleError."""
    return ends.opened(create("mqtt", f"bench-{what}-{secrets.token_hex(4)}", settings_of(url)), desk)


def wall_clock() -> Clock:
    """Wall-clock time, ns, that is neither set nor slewed from now on: NTP may slew CLOCK_MONOTONIC by 500 ppm."""
    since = time.time_ns() - time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
    return lambda: time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW) + since


def serve(url: str, clock: Clock | None = None) -> int:
    """Runs an echo until Ctrl-C. Raises PebbleError without a broker."""
    desk = Desk()
    with interrupted_by_signals(), closing(opened(url, "echo", desk)) as connection:
        ends.echo(connection, "+", clock or wall_clock())
        Console().print(f"Echo through {url}, until Ctrl-C", highlight=False)
        while True:
            desk.turn()


class Offset(NamedTuple):
    """The far clock is ahead of ours by ``ns`` ± ``error_ns`` during all of the exchanges."""

    ns: float = math.nan
    error_ns: float = math.inf


def estimate(exchanges: Sequence[Exchange]) -> Offset:
    """Unknown for fewer than ``LEAST`` exchanges, or if a clock was set meanwhile. Drift adds to the error."""
    if len(exchanges) < LEAST:
        return Offset()
    begin, end = min(one.t1 for one in exchanges), max(one.t4 for one in exchanges)
    middle = (begin + end) // 2
    most = min(one.t2 - one.t1 + DRIFT * abs(one.t1 - middle) for one in exchanges)
    least = max(one.t3 - one.t4 - DRIFT * abs(one.t4 - middle) for one in exchanges)
    error = (most - least) / 2 + DRIFT * (end - begin) / 2
    return Offset(round((most + least) / 2), round(error) + 1) if least <= most else Offset()  # 1: for rounding


# -- the side that measures


def prepare(run: Run) -> None:
    if run["variants"] != [VARIANT] or run["loads"] or run.options.get("null"):
        raise PebbleError("--variants, --loads and --null have no use with --far: there is one variant")
    settings_of(run["far"])


@contextmanager
def environment(run: Run) -> Iterator[Sender]:
    """A sender whose echo answers. Raises PebbleError without an echo."""
    desk = Desk()
    with closing(opened(run["far"], "sender", desk)) as connection:
        sender = Sender(connection, secrets.token_hex(4), wall_clock(), desk)
        run.show("waiting for the echo")
        if not sender.warm_up(_WARM_UP, ANSWER_S):
            raise PebbleError("no echo answers there: run `pebble bench echo URL` on the other machine")
        yield sender


def measure(case: Case) -> Iterator[Cell]:
    """One slice, in ms. The clocks are compared in each slice, before they drift far.

    Round trips are without the processing time of the echo, so that the two one-way times add up to them. One-way times
    whose median the clocks' error exceeds are unknown.
    """
    done = case.env.run(SliceSpec.of(case))
    offset = estimate(done.exchanges)
    trips = [(one.t4 - one.t1 - (one.t3 - one.t2)) / 1e6 for one in done.exchanges]
    yield case.cell(ROUND_TRIP, "ms", trips, sent=done.sent, late=done.late)
    there = [(one.t2 - one.t1 - offset.ns) / 1e6 for one in done.exchanges]
    back = [(one.t4 - one.t3 + offset.ns) / 1e6 for one in done.exchanges]
    offset_ms, error_ms = (rounded(ns / 1e6, 6) for ns in offset)
    for name, times in ((THERE, there), (BACK, back)):
        known = percentile(times, 50) > offset.error_ns / 1e6
        yield case.cell(name, "ms", times if known else [], clock_offset_ms=offset_ms, clock_error_ms=error_ms)


TABLE = Grid(
    title="Between two machines, ms; how far ahead the far clock is, ± the error of one-way times",
    rows=("size", "rate", "measure"),
    columns=(
        percentile_column(50),
        percentile_column(99),
        LOST,
        single_column("far clock", "clock_offset_ms", "+.3f"),
        single_column("±", "clock_error_ms", ".3f"),
    ),
)
