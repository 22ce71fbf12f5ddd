"""The comparisons of a report: command lines, durations and descriptions."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from pebble.errors import PebbleError


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """One command of the report. Its results are ``<name>.json``, its output ``<name>.txt``."""

    name: str
    title: str
    what: str  # what is measured, and how to read it
    full: Sequence[str]  # what follows ``pebble``
    quick: Sequence[str]
    full_s: int  # expected
    quick_s: int
    #: How many lines of its assessment go into the summary; the most important come first.
    summary_lines: int = 0
    root: bool = False  # needs root, to capture packets

    def arguments(self, quick: bool) -> Sequence[str]:
        return self.quick if quick else self.full

    def expected_s(self, quick: bool) -> int:
        return self.quick_s if quick else self.full_s


def _bench(*words: str) -> tuple[str, ...]:
    return ("bench", *words)


COMPARISONS = (
    Comparison(
        name="control",
        title="Service to service",
        what="A message of a drive command's size goes from one process to another and back, as between a robot's "
        "services: unloaded, with camera frames on the same transport, and beside a process that uses a whole core. "
        "One-way is from just before the publish call until the receiver's handler runs; both ends use the same clock.",
        full=_bench("control"),
        quick=_bench("control", "--quick"),
        full_s=700,
        quick_s=40,
        summary_lines=5,
    ),
    Comparison(
        name="control-null",
        title="Service to service: the null test",
        what="One variant against itself, and against itself with a fifth of its usual latency planted by the sender. "
        "The first interval must include 1.00, the second must lie above it; otherwise the comparison above finds "
        "differences that do not exist, or misses some that do.",
        full=_bench("control", "--null"),
        quick=_bench("control", "--null", "--quick"),
        full_s=180,
        quick_s=10,
    ),
    Comparison(
        name="bridge",
        title="Operator to wheels, and back",
        what="A whole robot of each kind, with a stock broker between it and the operator. Down is from the operator's "
        "publish call to the last byte of the command's line at the MCU's pty; up is from the "
        "MCU's report to the operator.",
        full=_bench("bridge", "--with-media"),
        quick=_bench("bridge", "--quick"),
        full_s=300,
        quick_s=22,
        summary_lines=3,
    ),
    Comparison(
        name="bridge-profile",
        title="Operator to wheels: where the time goes",
        what="The same path of a command, hop by hop, from the time stamps of its packets on loopback: for a typical "
        "command, and for the slowest ones.",
        full=_bench("bridge", "--profile"),
        quick=_bench("bridge", "--profile", "--quick"),
        full_s=60,
        quick_s=12,
        root=True,
    ),
    Comparison(
        name="bridge-null",
        title="Operator to wheels: the null test",
        what="One robot in three roles that take turns: plain, again, and with a fifth of the usual latency planted by "
        "the operator. The first interval must include 1.00, the second must lie above it.",
        full=_bench("bridge", "--null"),
        quick=_bench("bridge", "--null", "--quick"),
        full_s=150,
        quick_s=14,
    ),
    Comparison(
        name="startup",
        title="Start-up",
        what="The time from a robot's launch to its first heartbeat, to ready and to the first obeyed command, and the "
        "time until a late subscriber has all retained messages; and the time from an operator's request to the first "
        "decoded picture. Each dot in the figure is one launch or subscriber.",
        full=_bench("startup"),
        quick=_bench("startup", "--quick"),
        full_s=156,
        quick_s=23,
        summary_lines=2,
    ),
    Comparison(
        name="cost",
        title="Memory and CPU",
        what="What each process of a robot needs while it is idle, driven, and streaming. Memory is PSS, in which "
        "shared pages are divided among their users; CPU is per cent of one core.",
        full=_bench("cost"),
        quick=_bench("cost", "--quick"),
        full_s=180,
        quick_s=20,
        summary_lines=10,
    ),
    Comparison(
        name="frames",
        title="Camera frames inside the robot",
        what="BGR pictures at 30 Hz from one process to others on the same machine. The latency is from the last byte "
        "written until the reader has a whole numpy array.",
        full=_bench("frames"),
        quick=_bench("frames", "--quick"),
        full_s=330,
        quick_s=20,
        summary_lines=4,
    ),
    Comparison(
        name="frames-null",
        title="Camera frames: the null test",
        what="One frame transport against itself, and with a fifth of its usual latency planted by the writer. The "
        "first interval must include 1.00, the second must lie above it.",
        full=_bench("frames", "--null", "zenoh-shm"),
        quick=_bench("frames", "--null", "zenoh-shm", "--quick"),
        full_s=130,
        quick_s=8,
    ),
    Comparison(
        name="video",
        title="Video on the wire",
        what="Bytes of each video encoding at equal quality (SSIM) on the same synthetic clips. Nothing is sent: this "
        "is the encoders' output.",
        full=_bench("video"),
        quick=_bench("video", "--quick"),
        full_s=60,
        quick_s=8,
    ),
    Comparison(
        name="sound",
        title="Sound on the wire",
        what="Bytes of each sound encoding with the headers of MQTT, TCP and IP. Nothing is sent: these are the "
        "encoders' bytes for synthetic speech.",
        full=_bench("sound"),
        quick=_bench("sound"),
        full_s=6,
        quick_s=6,
    ),
    Comparison(
        name="fleet",
        title="A fleet on one broker",
        what="Robots that are their own MCU, the real firmware on simulated pins, all on one stock broker and driven "
        "by one operator at 10 Hz each. The latency is from the operator's publish call to the change of the pins.",
        full=_bench("fleet", "--robots", "100", "--seconds", "20"),
        quick=_bench("fleet", "--quick"),
        full_s=35,
        quick_s=12,
    ),
    Comparison(
        name="traffic",
        title="Traffic of robots, as in the paper",
        what="Section 4.1 of the paper with simulated robots: Goob and Fred, MiniLAMP and BenJr stand idle, then are "
        "driven, and Goob and Fred send pictures as JSON and sound as PCM. `pebble record` records them at a real "
        "broker, `pebble analyse` computes, with the same definitions as the paper: bandwidth of payloads in active "
        "seconds, outages of heartbeats, and their latency from stamp to reception.",
        full=_bench("traffic"),
        quick=_bench("traffic", "--quick"),
        full_s=140,
        quick_s=19,
        summary_lines=4,
    ),
    Comparison(
        name="impair",
        title="On an impaired network",
        what="Whole robots whose uplink is limited and loses packets, trial after trial, as in section 4.2 of the "
        "paper: heartbeat, driving, video, then audio in each. “original” is this Pebble with the original's encodings "
        "(JSON video, PCM audio); “h264 opus” are the encodings with rate control.",
        full=("impair",),
        quick=("impair", "--quick"),
        full_s=1300,
        quick_s=85,
        summary_lines=9,
    ),
)
NAMES = tuple(one.name for one in COMPARISONS)


def chosen(names: Sequence[str]) -> list[Comparison]:
    """The comparisons of these names, in the report's order; without names all that this user may run.

    Raises PebbleError for unknown names.
    """
    if unknown := [name for name in names if name not in NAMES]:
        raise PebbleError(f"there is no {', '.join(unknown)} in the report: there are {', '.join(NAMES)}")
    if not names:
        return [one for one in COMPARISONS if one not in needs_root()]
    return [one for one in COMPARISONS if one.name in names]


def title_of(name: str) -> str:
    return next((one.title for one in COMPARISONS if one.name == name), name)


def needs_root() -> list[Comparison]:
    """The comparisons that this user may not run."""
    return [one for one in COMPARISONS if one.root and os.geteuid() != 0]
