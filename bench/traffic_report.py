"""What a recording of the demo's robots shows beside the paper's section 4.1: tables, sentences, cells. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import msgspec
from rich.table import Table

from pebble.bench.paper import MONO_PCM_KBPS, TABLE_4_1
from pebble.bench.results import Cell, Results
from pebble.bench.tables import plain_table
from pebble.recordings.traffic.results import AUDIO, VIDEO, Bandwidth, RobotTraffic, Traffic
from pebble.recordings.traffic.tables import BRIEF_MS

_ANALYSIS: Final = "analysis"  # figure of a cell: all of a RobotTraffic, as JSON
_SAME: Final = 0.01  # of the paper's PCM
LEAST_SECONDS: Final = 20  # with sound, to judge its bandwidth
#: A range of one second is also what stamps make that are cut to whole seconds.
_PAPER_LATENCIES: Final = {
    "goob": "mostly 20 to 40 ms, across the internet",
    "benjr": "about 100 to 1100 ms, a range as of stamps of whole seconds",
    "minilamp": "about 100 to 1100 ms, over Starlink, a range as of stamps of whole seconds",
}


def name_of(robot: RobotTraffic) -> str:
    """``goob``."""
    return robot.robot.rpartition("/")[2]


def tables(traffic: Traffic) -> Iterator[Table]:
    """Table 4.1 beside the paper's, and heartbeats, whose distributions the paper shows as figures."""
    yield _media(traffic)
    yield _heartbeats(traffic)


def _media(traffic: Traffic) -> Table:
    heads = [f"{family} {value}" for family in (VIDEO, AUDIO) for value in ("median", "p95")]
    table = plain_table("Table 4.1: media, kbit/s of active seconds", ["robot", "", *heads], left=2)
    robots = {name_of(robot): robot for robot in traffic.robots}
    for name, paper in TABLE_4_1.items():
        table.add_row(name, "paper", *(f"{value:.2f}" for value in paper))
        table.add_row("", "here", *_media_cells(robots.get(name)))
    return table


def _media_cells(robot: RobotTraffic | None) -> Iterator[str]:
    for family in (VIDEO, AUDIO):
        found = None if robot is None else robot.of(family)
        yield from ("–", "–") if found is None else (f"{found.median_kbps:.2f}", f"{found.p95_kbps:.2f}")


def _heartbeats(traffic: Traffic) -> Table:
    heads = ("robot", "heartbeats", "every ms", "outages", "below 300 ms", "shared", "latency p1", "p50", "p95 ms")
    table = plain_table("Heartbeats", heads)
    for robot in traffic.robots:
        usual, latency = robot.intervals, robot.latency
        if usual is not None and latency is not None:
            brief = sum(one.length_ms < BRIEF_MS for one in robot.outages)
            counts = (latency.count, f"{usual.median_ms:.0f}", len(robot.outages), brief)
            shared = sum(one.cause != "robot" for one in robot.outages)
            times = (latency.floor_ms, latency.median_ms, latency.p95_ms)
            table.add_row(name_of(robot), *map(str, counts), str(shared), *(f"{time:.1f}" for time in times))
    return table


def assess(traffic: Traffic) -> list[str]:
    """What agrees with the paper, what differs, and why."""
    return [*_sound(traffic), *_video(traffic), *_outages(traffic), *_latencies(traffic)]


def _sound(traffic: Traffic) -> Iterator[str]:
    sounds = {name_of(robot): one for robot in traffic.robots if (one := robot.of(AUDIO)) is not None}
    shown = ", ".join(f"{name} {one.median_kbps:.1f} kbit/s" for name, one in sounds.items()) or "no sound"
    yield (
        f"aim: PCM, one channel at 16 kHz, takes the paper's {MONO_PCM_KBPS:.1f} kbit/s within 1 %: "
        f"{_judged(list(sounds.values()))} ({shown})"
    )
    yield (
        f"Goob's sound takes {TABLE_4_1['goob'][2]:.1f} kbit/s in the paper, as much as two channels: 50 packets of "
        "1,304 bytes a second; here Goob has one channel"
    )


def _judged(sounds: Sequence[Bandwidth]) -> str:
    """Packets of a second may be received in the next one: only the median of many seconds is the rate."""
    if sounds and min(one.seconds for one in sounds) < LEAST_SECONDS:
        return "not judged"
    met = bool(sounds) and all(abs(one.median_kbps / MONO_PCM_KBPS - 1) <= _SAME for one in sounds)
    return "met" if met else "missed"


def _video(traffic: Traffic) -> Iterator[str]:
    for robot in traffic.robots:
        found, paper = robot.of(VIDEO), TABLE_4_1.get(name_of(robot))
        if found is not None and paper is not None:
            yield (
                f"{name_of(robot)}'s video as JSON takes {found.median_kbps / paper[0]:.2f}× the paper's median: a "
                "simulated camera shows other things, and Table 4.1 names neither encoding, size nor rate"
            )


def _outages(traffic: Traffic) -> Iterator[str]:
    outages = [one for robot in traffic.robots for one in robot.outages]
    brief = sum(one.length_ms < BRIEF_MS for one in outages)
    shared = sum(one.cause != "robot" for one in outages)
    found = (
        f"{len(outages)} outages of heartbeats, {brief} of them shorter than 300 ms (the paper: most), {shared} of "
        "several robots at once or of the recorder, so of this machine"
    )
    paper = "the paper's are of archived operation, over the internet"
    yield f"{found if outages else 'no outage of heartbeats'}; {paper}"


def _latencies(traffic: Traffic) -> Iterator[str]:
    for robot in traffic.robots:
        latency, paper = robot.latency, _PAPER_LATENCIES.get(name_of(robot))
        if latency is not None and paper is not None:
            whole = "its stamps are of whole seconds" if latency.whole_seconds else "its stamps are of milliseconds"
            yield (
                f"{name_of(robot)}'s heartbeats take {latency.median_ms:.1f} ms, p95 {latency.p95_ms:.1f} ms, over "
                f"loopback; {whole} (the paper: {paper})"
            )


def cells_of(traffic: Traffic) -> list[Cell]:
    """The lengths of each robot's outages with all of its analysis, and the bandwidths of each kind of message."""
    return [cell for robot in traffic.robots for cell in (_outage_cell(robot), *_bandwidth_cells(robot))]


def _outage_cell(robot: RobotTraffic) -> Cell:
    lengths = [one.length_ms for one in robot.outages]
    analysis = {_ANALYSIS: msgspec.json.encode(robot).decode()}
    return Cell(variant=name_of(robot), measure="outage", unit="ms", rounds=[lengths], figures=dict(analysis))


def _bandwidth_cells(robot: RobotTraffic) -> Iterator[Cell]:
    for one in robot.bandwidth:
        yield Cell(
            variant=name_of(robot),
            params={"messages": one.family, "time": one.time},
            measure="bandwidth",
            unit="kbit/s",
            rounds=[[one.median_kbps]],
            figures={"p95": round(one.p95_kbps, 3), "seconds": one.seconds, "count": one.messages, "bytes": one.bytes},
        )


def robots_of(results: Results) -> dict[str, RobotTraffic]:
    """The analysis of each robot, by its name."""
    found = {cell.variant: cell.figures[_ANALYSIS] for cell in results.cells if _ANALYSIS in cell.figures}
    return {name: msgspec.json.decode(str(text), type=RobotTraffic) for name, text in found.items()}
