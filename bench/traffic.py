"""The paper's section 4.1 with simulated robots: their traffic is recorded, and analysed as by ``pebble analyse``.

The demo's robots on a real mosquitto: idle, then driven and watched, recorded by ``pebble record``.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
from rich.table import Table

from pebble.bench.clients import driving
from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Report, Run
from pebble.bench.judging.aims import outcome
from pebble.bench.pictures import Drawn
from pebble.bench.results import Cell, Judged, Results, Value
from pebble.bench.tables import plain_table
from pebble.client.media_receiver import MediaReceiver
from pebble.errors import PebbleError
from pebble.recordings.traffic.results import AUDIO, IDLE, SESSION, VIDEO, RobotTraffic, Traffic
from pebble.rig.processes import end_all
from pebble.rig.testbed import ROBOTS, Testbed
from pebble.transports import MqttSettings, create

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pebble.bench.plots import Picture

#: Table 4.1 of the paper, kbit/s: median and 95th percentile of video, and of audio.
TABLE_4_1: Final = {"fred": (172.46, 283.99, 265.60, 270.91), "goob": (181.18, 588.79, 521.60, 532.03)}
MONO_PCM_KBPS: Final = 265.6  # one channel at 16 kHz: 50 packets of 664 bytes a second
_ANALYSIS: Final = "analysis"  # figure of a cell: all of a RobotTraffic, as JSON
_SAME: Final = 0.01  # of the paper's PCM
LEAST_SECONDS: Final = 20  # with sound, to judge its bandwidth
_READY_S = 30.0
_POLL_S = 0.1
_LAST_S = 0.5  # until what was published last is recorded
_END_S = 10.0  # for the recorder to finish its files
#: What differs from the paper, and why.
_DIFFERENCES: Final = (
    f"Goob's sound takes {TABLE_4_1['goob'][2]:.1f} kbit/s in the paper, as much as two channels; here it has one",
    "Video differs: a simulated camera shows other things, and Table 4.1 names neither encoding, size nor rate",
    "Heartbeats go over loopback here. The paper's went over the internet: most outages are shorter than 300 ms; "
    "latencies of Goob are mostly 20 to 40 ms, those of BenJr and MiniLAMP 100 to 1100 ms, as of stamps in seconds",
)
_OUTAGES, _LATENCY, _BANDWIDTH = "outages of heartbeats", "latency of heartbeats", "bandwidth"
#: The paper's Figures 4.1 to 4.6: robot and content.
_FIGURES: Final = (
    ("goob", _OUTAGES), ("goob", _LATENCY), ("minilamp", _BANDWIDTH),
    ("minilamp", _OUTAGES), ("benjr", _LATENCY), ("minilamp", _LATENCY),
)  # fmt: skip


def prepare(_run: Run) -> None:
    if find_spec("duckdb") is None:
        raise PebbleError('left out: the analysis of recordings needs DuckDB: pip install "pebble-robot[archive]"')


def measure(case: Case) -> Iterator[Cell]:
    """The analysis of a recording that is made now. Raises PebbleError."""
    from pebble.recordings.traffic.analysis import analyse
    from pebble.recordings.traffic.sources import sources

    with tempfile.TemporaryDirectory(prefix="pebble-traffic-") as scratch:
        recordings = Path(scratch) / "recordings"
        record(recordings, case.run["idle_s"], case.run["session_s"])
        found = sources([recordings], Path(scratch))
        yield from cells_of(analyse(found, Path(scratch)))


def record(folder: Path, idle_s: float, session_s: float) -> None:
    """Record all robots into ``folder``: idle for ``idle_s``, then used for ``session_s``. Raises PebbleError."""
    with Testbed(threading.Event()) as testbed:
        testbed.start_brokers()
        recorder = testbed.start_recorder(folder)
        recorder.wait_until(lambda: b"Recording" in recorder.log.read_bytes(), _READY_S)  # it is connected
        testbed.start_robots()
        testbed.wait_until_ready()
        time.sleep(idle_s)
        _use(testbed, session_s)
        if problems := testbed.unexpected_exits():
            raise PebbleError("; ".join(problems))
        time.sleep(_LAST_S)
        end_all([recorder], _END_S)
        testbed.keep = False


def _use(testbed: Testbed, seconds: float) -> None:
    """Drive all robots while pictures and sound arrive of those that have them. Raises PebbleError."""
    viewer = create("mqtt", "pebble-bench-viewer", MqttSettings(host="127.0.0.1", port=testbed.broker_port))
    robots = testbed.robots.values()
    with viewer, ExitStack() as stack:
        receivers = [
            stack.enter_context(closing(MediaReceiver(viewer, robot.base))) for robot in robots if robot.has_media
        ]

        def poll() -> None:
            time.sleep(_POLL_S)
            for receiver in receivers:
                receiver.poll()

        for receiver in receivers:
            receiver.wait_for_capabilities(_READY_S)
            receiver.viewer.request("video", "json")
            receiver.viewer.request("audio", "pcm")
        end = time.monotonic() + _READY_S
        while silent := [one.name for one in receivers if len(one.encoding) < 2]:
            poll()
            if time.monotonic() > end:
                raise PebbleError(f"no pictures or no sound came from {', '.join(silent)}")
        with driving(testbed.broker_port, *(robot.base for robot in robots)):
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                poll()


# -- cells


def cells_of(traffic: Traffic) -> list[Cell]:
    """The lengths of each robot's outages with all of its analysis, and the bandwidths of each kind of message."""
    cells: list[Cell] = []
    for robot in traffic.robots:
        name, lengths = robot.robot.rpartition("/")[2], [one.length_ms for one in robot.outages]
        analysis = msgspec.json.encode(robot).decode()
        cells.append(Cell(variant=name, measure="outage", unit="ms", rounds=[lengths], figures={_ANALYSIS: analysis}))
        for one in robot.bandwidth:
            about: dict[str, Value] = {"messages": one.family, "time": one.time}
            median = [one.median_kbps]
            cells.append(Cell(variant=name, params=about, measure="bandwidth", unit="kbit/s", rounds=[median]))
    return cells


def robots_of(cells: Sequence[Cell]) -> dict[str, RobotTraffic]:
    """The analysis of each robot, by its name."""
    found = {cell.variant: cell.figures[_ANALYSIS] for cell in cells if _ANALYSIS in cell.figures}
    return {name: msgspec.json.decode(str(text), type=RobotTraffic) for name, text in found.items()}


# -- the report


def tables(cells: Sequence[Cell]) -> Iterator[Table]:
    """Table 4.1 beside the paper's, and heartbeats, whose distributions the paper shows as figures."""
    robots = robots_of(cells)
    heads = [f"{family} {value}" for family in (VIDEO, AUDIO) for value in ("median", "p95")]
    table = plain_table("Table 4.1: media, kbit/s of active seconds", ["robot", "", *heads], left=2)
    for name, paper in TABLE_4_1.items():
        here = [robots[name].of(family) if name in robots else None for family in (VIDEO, AUDIO)]
        shown = [("–", "–") if one is None else (f"{one.median_kbps:.2f}", f"{one.p95_kbps:.2f}") for one in here]
        table.add_row(name, "paper", *(f"{value:.2f}" for value in paper))
        table.add_row("", "here", *chain(*shown))
    yield table
    table = plain_table("Heartbeats", ["robot", "heartbeats", "every ms", "outages", "latency p50", "p95 ms"])
    for name, robot in robots.items():
        if robot.intervals is not None and robot.latency is not None:
            counts = (robot.latency.count, round(robot.intervals.median_ms), len(robot.outages))
            times = (robot.latency.median_ms, robot.latency.p95_ms)
            table.add_row(name, *map(str, counts), *(f"{time:.1f}" for time in times))
    yield table


def assessment(cells: Sequence[Cell]) -> Iterator[str | Judged]:
    """Packets of a second may be received in the next one: only the median of many seconds is the rate of sound."""
    sounds = {name: one for name, robot in robots_of(cells).items() if (one := robot.of(AUDIO)) is not None}
    enough = all(one.seconds >= LEAST_SECONDS for one in sounds.values())
    same = all(abs(one.median_kbps / MONO_PCM_KBPS - 1) <= _SAME for one in sounds.values())
    yield Judged(
        what=f"PCM, one channel at 16 kHz, takes the paper's {MONO_PCM_KBPS:.1f} kbit/s within 1 %",
        outcome=outcome(same and sounds.keys() >= TABLE_4_1.keys(), judged=enough),
        measured=", ".join(f"{name} {one.median_kbps:.1f} kbit/s" for name, one in sounds.items()) or "no sound",
    )
    yield from _DIFFERENCES


def figures(results: Results) -> list[Picture]:
    """Figures 4.1 to 4.6 of the paper, drawn as `pebble analyse` draws them, of those robots that were analysed."""
    from pebble.bench.plots import Picture, panels
    from pebble.recordings.traffic.figures import draw_bandwidth, draw_latency, draw_outages

    robots = robots_of(results.cells)
    shown = [(number, name, what) for number, (name, what) in enumerate(_FIGURES, 1) if name in robots]

    def make() -> Figure:
        heading = "Traffic of simulated robots: the paper's Figures 4.1 to 4.6"
        figure, places = panels(len(shown), 2, (5.6, 3.0), heading)
        for axes, (number, name, what) in zip(places, shown, strict=True):
            robot = robots[name]
            if what == _BANDWIDTH:
                draw_bandwidth(axes, [one for one in robot.bandwidth if one.time in (SESSION, IDLE)])
            elif what == _OUTAGES:
                draw_outages(axes, robot)
            elif robot.latency is not None:
                draw_latency(axes, robot.latency)
            title = f"Figure 4.{number}: {name}, {what}"
            axes.set_title(title, loc="left", pad=22.0, weight="bold")  # points for the legend between panel and title
        return figure

    caption = "Figures 4.1 to 4.6 of the paper, with simulated robots on this machine"
    return [Picture("traffic-figures", caption, make)] if shown else []


TRAFFIC = Comparison(
    name="traffic",
    title="Traffic of robots, as in the paper",
    what="Section 4.1 of the paper with simulated robots: Goob and Fred, MiniLAMP and BenJr stand idle, then are "
    "driven, and Goob and Fred send pictures as JSON and sound as PCM. `pebble record` records them at a real "
    "broker, `pebble analyse` computes, with the same definitions as the paper: bandwidth of payloads in active "
    "seconds, outages of heartbeats, and their latency from stamp to reception.",
    help="""Traffic of the demo's robots as in the paper's section 4.1: bandwidth, outages and latency.

    Needs mosquitto and the packages of the extra "archive".
    """,
    full=Budget(140, idle_s=40.0, session_s=80.0),
    quick=Budget(19, idle_s=7.0, session_s=6.0),
    constants={"robots": list(ROBOTS)},
    measuring=Measuring(prepare=prepare, measure=measure),
    report=Report(
        tables=(tables,),
        assessment=(assessment,),
        complete=bool,  # a robot without outages is no failure
        pictures=(Drawn("pebble.bench.traffic:figures"),),
    ),
)
