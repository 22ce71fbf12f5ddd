"""An event loop of asyncio in virtual time: it runs when it is told to, and never waits."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any


class _NoFiles:
    """A stand-in for a selector."""

    def select(self, _timeout: float | None) -> list[Any]:
        return []


class VirtualLoop(asyncio.BaseEventLoop):
    """``clock`` is its time. What runs in other threads elsewhere runs here at once."""

    def __init__(self, clock: Callable[[], float]) -> None:
        super().__init__()
        self._virtual_clock = clock
        self._selector = _NoFiles()

    def time(self) -> float:
        return self._virtual_clock()

    def run_in_executor(self, _executor: Any, function: Callable[..., Any], *arguments: Any) -> Any:
        future = self.create_future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    @property
    def due(self) -> float | None:
        """When there is something to do next."""
        while self._scheduled and self._scheduled[0]._cancelled:  # type: ignore[attr-defined]
            self._run_now()
        if self._ready:  # type: ignore[attr-defined]
            return self.time()
        return self._scheduled[0]._when if self._scheduled else None  # type: ignore[attr-defined]

    def turn(self) -> None:
        """Do all that is due."""
        while self._ready or (self._scheduled and self._scheduled[0]._when <= self.time()):  # type: ignore[attr-defined]
            self._run_now()

    def end(self) -> None:
        """Cancel every task, and let each end."""
        for _ in range(3):
            for task in asyncio.all_tasks(self):
                task.cancel()
            while self._ready:  # type: ignore[attr-defined]
                self._run_now()
        self.close()

    def _run_now(self) -> None:
        asyncio._set_running_loop(self)
        try:
            self._run_once()  # type: ignore[attr-defined]
        finally:
            asyncio._set_running_loop(None)

    def _process_events(self, _events: list[Any]) -> None:
        """There are no files."""

    def _write_to_self(self) -> None:
        """Nothing waits that would have to be woken up."""
