"""The pages' own modules, in a process of node, in virtual time."""

from __future__ import annotations

import heapq
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from tests.kit.schedules import ViolatedError
from tests.robot.lockstep.scheduler import Scheduler

CORE = Path(__file__).parents[4] / "pebble/extensions/page/static/core"
EPOCH = 1_700_000_000.0  # the wall clock at virtual time 0

_NEVER = float("inf")


class Output(NamedTuple):
    """Something that a page does: ``connect``, ``send`` or ``close`` a socket, or answers with its ``state``."""

    page: int
    what: str
    value: Any  # number of the socket, or the state
    text: str = ""


class _Answer(msgspec.Struct):
    now: float
    due: float | None
    out: list[Any]


_answers = msgspec.json.Decoder(_Answer)


class Pages:
    """All pages of one world after the other. ``folder`` holds the modules."""

    def __init__(self, folder: Path = CORE) -> None:
        program = Path(__file__).parent / "page.js"
        self._process = subprocess.Popen(
            ["node", str(program), str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._do: list[Any] = []
        self._begin: list[float] | None = None
        self.due = _NEVER

    def close(self) -> None:
        self._process.stdin.close()  # type: ignore[union-attr]
        self._process.stdout.close()  # type: ignore[union-attr]
        self._process.wait(5)

    def begin(self, now: float) -> None:
        """Forget all pages."""
        self._do, self._begin, self.due = [], [now, EPOCH], _NEVER

    def do(self, page: int, command: str, *arguments: Any) -> None:
        """To be done at the present time."""
        self._do.append([page, command, *arguments])

    @property
    def waiting(self) -> bool:
        return bool(self._do)

    def exchange(self, now: float, to: float | None = None) -> tuple[float, list[Output]]:
        """Do what waits, and let time pass ``to`` then, or until pages do something."""
        request: dict[str, Any] = {"at": now, "do": self._do}
        if self._begin is not None:
            request["begin"], self._begin = self._begin, None
        if to is not None:
            request["to"] = to
        self._do = []
        self._process.stdin.write(msgspec.json.encode(request) + b"\n")  # type: ignore[union-attr]
        self._process.stdin.flush()  # type: ignore[union-attr]
        line = self._process.stdout.readline()  # type: ignore[union-attr]
        assert line, "a page's module has failed: see its message above"
        answer = _answers.decode(line)
        self.due = _NEVER if answer.due is None else answer.due
        return answer.now, [Output(*one) for one in answer.out]


class PagesScheduler(Scheduler):
    """Python's jobs and the pages' timers, in one order. ``on_output`` is called with what pages do."""

    def __init__(self, now: float, pages: Pages) -> None:
        super().__init__(now)
        self.pages = pages
        self.on_output = lambda output: None
        pages.begin(now)

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while True:
            if self.pages.waiting:
                self._take(*self.pages.exchange(self.now))
                continue
            due = self._heap[0][0] if self._heap else _NEVER
            if self.pages.due <= min(due, end):
                self._take(*self.pages.exchange(self.now, min(due, end)))
            elif due <= end:
                self._run_first()
            else:
                break
        self.now = end

    def flush(self) -> None:
        """Let pages do what waits, without time passing."""
        while self.pages.waiting:
            self._take(*self.pages.exchange(self.now))

    def _take(self, now: float, outputs: list[Output]) -> None:
        if outputs:
            self.now = max(self.now, now)
        for output in outputs:
            self.on_output(output)
        self._raise()

    def _run_first(self) -> None:
        self.now, _, job = heapq.heappop(self._heap)
        job()
        self._raise()

    def _raise(self) -> None:
        if self._violated:
            raise ViolatedError(self._violated)
