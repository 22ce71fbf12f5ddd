"""The options of a run: which robots, under which conditions, and for how long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pebble.bench.comparison import FOLDER
from pebble.bench.impair.conditions import Condition, chosen, trials
from pebble.bench.impair.messages import TrialRequest
from pebble.bench.impair.network import KINDS
from pebble.bench.results import LONGEST_S
from pebble.errors import PebbleError

QUICK = ("base-start", "256k", "64k+5%", "base-end")
SHORTEST_WINDOW_S = 1.0


@dataclass(frozen=True, slots=True)
class Subject:
    """One robot under test. Encodings are requested by the operator; None: as the robot is configured."""

    name: str
    transport: str  # inside the robot: "mqtt" or "zenoh"
    video: str | None = None
    audio: str | None = None

    @property
    def form(self) -> str:
        """Its encodings: the second part of its name."""
        return self.name.partition(" ")[2]


#: The robots are configured with the original's settings: JSON pictures and PCM.
SUBJECTS = (
    Subject("mqtt original", "mqtt"),
    Subject("zenoh original", "zenoh"),
    Subject("mqtt h264 opus", "mqtt", "h264", "opus"),
    Subject("zenoh h264 opus", "zenoh", "h264", "opus"),
)
NAMES = tuple(subject.name for subject in SUBJECTS)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImpairPlan:
    """Windows are seconds of video and of audio in each trial; a quick plan runs all subjects at the same time."""

    trials: Sequence[str] = ()  # empty: all, or those of a quick run
    subjects: Sequence[str] = NAMES
    network: str = "auto"
    both_ways: bool = False
    window_s: float | None = None  # None: 8, or 4
    quick: bool = False
    output: Path = FOLDER

    def check(self) -> None:
        """Raises PebbleError naming an invalid option."""
        chosen(self.trials)
        unknown = [name for name in self.subjects if name not in NAMES]
        if unknown or not self.subjects:
            raise PebbleError(f"no subject {', '.join(unknown)!r}: choose from {', '.join(NAMES)}")
        if self.network not in KINDS:
            raise PebbleError(f"no kind of network {self.network!r}: choose from {', '.join(KINDS)}")
        if not SHORTEST_WINDOW_S <= self.window <= LONGEST_S:
            raise PebbleError(f"--window must be from {SHORTEST_WINDOW_S:.0f} to {LONGEST_S:.0f} seconds")

    @property
    def window(self) -> float:
        return self.window_s if self.window_s is not None else 4.0 if self.quick else 8.0

    def conditions(self) -> list[Condition]:
        """The requested conditions in the paper's order."""
        wanted = self.trials or (QUICK if self.quick else ())
        return chosen(wanted, self.both_ways) if wanted else trials(self.both_ways)

    def groups(self) -> list[list[Subject]]:
        """The subjects that run at the same time: the transports of one form, to limit the load on small machines."""
        chosen = [subject for subject in SUBJECTS if subject.name in self.subjects]
        if self.quick:
            return [chosen]
        forms = dict.fromkeys(subject.form for subject in chosen)
        return [[subject for subject in chosen if subject.form == form] for form in forms]

    def request(self, subject: Subject) -> TrialRequest:
        """The request to a subject's operator in each trial."""
        return TrialRequest(
            video=subject.video,
            audio=subject.audio,
            alone_s=2.0 if self.quick else 3.0,
            window_s=self.window,
            grace_s=1.0 if self.quick else 2.0,
            off_s=1.0 if self.quick else 2.0,
            clip_s=5.0,
        )

    def command(self) -> list[str]:
        """The command line that repeats the run."""
        words = ["pebble", "impair", "--link", self.network, "--window", f"{self.window:g}"]
        words += ["--trials", ",".join(self.trials)] if self.trials else []
        words += ["--subjects", ",".join(self.subjects)] if tuple(self.subjects) != NAMES else []
        return words + ["--both-ways"] * self.both_ways + ["--quick"] * self.quick
