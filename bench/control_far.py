"""Between two machines: round trips to an echo, and one-way times as precise as the two clocks allow."""

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
from pebble.bench.comparison import FOLDER
from pebble.bench.control_ends import Clock, Echo, Sender, SliceSpec, TransportConnection
from pebble.bench.control_plan import check_slices, command_of, rate_name, size_name
from pebble.bench.control_report import ROUND_TRIP
from pebble.bench.control_wire import Exchange
from pebble.bench.engine import check_folder, finish
from pebble.bench.results import Cell, Stopwatch, Value, percentile, rounded
from pebble.bench.tables import figure, plain_table
from pebble.errors import PebbleError
from pebble.runtime.inbox import Inbox
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports import MqttSettings, create

VARIANT = "mqtt"
THERE, BACK = "one-way there", "one-way back"
_SIZES, _RATES = (40, 1024), (20.0, 200.0)
_SECONDS, _ROUNDS, _QUICK_SECONDS, _QUICK_ROUNDS = 2.0, 10, 1.0, 4
_WARM_UP = 10  # messages
_ANSWER_S = 10.0  # to exchange these with the echo
_POLL_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class FarPlan:
    """Slices of ``seconds``: the clocks are compared in each slice, before they drift far."""

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
        """The plan for the command line's options. Raises PebbleError naming an invalid option.

        The recorded command has URL in place of the address: results name no hosts.
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
class FarCase:
    """Results of one size at one rate, over the rounds."""

    size: int
    rate: float
    sent: int = 0
    late: int = 0
    rounds: list[list[Exchange]] = field(default_factory=list)
    offsets: list[Offset | None] = field(default_factory=list)  # one for each round; None: too few replies

    @property
    def params(self) -> dict[str, Value]:
        return {"size": size_name(self.size), "rate": rate_name(self.rate)}

    @property
    def error_ms(self) -> float:
        """The largest error of all rounds; NaN if the clocks could not be compared."""
        return max((offset.error_ns / 1e6 for offset in self.offsets if offset is not None), default=math.nan)

    @property
    def ahead_ms(self) -> float:
        return percentile([offset.ns / 1e6 for offset in self.offsets if offset is not None], 50)


def wall_clock() -> Clock:
    """Wall-clock time, ns, that is neither set nor slewed from now on: NTP may slew CLOCK_MONOTONIC by 500 ppm."""
    since = time.time_ns() - _quartz_ns()
    return lambda: _quartz_ns() + since


def _quartz_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


def serve(settings: MqttSettings, clock: Clock | None = None, console: Console | None = None) -> int:
    """Runs an echo until Ctrl-C. Raises PebbleError without a broker."""
    console, inbox = console or Console(), Inbox()
    with interrupted_by_signals(), closing(_connection(settings, "echo", inbox)) as connection:
        echo = Echo(connection, "+", clock or wall_clock())
        console.print(f"Echo through {settings.host}:{settings.port}, until Ctrl-C", highlight=False)
        with console.status("") as status:
            while True:
                status.update(
                    f"echo through {settings.host}:{settings.port}, {echo.count} messages so far; Ctrl-C ends it"
                )
                end = time.monotonic() + _POLL_S
                while (left := end - time.monotonic()) > 0:
                    job = inbox.take(left)
                    if job is not None:
                        job()


def measure(plan: FarPlan, settings: MqttSettings, console: Console | None = None) -> int:
    """Measures against an echo, prints and writes; returns 0 if every round trip has results. Raises PebbleError."""
    console, inbox = console or Console(), Inbox()
    check_folder(plan.output)
    options: dict[str, Value | list[Value]] = {"seconds": plan.seconds, "rounds": plan.rounds}
    watch = Stopwatch("control-far", plan.command, options)
    cases = [FarCase(size, rate) for size in plan.sizes for rate in plan.rates]
    with interrupted_by_signals(), closing(_connection(settings, "sender", inbox)) as connection:
        sender = Sender(connection, secrets.token_hex(4), wall_clock(), inbox)
        with console.status("waiting for the echo") as status:
            if not sender.warm_up(_WARM_UP, _ANSWER_S):
                raise PebbleError(
                    f"no echo answers through {settings.host}:{settings.port}: "
                    "run `pebble bench echo URL` on the other machine"
                )
            for number in range(plan.rounds):
                for case in cases[:: -1 if number % 2 else 1]:
                    status.update(f"round {number + 1} of {plan.rounds}: {', '.join(map(str, case.params.values()))}")
                    _slice(sender, case, plan.seconds)
    cells = [cell for case in cases for cell in cells_of(case)]
    console.print(_table(cases))
    finish(watch.results(cells, assessment(cases), quick=plan.quick), plan.output, console)
    return 0 if all(cell.samples for cell in cells if cell.measure == ROUND_TRIP) else 1


def _connection(settings: MqttSettings, what: str, inbox: Inbox) -> TransportConnection:
    """Opens a connection with a client id of its own: several runs may share one broker."""
    return TransportConnection(create("mqtt", f"bench-{what}-{secrets.token_hex(4)}", settings), inbox)


def _slice(sender: Sender, case: FarCase, seconds: float) -> None:
    sent, late, exchanges = sender.run(SliceSpec(size=case.size, rate=case.rate, seconds=seconds))
    try:
        case.offsets.append(estimate(exchanges))
    except PebbleError:  # too few, or a clock was set: the round trips are still valid
        case.offsets.append(None)
    case.rounds.append(exchanges)
    case.sent, case.late = case.sent + sent, case.late + late


def round_trips(case: FarCase) -> list[list[float]]:
    """In ms, without the processing time of the echo, so that the two one-way times add up to it."""
    return [[(one.t4 - one.t1 - (one.t3 - one.t2)) / 1e6 for one in exchanges] for exchanges in case.rounds]


def one_ways(case: FarCase) -> tuple[list[list[float]], list[list[float]]]:
    """There and back, in ms, each round with its own offset; empty where the clock error exceeds the latency."""
    known = [(one, offset) for one, offset in zip(case.rounds, case.offsets, strict=True) if offset is not None]
    both = [[[one_way_ns(one, offset)[which] / 1e6 for one in all_] for all_, offset in known] for which in (0, 1)]
    there, back = ([] if _below_error(rounds, case.error_ms) else rounds for rounds in both)
    return there, back


def _below_error(rounds: Sequence[Sequence[float]], error_ms: float) -> bool:
    return not percentile([sample for one in rounds for sample in one], 50) > error_ms  # nor if either is NaN


def cells_of(case: FarCase) -> list[Cell]:
    """The clock error is one of the conditions, so that no value and no curve is shown without it."""
    figures: dict[str, Value] = {"sent": case.sent, "late": case.late}
    clocks: dict[str, Value] = {
        "clock_offset_ms": rounded(case.ahead_ms, 3),
        "clock_error_ms": rounded(case.error_ms, 3),
    }
    cells = [
        Cell(
            variant=VARIANT,
            params=case.params,
            measure=ROUND_TRIP,
            unit="ms",
            rounds=round_trips(case),
            figures=figures,
        )
    ]
    for measure, rounds in zip((THERE, BACK), one_ways(case), strict=True):
        cells.append(
            Cell(
                variant=VARIANT,
                params=case.params | {"clocks": f"± {figure(case.error_ms)} ms"},
                measure=measure,
                unit="ms",
                rounds=rounds,
                figures=figures | clocks,
            )
        )
    return cells


def _table(cases: Sequence[FarCase]) -> Table:
    table = plain_table(
        "Between two machines, ms: p50/p99", ["size", "rate", "round trip", "there", "back", "±", "lost"], left=2
    )
    for case in cases:
        there, back = one_ways(case)
        counted = sum(map(len, case.rounds))
        times = [_both(rounds) for rounds in (round_trips(case), there, back)]
        table.add_row(*map(str, case.params.values()), *times, figure(case.error_ms), str(case.sent - counted))
    return table


def _both(rounds: Sequence[Sequence[float]]) -> str:
    samples = [sample for one in rounds for sample in one]
    return f"{figure(percentile(samples, 50))}/{figure(percentile(samples, 99))}" if samples else "unknown"


def assessment(cases: Sequence[FarCase]) -> list[str]:
    """One sentence for each result."""
    return [line for case in cases for line in _sentences(case)]


def _sentences(case: FarCase) -> list[str]:
    what, error = f"{size_name(case.size)} at {rate_name(case.rate)}", f"± {figure(case.error_ms)} ms"
    lines = [f"{what}: {_both(round_trips(case))} ms there and back (p50/p99)"]
    if math.isnan(case.error_ms):
        return [*lines, f"{what}: too few replies to compare the clocks: one-way times are unknown"]
    lines.append(f"{what}: the far clock is {case.ahead_ms:+.3f} ms from ours, {error}")
    for name, rounds in zip((THERE, BACK), one_ways(case), strict=True):
        unknown = f"unknown: below the clock error of {error}"
        lines.append(f"{what}: {name}: {f'{_both(rounds)} ms {error}' if rounds else unknown}")
    return lines
