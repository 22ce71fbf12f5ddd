"""The options of one run of ``pebble bench bridge``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from pebble.bench.bridge_drive import RATE_HZ
from pebble.bench.bridge_driven_robot import STAND_IN
from pebble.bench.comparison import FOLDER
from pebble.bench.engine import check_folder
from pebble.bench.results import LONGEST_S, Value
from pebble.errors import PebbleError
from pebble.rig.robot import KINDS, check_kinds


class Mode(StrEnum):
    """The value is its option on the command line."""

    COMPARE = ""
    MEDIA = "--with-media"
    NULL = "--null"
    PROFILE = "--profile"


#: Seconds and rounds; the second pair is for --quick.
_USUAL = {
    Mode.COMPARE: ((4.0, 10), (0.5, 4)),
    Mode.MEDIA: ((4.0, 10), (0.5, 4)),
    Mode.NULL: ((4.0, 10), (0.5, 4)),
    Mode.PROFILE: ((10.0, 3), (2.0, 1)),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgePlan:
    """In each round every robot is driven for ``seconds``."""

    mode: Mode = Mode.COMPARE
    seconds: float = 4.0
    rounds: int = 10
    kinds: Sequence[str] = (STAND_IN, *KINDS)
    quick: bool = False
    output: Path = FOLDER

    @property
    def with_media(self) -> bool:
        return self.mode is Mode.MEDIA

    @property
    def media_kinds(self) -> Sequence[str]:
        """The robots that are also driven while media flow; the stand-in has none."""
        return [kind for kind in self.kinds if kind != STAND_IN] if self.with_media else []

    def check(self) -> None:
        """Raises PebbleError naming an invalid option."""
        check_kinds(self.kinds, also=(STAND_IN,) if self.mode in (Mode.COMPARE, Mode.MEDIA) else ())
        if self.mode is Mode.NULL and len(self.kinds) != 1:
            raise PebbleError("--null takes one transport: --variants mqtt, or zenoh")
        if not 0 < self.seconds <= LONGEST_S or self.rounds < 1:
            raise PebbleError(f"seconds and rounds must be positive, and seconds at most {LONGEST_S:.0f}")
        check_folder(self.output)

    def options(self) -> dict[str, Value | list[Value]]:
        """All options that affect the results."""
        return {
            "mode": self.mode.removeprefix("--") or "compare",
            "seconds": self.seconds,
            "rounds": self.rounds,
            "variants": list(self.kinds),
            "rate_hz": RATE_HZ,
        }

    def command(self) -> list[str]:
        """The command line that repeats the run."""
        words = ["pebble", "bench", "bridge", *([self.mode.value] if self.mode else [])]
        words += ["--rounds", str(self.rounds), "--seconds", f"{self.seconds:g}", "--variants", ",".join(self.kinds)]
        return [*words, *(["--quick"] if self.quick else [])]


def plan(mode: Mode, *, quick: bool = False, **given: Any) -> BridgePlan:
    """The default or quick plan, with the ``given`` options replaced."""
    seconds, rounds = _USUAL[mode][quick]
    kinds = {Mode.NULL: KINDS[1:], Mode.PROFILE: KINDS}.get(mode, (STAND_IN, *KINDS))
    return BridgePlan(mode=mode, quick=quick, **{"seconds": seconds, "rounds": rounds, "kinds": kinds, **given})
