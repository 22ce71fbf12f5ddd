"""Synthetic results of all comparisons, to test plots and reports."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pebble.bench.fleet import BROKER_CPU, BROKER_MB, PAGE_MB, PINS, VIEWER_CPU
from pebble.bench.results import Cell, Judged, Results
from pebble.bench.traffic import cells_of
from pebble.recordings.traffic.results import Bandwidth, Histogram, Intervals, Latency, Outage, RobotTraffic, Traffic

TRIALS = (
    "base-start", "1024k", "512k", "256k", "128k", "64k", "1%", "2%", "5%", "10%",
    "256k+1%", "128k+2%", "64k+5%", "base-end", "starlink", "wifi-power-save",
)  # fmt: skip
SUBJECTS = ("mqtt original", "zenoh original", "mqtt h264 opus", "zenoh h264 opus")
_VARIANTS = {
    "paho": 520.0, "mqtt": 480.0, "mqtt-nodelay": 440.0, "mqtt5": 450.0, "zenoh-p2p": 190.0, "zenoh-hub": 300.0,
}  # fmt: skip
_random = np.random.default_rng(7)


def latencies(middle: float, count: int = 300, rounds: int = 10, spread: float = 0.25) -> list[list[float]]:
    """Rounds of skewed samples, as latencies are, with an offset of their own in each round."""
    return [
        (middle * _random.lognormal(0, 0.04) * (_random.lognormal(0, spread, count) + _random.exponential(0.1, count)))
        .round(3)
        .tolist()
        for _ in range(rounds)
    ]


def _results(bench: str, cells: list[Cell], lines: list[str | Judged], **more: object) -> Results:
    machine = {"cpu": "Some CPU @ 2.40GHz", "cores": 2, "kernel": "6.1.0", "python": "3.11.2", "mosquitto": "2.0.11"}
    return Results(
        bench=bench,
        command=["pebble", "bench", bench],
        machine={**machine, "system": "Debian GNU/Linux 12 (bookworm)"},
        began="2026-11-20T14:00:00Z",
        took_s=61.0,
        cells=cells,
        assessment=[line for line in lines if isinstance(line, str)],
        aims=[line for line in lines if isinstance(line, Judged)],
        **more,  # type: ignore[arg-type]
    )


def _aim(what: str, outcome: str, measured: str) -> Judged:
    return Judged(what=what, outcome=outcome, measured=measured)


def control(small: bool = False) -> Results:
    conditions = [("40 B", "20 Hz", "none"), ("40 B", "200 Hz", "none"), ("40 B", "1000 Hz", "none")]
    conditions += [("1024 B", "20 Hz", "none"), ("1024 B", "200 Hz", "none"), ("1024 B", "1000 Hz", "none")]
    conditions += [
        (size, rate, load) for load in ("media", "hog") for size, rate in (("40 B", "20 Hz"), ("40 B", "200 Hz"))
    ]
    conditions = conditions[5:8] if small else conditions
    cells = [
        Cell(
            variant=variant,
            params={"size": size, "rate": rate, "load": load},
            measure=measure,
            unit="us",
            rounds=latencies(middle * (1 if load == "none" else 1.7) * (2 if measure == "round trip" else 1), 60),
            figures={"sent": 600, "late": 0, "cpu_percent": 3.0},
        )
        for size, rate, load in conditions
        for variant, middle in _VARIANTS.items()
        for measure in ("one-way", "round trip")
    ]
    return _results(
        "control",
        cells,
        [
            "p50: zenoh-p2p takes 0.43× the time of mqtt-nodelay (99 % interval 0.41–0.45)",
            _aim("Zenoh peer to peer, p50 at most 0.70 of the better MQTT variant's", "met", "0.43, at most 0.45"),
            _aim("with media, p99 at 200 Hz at most 0.35 of it", "missed", "0.41, at most 0.52"),
        ],
    )


def null_test(bench: str, variant: str) -> Results:
    roles = {variant: 1.0, f"{variant} again": 1.0, f"{variant} +20 %": 1.2}
    cells = [
        Cell(variant=role, params={"size": "40 B", "rate": "200 Hz"}, measure="one-way", unit="us",
             rounds=latencies(200 * factor))
        for role, factor in roles.items()
    ]  # fmt: skip
    return _results(f"{bench}-null", cells, [_aim("the same against itself is equal", "met", "1.01")])


def bridge() -> Results:
    cells = [
        Cell(variant=variant, params={"load": load}, measure=measure, unit="ms",
             rounds=latencies(middle * (1.6 if load == "media" else 1), 80), figures={"sent": 800})
        for measure, loads in (("down", ("none", "commands", "media")), ("up", ("none", "media")))
        for load in loads
        for variant, middle in {"paho": 1.1, "mqtt": 0.9, "zenoh": 0.6, "one hop": 0.25}.items()
        if (variant, load) != ("paho", "media") and (variant != "one hop" or (measure, load) == ("down", "none"))
    ]  # fmt: skip
    cells += [
        Cell(variant=variant, params={"load": load, "process": process}, measure="CPU per message", unit="us",
             rounds=latencies(middle, 4))
        for load in ("none", "commands")
        for process in ("bridge", "serial bridge")
        for variant, middle in {"paho": 400.0, "mqtt": 300.0, "zenoh": 350.0}.items()
    ]  # fmt: skip
    return _results("bridge", cells, [_aim("mqtt, p50 at most 0.7 ms", "missed", "0.9 ms")])


def startup() -> Results:
    measures = {"first heartbeat": 1.1, "all ready": 1.4, "first command obeyed": 1.2, "late operator": 0.08}
    cells = [
        Cell(variant=variant, measure=measure, unit="s", rounds=[[sample] for (sample,) in latencies(middle, 1)])
        for measure, middle in measures.items()
        for variant in ("mqtt", "zenoh")
    ]
    return _results("startup", cells, ["zenoh and mqtt are equal within noise: 1.01 (0.96 to 1.05)"])


def cost(small: bool = False) -> Results:
    processes = {
        "mqtt": ["launcher", "mosquitto", "mqtt_bridge", "serial_mcu_bridge", "av_daemon", "camera_publisher", "all"]
    }
    processes["zenoh"] = [name.replace("mosquitto", "zenoh_hub") for name in processes["mqtt"]]
    cells = [
        Cell(variant=variant, params={"phase": phase, "process": process}, measure=measure, unit=unit,
             rounds=latencies(80.0 if process == "all" else 15.0, 1, 3))
        for measure, unit in (("PSS", "MB"), ("CPU", "%"), ("threads", ""))
        for phase in ("idle", "streaming h264 opus", *(() if small else ("driving", "streaming")))
        for variant in ("mqtt", "zenoh")
        for process in processes[variant]
    ]  # fmt: skip
    return _results("cost", cells, ["mqtt needs less memory: 80 MB against 95 MB (medians of 3 rounds)"])


def frames(small: bool = False) -> Results:
    variants = {"zenoh-shm": 190, "zenoh-copy": 420, "zenoh-net": 900, "mqtt": 2400, "gstreamer-shm": 350, "memcpy": 60}
    cells = [
        Cell(variant=variant, params={"size": size, "readers": readers}, measure="frame", unit="us",
             rounds=latencies(middle * (5 if size != "640x480" and variant != "zenoh-shm" else 1), 90, 3))
        for size in ("640x480", "1920x1080")
        for readers in ((3,) if small else (1, 3))
        for variant, middle in variants.items()
    ]  # fmt: skip
    return _results("frames", cells, ["zenoh-shm takes 0.08× the time of mqtt (99 % interval 0.07–0.09)"])


def fleet() -> Results:
    """A broker that takes 10 % and 5 MB for each thousand robots, and a page that takes 40 % and 50 MB."""
    each = {BROKER_CPU: ("%", 10), VIEWER_CPU: ("%", 40), BROKER_MB: ("MB", 5), PAGE_MB: ("MB", 50)}
    cells = [
        Cell(variant="mqtt", params={"robots": robots}, measure=name, unit=unit, rounds=[[slope * robots / 1000]])
        for robots in (100, 300, 1000)
        for name, (unit, slope) in each.items()
    ]
    pins = Cell(variant="mqtt", params={"robots": 1000}, measure=PINS, unit="ms", rounds=latencies(2.0, 900, 1))
    return _results("fleet", [*cells, pins], [])


def video() -> Results:
    forms = {"reference": 90e3, "json": 86e3, "pbvd": 75e3, "pbvz": 60e3, "h264": 15e3, "h264, key/5": 31e3}
    cells = [
        Cell(variant=form, params={"scene": scene}, measure="wire", unit="kB/s", rounds=[[size / 1000]])
        for scene in ("still", "moving", "dark and noisy")
        for form, size in forms.items()
    ]
    return _results("video", cells, [])


def sound() -> Results:
    cells = [Cell(variant="pcm", params={}, measure="wire", unit="kbit/s", rounds=[[290.0]])]
    cells += [
        Cell(variant="opus", params={"bitrate": bitrate, "bundle": bundle}, measure="wire", unit="kbit/s",
             rounds=[[bitrate / 1000 + 40 / bundle]])
        for bitrate in (16_000, 24_000, 32_000)
        for bundle in (1, 2, 3)
    ]  # fmt: skip
    return _results("sound", cells, [])


def impair(trials: tuple[str, ...] = TRIALS) -> Results:
    cells = []
    for subject in SUBJECTS:
        good = "opus" in subject
        for number, trial in enumerate(trials):
            bad = 1 + 4 * ("k" in trial and not good) + (number % 4 if "%" in trial else 0)
            figures = {"delivered_percent": 99.0 if good else 100 / bad, "on_time_percent": 98.0 if good else 60 / bad}
            cells += [
                Cell(variant=subject, params={"trial": trial}, measure=measure, unit=unit,
                     rounds=latencies(middle * bad, 50, 1), figures=more)
                for measure, unit, middle, more in (
                    ("audio latency", "ms", 45, figures),
                    ("video latency", "ms", 60, {"fps": 15 / bad, "frozen_s": bad - 1.0, "longest_gap_s": 0.1 * bad}),
                    ("heartbeat gap", "s", 1.0, {"longest_offline_s": bad - 1.0}),
                    ("drive alone", "ms", 2, {"sent": 50}),
                    ("drive during video", "ms", 2.1, {}),
                    ("drive during audio", "ms", 2.2, {}),
                )
            ]  # fmt: skip
        for what, middle in (("audio", 45.0), ("drive", 2.0)):
            seconds = np.linspace(2, 24 * len(trials), 1500).round(3).tolist()
            times = latencies(middle, 1500, 1)[0]
            cells.append(Cell(variant=subject, measure=f"{what} over time", unit="ms", rounds=[seconds, times]))
    marks = ";".join(f"{trial}@{2 + 24 * number}" for number, trial in enumerate(trials))
    aims = [_aim("mqtt h264 opus at 256k, audio at least 99 %", "met", "99.0 %")]
    return _results("impair", cells, aims, options={"window_s": 8.0, "marks": marks})


def impair_thin() -> Results:
    """Two robots, one of which never moves; it is let go once and stopped once."""
    cells = []
    for subject, speed in (("wide", 0.0), ("thin", 0.6)):
        curves = {
            "commanded": [[0.0, 0.5, 5.0, 9.0, 12.0], [0.0, 0.6, 0.0, 0.4, 0.0]],
            "wheels": [[0.0, 0.8, 5.3, 9.3, 12.3], [0.0, speed, 0.0, speed, 0.0]],
            "released": [[5.0], [0.0]],
            "stopped": [[12.0], [0.0]],
        }
        cells += [
            Cell(variant=subject, params={"trial": "thin-9.6k"}, measure=f"{what} over time", unit="s", rounds=rounds)
            for what, rounds in curves.items()
        ]
    return _results("impair-thin", cells, [])


def broken() -> Results:
    """NaN, empty rounds, a single round, a missing variant, very long names."""
    long = "a-variant-with-a-name-that-is-much-longer-than-anybody-would-think"
    nowhere = Cell(variant="mqtt5", params={"size": "40 B"}, measure="one-way", unit="us", rounds=[[], [math.nan] * 30])
    cells = [
        Cell(variant=name, params={"size": size}, measure="one-way", unit="us", rounds=latencies(300, 40, 1))
        for size, names in {"40 B": ("mqtt", long), "1024 B": (long, "zenoh-p2p")}.items()
        for name in names
    ]
    return _results("control", [*cells, nowhere], [], quick=True)


def traffic() -> Results:
    return _results("traffic", cells_of(analysed()), [_aim("PCM", "met", "fred 265.6 kbit/s")])


def analysed() -> Traffic:
    """All of the paper's robots, with outages."""
    return Traffic(
        since_ns=0, until_ns=60 * 10**9, recordings=1, missing=0, dropped=0, gaps=[],
        robots=[_robot_traffic(name) for name in ("goob", "fred", "minilamp", "benjr")],
    )  # fmt: skip


def _robot_traffic(name: str) -> RobotTraffic:
    outages = [Outage(since_ns=0, length_ms=length) for length in (120.0, 180.0, 250.0, 900.0)]
    families = (("drive", 3.2), ("heartbeat", 1.2), ("video", 170.0), ("audio", 265.6))
    return RobotTraffic(
        robot=f"pebble/robots/{name}", machine="MCU" if name in ("minilamp", "benjr") else "Linux", messages=1000,
        bytes=100_000, session_s=30, idle_s=30, offline=0, offline_s=0.0, sessions=[], outages=outages,
        bandwidth=[
            Bandwidth(family, time, 30, kbps, 1.3 * kbps, 300, 10_000)
            for family, kbps in families
            for time in ("all", "session", "idle")
        ],
        intervals=Intervals(count=240, median_ms=250.0),
        latency=Latency(240, 1.0, 2.5, 30.0, 60.0, Histogram(0.0, 2.0, [90, 80, 40, 20, 5, 0, 5])),
    )  # fmt: skip


def one_of_each(small: bool = False) -> dict[str, Results]:
    """By the name of the comparison; ``small``: fewer cells of the largest ones."""
    trials = ("base-start", "512k", "256k", "64k+5%", "wifi-power-save") if small else TRIALS
    made: list[Callable[[], Results]] = [bridge, startup, video, sound, fleet, traffic, impair_thin]
    every = [control(small), frames(small), cost(small), *(make() for make in made), impair(trials)]
    every += [null_test("control", "zenoh-p2p"), null_test("bridge", "zenoh"), null_test("frames", "zenoh-shm")]
    return {results.bench: results for results in every}
