"""Measures the latency of messages between two services, one-way and round trip, on MQTT and Zenoh in turn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from pebble.bench import null
from pebble.bench.control_ends import SliceSpec
from pebble.bench.control_participants import Participants, Slice, joined
from pebble.bench.control_plan import Condition, ControlPlan
from pebble.bench.control_report import MEASURES, ONE_WAY, assessment, legend, tables, wake_up_cost
from pebble.bench.engine import check_folder, finish
from pebble.bench.ratios import LEAST_ROUNDS
from pebble.bench.results import Cell, Judged, Stopwatch, Value, percentile, rounded
from pebble.bench.wake_up import wake_up_us
from pebble.errors import PebbleError
from pebble.runtime.signals import interrupted_by_signals
from pebble.transports.segments import sweep

_AROUND_S = 0.25  # overhead of a slice: first messages, last replies, switching the load
_START_S = 0.9  # to start one role, for the estimate

Round = dict[tuple[str, Condition], Slice]


def run(plan: ControlPlan, console: Console | None = None) -> int:
    """Measures, prints and writes; returns 0 if every role has results of enough rounds, if so many were requested.

    Raises PebbleError.
    """
    console = console or Console()
    check_folder(plan.output)
    console.print(_announcement(plan), highlight=False, soft_wrap=True)
    watch = Stopwatch(plan.bench, plan.command, _options(plan))
    wake_ups_us = wake_up_us()
    with interrupted_by_signals():
        try:
            measured, problems = _measure(plan, console)
        finally:
            sweep()  # Zenoh leaves a file behind even after a regular end
    cells = cells_of(plan, measured)
    tested = null.assessment(cells) if plan.null else [*wake_up_cost(cells, *wake_ups_us), *assessment(cells)]
    lines: list[str | Judged] = list(tested)
    if len(measured) < plan.rounds:
        why = ", ".join(dict.fromkeys(problems))
        lines.insert(0, f"{plan.rounds - len(measured)} of {plan.rounds} rounds failed and were left out: {why}")
    results = watch.results(cells, lines, quick=plan.quick)
    for line in legend(plan.roles):
        console.print(line, style="dim", highlight=False, soft_wrap=True)
    for table in tables(cells):
        console.print(table)
    finish(results, plan.output, console)
    enough = len(measured) >= LEAST_ROUNDS or plan.rounds < LEAST_ROUNDS
    return 0 if enough and all(cell.samples for cell in cells) else 1


def _announcement(plan: ControlPlan) -> str:
    starts = -(-plan.rounds // plan.fresh_every)
    slices = plan.passes * len(plan.roles) * len(plan.conditions)
    minutes = (plan.rounds * slices * (plan.seconds + _AROUND_S) + starts * len(plan.roles) * _START_S) / 60
    return f"{slices} slices of {plan.seconds:g} s in each of {plan.rounds} rounds: about {minutes:.1f} min"


def _options(plan: ControlPlan) -> dict[str, Value | list[Value]]:
    return {
        "variants": list(plan.roles),
        "seconds": plan.seconds,
        "rounds": plan.rounds,
        "passes": plan.passes,
        "fresh_every": plan.fresh_every,
        "loads": list(plan.loads),
    }


def _measure(plan: ControlPlan, console: Console) -> tuple[list[Round], list[str]]:
    """Measures all rounds; also returns the problems. A round in which a process failed is left out for all roles.

    Raises PebbleError if no round succeeded.
    """
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=console,
        transient=True,
    )  # fmt: skip
    rounds: list[Round] = []
    problems: list[str] = []
    work_us: dict[Condition, float] = {}
    with progress:
        bar = progress.add_task("control", total=plan.rounds * plan.passes * len(plan.roles) * len(plan.conditions))
        for first in range(0, plan.rounds, plan.fresh_every):
            progress.update(bar, description=f"round {first + 1} of {plan.rounds}: starting")
            try:
                with Participants(plan.roles, plan.loads) as participants:
                    if plan.null and not work_us:
                        work_us = {condition: _pilot(participants, plan, condition) for condition in plan.conditions}
                    for number in range(first, min(first + plan.fresh_every, plan.rounds)):
                        progress.update(bar, description=f"round {number + 1} of {plan.rounds}")
                        rounds.append(_round(participants, plan, number, work_us, lambda: progress.advance(bar)))
                        work_us = {condition: _planted_us(plan, condition, rounds) for condition in work_us}
            except PebbleError as error:
                problems.append(str(error).partition("\n")[0].rstrip(":"))
                console.print(f"round {len(rounds) + 1}: {error}", style="red", highlight=False, markup=False)
    if not rounds:
        raise PebbleError("no round could be measured: see the lines above")
    return rounds, problems


def _round(
    participants: Participants,
    plan: ControlPlan,
    number: int,
    work_us: Mapping[Condition, float],
    done: Callable[[], None],
) -> Round:
    """Measures the roles of each condition one after another; every other pass runs in reverse order."""
    measured: dict[tuple[str, Condition], list[Slice]] = {}
    for pass_ in range(plan.passes):
        step = -1 if (number + pass_) % 2 else 1
        for condition in plan.conditions[::step]:
            for role in plan.roles[::step]:
                spec = _slice_spec(plan, condition, work_us.get(condition, 0.0), slowed=null.is_slowed(role))
                measured.setdefault((role, condition), []).append(participants.run(role, spec, condition.load))
                done()
    return {key: joined(slices) for key, slices in measured.items()}


def _pilot(participants: Participants, plan: ControlPlan, condition: Condition) -> float:
    """How long, in us, each role works at each message of the first round: a fifth of the usual latency.

    The slowed role works after taking the time stamp, the others before it; nothing else differs.
    """
    answer = participants.run(plan.roles[0], _slice_spec(plan, condition), condition.load).answer
    return null.SLOWDOWN * percentile(answer.one_way, 50)


def _planted_us(plan: ControlPlan, condition: Condition, rounds: Sequence[Round]) -> float:
    """The same for the next round, from all latencies so far."""
    plain = [one[role, condition].answer.one_way for one in rounds for role in plan.roles if not null.is_slowed(role)]
    latencies = [latency for one in plain for latency in one]
    return null.SLOWDOWN * percentile(latencies, 50) if latencies else 0.0


def _slice_spec(plan: ControlPlan, condition: Condition, work_us: float = 0.0, *, slowed: bool = False) -> SliceSpec:
    return SliceSpec(size=condition.size, rate=condition.rate, seconds=plan.seconds, work_us=work_us, slowed=slowed)


def cells_of(plan: ControlPlan, measured: Sequence[Round]) -> list[Cell]:
    """One-way times first. The null test uses only these, since its slowdown is a fifth of them."""
    return [
        Cell(
            variant=role,
            params=condition.params,
            measure=measure,
            unit="us",
            rounds=[getattr(one[role, condition].answer, field) for one in measured],
            figures=_figures([one[role, condition] for one in measured]),
        )
        for measure, field in MEASURES.items()
        if not plan.null or measure == ONE_WAY
        for condition in plan.conditions
        for role in plan.roles
    ]


def _figures(slices: Sequence[Slice]) -> dict[str, Value]:
    whole = joined(slices)
    return {
        "sent": whole.answer.sent,
        "late": whole.answer.late,
        "cpu_percent": round(whole.cpu, 1),
        "broker_cpu_percent": round(whole.backbone_cpu, 1),
        "call_us": rounded(percentile(whole.answer.call, 50), 1),
        "fabric_us": rounded(percentile(whole.answer.transport_times, 50), 1),
        "inbox_us": rounded(percentile(whole.answer.inbox, 50), 1),
        "wake_ups": round(whole.wake_ups, 1),
        "broker_wake_ups": round(whole.backbone_wake_ups, 1),
        "pictures_hz": rounded(whole.pictures_hz, 1),
    }
