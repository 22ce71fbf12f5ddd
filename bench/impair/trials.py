"""Robots behind impaired networks: in each trial it is impaired, and an operator drives and watches."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from itertools import islice
from typing import TypeVar

from pebble.bench.comparison import Budget, Comparison, Option, Round, Run
from pebble.bench.impair.cells import Trial, cells_of, over_time
from pebble.bench.impair.conditions import TRIALS, Condition, chosen
from pebble.bench.impair.metrics import RecoveryRequest, TrialRequest
from pebble.bench.impair.network import KINDS, Traffic, resolved
from pebble.bench.impair.report import AIMS, QUOTED, SENTENCES, TABLES
from pebble.bench.impair.robots import CLIP_S, FPS, HEIGHT, SUBJECTS, WIDTH, ImpairedRobot, TestBed
from pebble.bench.pictures import Drawn
from pebble.bench.results import LONGEST_S, Cell
from pebble.errors import PebbleError

_T = TypeVar("_T")

CLEAN = Condition("clean")
QUICK = ("base-start", "256k", "64k+5%", "base-end")
NAMES = tuple(subject.name for subject in SUBJECTS)
_UP_S, _RECOVERED_S, _PHASE_S = 80.0, 30.0, 30.0  # limits for an operator's next report; its own limits are shorter
_CLIP_S = 5.0  # at most
_LINKS = {
    "namespaces": "network namespaces, {} impaired",
    "proxy": "a userspace proxy, loss modelled; {} impaired",
}


def prepare(run: Run) -> None:
    """Chooses the kind of network; the recorded command line uses the same kind. Raises PebbleError."""
    run.options["link"], why_proxy = resolved(run["link"])
    if why_proxy is not None:
        why = f"A proxy replaces the network namespaces: {why_proxy}"
        run.console.print(why, highlight=False, soft_wrap=True)
    words = _LINKS[run["link"]].format("both directions" if run["both_ways"] else "robot's uplink")
    run.recorded |= {"link_words": words, "why_proxy": why_proxy}  # None: no proxy, or a requested one


def conditions(run: Run) -> list[Condition]:
    """The requested ones in the paper's order."""
    return chosen(run["trials"], run["both_ways"])


@contextmanager
def test_bed(run: Run) -> Iterator[TestBed]:
    run.show("starting the robots")
    with TestBed([one for one in SUBJECTS if one.name in run["variants"]], run["link"]) as bed:
        yield bed


def groups(run: Run, robots: Sequence[ImpairedRobot]) -> list[list[ImpairedRobot]]:
    """Those that run at the same time: the transports of one form, to limit the load on small machines; or all."""
    if run["all_at_once"]:
        return [list(robots)]
    forms = dict.fromkeys(robot.subject.form for robot in robots)
    return [[robot for robot in robots if robot.subject.form == form] for form in forms]


def measure(round_: Round) -> Iterator[Cell]:
    """All trials; one that fails ends them, and the earlier ones count. Raises PebbleError if there are none."""
    run, bed = round_.run, round_.env
    began_ns, trials, marks = time.monotonic_ns(), list[Trial](), list[str]()
    with ThreadPoolExecutor(len(bed.robots), thread_name_prefix="subject") as pool:
        at_once = partial(_at_once, pool)
        try:
            at_once(bed.robots, lambda robot: robot.next_report(_UP_S))
            cases = round_.cases()
            for number, condition in enumerate(conditions(run)):
                list(islice(cases, len(bed.robots)))  # for the progress that is shown
                turn = slice(None, None, -1 if number % 2 else 1)
                for place, group in enumerate(groups(run, bed.robots)[turn]):
                    run.show(f"{condition.name}: {', '.join(robot.subject.name for robot in group)}")
                    at_once(group[turn], partial(_recover, run=run))
                    if not place:
                        marks.append(f"{condition.name}@{(time.monotonic_ns() - began_ns) / 1e9:.1f}")
                    trials += _tried(run, condition, group[turn], at_once)
        except PebbleError as error:
            if not trials:
                raise
            run.problem = PebbleError(f"the trials ended early: {error}")
        finally:
            bed.end_trials()  # unblocks threads that wait for an operator
    run.recorded["marks"] = ";".join(marks)
    yield from cells_of(trials, FPS)
    yield from over_time(trials, began_ns)


def _at_once(pool: ThreadPoolExecutor, robots: Sequence[ImpairedRobot], act: Callable[[ImpairedRobot], _T]) -> list[_T]:
    """Runs ``act`` for all robots at the same time; the first error ends it."""
    futures = [pool.submit(act, robot) for robot in robots]
    for future in wait(futures, return_when=FIRST_EXCEPTION).done:
        future.result()
    return [future.result() for future in futures]


def _tried(
    run: Run,
    condition: Condition,
    robots: Sequence[ImpairedRobot],
    at_once: Callable[..., list[Trial]],
) -> list[Trial]:
    at_once(robots, lambda robot: robot.network.apply(condition))
    trials = at_once(robots, lambda robot: _trial(run, robot, condition.name))
    at_once(robots, lambda robot: robot.network.apply(CLEAN))
    return trials


def _recover(robot: ImpairedRobot, run: Run) -> None:
    robot.send(RecoveryRequest(quiet_s=run["quiet_s"]))
    robot.next_report(_RECOVERED_S)


def _trial(run: Run, robot: ImpairedRobot, name: str) -> Trial:
    began_ns, subject = time.monotonic_ns(), robot.subject
    lengths = {phase: run[phase] for phase in ("alone_s", "window_s", "grace_s", "off_s", "clip_s")}
    robot.send(TrialRequest(video=subject.video, audio=subject.audio, **lengths))
    traffic: dict[str, tuple[Traffic, Traffic]] = {}
    phase, before = "", Traffic()
    while True:
        report = robot.next_report(_PHASE_S + run["window_s"])
        if report.record is not None:
            return Trial(subject.name, name, report.record, robot.entries(began_ns), traffic, robot.playbacks())
        if report.phase:
            phase, before = report.phase, robot.network.traffic()
        else:
            traffic[phase] = before, robot.network.traffic()


IMPAIR = Comparison(
    name="impair",
    title="On an impaired network",
    what="Whole robots whose uplink is limited and loses packets, trial after trial, as in section 4.2 of the "
    "paper: heartbeat, driving, video, then audio in each. “original” is this Pebble with the original's encodings "
    "(JSON video, PCM audio); “h264 opus” are the encodings with rate control.",
    options=(
        Option(name="trials", many=True, known=TRIALS, metavar="NAMES", recorded=False,
               help="Some of them, separated by commas."),
        Option(name="subjects", sets="variants", many=True, known=NAMES, metavar="NAMES",
               help='Such as "mqtt original,zenoh h264 opus".'),
        Option(name="both-ways", sets="both_ways", kind=bool, help="Impair the direction to the robot, too."),
        Option(name="link", known=KINDS, metavar="KIND", help="auto, namespaces (needs root) or proxy."),
        Option(name="window", sets="window_s", kind=float, least=1.0, most=LONGEST_S,
               help="Seconds of video, and of audio, per trial."),
    ),
    full=Budget(1300, trials=list(TRIALS), both_ways=False, link="auto", window_s=8.0, alone_s=3.0, grace_s=2.0,
                off_s=2.0, quiet_s=2.0, clip_s=_CLIP_S, all_at_once=False),
    quick=Budget(85, trials=list(QUICK), window_s=4.0, alone_s=2.0, grace_s=1.0, off_s=1.0, quiet_s=1.0,
                 all_at_once=True),
    constants={
        "picture": f"{WIDTH}x{HEIGHT} at {FPS} a second, synthetic, jpeg_quality 10, keyframe_interval 5",
        "sound": "16 kHz mono, chunks of 20 ms, synthetic speech",
        "drive_hz": 10,
        "soundboard": f"a wav file of {CLIP_S:g} s, played by a simulated loudspeaker",
    },
    variants=NAMES,
    conditions=lambda run: [{"trial": condition.name} for condition in conditions(run)],
    prepare=prepare,
    environment=test_bed,
    measure_round=measure,
    figures={"sent": lambda values: values[-1]},  # of the only round; None if nothing arrived
    tables=TABLES,
    title_suffix=", over {link_words}, windows of {window_s:g} s{quick}",
    legend=lambda _cells: QUOTED,
    assessment=(*AIMS, *SENTENCES),
    complete=lambda _cells: True,  # in the worst trials nothing may arrive
    pictures=(Drawn("pebble.bench.impair.pictures:over_trials"), Drawn("pebble.bench.impair.pictures:over_time")),
    summary_lines=9,
    words=("impair",),
)  # fmt: skip
