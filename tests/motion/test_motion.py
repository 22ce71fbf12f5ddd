"""Histories against latch and arbiter in CPython, and what the cores did, call by call, in the real MicroPython."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from pebble.extensions.install.flash.boards import FIRMWARE
from pebble.motion.latch import is_name, reset_of, stop_of
from tests.firmware.micropython import SCRIPTS, compile_module, run
from tests.motion.histories import ENGINE, LENGTH
from tests.motion.world import CORE_NAMES, CORES
from tests.support import cases

HISTORIES, REPEATED = cases(80_000, 300_000) // LENGTH, 100

_BODIES: tuple[Any, ...] = (
    *(None, 0, True, "stop", [], [1], {}, {"stop": None}, {"stop": 7}, {"stop": "0" * 15}, {"stop": "0" * 17}),
    *({"stop": "0123456789abcdef"}, {"stop": "0123456789ABCDEF"}, {"stop": "0123456789abcdeg"}, {"stop": "ü" * 16}),
    *({"value": {"stop": "0123456789abcdef", "by": "anna"}}, {"value": [], "stop": "0123456789abcdef"}),
    *({"by": "a" * 40, "why": "w" * 50}, {"by": 'a"b\\c\n\x00\x7fü€😀', "why": ["x"]}, {"by": {}, "why": True}),
    *({"boot": "00c0ffee", "count": 3}, {"boot": "00c0ffee", "count": True}, {"boot": "00c0ffee", "count": 3.0}),
    *({"boot": 7, "count": 3}, {"boot": "", "count": -1}, {"boot": "x", "count": 1 << 40}, {"boot": "x"}),
    *({"value": {"boot": "x", "count": 1}, "boot": "y", "count": 2}, {"stop": "\uff10123456789abcde"}),
)


def bodies() -> str:
    """What the parsing functions return for commands of every shape."""
    return json.dumps([[body, stop_of(body), reset_of(body), is_name(body)] for body in _BODIES], ensure_ascii=False)


def traces(seed: int, count: int) -> Iterator[str]:
    """One line for each history: calls as ``[object, method, arguments, result]``."""
    for number in range(count):
        calls: list[Any] = []
        assert ENGINE.result(_recording(calls), ENGINE.draw(seed, number)).problems == []
        yield json.dumps(calls, separators=(",", ":"))


def _all(lease: Any) -> list[Any]:
    return [lease.key, list(lease.holder), list(lease.asker), lease.others, lease.changed, lease.halts]


def _recording(calls: list[Any]) -> Any:
    """Cores that add every call from outside to ``calls``."""

    class Latch(CORES.Latch):  # type: ignore[misc]
        number = 0

        def __init__(self, boot: str, names: int, diff: Any) -> None:
            super().__init__(boot, names, diff)
            self.number = len(calls)
            calls.append([self.number, "latch", [boot, names], None])

        def restore(self, saved: object) -> None:
            super().restore(saved)
            calls.append([self.number, "restore", [saved], self.saved()])

        def reset(self, *arguments: Any) -> bool:
            result: bool = super().reset(*arguments)
            calls.append([self.number, "reset", arguments, [result, self.saved()]])
            return result

        def state(self, persisted: bool | None) -> dict[str, Any]:
            result: dict[str, Any] = super().state(persisted)
            calls.append([self.number, "state", [persisted], dict(result)])
            return result

    class Lease(CORES.Lease):  # type: ignore[misc]
        def __init__(self, now: int, diff: Any, keys: Any, strangers: int) -> None:
            self.first = [now, keys.next, strangers]
            super().__init__(now, diff, keys, strangers)

        def hold(self, *arguments: Any) -> None:
            super().hold(*arguments)
            calls.append([self.number, "hold", arguments, _all(self)])

        def release(self, *arguments: Any) -> None:
            super().release(*arguments)
            calls.append([self.number, "release", arguments, _all(self)])

    class Arbiter(CORES.Arbiter):  # type: ignore[misc]
        def __init__(self, latch: Any, lease: Any, now: int, diff: Any, watchdog_ms: int) -> None:
            super().__init__(latch, lease, now, diff, watchdog_ms)
            self.number = lease.number = latch.number
            calls.append([self.number, "lease", lease.first, None])
            calls.append([self.number, "arbiter", [now, watchdog_ms], None])
            self.outside = True

        def judge(self, *arguments: Any) -> int:
            self.outside = False
            result: int = super().judge(*arguments)
            self.outside = True
            calls.append([self.number, "judge", arguments, [result, self.barred, *_all(self.lease)]])
            return result

        def stop(self, *arguments: Any) -> bool:
            result: bool = super().stop(*arguments)
            calls.append([self.number, "stop", arguments, [result, self.barred]])
            return result

        def tick(self, now: int) -> None:
            super().tick(now)
            if self.outside:
                calls.append([self.number, "tick", [now], self.barred])

    return SimpleNamespace(Latch=Latch, Lease=Lease, Arbiter=Arbiter, diff=CORES.diff, StopSender=CORES.StopSender)


def test_no_history_breaks_a_rule() -> None:
    broken = [one for one in ENGINE.run("", 3, range(HISTORIES)) if one.problems]
    assert not broken, "python -m tests.kit.schedules motion --seed 3 prints the shortest history"


def test_micropython_returns_the_same_results(tmp_path: Path) -> None:
    """The calls are repeated on the cores as they are compiled for a board; how many, and whether all results are the
    same, is the last line."""
    for name in CORE_NAMES:
        compile_module(FIRMWARE["minilamp"], Path("common", f"{name}.py"), tmp_path)
    lines = (bodies(), *traces(3, REPEATED))
    (tmp_path / "traces.jsonl").write_text("".join(line + "\n" for line in lines), encoding="utf-8")
    done = run(tmp_path, SCRIPTS / "motion.py", heap=8 * 1024 * 1024, timeout_s=600.0)
    assert done.returncode == 0, done.stdout + done.stderr
    [counts] = done.stdout.splitlines()
    histories, calls, same = json.loads(counts)
    assert (histories, same) == (REPEATED, True)
    assert calls > 50 * REPEATED
