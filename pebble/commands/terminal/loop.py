"""Reads keys from a terminal and shows a status line, until a signal, Ctrl-D or the loss of the terminal ends it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from pebble.client.terminal.key_decoder import END, KeyDecoder
from pebble.config.visible import shown

if TYPE_CHECKING:
    from pebble.client.terminal.keys import Terminal

_SHOW_PERIOD_S = 0.1


class TerminalLoop:
    """``now`` is a clock in seconds, and goes on while nothing is read."""

    def __init__(self, terminal: Terminal, now: Callable[[], float]) -> None:
        self._terminal, self._now = terminal, now
        self._decoder = KeyDecoder()
        self._line, self._shown_at = "", float("-inf")

    @property
    def ended(self) -> str:
        """Why it is over: a signal, Ctrl-D, or a terminal that is gone; empty while it is not."""
        return self._terminal.ended

    def keys(self, seconds: float) -> list[str]:
        """Wait up to ``seconds`` for keys, or for a signal."""
        due = self._decoder.due
        data = self._terminal.read(seconds if due is None else min(seconds, due - self._now()))
        keys = self._decoder.feed(data, self._now())
        if END in keys:
            self._terminal.ended = END
        return keys

    def show(self, status: Callable[[], str], *, at_once: bool) -> None:
        """Show the status if it has changed, a few times a second unless ``at_once``."""
        now = self._now()
        if at_once or now - self._shown_at >= _SHOW_PERIOD_S:
            self._shown_at = now
            if (line := shown(status())) != self._line:
                self._line = line
                self._terminal.show(line)

    def suspend(self, prepare: Callable[[], object]) -> None:
        """After Ctrl-Z: prepare for standing still, then stand still until this process goes on."""
        if self._terminal.suspended:
            prepare()
            self._terminal.stand_still()
            self._line = ""  # a shell has written over it
