"""The paper's section 4.1 with simulated robots: their traffic is recorded, and analysed as by ``pebble analyse``.

The demo's robots on a real mosquitto: idle, then driven and watched, recorded by ``pebble record``. Definitions are the
paper's: payload bytes, medians and 95th percentiles of active seconds, outages of heartbeats, and their latency.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.table import Table

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.clients import driving
from pebble.extensions.lab.bench.results import Cell, begin, round_cell
from pebble.extensions.lab.bench.rounds import Progress, measure_rounds
from pebble.extensions.lab.bench.show import Picture, Shown, plain_table
from pebble.extensions.lab.rig.processes import end_all
from pebble.extensions.lab.rig.testbed import Testbed
from pebble.extensions.operator.client.media_receiver import MediaReceiver
from pebble.extensions.recordings.traffic.results import AUDIO, IDLE, SESSION, VIDEO, RobotTraffic
from pebble.transports import MqttSettings, create

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Analysed = Mapping[str, RobotTraffic]  # by the robot's name

#: Table 4.1 of the paper, kbit/s: median and 95th percentile of video, and of audio.
TABLE_4_1: Final = {"fred": (172.46, 283.99, 265.60, 270.91), "goob": (181.18, 588.79, 521.60, 532.03)}
_READY_S = 30.0
_POLL_S = 0.1
_LAST_S = 0.5  # until what was published last is recorded
_END_S = 10.0  # for the recorder to finish its files
#: What differs from the paper, and why.
_DIFFERENCES: Final = (
    f"Goob's sound takes {TABLE_4_1['goob'][2]:.1f} kbit/s in the paper, as much as two channels; here it has one.",
    "Video differs: a simulated camera shows other things, and Table 4.1 names neither encoding, size nor rate.",
    "Heartbeats go over loopback here. The paper's went over the internet: most outages are shorter than 300 ms; "
    "latencies of Goob are mostly 20 to 40 ms, those of BenJr and MiniLAMP 100 to 1100 ms, as of stamps in seconds.",
)
_OUTAGES, _LATENCY, _BANDWIDTH = "outages of heartbeats", "latency of heartbeats", "bandwidth"
#: The paper's Figures 4.1 to 4.6: robot and content.
_FIGURES: Final = (
    ("goob", _OUTAGES), ("goob", _LATENCY), ("minilamp", _BANDWIDTH),
    ("minilamp", _OUTAGES), ("benjr", _LATENCY), ("minilamp", _LATENCY),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Settings:
    """The seconds for which the robots are idle, and in use."""

    idle_s: float = 40.0
    session_s: float = 80.0


FULL: Final = Settings()
QUICK: Final = Settings(idle_s=7.0, session_s=6.0)


def run(settings: Settings, console: Console) -> Shown:
    """Record all robots and analyse the recording. Raises PebbleError."""
    if find_spec("duckdb") is None:
        raise PebbleError('left out: the analysis of recordings needs DuckDB: pip install "pebble-robot[archive]"')
    results, robots = begin("traffic", settings), dict[str, RobotTraffic]()

    def measure(_number: int, progress: Progress) -> Iterator[Cell]:
        progress("recording")
        robots.update(analysed(settings))
        return cells_of(robots)

    measure_rounds(results, 1, measure, console)
    # measure_rounds counts a cell without samples as incomplete; but a robot may have had no outage.
    results.complete = bool(robots)
    results.notes += _DIFFERENCES
    return Shown(results, [media_table(robots)], figures(robots))


def analysed(settings: Settings) -> Analysed:
    """Make a recording; return its analysis, by robot. Raises PebbleError."""
    from pebble.extensions.recordings.traffic.analysis import analyse
    from pebble.extensions.recordings.traffic.sources import sources

    with tempfile.TemporaryDirectory(prefix="pebble-traffic-") as scratch:
        recordings = Path(scratch) / "recordings"
        record(recordings, settings.idle_s, settings.session_s)
        indexed = sources([recordings], Path(scratch))
        return {robot.robot.rpartition("/")[2]: robot for robot in analyse(indexed, Path(scratch)).robots}


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
        testbed.keep = False  # its logs are needed only after a problem


def _use(testbed: Testbed, seconds: float) -> None:
    """Drive all robots, while pictures and sound arrive from those that have them. Raises PebbleError."""
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
            receiver.request("video", "json")
            receiver.request("audio", "pcm")
        end = time.monotonic() + _READY_S
        # a receiver knows an encoding of its pictures, and of its sound, once they arrive
        while silent := [receiver.robot.name for receiver in receivers if len(receiver.encoding) < 2]:
            poll()
            if time.monotonic() > end:
                raise PebbleError(f"no pictures or no sound came from {', '.join(silent)}")
        with driving(testbed.broker_port, *(robot.base for robot in robots)):
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                poll()


def cells_of(robots: Analysed) -> Iterator[Cell]:
    """Yield the lengths of each robot's outages, its latency, and the bandwidths of each kind of message."""
    for name, robot in robots.items():
        yield round_cell(name, "outage", "ms", [outage.length_ms for outage in robot.outages])
        if robot.latency is not None:
            yield round_cell(name, "heartbeat latency", "ms", [robot.latency.median_ms], p95_ms=robot.latency.p95_ms)
        for bandwidth in robot.bandwidth:
            params = {"messages": bandwidth.family, "time": bandwidth.time}
            yield round_cell(name, "bandwidth", "kbit/s", [bandwidth.median_kbps], params, p95_kbps=bandwidth.p95_kbps)


def media_table(robots: Analysed) -> Table:
    """Return Table 4.1 beside the paper's values."""
    heads = [f"{family} {value}" for family in (VIDEO, AUDIO) for value in ("median", "p95")]
    table = plain_table("Table 4.1: media, kbit/s of active seconds", ["robot", "", *heads], left=2)
    for name, paper in TABLE_4_1.items():
        measured = [robots[name].of(family) if name in robots else None for family in (VIDEO, AUDIO)]
        shown = list[str]()
        for bandwidth in measured:
            shown += ["–", "–"] if bandwidth is None else [f"{bandwidth.median_kbps:.2f}", f"{bandwidth.p95_kbps:.2f}"]
        table.add_row(name, "paper", *(f"{value:.2f}" for value in paper))
        table.add_row("", "here", *shown)
    return table


def figures(robots: Analysed) -> Sequence[Picture]:
    """Return Figures 4.1 to 4.6 of the paper, drawn as `pebble analyse` draws them."""
    caption = "Figures 4.1 to 4.6 of the paper, with simulated robots on this machine"
    return [Picture("traffic-figures", caption, partial(_draw, robots))] if robots else []


def _draw(robots: Analysed) -> Figure:
    """Draw the figures of robots that were recorded, each in a panel."""
    from pebble.extensions.lab.bench.plots import panels
    from pebble.extensions.recordings.traffic.figures import draw_bandwidth, draw_latency, draw_outages

    shown = [(number, name, what) for number, (name, what) in enumerate(_FIGURES, 1) if name in robots]
    figure, places = panels(len(shown), 2, (5.6, 3.0), "Traffic of simulated robots: the paper's Figures 4.1 to 4.6")
    for axes, (number, name, what) in zip(places, shown, strict=True):
        robot = robots[name]
        if what == _BANDWIDTH:
            draw_bandwidth(axes, [bandwidth for bandwidth in robot.bandwidth if bandwidth.time in (SESSION, IDLE)])
        elif what == _OUTAGES:
            draw_outages(axes, robot)
        elif robot.latency is not None:
            draw_latency(axes, robot.latency)
        title = f"Figure 4.{number}: {name}, {what}"
        axes.set_title(title, loc="left", pad=22.0, weight="bold")  # points for the legend between panel and title
    return figure
