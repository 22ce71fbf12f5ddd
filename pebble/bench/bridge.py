"""How fast a drive command reaches the wheels and a report of the MCU its operator, on MQTT and on Zenoh.

Down: from the operator's publish call to the last byte of the command's line at the MCU's pty. Up: from the moment at
which the MCU writes a report until the operator hears it. In between lie a remote broker, the bridge, the robot's own
transport and the serial bridge. Real processes, stock mosquitto, loopback.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack

from rich.console import Console
from rich.progress import Progress

from pebble.bench import bridge_report, output
from pebble.bench.bridge_drive import Found, Stretch
from pebble.bench.bridge_driven import Driven
from pebble.bench.bridge_hop import HOP, Hop
from pebble.bench.bridge_media import Audience
from pebble.bench.bridge_plan import Plan
from pebble.bench.bridge_tally import LOADED, UNLOADED, Tally
from pebble.bench.results import Stopwatch
from pebble.bench.rounds import Rounds
from pebble.signals import interrupted_by_signals
from pebble.transports.segments import sweep

_SETTLE_S = 1.0  # start-up work is over
_TURN_S = 1.0  # then it is another robot's turn
_MEDIA_SETTLE_S = 1.0

Played = tuple[Tally, list[Stretch], list[Found], Mapping[str, int]]
"""Whose part of a round it is, what was driven, what arrived, and what media flowed meanwhile."""


def run(plan: Plan, console: Console | None = None) -> int:
    """Measure, show and write; 0 if everything has figures and rounds enough are left. Raises PebbleError."""
    console = console or Console()
    plan.check()
    watch = Stopwatch("bridge", plan.command(), plan.options())
    tallies = [Tally(kind, load) for load in _loads(plan) for kind in plan.kinds]
    tallies.append(Tally(HOP, reports=False))
    rounds = Rounds(plan.rounds, console)
    with interrupted_by_signals():
        try:
            _measure(plan, tallies, rounds, console)
        finally:
            sweep()  # Zenoh leaves files behind even when it ends politely
    cells = [cell for tally in tallies for cell in tally.cells()]
    bridge_report.show(cells, console)
    lines = [*rounds.told(), *bridge_report.verdict(cells)]
    output.finish(watch.results(cells, lines, quick=plan.quick), plan.output, console)
    return rounds.code(cells)


def _loads(plan: Plan) -> tuple[str, ...]:
    return (UNLOADED, LOADED) if plan.with_media else (UNLOADED,)


def _measure(plan: Plan, tallies: Sequence[Tally], rounds: Rounds, console: Console) -> None:
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("", total=plan.rounds)
        for number in range(plan.rounds):

            def say(what: str, number: int = number) -> None:
                progress.update(task, completed=number, description=f"round {number + 1} of {plan.rounds}: {what}")

            with rounds.attempt(number):
                for tally, stretches, found, flowed in _round(plan, tallies, number, say):
                    tally.add_round(stretches, found, flowed)


def _round(plan: Plan, tallies: Sequence[Tally], number: int, say: Callable[[str], None]) -> list[Played]:
    """Nothing of a round counts before all of it is done. Raises PebbleError."""
    by_name = {(tally.variant, tally.load): tally for tally in tallies}
    played: list[Played] = []
    with ExitStack() as stack:
        say("starting the robots")
        cast = [stack.enter_context(Driven(kind, media=plan.with_media)) for kind in plan.kinds]
        hop = stack.enter_context(Hop())
        for driven in cast:
            driven.wait()
        time.sleep(_SETTLE_S)
        say("driving in turns")
        players: list[Driven | Hop] = [*cast, hop]
        for player, stretches in _in_turns(players, plan.seconds, backwards=bool(number % 2)):
            played.append((by_name[player.kind, UNLOADED], stretches, player.look_up(stretches), {}))
        for driven in (cast[::-1] if number % 2 else cast) if plan.with_media else ():
            say(f"{driven.kind} with media")
            played.append(_drive_with_media(driven, plan.seconds, by_name[driven.kind, LOADED]))
    return played


def _in_turns(
    players: Sequence[Driven | Hop], seconds: float, *, backwards: bool
) -> list[tuple[Driven | Hop, list[Stretch]]]:
    """Each is driven for ``seconds`` in all; who began comes last in the next turn."""
    turns = max(1, round(seconds / _TURN_S))
    stretches: dict[str, list[Stretch]] = {player.kind: [] for player in players}
    for turn in range(turns):
        for player in players[::-1] if backwards != bool(turn % 2) else players:
            stretches[player.kind].append(player.drive(seconds / turns))
    return [(player, stretches[player.kind]) for player in players]


def _drive_with_media(driven: Driven, seconds: float, tally: Tally) -> Played:
    with Audience(driven.robot, driven.operator) as audience:
        time.sleep(_MEDIA_SETTLE_S)
        before = audience.counts()
        stretches = [driven.drive(seconds)]
        after = audience.counts()
    return tally, stretches, driven.look_up(stretches), {name: after[name] - before[name] for name in after}
