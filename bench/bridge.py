"""Measures the latency of drive commands to the wheels and of MCU reports to the operator, with whole robots."""

from __future__ import annotations

import re
import socket
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import pairwise
from statistics import fmean
from typing import Any

from pebble.bench import null
from pebble.bench.aims import Aim, RatioAim, with_lost
from pebble.bench.bridge_operator import ALL, FLOWS, HOP, STAND_IN, DrivenRobot, Turn, Wheels, arrivals, wheels_of
from pebble.bench.comparison import Budget, Case, Comparison, Option, Round, Run, of_known, rounds, seconds, variants
from pebble.bench.drivers import RATE_HZ
from pebble.bench.pictures import bars, ecdf, null_ratios, ratios
from pebble.bench.ratios import LEAST_ROUNDS
from pebble.bench.results import Cell, grouped
from pebble.bench.tables import COUNT, LOST, SPREAD, Claims, Grid, percentile_column, single_column
from pebble.errors import PebbleError
from pebble.rig.robot import KINDS

UNLOADED, COMMANDS, LOADED = "none", "commands", "media"  # unloaded: 20 commands and 50 reports a second
DOWN, UP, CPU = "down", "up", "CPU per message"
NULL_RATE_HZ = 100.0  # more than an operator's 20 a second, to shorten the test
AIMED = {
    (DOWN, UNLOADED): "command to the wheels",
    (UP, UNLOADED): "report to the operator",
    (DOWN, COMMANDS): "command to the wheels, commands only",
}
#: Percentile, ms, and how many samples are needed to assess it: with fewer, hardly any lie beyond.
AIMS_MS = ((50, 0.7, 1), (99, 2.0, 300))
#: Ratios to the stand-in, at most: of mqtt and zenoh. Commands where nothing else is forwarded, by percentile; with
#: fewer samples in each round than the last number, the percentile is the maximum. CPU where all is, by process.
AIMS_COMMANDS = {50: (1.0, 1.05, 1), 99: (0.5, 0.5, 100)}
AIMS_CPU = {"bridge": (1.0, 1.1), "serial bridge": (1.1, 1.4)}
_TURN_S, _NULL_TURN_S = 1.0, 0.05  # of driving one robot before the next one
_STARTUP_S = 1.0  # for start-up work to finish
_LOADED_S = 4.0  # at most, of driving each robot while media flow
_PILOT_S = 2.0
_MODES = ("with-media", "null", "profile")

#: By transport, in order: the component that holds the command. Results are compared by these names.
HOPS = {
    "mqtt": ("operator's client", "remote broker", "bridge", "robot's broker", "serial bridge", "all the way"),
    "zenoh": ("operator's client", "remote broker", "bridge, fabric, serial bridge", "all the way"),
}
_ETH_P_IP, _SO_RCVBUFFORCE, _SO_TIMESTAMPNS = 0x0800, 33, 35  # if_ether.h, asm-generic/socket.h
_BUFFER = 512 * 1024 * 1024  # bytes at most: the traffic of minutes
_COMMAND = re.compile(rb'/drive-values.{0,3}?(\{"x": [-+.0-9e]+, "z": [-+.0-9e]+\})', re.DOTALL)  # a packet's number


def prepare(run: Run) -> None:
    """Raises PebbleError if several modes are wanted, or without permission to capture packets."""
    if len(named := [f"--{name}" for name in _MODES if run[name]]) > 1:
        raise PebbleError(f"{' and '.join(named)} are different runs: give one of them")
    turn_s = _NULL_TURN_S if run["null"] else _TURN_S
    run.options["passes"] = 1 if run["profile"] else max(1 + run["null"], round(run["seconds"] / turn_s))
    if run["profile"]:
        capture().close()


def measure(round_: Round) -> Iterator[Cell]:
    """Fresh robots that forward reports, also with media; and fresh ones that do not. In turn, the other way round."""
    run = round_.run
    for load in (COMMANDS, UNLOADED) if round_.number % 2 else (UNLOADED, COMMANDS):
        reports, media = load == UNLOADED, load == UNLOADED and run["with-media"]
        with ExitStack() as stack:
            run.show("starting the robots")
            driven = {
                kind: stack.enter_context(DrivenRobot(kind, media=media and kind in KINDS, reports=reports))
                for kind in (*run["variants"], *([HOP] if reports else []))
            }
            for one in driven.values():
                one.wait()
            time.sleep(_STARTUP_S)
            yield from _in_turns(round_, load, driven)
            for case in round_.cases([{"load": LOADED}], 1) if media else ():
                if case.variant in KINDS:  # the stand-in has no media
                    turn, flowed = driven[case.variant].drive_with_media(min(run["seconds"], _LOADED_S))
                    yield from cells_of(case, turn, flowed)


def _in_turns(round_: Round, load: str, driven: Mapping[str, DrivenRobot], rate_hz: float = RATE_HZ) -> Iterator[Cell]:
    """Drives each of them for the seconds of a round, in as many turns as there are passes."""
    turn_s, turns = round_.run["seconds"] / round_.run["passes"], []
    for case in round_.cases([{"load": load}]):
        if (robot := driven.get(case.variant)) is not None:
            turns.append((case, robot.drive(turn_s, rate_hz, work_us=case.planted_us, slowed=case.slowed)))
    for name, own in grouped(turns, lambda one: one[0].variant).items():
        driven[name].match_arrivals([turn for _, turn in own])
        for case, turn in own:
            yield from cells_of(case, turn)


def cells_of(case: Case, turn: Turn, flowed: Mapping[str, int] | None = None) -> Iterator[Cell]:
    """Of one turn; ``flowed`` counts the media received meanwhile."""
    load, took_s = case.condition["load"], (turn.ended - turn.began) / 1e9
    figures: dict[str, Any] = {f"{name}_per_s": count / took_s for name, count in (flowed or {}).items()}
    if ALL in turn.cpu_s:
        figures["cpu_percent"] = 100 * turn.cpu_s[ALL] / took_s
    yield case.cell(DOWN, "ms", turn.down, sent=len(turn.sent), **figures)
    if case.run.comparison.is_null:
        return
    if load != COMMANDS and case.variant != HOP:
        yield case.cell(UP, "ms", turn.up, sent=turn.reports, **figures)
    for part, cpu_s in turn.cpu_s.items():
        if part != ALL and load != LOADED:
            each = [1e6 * cpu_s / turn.forwarded] if turn.forwarded else []
            yield case.cell(CPU, "us", each, {"process": part})


# -- the null test, of one robot for all roles and rounds: fresh ones would differ by more than the planted difference


@contextmanager
def running(kind: str) -> Iterator[DrivenRobot]:
    with DrivenRobot(kind) as driven:
        driven.wait()
        time.sleep(_STARTUP_S)
        yield driven


def pilot(case: Case) -> Iterator[Cell]:
    """The usual latency."""
    turn = case.env.drive(_PILOT_S, NULL_RATE_HZ)
    case.env.match_arrivals([turn])
    yield case.cell(DOWN, "ms", turn.down)


# -- the profile


def trace_commands(case: Case) -> Iterator[Cell]:
    """Drives a fresh robot and follows each command. Raises PebbleError."""
    with running(case.variant) as driven, capture() as wire:
        turn = driven.drive(case.run["seconds"])
        driven.match_arrivals([turn])  # waits for the last ones
        pty, found = arrivals(driven.subject.lines(turn.began)), passed(wire)
        ends = [(port, end) for port in driven.subject.broker_ports for end in ("to", "from")]
        times = hops(turn.sent, [*(found.get(end, {}) for end in ends), pty])
    for number, name in enumerate(HOPS[case.variant]):
        yield case.cell("hop", "ms", [one[number] for one in times], {"hop": name})


def hops(sent: Mapping[Wheels, int], stations: Sequence[Mapping[Wheels, int]]) -> list[tuple[float, ...]]:
    """For each command that passed all stations the time of each hop, and of all of them, ms."""
    ways = (
        [ns, *(station[speeds] for station in stations)]
        for speeds, ns in sent.items()
        if all(speeds in station for station in stations)
    )
    return [(*((there - here) / 1e6 for here, there in pairwise(way)), (way[-1] - way[0]) / 1e6) for way in ways]


def capture() -> socket.socket:
    """Captures packets from now on; :func:`passed` reads them afterwards. Raises PebbleError without permission."""
    try:
        wire = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM)  # no protocol: it receives nothing yet
    except OSError as error:
        raise PebbleError(f"--profile captures packets on loopback, which requires root: {error.strerror}") from None
    wire.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER)
    wire.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    wire.setblocking(False)
    wire.bind(("lo", _ETH_P_IP))
    return wire


def passed(wire: socket.socket) -> dict[tuple[int, str], dict[Wheels, int]]:
    """By port, from or to it: when (CLOCK_MONOTONIC, ns) each command passed first."""
    offset = time.time_ns() - time.monotonic_ns()  # the kernel stamps packets by the wall clock
    found: dict[tuple[int, str], dict[Wheels, int]] = {}
    with suppress(BlockingIOError):
        while True:
            packet, stamps, _, _ = wire.recvmsg(65_536, 64)
            seconds, ns = struct.unpack("qq", stamps[0][2])
            for ports, wheels in commands(packet):
                for end in zip(ports, ("from", "to"), strict=True):
                    found.setdefault(end, {}).setdefault(wheels, seconds * 1_000_000_000 + ns - offset)
    return found


def commands(packet: bytes) -> list[tuple[tuple[int, int], Wheels]]:
    """The drive commands in an IP packet: source and destination port, and the wheel speeds."""
    source, destination = struct.unpack_from("!HH", packet, 4 * (packet[0] & 15))
    return [((source, destination), wheels_of(found)) for found in _COMMAND.findall(packet)]


# -- the report


LATENCIES = Grid(
    title="Commands down, reports up; and the load on the robot", rows=("conditions", "variant"),
    columns=(percentile_column(50, "p50 ms"), *map(percentile_column, (95, 99, 100)), COUNT, LOST),
    baseline=STAND_IN, of=lambda cell: cell.measure != CPU,
)  # fmt: skip
CPU_TABLE = Grid(
    title="CPU for each forwarded message, us: median (minimum to maximum) of the rounds",
    rows=("load", "variant", "process"), heads=("load", "robot", "process"),
    columns=(SPREAD, COUNT), baseline=STAND_IN, of=lambda cell: cell.measure == CPU,
)  # fmt: skip
MEANWHILE = Grid(
    title="Meanwhile", rows=("variant", "load"), heads=("robot", "load"),
    columns=(
        single_column("CPU %", "cpu_percent", ".1f"),
        *(single_column(f"{name}/s", f"{name}_per_s", ".1f") for name in FLOWS),
    ),
    of=lambda cell: cell.measure == DOWN and "cpu_percent" in cell.figures,
)  # fmt: skip


def matches(measure: str, *kinds: str, **params: str) -> Callable[[Cell], bool]:
    """Whether a cell has this measure, is of one of these robots (or of any of ours), and has these parameters."""
    known = kinds or KINDS
    return lambda cell: cell.measure == measure and cell.variant in known and params.items() <= cell.params.items()


def _aims() -> Iterator[Aim | RatioAim]:
    for (measure_, load), what in AIMED.items():
        for percent, ms, least in AIMS_MS:
            yield Aim(
                what=f"{{variant}}, {what}, p{percent} at most {{bound:g}} ms",
                of=matches(measure_, load=load), value=with_lost(percent), at_most=ms, unit="ms",
                least=least, least_rounds=LEAST_ROUNDS, never="not within 1 s",
            )  # fmt: skip
    for percent, (*bounds, least) in AIMS_COMMANDS.items():
        for kind, at_most in zip(KINDS, bounds, strict=True):
            yield RatioAim(
                what=f"{{variant}}, {AIMED[DOWN, COMMANDS]}, p{percent} at most {{bound:.2f}} of {STAND_IN}'s",
                of=matches(DOWN, kind, load=COMMANDS), to=STAND_IN, percent=percent, at_most=at_most, least=int(least),
            )  # fmt: skip
    for process, both in AIMS_CPU.items():
        what = f"{CPU} of the {process}, commands and reports"
        for kind, at_most in zip(KINDS, both, strict=True):
            yield RatioAim(
                what=f"{{variant}}, {what}, at most {{bound:.2f}} of {STAND_IN}'s",
                of=matches(CPU, kind, load=UNLOADED, process=process), to=STAND_IN, at_most=at_most,
            )  # fmt: skip


_OPTIONS = (
    Option(name="with-media", kind=bool, help="Also with 1080p pictures and sound, and compare."),
    rounds("How often robots are started."),
    seconds("Driving time per robot and round, under each load; at most 4 with media."),
    Option(name="null", kind=bool, recorded=False, help="One robot against itself, also slowed down by a fifth."),
    Option(name="profile", kind=bool, recorded=False, help="Latency of a command hop by hop."),
)
_OURS = variants(KINDS, "mqtt or zenoh.")
_UNSET = dict.fromkeys(_MODES, False)

BRIDGE_NULL = Comparison(
    name="bridge-null",
    title="Operator to wheels: the null test",
    what="One robot in three roles that take turns: plain, again, and with a fifth of the usual latency planted by "
    "the operator. The first interval must include 1.00, the second must lie above it.",
    options=(*_OPTIONS, _OURS),
    full=Budget(150, **{**_UNSET, "null": True}, rounds=10, seconds=4.0, fresh_every=10_000),
    quick=Budget(14, rounds=4, seconds=0.5),
    constants={"rate_hz": NULL_RATE_HZ},
    is_null=True,
    variants=KINDS[1:],
    conditions=lambda _run: [{"load": UNLOADED}],
    prepare=prepare,
    environment=lambda run: running(run["variants"][0]),
    measure=pilot,
    # very short turns, so that a disturbance of the machine hits all roles
    measure_round=lambda round_: _in_turns(round_, UNLOADED, {round_.run["variants"][0]: round_.env}, NULL_RATE_HZ),
    tables=(LATENCIES,),
    assessment=(null.assessment,),
    words=("bench", "bridge"),
    reported=("--null",),
    pictures=(null_ratios("Null test of bridge"), ecdf("Null test of bridge")),
)
BRIDGE_PROFILE = Comparison(
    name="bridge-profile",
    title="Operator to wheels: where the time goes",
    what="The same path of a command, hop by hop, from the time stamps of its packets on loopback: for a typical "
    "command, and for the slowest ones.",
    options=(*_OPTIONS, _OURS),
    full=Budget(60, **{**_UNSET, "profile": True}, rounds=3, seconds=10.0),
    quick=Budget(12, rounds=1, seconds=2.0),
    constants={"rate_hz": RATE_HZ},
    variants=KINDS,
    prepare=prepare,
    measure=trace_commands,
    tables=(
        Grid(
            title="Each hop of a command, ms", rows=("variant", "hop"),
            columns=(*map(percentile_column, (50, 99, 100)), COUNT),
        ),
    ),
    root=True,
    words=("bench", "bridge"),
    reported=("--profile",),
    pictures=(ecdf("Operator to wheels, hop by hop"),),
)  # fmt: skip
BRIDGE = Comparison(
    name="bridge",
    title="Operator to wheels, and back",
    what="A whole robot of each kind, with a stock broker between it and the operator. Down is from the operator's "
    "publish call to the last byte of the command's line at the MCU's pty; up is from the MCU's report to the "
    "operator. Under “commands” robots forward no reports. CPU is that of the process that bridges, and of the one "
    "that owns the serial line, for each command and report that they forwarded.",
    help="Drive commands from an operator to the wheels of a whole simulated robot, and its telemetry back: on MQTT, "
    "Zenoh and plain paho, compared with one hop through a stock broker. Needs mosquitto.",
    options=(*_OPTIONS, variants((STAND_IN, *KINDS), "paho, mqtt, zenoh; --null: one of ours, zenoh by default.")),
    full=Budget(1900, **_UNSET, rounds=10, seconds=25.0),
    quick=Budget(22, rounds=2, seconds=0.5),
    constants={"rate_hz": RATE_HZ},
    variants=(STAND_IN, *KINDS),
    references=(HOP,),
    conditions=lambda run: [{"load": load} for load in (UNLOADED, COMMANDS, LOADED)[: 2 + run["with-media"]]],
    prepare=prepare,
    measure_round=measure,
    measures=(DOWN, UP, CPU),
    figures=dict.fromkeys(("cpu_percent", "frames_per_s", "video_per_s", "audio_per_s"), of_known(fmean, 1)),
    tables=(LATENCIES, CPU_TABLE, MEANWHILE),
    assessment=(
        Claims(
            what="Median, {measure}, load {load}", judged=lambda cell: cell.params["load"] == UNLOADED,
            of=lambda cell: cell.measure != CPU and cell.variant in KINDS,
        ),
        Claims(
            what="{measure}, {process}, load {load}", quantity={CPU: "CPU time"},
            of=lambda cell: cell.measure == CPU and cell.variant in KINDS, judged=lambda _cell: False,
        ),
        *_aims(),
    ),
    modes={"null": BRIDGE_NULL, "profile": BRIDGE_PROFILE},
    summary_lines=3,
    reported_full=("--with-media",),
    pictures=(
        ecdf("Operator to wheels and back", measures=(DOWN, UP)),
        ratios("Operator to wheels and back", "mqtt", measures=(DOWN, UP)),
        bars("Operator to wheels and back", measures=(CPU,), panel="load", group="process"),
    ),
)  # fmt: skip
