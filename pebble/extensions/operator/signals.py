"""Handlers of the signals that end a command, for the duration of a ``with`` block."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

import typer

from pebble.runtime.signals import ending_signals

if TYPE_CHECKING:
    import asyncio


@contextmanager
def handled_by(handler: Callable[[int, FrameType | None], Any], *more: int) -> Iterator[None]:
    """Call ``handler`` during the block on the signals that end a program, and on ``more``. Main thread only."""
    before = {number: signal.signal(number, handler) for number in (*ending_signals(), *more)}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGTERM and SIGHUP too, so that a command cleans up as after Ctrl-C.

    In the main thread only.
    """

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    with handled_by(interrupt):
        yield


class _EndedError(KeyboardInterrupt):
    """An end by SIGTERM of a block of :func:`until_ended`."""


def _end(_signal: int, _frame: FrameType | None) -> None:
    raise _EndedError


@contextmanager
def until_ended() -> Iterator[None]:
    """End the command with exit code 0 on SIGTERM, as it runs until it is ended. In the main thread only."""
    before = signal.signal(signal.SIGTERM, _end)
    try:
        yield
    except _EndedError:
        raise typer.Exit from None
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def ending_event() -> Iterator[asyncio.Event]:
    """Yield an event that is set by the signals that end a program.

    Not every platform lets an event loop handle signals.
    """
    import asyncio  # most commands have no loop

    loop, event = asyncio.get_running_loop(), asyncio.Event()
    with handled_by(lambda *_: loop.call_soon_threadsafe(event.set)):
        yield event
