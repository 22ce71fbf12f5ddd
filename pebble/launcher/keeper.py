"""Keeps one program of the robot running: starts it, listens to it, starts it again, stops it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress

from pebble.launcher.child import Child, read_available
from pebble.launcher.log_lines import LineSplitter
from pebble.launcher.program import Program
from pebble.launcher.reactor import Reactor
from pebble.launcher.supervisor import LOOP_EXITS, LOOP_WINDOW_S, Life
from pebble.timers import Timer

_LAST_READS = 16  # 64 KiB each, of what a child left in its pipe when it died

log = logging.getLogger(__name__)


class Keeper:
    """One program, its life and its present child. All methods belong to the reactor's thread.

    An on-demand program is started by :meth:`want`, any other by :meth:`start`. ``on_line(pid, line)`` gets what the
    child writes, ``on_note(line)`` its notes that are no signs of life; ``on_change()`` is called when its state may
    have changed, ``on_end()`` whenever a child has ended.
    """

    def __init__(
        self,
        program: Program,
        life: Life,
        reactor: Reactor,
        *,
        spawn: Callable[[Program], Child],
        on_line: Callable[[int, str], None],
        on_note: Callable[[str], None],
        on_change: Callable[[], None],
        on_end: Callable[[], None],
    ) -> None:
        self.program, self.life = program, life
        self.wanted = not program.on_demand
        self.shown = not program.on_demand  # in the robot's status: on-demand programs from the first time on
        self._reactor, self._spawn = reactor, spawn
        self._on_line, self._on_note, self._on_change, self._on_end = on_line, on_note, on_change, on_end
        self._child: Child | None = None
        self._lines, self._notes = LineSplitter(), LineSplitter()
        self._timer: Timer | None = None  # to the next start, the next look whether the child is stuck, or its kill
        self._stopping = False  # for good
        self._ending = self._was_stuck = False  # the present child

    @property
    def running(self) -> bool:
        return self._child is not None

    def want(self) -> None:
        """Run an on-demand program, from now on or as soon as the one that still stops has ended."""
        if self.wanted or self._stopping:
            return
        log.info("%s is wanted", self.program.name)
        self.wanted = self.shown = True
        if self._child is None:
            self._start_when_rested()

    def unwant(self) -> None:
        """Ask it to end, and kill it where it does not; nobody waits. Started again only when it is wanted again."""
        if not self.wanted or self._stopping:
            return
        log.info("%s is not wanted any more", self.program.name)
        self.wanted = False
        if self._ending:  # wanted for a moment while it was stopping already
            return
        self._cancel_timer()
        self._end()
        if self._child is not None:
            self._timer = self._reactor.after(self.program.stop_timeout_s, self._enforce)

    def start(self) -> None:
        self._lines, self._notes, self._ending, self._was_stuck = LineSplitter(), LineSplitter(), False, False
        self.life.started(time.monotonic())
        try:
            self._child = child = self._spawn(self.program)
        except OSError as error:
            self._start_again(f"could not start: {error}")
            return
        self._reactor.watch(child.output, lambda: self._read_output(child))
        self._reactor.watch(child.notes, lambda: self._read_notes(child))
        self._reactor.watch(child.exited, lambda: self._exited(child))
        self._look_at(self.life.stuck_at)
        self._on_change()

    def stop(self) -> None:
        """Ask the child to end, and start it no more."""
        self._stopping, self.wanted = True, False
        self._cancel_timer()
        self._end()

    def kill(self) -> None:
        """End it at once. Its exit is noticed by the reactor like any other."""
        if self._child is not None:
            self._child.kill()

    # -- what a child says

    def _read_output(self, child: Child) -> None:
        data = read_available(child.output)
        if data == b"":
            self._reactor.forget(child.output)  # it closed its stderr, or has ended
        elif data is not None:
            self._pass_on(child, self._lines.feed(data))

    def _read_notes(self, child: Child) -> None:
        data = read_available(child.notes)
        if data == b"":
            self._reactor.forget(child.notes)
        elif data is not None:
            self._hear(data)

    def _hear(self, data: bytes) -> None:
        for line in self._notes.feed(data):
            if line == "ALIVE":
                self.life.alive(time.monotonic())
            elif line == "READY":
                self._ready()
            else:
                self._on_note(line)

    def _ready(self) -> None:
        if self._ending:  # too late
            return
        self.life.ready(time.monotonic())
        self._look_at(self.life.stuck_at)  # from now on signs of life come more often
        self._on_change()

    def _pass_on(self, child: Child, lines: list[str]) -> None:
        for line in lines:
            self._on_line(child.pid, line)

    # -- what becomes of it

    def _start_when_rested(self) -> None:
        wait = self.life.rest_s(time.monotonic())
        if wait > 0:
            self._timer = self._reactor.after(wait, self.start)
        else:
            self.start()

    def _end(self) -> None:
        if self._child is not None:
            self._ending = True
            self._child.terminate()
        else:
            self.life.stopped(None)
            self._on_change()

    def _enforce(self) -> None:
        log.warning("%s did not stop within %g s: killed", self.program.name, self.program.stop_timeout_s)
        self.kill()

    def _look(self) -> None:
        if time.monotonic() < self.life.stuck_at:
            self._look_at(self.life.stuck_at)
            return
        log.error("%s gives no sign of life: killed", self.program.name)
        self._was_stuck = True
        self.kill()

    def _look_at(self, due: float) -> None:
        self._cancel_timer()
        self._timer = self._reactor.at(due, self._look)

    def _exited(self, child: Child) -> None:
        child.kill()  # what it started must not go on without it; until it is reaped the group's number is its own
        self._read_rest(child)
        for descriptor in (child.output, child.notes, child.exited):
            with suppress(KeyError):  # forgotten at its end
                self._reactor.forget(descriptor)
        how = child.end()
        self._child = None
        self._cancel_timer()
        if self._ending:
            self._ending = False
            self.life.stopped(how)
            self._on_change()
            if self.wanted:  # again, meanwhile
                self._start_when_rested()
        else:
            self._start_again("stuck, killed" if self._was_stuck else how)
        self._on_end()

    def _read_rest(self, child: Child) -> None:
        self._hear(read_available(child.notes) or b"")
        for _ in range(_LAST_READS):
            data = read_available(child.output)
            if not data:
                break
            self._pass_on(child, self._lines.feed(data))
        self._pass_on(child, self._lines.rest())

    def _start_again(self, how: str) -> None:
        was_looping = self.life.looping
        wait = self.life.exited(time.monotonic(), how)
        self._timer = self._reactor.after(wait, self.start)
        name = self.program.name
        if not self.life.looping:
            log.warning("%s ended (%s): starting it again in %.1f s", name, how, wait)
        elif not was_looping:
            log.error(
                "%s ended %d times within %d s, last: %s. Trying again every %d s",
                name, LOOP_EXITS, LOOP_WINDOW_S, how, wait,
            )  # fmt: skip
        self._on_change()

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
