"""Measures the latency of drive commands to the wheels and of MCU reports to the operator, on MQTT and on Zenoh.

Down: from the operator's publish call to the last byte of the command's line at the MCU's pty. Up: from the moment at
which the MCU writes a report until the operator receives it. In between are a remote broker, the bridge, the robot's
local transport and the serial bridge. Real processes, stock mosquitto, loopback.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from statistics import fmean
from typing import Any

from rich.table import Table

from pebble.bench import null
from pebble.bench.aims import Aim, RatioAim, with_lost
from pebble.bench.bridge_operator import (
    FLOWS,
    FORWARDER,
    HOP,
    RATE_HZ,
    SERIAL,
    STAND_IN,
    Arrived,
    Driven,
    DrivenRobot,
    DriveSegment,
    OneHop,
)
from pebble.bench.bridge_profile import PacketCapture, profile_assessment, profile_tables, trace_commands
from pebble.bench.comparison import Budget, Case, Comparison, Option, Round, Run, of_known, rounds, seconds, variants
from pebble.bench.pictures import bars, ecdf, null_ratios, ratios
from pebble.bench.ratios import LEAST_ROUNDS, paired
from pebble.bench.results import Cell, Value, grouped
from pebble.bench.tables import (
    Grid,
    base_of,
    caveat,
    figure,
    latency_table,
    plain_table,
    sentence,
    single_column,
    spread,
)
from pebble.errors import PebbleError
from pebble.rig.robot import KINDS

UNLOADED, COMMANDS, LOADED = "none", "commands", "media"  # unloaded: 20 commands and 50 reports a second
DOWN, UP, CPU = "down", "up", "CPU per message"
_LOSS_SHOWN = 0.005
WAYS = {DOWN: "command to the wheels", UP: "report to the operator"}
SUFFIXES = {UNLOADED: "", COMMANDS: ", commands only", LOADED: ", media flowing"}
_MEANWHILE = Grid(
    title="Meanwhile", rows=("variant", "load"), heads=("robot", "load"),
    columns=(
        single_column("CPU %", "cpu_percent", ".1f"),
        *(single_column(f"{name}/s", f"{name}_per_s", ".1f") for name in FLOWS),
    ),
    of=lambda cell: cell.measure == DOWN and "cpu_percent" in cell.figures,
)  # fmt: skip
NULL_RATE_HZ = 100.0  # more than an operator's 20 a second, to shorten the test
AIMS_MS, AIMED = {50: 0.7, 99: 2.0}, ((DOWN, UNLOADED), (UP, UNLOADED), (DOWN, COMMANDS))
#: At most this ratio to the stand-in. Commands, by percentile: nothing else is forwarded.
AIMS_COMMANDS = {50: {"mqtt": 1.0, "zenoh": 1.05}, 99: {"mqtt": 0.5, "zenoh": 0.5}}
#: CPU for each message, by process: commands and reports are forwarded.
AIMS_CPU = {FORWARDER: {"mqtt": 1.0, "zenoh": 1.1}, SERIAL: {"mqtt": 1.1, "zenoh": 1.4}}
LEAST_SAMPLES = {50: 1, 99: 300}  # to assess an aim: with fewer, hardly any lie beyond that percentile
LEAST_IN_ROUND = {50: 1, 99: 100}  # to compare by rounds: with fewer, p99 is the maximum
_TURN_S, _NULL_TURN_S = 1.0, 0.05  # of driving one robot before the next one
_STARTUP_S = 1.0  # for start-up work to finish
_MEDIA_STARTUP_S = 1.0
_LOADED_S = 4.0  # at most, of driving each robot while media flow
_PILOT_S = 2.0
_MODES = ("with-media", "null", "profile")


def conditions(run: Run) -> list[dict[str, Value]]:
    return [{"load": load} for load in (UNLOADED, COMMANDS, *([LOADED] if run["with-media"] else []))]


def prepare(run: Run) -> None:
    """Raises PebbleError if several modes are wanted."""
    if len(named := [f"--{name}" for name in _MODES if run[name]]) > 1:
        raise PebbleError(f"{' and '.join(named)} are different runs: give one of them")
    turn_s = _NULL_TURN_S if run.comparison.is_null else _TURN_S
    run.options["passes"] = max(1 + run.comparison.is_null, round(run["seconds"] / turn_s))


def prepare_profile(run: Run) -> None:
    """Raises PebbleError without permission to capture packets."""
    prepare(run)
    run.options["passes"] = 1
    with PacketCapture(()):
        pass


def measure(round_: Round) -> Iterator[Cell]:
    """Fresh robots that forward reports, also with media; and fresh ones that do not. In turn, the other way round."""
    run = round_.run
    for load in (COMMANDS, UNLOADED) if round_.number % 2 else (UNLOADED, COMMANDS):
        reports, media = load == UNLOADED, load == UNLOADED and run["with-media"]
        with ExitStack() as stack:
            run.show("starting the robots")
            driven: dict[str, Driven] = {
                kind: stack.enter_context(DrivenRobot(kind, media=media and kind in KINDS, reports=reports))
                for kind in run["variants"]
            }
            if reports:
                driven[HOP] = stack.enter_context(OneHop())
            for one in driven.values():
                one.wait()
            time.sleep(_STARTUP_S)
            yield from _in_turns(round_, load, driven)
            if media:
                yield from _with_media(round_, driven)


def _in_turns(round_: Round, load: str, driven: Mapping[str, Driven]) -> Iterator[Cell]:
    """Drives each of them for the seconds of a round, in as many turns as there are passes."""
    turn_s = round_.run["seconds"] / round_.run["passes"]
    cases = (case for case in round_.cases([{"load": load}]) if case.variant in driven)
    turns = [(case, driven[case.variant].drive(turn_s)) for case in cases]
    for name, one in driven.items():
        own = [(case, segment) for case, segment in turns if case.variant == name]
        found = one.match_arrivals([segment for _, segment in own])
        for (case, segment), arrived in zip(own, found, strict=True):
            yield from cells_of(case, segment, arrived)


def _with_media(round_: Round, driven: Mapping[str, Driven]) -> Iterator[Cell]:
    """One robot after the other, while its own camera and microphone are in use; the stand-in has none."""
    for case in round_.cases([{"load": LOADED}], 1):
        robot = driven[case.variant]
        if isinstance(robot, DrivenRobot) and case.variant in KINDS:
            with robot.media_load() as counts:
                time.sleep(_MEDIA_STARTUP_S)
                before = counts()
                segment = robot.drive(min(case.run["seconds"], _LOADED_S))
                after = counts()
            (arrived,) = robot.match_arrivals([segment])
            yield from cells_of(case, segment, arrived, {name: after[name] - before[name] for name in after})


def cells_of(
    case: Case, segment: DriveSegment, arrived: Arrived, flowed: Mapping[str, int] | None = None
) -> Iterator[Cell]:
    """Of one turn; ``flowed`` counts the media received meanwhile."""
    load, took_s = case.condition["load"], (segment.ended - segment.began) / 1e9
    figures: dict[str, Any] = {"cpu_percent": 100 * segment.cpu_s / took_s} if segment.cpu_s else {}
    figures |= {f"{name}_per_s": count / took_s for name, count in (flowed or {}).items()}
    yield case.cell(DOWN, "ms", arrived.down, sent=arrived.sent, **figures)
    if load != COMMANDS and case.variant != HOP:
        yield case.cell(UP, "ms", arrived.up, sent=arrived.reports, **figures)
    if load != LOADED:
        for part, cpu_s in segment.parts_cpu_s.items():
            each = [1e6 * cpu_s / arrived.forwarded] if arrived.forwarded else []
            yield case.cell(CPU, "us", each, {"process": part})


# -- the null test


@contextmanager
def _running_robot(run: Run) -> Iterator[DrivenRobot]:
    """One for all roles and rounds: fresh robots would differ by more than the planted difference."""
    (kind,) = run["variants"]
    with DrivenRobot(kind) as driven:
        driven.wait()
        time.sleep(_STARTUP_S)
        yield driven


def pilot(case: Case) -> Iterator[Cell]:
    """The usual latency. Raises PebbleError if no command arrives."""
    (found,) = case.env.match_arrivals([case.env.drive(_PILOT_S, NULL_RATE_HZ)])
    if not found.down:
        raise case.env.problem("no command arrived")
    yield case.cell(DOWN, "ms", found.down)


def in_roles(round_: Round) -> Iterator[Cell]:
    """Very short turns, so that a disturbance of the machine hits all roles.

    The operator works before every command; only in the slowed role it reads the clock before that work.
    """
    robot, run = round_.env, round_.run
    cases, segments, turn_s = [], [], run["seconds"] / run["passes"]
    for case in round_.cases():
        cases.append(case)
        segments.append(robot.drive(turn_s, NULL_RATE_HZ, work_us=case.planted_us, slowed=case.slowed))
    run.notes[:] = [
        f"Planted: {cases[0].planted_us:.0f} us, a fifth of the usual latency. All {run.rounds} rounds are turns of"
        " one running robot, not fresh robots, and only commands to the wheels are assessed."
    ]
    for case, arrived in zip(cases, robot.match_arrivals(segments), strict=True):
        yield case.cell(DOWN, "ms", arrived.down, sent=arrived.sent)


# -- the report


def legend(cells: Sequence[Cell]) -> Iterator[str]:
    if cells:
        yield f"{UNLOADED}: 20 commands and 50 reports a second; {COMMANDS}: the robots forward no reports"


def tables(cells: Sequence[Cell]) -> Iterator[Table]:
    """The latencies, CPU for each message, then CPU and media rates of the same time."""
    if some := [cell for cell in cells if cell.measure in WAYS]:
        baseline = STAND_IN if any(cell.variant == STAND_IN for cell in some) else null.variant_of(some[0].variant)
        yield latency_table("Commands down, reports up; and the load on the robot", some, baseline)
    if some := [cell for cell in cells if cell.measure == CPU]:
        yield _cpu_table(some)
    if any(map(_MEANWHILE.of, cells)):
        yield from _MEANWHILE(cells)


def _cpu_table(cells: Sequence[Cell]) -> Table:
    title = "CPU for each forwarded message: median (minimum to maximum) of the rounds"
    table = plain_table(title, ["load", "process", "robot", "us", "turns", f"/ {STAND_IN}"], left=3)
    for place, some in grouped(cells, lambda cell: tuple(map(str, cell.params.values()))).items():
        table.add_section()
        for cell, shown in zip(some, [place, *len(some) * [("", "")]], strict=False):
            base = base_of(cell, cells, STAND_IN)
            ratio = "" if base is None else str(paired(cell.rounds, base.rounds))
            table.add_row(*shown, cell.variant, spread(cell), str(len(cell.samples)), ratio)
    return table


def assessment(cells: Sequence[Cell]) -> Iterator[str]:
    """One sentence for each comparison."""
    for load, suffix in SUFFIXES.items():
        for way, words in WAYS.items():
            what, robots = f"Median, {words}{suffix}", _found(cells, way, load)
            if robots:
                yield sentence(what, robots, quantity="time")
            for plain in _found(cells, way, load, [STAND_IN]):
                yield from (sentence(what, [plain, one], quantity="time") for one in robots if plain.samples)
    for way, words in WAYS.items():
        for loaded in _found(cells, way, LOADED):
            for free in _found(cells, way, UNLOADED, [loaded.variant]):
                yield f"{free.variant}, {words}, p99: {_media_effect(loaded, free)}"
    for cell in cells:
        if cell.measure == CPU and (base := base_of(cell, cells, STAND_IN)) is not None:
            load = "commands and reports" if cell.params["load"] == UNLOADED else "commands only"
            yield sentence(f"{CPU}, {cell.params['process']}, {load}", [base, cell], quantity="CPU time")
    yield from _floor(cells)
    yield from _lost(cells)
    yield from caveat([cell for way in WAYS for cell in _found(cells, way, UNLOADED)])


def matches(measure: str, variants: Sequence[str], **params: str) -> Callable[[Cell], bool]:
    """Whether a cell has this measure, one of these variants and these parameters."""
    return lambda cell: cell.measure == measure and cell.variant in variants and params.items() <= cell.params.items()


def _found(cells: Sequence[Cell], measure: str, load: str, variants: Sequence[str] = KINDS) -> list[Cell]:
    """In the order of the variants."""
    return [cell for name in variants for cell in filter(matches(measure, [name], load=load), cells)]


def _media_effect(loaded: Cell, free: Cell) -> str:
    """Compares p99 with and without media."""
    times = f"{figure(free.percentile(99))} ms, with media {figure(loaded.percentile(99))} ms"
    rounds = [*loaded.rounds, *free.rounds]
    if min(len(loaded.rounds), len(free.rounds)) < LEAST_ROUNDS or min(map(len, rounds)) < LEAST_IN_ROUND[99]:
        return times
    ratio = paired(loaded.rounds, free.rounds, 99)
    return f"{times}; {ratio.words('the robot with media', 'the one without')}"


def _floor(cells: Sequence[Cell]) -> Iterator[str]:
    """The time a robot adds to one hop through a broker."""
    robots = _found(cells, DOWN, UNLOADED)
    for hop in (cell for cell in cells if cell.variant == HOP and cell.samples and robots):
        floor = hop.percentile(50)
        more = ", ".join(f"{cell.variant} {figure(cell.percentile(50) - floor)} ms more" for cell in robots)
        yield f"One hop, operator to a stock client through a broker of their own, takes {figure(floor)} ms; {more}."


def _lost(cells: Sequence[Cell]) -> Iterator[str]:
    """Reports losses above a threshold."""
    for cell in (cell for cell in cells if cell.measure in WAYS):
        lost, sent = cell.lost or 0, len(cell.samples) + (cell.lost or 0)
        if lost > _LOSS_SHOWN * sent:
            what = f"{cell.variant}, {WAYS[cell.measure]}{SUFFIXES[str(cell.params['load'])]}"
            yield f"{what}: {100 * lost / sent:.1f} % of {sent} were overtaken, or did not arrive within 1 s."


def _with_excess(aim: float) -> Callable[[float], str]:
    """Formats a latency, with what it takes longer than an aim."""
    return lambda ms: f"{figure(ms)} ms" + (f", by {ms - aim:.2f} ms" if ms > aim else "")


def _aims() -> Iterator[Aim | RatioAim]:
    for measure_, load in AIMED:
        for percent, at_most in AIMS_MS.items():
            yield Aim(
                what=f"{{variant}}, {WAYS[measure_]}{SUFFIXES[load]}, p{percent} at most {{bound:g}} ms",
                of=matches(measure_, KINDS, load=load), value=with_lost(percent), at_most=at_most,
                least=LEAST_SAMPLES[percent], least_rounds=LEAST_ROUNDS,
                shown=_with_excess(at_most), never="not within 1 s",
            )  # fmt: skip
    for percent, bounds in AIMS_COMMANDS.items():
        what, least = f"{WAYS[DOWN]}{SUFFIXES[COMMANDS]}, p{percent}", LEAST_IN_ROUND[percent]
        yield from _ratio_aims(what, bounds, DOWN, percent=percent, least=least, load=COMMANDS)
    for process, bounds in AIMS_CPU.items():
        yield from _ratio_aims(
            f"{CPU} of the {process}, commands and reports,", bounds, CPU, load=UNLOADED, process=process
        )


def _ratio_aims(
    what: str, bounds: Mapping[str, float], measure: str, percent: int = 50, least: int = 1, **params: str
) -> Iterator[RatioAim]:
    for kind, at_most in bounds.items():
        yield RatioAim(
            what=f"{{variant}}, {what} at most {{bound:.2f}} of {STAND_IN}'s",
            of=matches(measure, [kind], **params), to=STAND_IN, percent=percent, at_most=at_most, least=least,
        )  # fmt: skip


def _options(known: Sequence[str]) -> tuple[Option, ...]:
    return (
        Option(name="with-media", kind=bool, help="Also with 1080p pictures and sound, and compare."),
        rounds("How often robots are started."),
        seconds("Driving time per robot and round, under each load; at most 4 with media."),
        variants(known, "Some of paho, mqtt and zenoh. [--null: one of mqtt and zenoh, by default zenoh]"),
        Option(
            name="null", kind=bool, recorded=False,
            help="One robot against itself, and against itself slowed down by a fifth.",
        ),
        Option(name="profile", kind=bool, recorded=False, help="Latency of a command hop by hop."),
    )  # fmt: skip


_UNSET = dict.fromkeys(_MODES, False)

BRIDGE_NULL = Comparison(
    name="bridge-null",
    title="Operator to wheels: the null test",
    what="One robot in three roles that take turns: plain, again, and with a fifth of the usual latency planted by "
    "the operator. The first interval must include 1.00, the second must lie above it.",
    options=_options(KINDS),
    full=Budget(150, **{**_UNSET, "null": True}, rounds=10, seconds=4.0, fresh_every=10_000),
    quick=Budget(14, rounds=4, seconds=0.5),
    constants={"rate_hz": NULL_RATE_HZ},
    is_null=True,
    variants=KINDS[1:],
    conditions=lambda _run: [{"load": UNLOADED}],
    prepare=prepare,
    environment=_running_robot,
    measure=pilot,
    measure_round=in_roles,
    tables=(tables,),
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
    options=_options(KINDS),
    full=Budget(60, **{**_UNSET, "profile": True}, rounds=3, seconds=10.0),
    quick=Budget(12, rounds=1, seconds=2.0),
    constants={"rate_hz": RATE_HZ},
    variants=KINDS,
    prepare=prepare_profile,
    measure=trace_commands,
    tables=(profile_tables,),
    assessment=(profile_assessment,),
    root=True,
    words=("bench", "bridge"),
    reported=("--profile",),
    pictures=(ecdf("Operator to wheels, hop by hop"),),
)
BRIDGE = Comparison(
    name="bridge",
    title="Operator to wheels, and back",
    what="A whole robot of each kind, with a stock broker between it and the operator. Down is from the operator's "
    "publish call to the last byte of the command's line at the MCU's pty; up is from the MCU's report to the "
    "operator. Under “commands” robots forward no reports. CPU is that of the process that bridges, and of the one "
    "that owns the serial line, for each command and report that they forwarded.",
    help="""Drive commands from an operator to the wheels of a whole simulated robot, and its telemetry back.

    Latency at 20 commands and 50 reports a second, and at 20 commands alone, on MQTT, on Zenoh and of a robot of plain
    paho, compared with one hop through a stock broker. With --with-media also while a program on the robot reads
    1920x1080 frames at 30 Hz and an operator receives video and audio. Needs mosquitto.

    \b
        pebble bench bridge
        pebble bench bridge --with-media --output results
        pebble bench bridge --seconds 4
        pebble bench bridge --profile
    """,
    options=_options((STAND_IN, *KINDS)),
    full=Budget(1900, **_UNSET, rounds=10, seconds=25.0),
    quick=Budget(22, rounds=2, seconds=0.5),
    constants={"rate_hz": RATE_HZ},
    variants=(STAND_IN, *KINDS),
    references=(HOP,),
    conditions=conditions,
    prepare=prepare,
    measure_round=measure,
    measures=(DOWN, UP, CPU),
    figures=dict.fromkeys(("cpu_percent", "frames_per_s", "video_per_s", "audio_per_s"), of_known(fmean, 1)),
    tables=(tables,),
    legend=legend,
    assessment=(assessment, *_aims()),
    modes={"null": BRIDGE_NULL, "profile": BRIDGE_PROFILE},
    summary_lines=3,
    reported_full=("--with-media",),
    pictures=(
        ecdf("Operator to wheels and back", measures=(DOWN, UP)),
        ratios("Operator to wheels and back", "mqtt", measures=(DOWN, UP)),
        bars("Operator to wheels and back", measures=(CPU,), panel="load", group="process"),
    ),
)  # fmt: skip
