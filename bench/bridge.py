"""Measures the latency of drive commands to the wheels and of MCU reports to the operator, with whole robots."""

from __future__ import annotations

import re
import socket
import struct
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from statistics import fmean
from typing import Any

from pebble.bench.bridge_operator import ALL, HOP, STAND_IN, Arrived, DrivenRobot, Turn, Wheels, driven_robot, wheels_of
from pebble.bench.clients import RATE_HZ
from pebble.bench.comparison import (
    Budget,
    Case,
    Comparison,
    Measuring,
    Option,
    Report,
    Round,
    Run,
    of_known,
    rounds,
    seconds,
    variants,
)
from pebble.bench.judging.aims import RatioAim
from pebble.bench.pictures import bars, ecdf, null_ratios, ratios
from pebble.bench.results import Cell, grouped
from pebble.bench.tables import COUNT, LOST, SPREAD, Claims, Grid, percentile_column, single_column
from pebble.bench.usage import wall_clock_ahead_ns
from pebble.errors import PebbleError
from pebble.rig.robot import KINDS

UNLOADED, COMMANDS, LOADED = "none", "commands", "media"  # unloaded: 20 commands and 50 reports a second
DOWN, UP, CPU = "down", "up", "CPU per message"
STARTUP_S = 1.0  # for start-up work to finish
_LOADED_S = 2.0  # at most, of driving each robot while media flow
_PILOT_S = 2.0

#: By transport, in order: the component that holds the command. Results are compared by these names.
HOPS = {
    "mqtt": ("operator's client", "remote broker", "bridge", "robot's broker", "serial bridge", "all the way"),
    "zenoh": ("operator's client", "remote broker", "bridge, fabric, serial bridge", "all the way"),
}
_ETH_P_IP, _SO_RCVBUFFORCE, _SO_TIMESTAMPNS = 0x0800, 33, 35  # if_ether.h, asm-generic/socket.h
_BUFFER = 512 * 1024 * 1024  # bytes at most: the traffic of minutes
_COMMAND = re.compile(rb'/drive-values.{0,3}?(\{"x": [-+.0-9e]+, "z": [-+.0-9e]+\})', re.DOTALL)  # a packet's number


def prepare(run: Run) -> None:
    """Raises PebbleError if several modes are wanted."""
    if len(named := [f"--{name}" for name in ("with-media", "null", "profile") if run.options.get(name)]) > 1:
        raise PebbleError(f"{' and '.join(named)} are different runs: give one of them")


@contextmanager
def running(kinds: Iterable[str], *, media: bool = False, reports: bool = True) -> Iterator[dict[str, DrivenRobot]]:
    """Fresh robots, which are ready; with ``reports`` they forward those of their MCUs."""
    with ExitStack() as stack:
        driven = {kind: stack.enter_context(driven_robot(kind, media=media, reports=reports)) for kind in kinds}
        for one in driven.values():
            one.wait_until_ready()
        time.sleep(STARTUP_S)
        yield driven


def measure(round_: Round) -> Iterator[Cell]:
    """Fresh robots that forward reports, also with media; and fresh ones that do not. In turn, the other way round."""
    run = round_.run
    for load in (COMMANDS, UNLOADED) if round_.number % 2 else (UNLOADED, COMMANDS):
        reports, media = load == UNLOADED, load == UNLOADED and bool(run.options.get("with-media"))
        run.show("starting the robots")
        with running([*run["variants"], *([HOP] if reports else [])], media=media, reports=reports) as driven:
            yield from _in_turns(round_, load, driven)
            for case in round_.cases([{"load": LOADED}], 1) if media else ():
                if case.variant in KINDS:  # the stand-in has no media
                    turn = driven[case.variant].drive_with_media(min(run["seconds"], _LOADED_S))
                    yield from cells_of(case, turn, driven[case.variant].arrived([turn]))


def _in_turns(round_: Round, load: str, driven: Mapping[str, DrivenRobot]) -> Iterator[Cell]:
    """Drives each of them for the seconds of a round, in turns of about ``turn_s``."""
    run, turns = round_.run, []
    passes = max(1, round(run["seconds"] / run["turn_s"]))
    for case in round_.cases([{"load": load}], passes):
        if (robot := driven.get(case.variant)) is not None:
            turn = robot.drive(run["seconds"] / passes, run["rate_hz"], work_us=case.planted_us, slowed=case.slowed)
            turns.append((case, turn))
    for name, own in grouped(turns, lambda one: one[0].variant).items():
        arrived = driven[name].arrived([turn for _, turn in own])
        for case, turn in own:
            yield from cells_of(case, turn, arrived)


def cells_of(case: Case, turn: Turn, arrived: Arrived) -> Iterator[Cell]:
    load, took_s = case.condition["load"], (turn.ended - turn.began) / 1e9
    figures: dict[str, Any] = {"cpu_percent": 100 * turn.cpu_s[ALL] / took_s} if ALL in turn.cpu_s else {}
    down = [(arrived.commands[one] - ns) / 1e6 for one, ns in turn.sent.items() if one in arrived.commands]
    yield case.cell(DOWN, "ms", down, sent=len(turn.sent), **figures)
    if case.run.comparison.is_null:
        return
    if load != COMMANDS and case.variant != HOP:
        own = [(sent, ns) for sent, ns in arrived.reports if turn.began <= sent <= turn.ended]
        yield case.cell(UP, "ms", [(ns - sent) / 1e6 for sent, ns in own if ns is not None], sent=len(own))
    forwarded = len(down) + sum(turn.began <= ns <= turn.ended for ns, _ in arrived.received)
    for part, cpu_s in turn.cpu_s.items():
        if part != ALL and load != LOADED:
            yield case.cell(CPU, "us", [1e6 * cpu_s / forwarded] if forwarded else [], {"process": part})


def pilot(case: Case) -> Iterator[Cell]:
    """The usual latency, for the null test of one robot: fresh ones would differ by more than what is planted."""
    turn = case.env[case.variant].drive(_PILOT_S, case.run["rate_hz"])
    return cells_of(case, turn, case.env[case.variant].arrived([turn]))


def trace_commands(case: Case) -> Iterator[Cell]:
    """Drives a fresh robot and follows each command. Raises PebbleError, also without permission to capture packets."""
    try:
        wire = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM)  # no protocol: it receives nothing yet
    except OSError as error:
        raise PebbleError(f"--profile captures packets on loopback, which requires root: {error.strerror}") from None
    wire.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER)
    wire.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)  # later: until then packets get the time of their recvmsg()
    wire.setblocking(False)
    with wire, running([case.variant]) as robots:
        wire.bind(("lo", _ETH_P_IP))
        driven = robots[case.variant]
        turn = driven.drive(case.run["seconds"], case.run["rate_hz"])
        arrived = driven.arrived([turn])  # waits for the last ones
        found = passed(wire)
        ends = [found[port, end] for port in driven.robot.broker_ports for end in ("to", "from")]
    times = hops(turn.sent, [*ends, arrived.commands])
    for name, each in zip(HOPS[case.variant], times, strict=True):
        yield case.cell("hop", "ms", each, {"hop": name})


def hops(sent: Mapping[Wheels, int], stations: Sequence[Mapping[Wheels, int]]) -> list[list[float]]:
    """The times of the commands that passed all stations, ms, for each hop and for all of them."""
    way = [sent, *stations]
    known = [wheels for wheels in sent if all(wheels in station for station in stations)]
    return [[(b[one] - a[one]) / 1e6 for one in known] for a, b in [*pairwise(way), (way[0], way[-1])]]


def passed(wire: socket.socket) -> Mapping[tuple[int, str], Mapping[Wheels, int]]:
    """By port, from or to it: when (CLOCK_MONOTONIC, ns) each command passed first."""
    offset = wall_clock_ahead_ns()  # the kernel stamps packets by it
    found = defaultdict[tuple[int, str], dict[Wheels, int]](dict)
    with suppress(BlockingIOError):
        while True:
            packet, stamps, _, _ = wire.recvmsg(65_536, 64)
            seconds, ns = struct.unpack("qq", stamps[0][2])
            for *ports, wheels in commands(packet):
                for end in zip(ports, ("from", "to"), strict=True):
                    found[end].setdefault(wheels, seconds * 1_000_000_000 + ns - offset)
    return found


def commands(packet: bytes) -> list[tuple[int, int, Wheels]]:
    """The drive commands in an IP packet: source and destination port, and the wheel speeds."""
    source, destination = struct.unpack_from("!HH", packet, 4 * (packet[0] & 15))
    return [(source, destination, wheels_of(found)) for found in _COMMAND.findall(packet)]


def _of(measure: str, kinds: Sequence[str], **params: str) -> Callable[[Cell], bool]:
    return lambda cell: cell.measure == measure and cell.variant in kinds and params.items() <= cell.params.items()


def _aims() -> Iterator[RatioAim]:
    """Beside the stand-in: an absolute time would say more about the machine than about us."""
    alone, both, forwards = "command to the wheels, commands only", "commands and reports", {"load": UNLOADED}
    beside = (
        (f"{alone}, p50", DOWN, {"load": COMMANDS}, 50, 1, (1.0, 1.05)),
        (f"{alone}, p99", DOWN, {"load": COMMANDS}, 99, 100, (0.5, 0.5)),
        (f"{CPU} of the bridge, {both},", CPU, {**forwards, "process": "bridge"}, 50, 1, (1.0, 1.1)),
        (f"{CPU} of the serial bridge, {both},", CPU, {**forwards, "process": "serial bridge"}, 50, 1, (1.1, 1.4)),
    )
    for what, measure_, params, percent, least, bounds in beside:
        for kind, at_most in zip(KINDS, bounds, strict=True):
            yield RatioAim(
                what=f"{{variant}}, {what} at most {{bound:.2f}} of {STAND_IN}'s", of=_of(measure_, [kind], **params),
                to=STAND_IN, percent=percent, at_most=at_most, least=least,
            )  # fmt: skip


LATENCIES = Grid(
    title="Commands down, reports up; and the load on the robot, % of a core", rows=("conditions", "variant"),
    columns=(
        *(percentile_column(50, "p50 ms"), *map(percentile_column, (95, 99, 100)), COUNT, LOST),
        single_column("CPU", "cpu_percent", ".1f"),
    ),
    baseline=STAND_IN, of=lambda cell: cell.measure != CPU,
)  # fmt: skip
CPU_TABLE = Grid(
    title="CPU for each forwarded message, us: median (minimum to maximum) of the rounds",
    rows=("load", "variant", "process"), columns=(SPREAD, COUNT), baseline=STAND_IN,
    of=lambda cell: cell.measure == CPU,
)  # fmt: skip
_OPTIONS = (
    Option(name="with-media", kind=bool, help="Also with 1080p pictures and sound, and compare."),
    rounds("How often robots are started."),
    seconds("Driving time per robot and round, under each load; at most 2 with media."),
    Option(name="null", kind=bool, recorded=False, help="One robot against itself, also slowed down by a fifth."),
    Option(name="profile", kind=bool, recorded=False, help="Latency of a command hop by hop."),
)
_OURS = (*_OPTIONS, variants(KINDS))

BRIDGE_PROFILE = Comparison(
    name="bridge-profile",
    title="Operator to wheels: where the time goes",
    what="The same path of a command, hop by hop, from the time stamps of its packets on loopback: for a typical "
    "command, and for the slowest ones.",
    options=_OURS,
    full=Budget(60, profile=True, rounds=3, seconds=10.0, rate_hz=RATE_HZ),
    quick=Budget(12, rounds=1, seconds=2.0),
    variants=KINDS,
    measuring=Measuring(prepare=prepare, measure=trace_commands),
    report=Report(
        tables=(
            Grid(
                title="Each hop of a command, ms", rows=("variant", "hop"),
                columns=(*map(percentile_column, (50, 99, 100)), COUNT),
            ),
        ),
        reported=("--profile",),
        pictures=(ecdf("Operator to wheels, hop by hop"),),
    ),
    root=True,
    words=("bench", "bridge"),
)  # fmt: skip
_BRIDGE = Comparison(
    name="bridge",
    title="Operator to wheels, and back",
    what="A whole robot of each kind, with a stock broker between it and the operator. Down is from the operator's "
    "publish call to the last byte of the command's line at the MCU's pty; up is from the MCU's report to the "
    "operator. Under “commands” robots forward no reports. CPU is that of the process that bridges, and of the one "
    "that owns the serial line, for each command and report that they forwarded.",
    help="Drive commands from an operator to the wheels of a whole simulated robot, and its telemetry back: on MQTT, "
    "Zenoh and plain paho, compared with one hop through a stock broker. Needs mosquitto.",
    options=(*_OPTIONS, variants((STAND_IN, *KINDS), "paho, mqtt, zenoh; --null: one of ours, zenoh by default.")),
    full=Budget(2100, rounds=20, seconds=12.5, turn_s=1.0, rate_hz=RATE_HZ),
    quick=Budget(22, rounds=2, seconds=0.5),
    variants=(STAND_IN, *KINDS),
    references=(HOP,),
    measuring=Measuring(
        prepare=prepare,
        measure_round=measure,
        measures=(DOWN, UP, CPU),
        figures={"cpu_percent": of_known(fmean, 1)},
    ),
    report=Report(
        tables=(LATENCIES, CPU_TABLE),
        assessment=(
            Claims(
                what="Median, {measure}, load {load}", judged=lambda cell: cell.params["load"] == UNLOADED,
                of=lambda cell: cell.measure != CPU and cell.variant in KINDS,
            ),
            *_aims(),
        ),
        reported_full=("--with-media",),
        pictures=(
            ecdf("Operator to wheels and back", measures=(DOWN, UP)),
            ratios("Operator to wheels and back", "mqtt", measures=(DOWN, UP)),
            bars("Operator to wheels and back", measures=(CPU,), panel="load", group="process"),
        ),
    ),
)  # fmt: skip
BRIDGE_NULL = _BRIDGE.null_test(
    "One robot in three roles that take turns: plain, again, and with a fifth of the usual latency planted by the "
    "operator. The first interval must include 1.00, the second must lie above it.",
    options=_OURS,
    # many messages, and very short turns, so that a disturbance of the machine hits all roles
    full=Budget(150, null=True, rounds=10, seconds=4.0, turn_s=0.05, rate_hz=100.0, fresh_every=10_000),
    quick=Budget(14, rounds=4, seconds=0.5),
    variants=KINDS[1:],
    references=(),
    conditions=lambda _run: [{"load": UNLOADED}],
    measuring={
        "environment": lambda run: running(run["variants"]),
        "measure": pilot,
        "measure_round": lambda round_: _in_turns(round_, UNLOADED, round_.env),
    },
    report={
        "tables": (LATENCIES,),
        "reported_full": (),
        "pictures": (null_ratios("Null test of bridge"), ecdf("Null test of bridge")),
    },
)
BRIDGE = replace(_BRIDGE, modes={"null": BRIDGE_NULL, "profile": BRIDGE_PROFILE})
