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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from msgspec.structs import replace
from rich.console import Console

from pebble.bench.aims import single
from pebble.bench.comparison import Case, Combine, Run, of_known
from pebble.bench.control_ends import (
    ROUND_TRIP,
    Clock,
    Connection,
    Desk,
    Echo,
    Exchange,
    Sender,
    SliceSpec,
    opened,
    rate_name,
    size_name,
)
from pebble.bench.results import Cell, Value
from pebble.bench.tables import Column, Grid, figure
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports import MqttSettings, create

VARIANT = "mqtt"
THERE, BACK = "one-way there", "one-way back"
MEASURES = (ROUND_TRIP, THERE, BACK)
#: The largest relative drift: quartz is within 50 ppm on each side unless NTP slews it.
DRIFT = 100e-6
LEAST = 8  # exchanges, to compare two clocks
_SIZES, _RATES = (40, 1024), (20.0, 200.0)
_WARM_UP = 10  # messages
_ANSWER_S = 10.0  # to exchange these with the echo
_POLL_S = 0.5


def settings_of(url: str, password_file: Path | None, ca_cert: Path | None) -> MqttSettings:
    """Raises PebbleError for another kind of URL."""
    from pebble.client.connection import password
    from pebble.client.url import settings_of

    _, settings = settings_of(url, password=password(password_file), ca_cert=ca_cert)
    if not isinstance(settings, MqttSettings):
        raise PebbleError(f"{url}: between machines only MQTT is measured: mqtt://HOST[:PORT] or mqtts://HOST[:PORT]")
    return settings


def wall_clock() -> Clock:
    """Wall-clock time, ns, that is neither set nor slewed from now on: NTP may slew CLOCK_MONOTONIC by 500 ppm."""
    since = time.time_ns() - time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
    return lambda: time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW) + since


def serve(settings: MqttSettings, clock: Clock | None = None) -> int:
    """Runs an echo until Ctrl-C. Raises PebbleError without a broker."""
    console, desk = Console(), Desk()
    with interrupted_by_signals(), closing(_connection(settings, "echo", desk)) as connection:
        echo, through = Echo(connection, "+", clock or wall_clock()), f"through {settings.host}:{settings.port}"
        console.print(f"Echo {through}, until Ctrl-C", highlight=False)
        with console.status("") as status:
            while True:
                status.update(f"echo {through}, {echo.count} messages so far; Ctrl-C ends it")
                desk.turn(_POLL_S)


def _connection(settings: MqttSettings, what: str, desk: Desk) -> Connection:
    """Opens a connection with a client id of its own: several runs may share one broker."""
    return opened(create("mqtt", f"bench-{what}-{secrets.token_hex(4)}", settings), desk)


# -- the offset of the clocks


@dataclass(frozen=True, slots=True)
class Offset:
    """The far clock is ahead of ours by ``ns`` ± ``error_ns`` during all of the exchanges."""

    ns: int
    error_ns: int


def estimate(exchanges: Sequence[Exchange]) -> Offset:
    """Works best over some seconds: drift adds to the error with time.

    Raises PebbleError for fewer than ``LEAST`` exchanges, or if a clock was set meanwhile.
    """
    if len(exchanges) < LEAST:
        raise PebbleError(f"{len(exchanges)} messages came back: comparing two clocks needs at least {LEAST}")
    begin, end = min(one.t1 for one in exchanges), max(one.t4 for one in exchanges)
    middle = (begin + end) // 2
    most = min(one.t2 - one.t1 + DRIFT * abs(one.t1 - middle) for one in exchanges)
    least = max(one.t3 - one.t4 - DRIFT * abs(one.t4 - middle) for one in exchanges)
    if least > most:
        raise PebbleError("the two clocks are inconsistent: one of them was set during the measurement; measure again")
    error = (most - least) / 2 + DRIFT * (end - begin) / 2
    return Offset(round((most + least) / 2), round(error) + 1)  # 1: for rounding


def one_way_ns(exchange: Exchange, offset: Offset) -> tuple[int, int]:
    """The times there and back, each ± the offset's error."""
    return exchange.t2 - exchange.t1 - offset.ns, exchange.t4 - exchange.t3 + offset.ns


# -- the side that measures


def conditions(run: Run) -> list[dict[str, Value]]:
    sizes, rates = (_SIZES[:1], _RATES[1:]) if run.quick else (_SIZES, _RATES)
    return [
        {"size": size_name(size), "rate": rate_name(rate)}
        for size in run["sizes"] or sizes
        for rate in run["rates"] or rates
    ]


def prepare(run: Run) -> None:
    for name, given in (("variants", run["variants"] != [VARIANT]), ("loads", run["loads"]), ("null", run["null"])):
        if given:
            raise PebbleError(f"--{name} has no use with --far: there is one variant, between two machines")
    _settings(run)


def _settings(run: Run) -> MqttSettings:
    return settings_of(run["far"], run["password-file"], run["ca-cert"])


@contextmanager
def environment(run: Run) -> Iterator[Sender]:
    """A sender whose echo answers. Raises PebbleError without an echo."""
    settings, desk = _settings(run), Desk()
    with closing(_connection(settings, "sender", desk)) as connection:
        sender = Sender(connection, secrets.token_hex(4), wall_clock(), desk)
        run.show("waiting for the echo")
        if not sender.warm_up(_WARM_UP, _ANSWER_S):
            raise PebbleError(
                f"no echo answers through {settings.host}:{settings.port}: "
                "run `pebble bench echo URL` on the other machine"
            )
        yield sender


def measure(case: Case) -> Iterator[Cell]:
    """One slice, in ms. The clocks are compared in each slice, before they drift far.

    Round trips are without the processing time of the echo, so that the two one-way times add up to them.
    """
    sent, late, exchanges = case.env.run(SliceSpec.of(case))
    trips = [(one.t4 - one.t1 - (one.t3 - one.t2)) / 1e6 for one in exchanges]
    yield case.cell(ROUND_TRIP, "ms", trips, sent=sent, late=late)
    clocks: dict[str, Any] = {"clock_offset_ms": None, "clock_error_ms": None}
    ways: list[tuple[int, int]] = []
    try:
        offset = estimate(exchanges)
    except PebbleError:  # too few, or a clock was set: the round trips are still valid
        pass
    else:
        ways = [one_way_ns(one, offset) for one in exchanges]
        clocks = {"clock_offset_ms": offset.ns / 1e6, "clock_error_ms": offset.error_ns / 1e6}
    for which, name in enumerate((THERE, BACK)):
        yield case.cell(name, "ms", [way[which] / 1e6 for way in ways], sent=sent, late=late, **clocks)


JOINED: Mapping[str, Combine] = {
    "late": sum,
    "clock_offset_ms": of_known(median, 6),  # ns
    "clock_error_ms": of_known(max, 6),
}
_OFFSET_MS, _ERROR_MS = single("clock_offset_ms"), single("clock_error_ms")


def derived(cells: list[Cell]) -> list[Cell]:
    """The clock error is one of the conditions, so that no value and no curve is shown without it.

    One-way times that it exceeds are unknown.
    """
    return [
        cell if cell.measure == ROUND_TRIP else replace(
            cell,
            params={**cell.params, "clocks": f"± {figure(_ERROR_MS(cell))} ms"},
            rounds=[one if cell.percentile(50) > _ERROR_MS(cell) else [] for one in cell.rounds],  # NaN: unknown
        )
        for cell in cells
    ]  # fmt: skip


def _both(cell: Cell) -> str:
    return f"{figure(cell.percentile(50))}/{figure(cell.percentile(99))}" if cell.samples else "unknown"


TABLES = (
    Grid(
        title="Between two machines, ms: p50/p99",
        rows=("size", "rate"),
        columns=(
            Column("round trip", _both, ROUND_TRIP),
            Column("there", _both, THERE),
            Column("back", _both, BACK),
            Column("±", lambda cell: figure(_ERROR_MS(cell)), THERE),
            Column("lost", lambda cell: str(cell.lost), ROUND_TRIP),
        ),
    ),
)


def assessment(cells: Sequence[Cell]) -> Iterator[str]:
    """One sentence for each result."""
    for trip in (cell for cell in cells if cell.measure == ROUND_TRIP):
        ways = [cell for cell in cells if cell is not trip and trip.params.items() <= cell.params.items()]
        what, error_ms = f"{trip.params['size']} at {trip.params['rate']}", _ERROR_MS(ways[0])
        error = f"± {figure(error_ms)} ms"
        yield f"{what}: {_both(trip)} ms there and back (p50/p99)"
        if math.isnan(error_ms):
            yield f"{what}: too few replies to compare the clocks: one-way times are unknown"
            continue
        yield f"{what}: the far clock is {_OFFSET_MS(ways[0]):+.3f} ms from ours, {error}"
        for way in ways:
            unknown = f"unknown: below the clock error of {error}"
            yield f"{what}: {way.measure}: {f'{_both(way)} ms {error}' if way.samples else unknown}"
