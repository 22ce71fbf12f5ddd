"""Between two machines: round trips to an echo elsewhere, and one-way times as well as the two clocks allow."""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console
from rich.table import Table

from pebble.bench.clock import Offset, estimate, one_way_ns
from pebble.bench.control_ends import Clock, Echo, Order, Sender, TransportLink
from pebble.bench.control_plan import check_slices, command_of, rate_name, size_name
from pebble.bench.control_report import ROUND_TRIP
from pebble.bench.control_wire import Exchange
from pebble.bench.figures import percentile, rounded
from pebble.bench.output import FOLDER, check_folder, finish
from pebble.bench.results import Cell, Stopwatch, Value
from pebble.bench.tables import figure, plain_table
from pebble.errors import PebbleError
from pebble.inbox import Inbox
from pebble.signals import interrupted_by_signals
from pebble.transports import MqttSettings, create

VARIANT = "mqtt"
THERE, BACK = "one-way there", "one-way back"
_SIZES, _RATES = (40, 1024), (20.0, 200.0)
_SECONDS, _ROUNDS, _QUICK_SECONDS, _QUICK_ROUNDS = 2.0, 10, 1.0, 4
_WARM_UP = 10  # messages
_ANSWER_S = 10.0  # until the echo has answered so many
_LOOK_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class FarPlan:
    """Slices of ``seconds``: the clocks are compared in each of them anew, before they can drift far."""

    sizes: Sequence[int] = _SIZES
    rates: Sequence[float] = _RATES
    seconds: float = _SECONDS
    rounds: int = _ROUNDS
    quick: bool = False
    output: Path = FOLDER
    command: Sequence[str] = ()

    @staticmethod
    def of(
        *,
        sizes: Sequence[int] | None = None,
        rates: Sequence[float] | None = None,
        seconds: float | None = None,
        rounds: int | None = None,
        quick: bool = False,
        output: Path = FOLDER,
    ) -> FarPlan:
        """What the command line asks for. Raises PebbleError naming what makes no sense.

        The command that is remembered says URL: results name no hosts.
        """
        asked = {"far": "URL", "sizes": sizes, "rates": rates, "seconds": seconds, "rounds": rounds}
        plan = FarPlan(
            sizes=sizes or (_SIZES[:1] if quick else _SIZES),
            rates=rates or (_RATES[1:] if quick else _RATES),
            seconds=seconds if seconds is not None else _QUICK_SECONDS if quick else _SECONDS,
            rounds=rounds if rounds is not None else _QUICK_ROUNDS if quick else _ROUNDS,
            quick=quick,
            output=output,
            command=command_of(asked, quick=quick),
        )
        check_slices(plan.sizes, plan.rates, plan.seconds, plan.rounds)
        return plan


@dataclass(slots=True)
class Way:
    """One size at one rate, over the rounds."""

    size: int
    rate: float
    sent: int = 0
    late: int = 0
    rounds: list[list[Exchange]] = field(default_factory=list)
    offsets: list[Offset | None] = field(default_factory=list)  # one for each round; None: too little came back

    @property
    def params(self) -> dict[str, Value]:
        return {"size": size_name(self.size), "rate": rate_name(self.rate)}

    @property
    def error_ms(self) -> float:
        """The worst of all rounds; NaN if the clocks could never be compared."""
        return max((offset.error_ns / 1e6 for offset in self.offsets if offset is not None), default=math.nan)

    @property
    def ahead_ms(self) -> float:
        return percentile([offset.ns / 1e6 for offset in self.offsets if offset is not None], 50)


def wall_clock() -> Clock:
    """This machine's time of day, ns; from now on neither set nor slewed: NTP may slew CLOCK_MONOTONIC by 500 ppm."""
    since = time.time_ns() - _quartz_ns()
    return lambda: _quartz_ns() + since


def _quartz_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


def serve(settings: MqttSettings, clock: Clock | None = None, console: Console | None = None) -> int:
    """Echo until Ctrl-C. Raises PebbleError without a broker."""
    console, inbox = console or Console(), Inbox()
    with interrupted_by_signals(), closing(_link(settings, "echo", inbox)) as link:
        echo = Echo(link, "+", clock or wall_clock())
        console.print(f"Echo by way of {settings.host}:{settings.port}, until Ctrl-C", highlight=False)
        with console.status("") as status:
            while True:
                status.update(
                    f"echo by way of {settings.host}:{settings.port}, {echo.count} messages so far; Ctrl-C ends it"
                )
                end = time.monotonic() + _LOOK_S
                while (left := end - time.monotonic()) > 0:
                    job = inbox.take(left)
                    if job is not None:
                        job()


def measure(plan: FarPlan, settings: MqttSettings, console: Console | None = None) -> int:
    """Measure against an echo, show and write; 0 if every round trip has figures. Raises PebbleError."""
    console, inbox = console or Console(), Inbox()
    check_folder(plan.output)
    options: dict[str, Value | list[Value]] = {"seconds": plan.seconds, "rounds": plan.rounds}
    watch = Stopwatch("control-far", plan.command, options)
    ways = [Way(size, rate) for size in plan.sizes for rate in plan.rates]
    with interrupted_by_signals(), closing(_link(settings, "sender", inbox)) as link:
        sender = Sender(link, secrets.token_hex(4), wall_clock(), inbox)
        with console.status("waiting for the echo") as status:
            if not sender.warm_up(_WARM_UP, _ANSWER_S):
                raise PebbleError(
                    f"nobody echoes by way of {settings.host}:{settings.port}: "
                    "run `pebble bench echo URL` on the other machine"
                )
            for number in range(plan.rounds):
                for way in ways[:: -1 if number % 2 else 1]:
                    status.update(f"round {number + 1} of {plan.rounds}: {', '.join(map(str, way.params.values()))}")
                    _slice(sender, way, plan.seconds)
    cells = [cell for way in ways for cell in cells_of(way)]
    console.print(_table(ways))
    finish(watch.results(cells, verdict(ways), quick=plan.quick), plan.output, console)
    return 0 if all(cell.samples for cell in cells if cell.measure == ROUND_TRIP) else 1


def _link(settings: MqttSettings, what: str, inbox: Inbox) -> TransportLink:
    """Client ids are this run's own: several may measure by way of one broker."""
    return TransportLink(create("mqtt", f"bench-{what}-{secrets.token_hex(4)}", settings), inbox)


def _slice(sender: Sender, way: Way, seconds: float) -> None:
    sent, late, exchanges = sender.run(Order(size=way.size, rate=way.rate, seconds=seconds))
    try:
        way.offsets.append(estimate(exchanges))
    except PebbleError:  # too few, or a clock was set: the round trips are good all the same
        way.offsets.append(None)
    way.rounds.append(exchanges)
    way.sent, way.late = way.sent + sent, way.late + late


def round_trips(way: Way) -> list[list[float]]:
    """In ms, and without the time the echo itself took: so that the two ways add up to it."""
    return [[(one.t4 - one.t1 - (one.t3 - one.t2)) / 1e6 for one in exchanges] for exchanges in way.rounds]


def one_ways(way: Way) -> tuple[list[list[float]], list[list[float]]]:
    """There and back, in ms, each round by its own offset; no samples where the clocks' error hides the latency."""
    known = [(one, offset) for one, offset in zip(way.rounds, way.offsets, strict=True) if offset is not None]
    both = [[[one_way_ns(one, offset)[which] / 1e6 for one in all_] for all_, offset in known] for which in (0, 1)]
    there, back = ([] if _hidden(rounds, way.error_ms) else rounds for rounds in both)
    return there, back


def _hidden(rounds: Sequence[Sequence[float]], error_ms: float) -> bool:
    return not percentile([sample for one in rounds for sample in one], 50) > error_ms  # nor if either is NaN


def cells_of(way: Way) -> list[Cell]:
    """The clocks' error is one of the conditions, so that no figure and no curve is shown without it."""
    figures: dict[str, Value] = {"sent": way.sent, "late": way.late}
    clocks: dict[str, Value] = {
        "clock_offset_ms": rounded(way.ahead_ms, 3),
        "clock_error_ms": rounded(way.error_ms, 3),
    }
    cells = [
        Cell(
            variant=VARIANT, params=way.params, measure=ROUND_TRIP, unit="ms", rounds=round_trips(way), figures=figures
        )
    ]
    for measure, rounds in zip((THERE, BACK), one_ways(way), strict=True):
        cells.append(
            Cell(
                variant=VARIANT,
                params=way.params | {"clocks": f"± {figure(way.error_ms)} ms"},
                measure=measure,
                unit="ms",
                rounds=rounds,
                figures=figures | clocks,
            )
        )
    return cells


def _table(ways: Sequence[Way]) -> Table:
    table = plain_table(
        "Between two machines, ms: p50/p99", ["size", "rate", "round trip", "there", "back", "±", "lost"], left=2
    )
    for way in ways:
        there, back = one_ways(way)
        counted = sum(map(len, way.rounds))
        times = [_both(rounds) for rounds in (round_trips(way), there, back)]
        table.add_row(*map(str, way.params.values()), *times, figure(way.error_ms), str(way.sent - counted))
    return table


def _both(rounds: Sequence[Sequence[float]]) -> str:
    samples = [sample for one in rounds for sample in one]
    return f"{figure(percentile(samples, 50))}/{figure(percentile(samples, 99))}" if samples else "unknown"


def verdict(ways: Sequence[Way]) -> list[str]:
    """Plain sentences."""
    return [line for way in ways for line in _sentences(way)]


def _sentences(way: Way) -> list[str]:
    what, error = f"{size_name(way.size)} at {rate_name(way.rate)}", f"± {figure(way.error_ms)} ms"
    said = [f"{what}: {_both(round_trips(way))} ms there and back (p50/p99)"]
    if math.isnan(way.error_ms):
        return [*said, f"{what}: too little came back to compare the clocks: one-way times are unknown"]
    said.append(f"{what}: the far clock is {way.ahead_ms:+.3f} ms from ours, {error}")
    for name, rounds in zip((THERE, BACK), one_ways(way), strict=True):
        unknown = f"unknown: it takes less than the {error} that the clocks can be compared to"
        said.append(f"{what}: {name}: {f'{_both(rounds)} ms, all of it {error}' if rounds else unknown}")
    return said
