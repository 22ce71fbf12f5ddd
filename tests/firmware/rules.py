"""Who may move a robot, as a second implementation that a drill compares the firmware with.

Where the exact moment of an end matters, it allows what the firmware may allow up to some milliseconds later.
"""

from __future__ import annotations

import json
import math
import re
from typing import Any, Final

from pebble.contract.payloads import Drive

HOLD_S: Final = 2.0
START_S: Final = 2.0
QUIET_S: Final = 0.5
_NAMES: Final = 4
_NAME: Final = re.compile("[0-9a-f]{16}")
FREE: Final = b'{"latched": false, "recent": []}'
_GRAIN_S: Final = 0.005


class Rules:
    """``stop``, ``reset`` and ``admits`` are for what the firmware reads, ``restart`` for its boot; ``tick`` often."""

    def __init__(self, now: float) -> None:
        self.restart(now, FREE, promised=False)

    def restart(self, now: float, file: bytes, *, promised: bool) -> None:
        """``file`` is what the board has saved; ``promised``: it has published that its stop is."""
        saved = _object(file)
        self.latched = bool(saved.get("latched", True)) or promised
        self._recent: list[str] = saved.get("recent", [])
        self.count = 0
        self._waits_from = -math.inf  # for persons to let go, after a reset
        self._scripts_from = now + START_S
        self._held_until = -math.inf
        self._lost_at = math.inf  # the end of a hold that bars
        self._script_until = -math.inf
        self._newest = self._barred = 0

    def stop(self, payload: bytes) -> bool:
        """Whether it is a new one."""
        name = _object(payload).get("stop", "")
        if not payload or (_NAME.fullmatch(name) and name in self._recent):
            return False
        self._recent = [name, *self._recent][:_NAMES]
        self.latched = True
        self.count += 1
        self._bar(self._newest)
        self._script_until = self._waits_from = -math.inf
        return True

    def reset(self, payload: bytes, boot: str, now: float) -> None:
        order = _object(payload)
        if self.latched and (order.get("boot"), order.get("count")) == (boot, self.count):
            self.latched = False
            self._waits_from = now

    def admits(self, drive: Drive, now: float) -> float | None:
        """Seconds at most for which it may move anything; None: it must have no effect."""
        self.tick(now)
        run = drive.run if drive.signed and isinstance(drive.run, int) else 0
        if run > self._newest:
            self._newest = run
            self._bar(run - 1)
        if self.latched:
            self._bar(run)
        if drive.moves and (self.latched or (not run and self._waits(now))):
            return None
        if not drive.moves and not run:
            self._waits_from = -math.inf
        valid_s = drive.valid_ms / 1000 if isinstance(drive.valid_ms, int) else math.inf
        if not run:
            self._person(drive, final=valid_s == 0, now=now)
        elif now < max(self._scripts_from, self._held_until) - _GRAIN_S or run <= self._barred:
            return None
        else:
            self._script_until = now + min(valid_s, 0.9)
        return valid_s

    def tick(self, now: float) -> None:
        if now >= self._lost_at + _GRAIN_S:
            self._lost_at = math.inf
            self._bar(self._newest)

    def _waits(self, now: float) -> bool:
        waits = now < self._waits_from + QUIET_S - _GRAIN_S
        self._waits_from = now if waits else -math.inf
        return waits

    def _person(self, drive: Drive, *, final: bool, now: float) -> None:
        if not drive.moves and (final or now < self._script_until - _GRAIN_S):
            self._bar(self._newest)
        self._script_until = -math.inf
        self._held_until = now + HOLD_S
        self._lost_at = math.inf if not drive.moves and not final else self._held_until

    def _bar(self, run: int) -> None:
        self._barred = max(self._barred, run)


def _object(raw: bytes) -> dict[str, Any]:
    try:
        body = json.loads(raw)
    except ValueError:
        body = None
    return body if isinstance(body, dict) else {}
