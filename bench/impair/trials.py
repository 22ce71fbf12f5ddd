"""Robots behind impaired networks: in each trial it is impaired, and an operator drives and watches."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec

from pebble.bench.comparison import Budget, Comparison, Measuring, Option, Report, Round, Run
from pebble.bench.impair import metrics
from pebble.bench.impair.conditions import CONDITIONS, Condition
from pebble.bench.impair.metrics import OperatorReport, Plan, Trial, cells_of, over_time
from pebble.bench.impair.network import REMOTE_HOST, NamespaceNetwork, Traffic, require_namespaces
from pebble.bench.impair.operator import CLIP
from pebble.bench.impair.thin import IMPAIR_THIN as IMPAIR_THIN
from pebble.bench.judging.aims import Aim, outcome, single, with_lost
from pebble.bench.judging.ratios import paired
from pebble.bench.pictures import Drawn
from pebble.bench.results import LONGEST_S, Cell, Judged, grouped
from pebble.bench.tables import Column, Grid, figure
from pebble.config.raw import deep_merge
from pebble.errors import PebbleError
from pebble.media.pcm import to_bytes
from pebble.media.sound_file import write_wav
from pebble.media.speech import Speech
from pebble.rig.processes import BROKERS, Processes, Program, Worker
from pebble.rig.robot import BASE, Config, Robot, synthetic_media
from pebble.simulation.loudspeaker import playbacks

CLEAN = Condition("clean")
TRIALS = [one.name for one in CONDITIONS]
QUICK = ("base-start", "256k", "64k+5%", "base-end")
PICTURES = WIDTH, HEIGHT, FPS = 640, 480, 15  # as the original is configured
CLIP_S = 0.5
_AUDIO_RATE = 16_000
_UP_S = 80.0  # for a robot to be ready; its operator waits for a shorter time
_LOSS_SHOWN = 0.005  # share of what was sent
_DRIVE_WAITS_MS = 100.0  # one command's time at 10 Hz
_OURS = "h264 opus"
_Value = Callable[[Cell], float]

NARROW = "256k"  # a trial that has aims, and its aims
NARROW_SOUND_PERCENT = 99.0  # delivered, at least
NARROW_SOUND_P95_MS = 400.0
NARROW_PICTURE_GAP_S = 1.0
WORST = "64k+5%"  # another one
WORST_SOUND_PERCENT = 95.0  # delivered, at least
WORST_DRIVE_P95_MS = 500.0
WORST_OFFLINE_S = 2.0
_p95 = with_lost(95)

#: What the operator requests; None: as the robot is configured, with the original's JSON pictures and PCM.
FORMS = {"original": (None, None), "h264 opus": ("h264", "opus")}
SUBJECTS = [f"{transport} {form}" for form in FORMS for transport in ("mqtt", "zenoh")]


# -- the robots, as processes


@dataclass(frozen=True, slots=True)
class ImpairedRobot:
    """One subject. The local broker and the robot's processes are on its side of the network; the rest is beyond it."""

    subject: str
    network: NamespaceNetwork
    robot: Robot
    remote: Program  # its broker
    operator: Worker
    limit_s: float  # for its operator's next report; the limits of that are shorter

    def next_report(self) -> OperatorReport:
        """The operator's next report. Raises PebbleError for a problem, a timeout, or if a process has ended."""
        try:
            report = msgspec.convert(self.operator.answer(self.limit_s), OperatorReport)
        except PebbleError as error:
            report = OperatorReport(problem=str(error))
        if ended := next((each for each in (self.remote, *self.robot.programs) if each.ended), None):
            raise PebbleError(f"{self.subject}: {ended.name} has ended\n{ended.tail()}".rstrip())
        if report.problem is not None:
            raise PebbleError(f"{self.subject}: {report.problem}\n{self.robot.log()}".rstrip())
        return report

    def recover(self) -> None:
        self.operator.send("recover")
        self.next_report()

    def trial(self, name: str) -> Trial:
        """The network is impaired already. Raises PebbleError."""
        began_ns, traffic = time.monotonic_ns(), dict[str, tuple[Traffic, Traffic]]()
        phase, before = "", Traffic()
        self.operator.send("trial")
        while (report := self.next_report()).record is None:
            if report.phase:
                phase, before = report.phase, self.network.traffic()
            else:
                traffic[phase] = before, self.network.traffic()
        entries, played = self.robot.lines(began_ns), playbacks(self.robot.folder)
        return Trial(self.subject, name, report.record, entries, traffic, played)


def start(subject: str, run: Run, processes: Processes) -> ImpairedRobot:
    """Starts all its processes; it is not yet ready. Raises PebbleError."""
    transport, _, form = subject.partition(" ")
    folder = processes.folder / str(SUBJECTS.index(subject))
    folder.mkdir()
    network = processes.add(NamespaceNetwork(subject), BROKERS)
    remote = processes.broker("remote broker", folder=folder, host=REMOTE_HOST, wrap=network.on_remote)
    robot = Robot(
        processes, transport, (REMOTE_HOST, remote.port), folder=folder, services=_services(folder), reports=None,
        wrap=network.on_robot,
    )  # fmt: skip
    robot.prepare()
    robot.launch()
    (video, audio), lengths = FORMS[form], {name: run[name] for name in Plan.__struct_fields__ if name.endswith("_s")}
    plan = msgspec.json.encode(Plan(video=video, audio=audio, **lengths)).decode()
    arguments = "pebble.bench.impair.operator", REMOTE_HOST, remote.port, BASE, plan
    operator = processes.worker(f"the operator of {subject}", *arguments, wrap=network.on_remote)
    return ImpairedRobot(subject, network, robot, remote, operator, limit_s=_UP_S + run["window_s"])


def _services(folder: Path) -> dict[str, Config]:
    """The original's keys and values where it has them; the loudspeaker records into the folder."""
    sound: Config = {"rate": _AUDIO_RATE, "channels": 1}
    video, audio = {"keyframe_interval": 5, "jpeg_quality": 10}, {**sound, "chunk_ms": 20}
    loudspeaker = [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(folder)]
    (sounds := folder / "sounds").mkdir()
    write_wav(sounds / CLIP, to_bytes(Speech(_AUDIO_RATE).samples(0, round(CLIP_S * _AUDIO_RATE))), _AUDIO_RATE)
    own = {
        "mqtt_bridge": {"media": {"video_publisher": video, "audio_publisher": audio}},
        "av_daemon": {"audio": sound},
        "soundboard_handler": {"playback": {"directory": str(sounds), "player_command": loudspeaker}},
    }
    services: dict[str, Config] = deep_merge(synthetic_media(PICTURES, PICTURES), own)
    return services


@contextmanager
def robots(run: Run) -> Iterator[list[ImpairedRobot]]:
    """All robots, which are not yet ready. Raises PebbleError if something does not start."""
    run.show("starting the robots")
    with Processes() as processes:
        yield [start(subject, run, processes) for subject in SUBJECTS if subject in run["variants"]]


# -- the course of the trials


def conditions(run: Run) -> list[Condition]:
    """The requested ones in the paper's order."""
    return [one for one in CONDITIONS if one.name in run["trials"]]


def groups(run: Run, every: Sequence[ImpairedRobot]) -> list[list[ImpairedRobot]]:
    """Those that run at the same time: the transports of one form, to limit the load on small machines; or all."""
    return [*grouped(every, lambda robot: run["all_at_once"] or robot.subject.partition(" ")[2]).values()]


def measure(round_: Round) -> Iterator[Cell]:
    """All trials; one that fails ends them, and the earlier ones count. Raises PebbleError if there are none."""
    run, every = round_.run, round_.env
    began_ns, trials, marks = time.monotonic_ns(), list[Trial](), dict[str, float]()
    with ThreadPoolExecutor(len(every), thread_name_prefix="subject") as pool:
        try:
            list(pool.map(ImpairedRobot.next_report, every))
            for number, condition in enumerate(conditions(run)):
                name, turn = condition.name, slice(None, None, -1 if number % 2 else 1)
                for group in (one[turn] for one in groups(run, every)[turn]):
                    run.show(f"{name}: {', '.join(robot.subject for robot in group)}")
                    list(pool.map(ImpairedRobot.recover, group))
                    marks.setdefault(name, (time.monotonic_ns() - began_ns) / 1e9)
                    list(pool.map(lambda robot, now=condition: robot.network.apply(now), group))
                    trials += list(pool.map(lambda robot, name=name: robot.trial(name), group))
                    list(pool.map(lambda robot: robot.network.apply(CLEAN), group))
        except PebbleError as error:
            if not trials:
                raise
            run.problem = PebbleError(f"the trials ended early: {error}")
        finally:
            for robot in every:
                robot.operator.ask_to_end()  # unblocks threads that wait for it
    run.recorded["marks"] = ";".join(f"{name}@{second:.1f}" for name, second in marks.items())
    yield from cells_of(trials)
    yield from over_time(trials, began_ns)


# -- the tables


def arrived(percent: float) -> _Value:
    """A percentile of what arrived; the share that arrived is in another column."""
    return lambda cell: cell.percentile(percent)


def _column(head: str, measure: str, value: str | _Value) -> Column:
    """The text of a figure, or of another value."""

    def shown(cell: Cell) -> str:
        if isinstance(value, str):
            found = cell.figures.get(value)
            return str(found) if isinstance(found, int) else figure(cell.single(value))
        return "never" if math.isinf(value(cell)) else figure(value(cell))

    return Column(head, shown, measure)


def _grid(title: str, *columns: tuple[str, str, str | _Value]) -> Grid:
    return Grid(
        title=title, rows=("trial", "variant"), heads=("trial", "subject"), of=lambda cell: "trial" in cell.params,
        columns=[_column(*one) for one in columns],
    )  # fmt: skip


TABLES = (
    _grid(
        "trials",
        ("audio\n%", metrics.SOUND, "delivered_percent"),
        ("p95\nms", metrics.SOUND, arrived(95)),
        ("video\nfps", metrics.PICTURES, "fps"),
        ("frozen\ns", metrics.PICTURES, "frozen_s"),
        ("drive\np95 ms", metrics.DRIVE, _p95),
        ("heart-\nbeat\ngap s", metrics.HEARTBEAT_GAP, "longest_gap_s"),
    ),
    _grid(
        "details of media",
        ("video\nkbit/s", metrics.PICTURES, "kbit_up"),
        ("audio\nkbit/s", metrics.SOUND, "kbit_up"),
        ("video\ndrops", metrics.PICTURES, "dropped_up"),
        ("audio\ndrops", metrics.SOUND, "dropped_up"),
        ("audio\np50 ms", metrics.SOUND, arrived(50)),
    ),
    _grid(
        "details of driving, and a clip",
        ("drive\np50 ms", metrics.DRIVE, with_lost(50)),
        ("drive\n%", metrics.DRIVE, "delivered_percent"),
        ("stopped\ntimes", metrics.DRIVE, "trips"),
        ("at rest\ns", metrics.DRIVE, "rest_s"),
        ("clip\nms", metrics.CLIP, with_lost(100)),
    ),
    _grid(
        "after media were switched off",
        ("no video\nbytes", metrics.AFTER_VIDEO, "bytes_up"),
        ("beats", metrics.AFTER_VIDEO, "heartbeats"),
        ("gap\ns", metrics.AFTER_VIDEO, "longest_gap_s"),
        ("no audio\nbytes", metrics.AFTER_AUDIO, "bytes_up"),
        ("beats", metrics.AFTER_AUDIO, "heartbeats"),
        ("gap\ns", metrics.AFTER_AUDIO, "longest_gap_s"),
    ),
)


# -- the aims, for our own encodings


def _aim(
    trial: str, words: str, measure: str, value: str | _Value, unit: str,
    *, at_most: float | None = None, at_least: float | None = None,
) -> Aim:  # fmt: skip
    def beside(cell: Cell) -> str:
        """How much was lost, and in which window."""
        sent = cell.single("sent")
        lost = (cell.lost or 0) / sent if at_most is not None and sent > 0 else 0.0
        words = f", {figure(100 * lost)} % lost" if lost > _LOSS_SHOWN else ""
        return f"{words}, window of {cell.single('window_s'):.3g} s"

    return Aim(
        what=f"{{variant}} at {trial}, {words} {'at least' if at_most is None else 'at most'} {{bound:g}} {unit}",
        of=lambda cell: cell.variant.endswith(_OURS) and (cell.measure, cell.params.get("trial")) == (measure, trial),
        value=single(value) if isinstance(value, str) else value, unit=unit, least=0, never="too much was lost",
        beside=beside, at_most=at_most, at_least=at_least,
    )  # fmt: skip


def behind_media(cells: Sequence[Cell]) -> Iterator[Judged]:
    """The aim that commands do not wait behind media. Trials with loss or delay are excluded: they dominate the p95."""
    steady = {one.name for one in CONDITIONS if not one.up.loss and not one.up.timed}
    for subject, trials in _found(cells, metrics.DRIVE_ALONE).items():
        waits = [
            (_p95(busy) - _p95(trials[trial]), f"{measure.removeprefix('drive during ')} at {trial}")
            for measure in (metrics.DRIVE_VIDEO, metrics.DRIVE_AUDIO)
            for trial, busy in _found(cells, measure).get(subject, {}).items()
            if trial in steady and math.isfinite(_p95(trials[trial]))
        ]
        if waits and subject.endswith(_OURS):
            longest_ms, where = max(waits, key=lambda one: one[0])
            most = f"most: {longest_ms:+.0f} ms" if math.isfinite(longest_ms) else "some were lost"
            yield Judged(
                what=f"{subject}, drive commands wait at most one command's time ({_DRIVE_WAITS_MS:g} ms) behind media"
                ", p95 against the same trial without",
                outcome=outcome(longest_ms <= _DRIVE_WAITS_MS),
                measured=f"{most}, {where}",
            )


AIMS = (
    _aim(NARROW, "sound delivered", metrics.SOUND, "delivered_percent", "%", at_least=NARROW_SOUND_PERCENT),
    _aim(NARROW, "sound p95", metrics.SOUND, _p95, "ms", at_most=NARROW_SOUND_P95_MS),
    _aim(NARROW, "longest time without a new picture", metrics.PICTURES, "longest_gap_s", "s",
         at_most=NARROW_PICTURE_GAP_S),
    _aim(WORST, "sound delivered", metrics.SOUND, "delivered_percent", "%", at_least=WORST_SOUND_PERCENT),
    _aim(WORST, "drive p95", metrics.DRIVE, _p95, "ms", at_most=WORST_DRIVE_P95_MS),
    _aim(WORST, "seen offline", metrics.HEARTBEAT_GAP, "longest_offline_s", "s", at_most=WORST_OFFLINE_S),
    behind_media,
)  # fmt: skip


# -- the sentences


def encodings(cells: Sequence[Cell]) -> Iterator[str]:
    share = single("on_time_percent")
    for trial in (NARROW, WORST):
        found = _found(cells, metrics.SOUND).items()
        shares = [f"{subject} {figure(share(trials[trial]))} %" for subject, trials in found if trial in trials]
        if len(shares) > 1:
            yield f"Sound that arrived within a second at {trial}: {', '.join(shares)}."


def trips(cells: Sequence[Cell]) -> Iterator[str]:
    """Stops by the robot, and rest times of the wheels: a robot that no command reaches never stops."""
    lines = []
    for subject, trials in _found(cells, metrics.DRIVE).items():
        times, rest_s, of_s = (sum(map(single(name), trials.values())) for name in ("trips", "rest_s", "window_s"))
        lines.append(f"{subject} {times:.0f} (wheels at rest for {figure(rest_s)} of {figure(of_s)} s)")
    yield f"Stops by the robot while it was driven: {', '.join(lines)}."


def transports(cells: Sequence[Cell]) -> Iterator[str]:
    """Compares Zenoh and MQTT inside the robot, with trials as rounds: both ran at the same time."""
    for form in dict.fromkeys(subject.partition(" ")[2] for subject in _found(cells, metrics.DRIVE)):
        for what, measure in (("drive", metrics.DRIVE), ("sound", metrics.SOUND), ("video", metrics.PICTURES)):
            mqtt, zenoh = (_found(cells, measure).get(f"{kind} {form}", {}) for kind in ("mqtt", "zenoh"))
            common = [trial for trial in mqtt if trial in zenoh]
            if len(common) > 1:
                interval = paired([zenoh[trial].samples for trial in common], [mqtt[trial].samples for trial in common])
                yield f"{form}, {what} p50 over {len(common)} trials: {interval.words('zenoh', 'mqtt')}."


def _found(cells: Sequence[Cell], measure: str) -> dict[str, dict[str, Cell]]:
    """The cells of a measure by subject, then by trial."""
    subjects = grouped((cell for cell in cells if cell.measure == measure), lambda cell: cell.variant)
    return {subject: {str(cell.params["trial"]): cell for cell in own} for subject, own in subjects.items()}


IMPAIR = Comparison(
    name="impair",
    title="On an impaired network",
    what="Whole robots whose uplink is limited and loses packets, trial after trial, as in section 4.2 of the "
    "paper: heartbeat, driving, video, then audio in each. “original” is this Pebble with the original's encodings "
    "(JSON video, PCM audio); “h264 opus” are the encodings with rate control.",
    options=(
        Option(name="trials", many=True, known=TRIALS, metavar="NAMES", recorded=False,
               help="Some of them, separated by commas; or thin: the trials of thin links, which are others."),
        Option(name="subjects", sets="variants", many=True, known=SUBJECTS, metavar="NAMES",
               help='Such as "mqtt original,zenoh h264 opus".'),
        Option(name="window", sets="window_s", kind=float, least=1.0, most=LONGEST_S,
               help="Seconds of video, and of audio, per trial."),
    ),
    full=Budget(1300, trials=TRIALS, window_s=8.0, alone_s=3.0, grace_s=2.0, off_s=2.0, quiet_s=2.0, clip_s=5.0,
                all_at_once=False),
    quick=Budget(85, trials=list(QUICK), window_s=4.0, alone_s=2.0, grace_s=1.0, off_s=1.0, quiet_s=1.0,
                 all_at_once=True),
    constants={
        "picture": f"{WIDTH}x{HEIGHT} at {FPS} a second, synthetic, jpeg_quality 10, keyframe_interval 5",
        "sound": "16 kHz mono, chunks of 20 ms, synthetic speech",
        "drive_hz": 10,
        "soundboard": f"a wav file of {CLIP_S:g} s, played by a simulated loudspeaker",
    },
    variants=SUBJECTS,
    measuring=Measuring(
        prepare=lambda _run: require_namespaces(),
        environment=robots,
        measure_round=measure,
        figures={"sent": lambda values: values[-1]},  # of the only round; None if nothing arrived
    ),
    report=Report(
        tables=TABLES,
        assessment=(*AIMS, encodings, trips, transports),
        complete=lambda _cells: True,  # in the worst trials nothing may arrive
        pictures=(Drawn("pebble.bench.impair.pictures:over_trials"), Drawn("pebble.bench.impair.pictures:over_time")),
    ),
    words=("impair",),
    root=True,
    modes={"trials=thin": IMPAIR_THIN},
)  # fmt: skip
