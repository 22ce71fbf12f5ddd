"""Synthetic results of comparisons, to test tables, plots and reports."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np

from pebble.bench import bridge, control, cost, frames, startup
from pebble.bench.impair import metrics, trials
from pebble.bench.results import STAND_IN, Cell, Results
from pebble.recordings.traffic.results import Bandwidth, Histogram, Latency, Outage, RobotTraffic

TRIALS = ("base-start", "512k", "256k", "64k+5%", "base-end")
_random = np.random.default_rng(7)


def cell(
    variant: str, measure: str, unit: str, middle: float, *, each: int = 60, rounds: int = 10,
    figures: Mapping[str, float] | None = None, **params: str | int,
) -> Cell:  # fmt: skip
    """Return a cell of skewed samples, as latencies are, with an offset of their own in each round."""
    samples = [
        (middle * _random.lognormal(0, 0.04) * _random.lognormal(0, 0.2, each)).round(3).tolist() for _ in range(rounds)
    ]
    return Cell(
        variant=variant, measure=measure, unit=unit, params=dict(params), rounds=samples,
        figures={name: [value] * rounds for name, value in (figures or {}).items()},
    )  # fmt: skip


def of_control() -> Results:
    conditions, counts = control.conditions(control.QUICK), {"sent": 60, "late": 0, "pictures_hz": 29.5}
    cells = [
        cell(variant, measure, "us", 400.0 * (1 + at), figures=counts, **condition)  # type: ignore[arg-type]
        for condition, (at, variant), measure in product(
            conditions, enumerate(control.VARIANTS), (control.ONE_WAY, control.ROUND_TRIP)
        )
    ]
    return Results(bench="control", cells=cells)


def of_bridge() -> Results:
    ours = {STAND_IN: 2.0, "mqtt": 1.0, "zenoh": 1.1}
    cells = [
        cell(variant, way, "ms", middle, figures={"sent": 60, "cpu_percent": 9.0}, load=load)
        for way, load in ((bridge.DOWN, bridge.UNLOADED), (bridge.DOWN, bridge.COMMANDS), (bridge.UP, bridge.UNLOADED))
        for variant, middle in ours.items()
    ]
    cells += [
        cell(variant, bridge.CPU, "us", 400 * middle, each=4, load=load, process=process)
        for load, process in product((bridge.UNLOADED, bridge.COMMANDS), ("bridge", "serial bridge"))
        for variant, middle in ours.items()
    ]
    return Results(bench="bridge", cells=cells)


def of_startup() -> Results:
    cells = [
        cell(variant, measure, "s" if measure in startup.STARTED else "ms", 10.0 * number, each=1)
        for number, measure in enumerate(startup.MEASURES, 1)
        for variant in ("mqtt", "zenoh")
    ]
    return Results(bench="startup", cells=cells)


def of_cost() -> Results:
    cells = [
        cell(variant, measure, unit, 80.0 if process == cost.ALL else 15.0, each=1, phase=phase, process=process)
        for measure, unit in ((cost.MEMORY, "MB"), (cost.CPU, "%"), (cost.THREADS, ""))
        for phase in (cost.IDLE, "h264+opus")
        for variant, own in (("mqtt", "mosquitto"), ("zenoh", "zenoh_hub"))
        for process in ("launcher", own, "serial_mcu_bridge", cost.ALL)
    ]
    return Results(bench="cost", cells=cells)


def of_frames() -> Results:
    cells = [
        cell(variant, "frame", "us", 200.0 * (1 + at), figures={"torn": 0, "fallbacks": 0, "cpu_reader": 2.0},
             size=size, readers=readers)
        for size, readers in product(("640x480", "1920x1080"), (1, 3))
        for at, variant in enumerate(frames.VARIANTS)
    ]  # fmt: skip
    return Results(bench="frames", cells=cells)


def of_impair() -> Results:
    cells = []
    for subject, (number, trial) in product(trials.SUBJECTS, enumerate(TRIALS)):
        bad = 1.0 + number * ("original" in subject)
        figures: dict[str, dict[str, float]] = {
            metrics.SOUND: {"delivered_percent": 100 / bad, "on_time_percent": 98 / bad, "kbit_up": 64.0},
            metrics.PICTURES: {"fps": 15 / bad, "frozen_s": bad - 1, "longest_gap_s": 0.1 * bad, "kbit_up": 100.0},
            metrics.HEARTBEAT_GAP: {"longest_gap_s": 0.3, "longest_offline_s": bad - 1},
            metrics.DRIVE: {"sent": 50, "delivered_percent": 99.0, "trips": number, "rest_s": 0.1},
            metrics.CLIP: {"sent": 50},
            metrics.AFTER_VIDEO: {"bytes_up": 4000, "heartbeats": 8, "longest_gap_s": 0.25},
            metrics.AFTER_AUDIO: {"bytes_up": 4000, "heartbeats": 8, "longest_gap_s": 0.25},
            **{name: {"sent": 50} for name in (metrics.DRIVE_ALONE, metrics.DRIVE_VIDEO, metrics.DRIVE_AUDIO)},
        }  # fmt: skip
        cells += [
            cell(subject, measure, "ms", 45 * bad, each=50, rounds=1, figures=values, trial=trial)
            for measure, values in figures.items()
        ]
    return Results(bench="impair", cells=cells)


def analysed() -> dict[str, RobotTraffic]:
    """Return all of the paper's robots, with outages."""
    return {name: _robot_traffic(name) for name in ("goob", "fred", "minilamp", "benjr")}


def _robot_traffic(name: str) -> RobotTraffic:
    outages = [Outage(since_ns=0, length_ms=length) for length in (120.0, 180.0, 250.0, 900.0)]
    families = (("drive", 3.2), ("heartbeat", 1.2), ("video", 170.0), ("audio", 265.6))
    return RobotTraffic(
        robot=f"pebble/robots/{name}", machine="MCU" if name in ("minilamp", "benjr") else "Linux", messages=1000,
        bytes=100_000, sessions=[], outages=outages,
        bandwidth=[
            Bandwidth(family, time, 30, kbps, 1.3 * kbps, 300, 10_000)
            for family, kbps in families
            for time in ("all", "session", "idle")
        ],
        interval_ms=250.0,
        latency=Latency(240, 2.5, 30.0, Histogram(0.0, 2.0, [90, 80, 40, 20, 5, 0, 5])),
    )  # fmt: skip
