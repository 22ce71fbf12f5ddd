"""The supervisor of one program of the robot: starts it, restarts it and stops it."""

import logging
from collections.abc import Callable
from enum import Enum, auto
from functools import partial

import msgspec

from pebble.extension import Program
from pebble.launcher.child import Child
from pebble.launcher.log_forwarding import text_of
from pebble.launcher.pipes import Pipes
from pebble.launcher.reactor import Reactor
from pebble.launcher.restart_policy import LOOP_EXITS, LOOP_WINDOW_S, RestartPolicy
from pebble.runtime import notes
from pebble.runtime.bounded_output import LINES_PER_S
from pebble.runtime.exits import ASKS_S, has_ended
from pebble.runtime.timers import Timer

_SCRIPTS_LINES_PER_S = 10 * LINES_PER_S  # of a program that runs scripts: it bounds each script itself

log = logging.getLogger(__name__)


class ProgramState(Enum):
    """State of the program; it also tells the purpose of the supervisor's one timer."""

    IDLE = auto()  # no child; started by request() or start()
    WAITING = auto()  # no child; the timer starts one
    RUNNING = auto()  # the timer checks for signs of life
    STUCK = auto()  # killed for lack of signs of life; started again after its exit
    RELEASED = auto()  # asked to end because it is not needed; the timer kills it; IDLE after its exit
    REPLACED = auto()  # as RELEASED, and requested again since: started again after its exit
    STOPPING = auto()  # asked to end for good
    STOPPED = auto()  # no child, and never another


_ACTIVE = (ProgramState.WAITING, ProgramState.RUNNING, ProgramState.STUCK, ProgramState.REPLACED)


class ProcessSupervisor:
    """A program, its restart policy and its present child. All methods run on the reactor's thread.

    :meth:`request` starts an on-demand program, :meth:`start` any other. ``on_line(pid, line)`` gets the child's
    output, ``on_note(note)`` its notes other than Ready and Alive. ``on_change()`` is called when the reported state
    may have changed, ``on_end()`` whenever a child has ended. While ``is_stopping()``, an ended child is not started
    again.
    """

    def __init__(
        self,
        program: Program,
        policy: RestartPolicy,
        reactor: Reactor,
        *,
        spawn: Callable[[Program], Child],
        on_line: Callable[[int, str], None],
        on_note: Callable[[notes.Note], None],
        on_change: Callable[[], None],
        on_end: Callable[[], None],
        is_stopping: Callable[[], bool],
    ) -> None:
        self.program, self.policy = program, policy
        self.state = ProgramState.IDLE
        self.shown = not program.on_demand  # in the robot's status: on-demand programs from their first request on
        self.held = False  # an on-demand program is requested, and has to wait
        self._reactor, self._spawn = reactor, spawn
        self._on_line, self._on_note, self._on_change, self._on_end = on_line, on_note, on_change, on_end
        self._is_stopping = is_stopping
        self._child: Child | None = None
        self._pipes: Pipes | None = None  # of the newest child
        self._timer: Timer | None = None  # for what, depends on the state: see ProgramState
        self._nonsense_logged = False

    @property
    def running(self) -> bool:
        """True from the start of a child until its exit."""
        return self._child is not None

    @property
    def requested(self) -> bool:
        """True if an on-demand program was requested, and not released since."""
        return self.state in _ACTIVE

    def request(self) -> None:
        """Run an on-demand program: now, or after the exit of a child that was asked to end."""
        self.held = False
        if self.state not in (ProgramState.IDLE, ProgramState.RELEASED):
            return
        log.info("%s is requested", self.program.name)
        self.shown = True
        if self.state is ProgramState.RELEASED:
            self.state = ProgramState.REPLACED
        else:
            self._start_after_request()

    def release(self) -> None:
        """Ask an on-demand program to end, and kill it later if it does not. Does not wait."""
        if self.held:
            self.held = False
            self._on_change()
        if self.state not in _ACTIVE:
            return
        log.info("%s is released", self.program.name)
        if self.state is ProgramState.REPLACED:  # the child was asked to end before
            self.state = ProgramState.RELEASED
            return
        self._end_child(ProgramState.RELEASED, without_child=ProgramState.IDLE)
        if self._child is not None:
            self._timer = self._reactor.after(self.program.stop_timeout_s, self._kill_overdue)

    def hold(self) -> None:
        """End a requested on-demand program; it waits until :meth:`request`."""
        if not self.held:
            self.release()
            self.shown = self.held = True
            self._on_change()

    def start(self) -> None:
        """Start the program, unless the robot is stopping."""
        if self._is_stopping():
            self.stop()  # there is no child: this only sets the state
            return
        self.policy.started(self._reactor.now(), plain=self.program.plain)
        try:
            self._child = child = self._spawn(self.program)
        except OSError as error:
            self._restart(f"could not start: {error}")
            return
        self.state = ProgramState.RUNNING
        rate = _SCRIPTS_LINES_PER_S if self.program.runs_scripts else LINES_PER_S
        self._pipes = Pipes(child, self._reactor, partial(self._printed, child.pid), self._noted, rate=rate)
        self._watch_exit(child)
        if not self.program.plain:  # a plain one gives no signs of life
            self._check_at(self.policy.stuck_at)
        self._on_change()

    def stop(self) -> None:
        """Ask the child to end, and start no other."""
        self.held = False
        self._end_child(ProgramState.STOPPING, without_child=ProgramState.STOPPED)

    def restart(self) -> None:
        """Ask the child to end; a program that should run is then started again."""
        if self._child is not None:
            self._child.terminate()

    def kill(self) -> None:
        """Kill the child. The reactor notices its exit like any other."""
        if self._child is not None:
            self._child.kill()

    # -- what the child tells

    def _printed(self, pid: int, line: bytes) -> None:
        if text := text_of(line):
            self._on_line(pid, text)

    def _noted(self, line: bytes) -> None:
        try:
            note = notes.decode(line)
        except msgspec.DecodeError:
            if not self._nonsense_logged:
                self._nonsense_logged = True
                log.warning("%s wrote what is no note, ignored: %.80s", self.program.name, text_of(line))
            return
        if isinstance(note, notes.Alive):
            self.policy.alive(self._reactor.now())
        elif isinstance(note, notes.Ready):
            self._ready()
        else:
            self._on_note(note)

    def _ready(self) -> None:
        if self.state is not ProgramState.RUNNING:  # too late
            return
        self.policy.ready(self._reactor.now())
        self._check_at(self.policy.stuck_at)  # from now on signs of life come more often
        self._on_change()

    # -- the timer

    def _start_after_request(self) -> None:
        wait_s = self.policy.request_delay_s(self._reactor.now())
        if wait_s > 0:
            self._start_in(wait_s)
        else:
            self.start()

    def _start_in(self, wait_s: float) -> None:
        self.state = ProgramState.WAITING
        self._timer = self._reactor.after(wait_s, self.start)

    def _check_at(self, due: float) -> None:
        self._cancel_timer()
        self._timer = self._reactor.at(due, self._check_alive)

    def _check_alive(self) -> None:
        if self._reactor.now() < self.policy.stuck_at:
            self._check_at(self.policy.stuck_at)
            return
        log.error("%s gives no sign of life: killed", self.program.name)
        self.state = ProgramState.STUCK
        self.kill()

    def _kill_overdue(self) -> None:
        log.warning("%s did not stop within %g s: killed", self.program.name, self.program.stop_timeout_s)
        self.kill()

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    # -- the end of a child

    def _end_child(self, ending: ProgramState, *, without_child: ProgramState) -> None:
        """Ask the child to end, and set the state ``ending``; without a child, set ``without_child``."""
        self._cancel_timer()
        if self._child is not None:
            self.state = ending
            self._child.terminate()
        else:
            self.state = without_child
            self.policy.stopped(None)  # None: no process was running
            self._on_change()

    def _watch_exit(self, child: Child) -> None:
        if child.exited is not None:
            self._reactor.watch(child.exited, lambda: self._exited(child))
            return

        def ask() -> None:  # repeatedly, as the system has no descriptor: see pebble.runtime.exits
            if has_ended(child.pid):
                self._exited(child)
            else:
                self._reactor.after(ASKS_S, ask)

        ask()

    def _exited(self, child: Child) -> None:
        child.kill()  # its own children must not go on; until it is reaped nobody else has the group's number
        if self._pipes is not None:
            self._pipes.close()
        if child.exited is not None:
            self._reactor.forget(child.exited)
        how = child.end()
        self._child = None
        self._cancel_timer()
        if self.state not in (ProgramState.RUNNING, ProgramState.STUCK):  # it was asked to end
            self._ended_as_asked(how)
        elif self._is_stopping():
            log.info("%s ended (%s) before its turn to stop", self.program.name, how)
            self._ended_as_asked(how)
        else:
            self._restart("stuck, killed" if self.state is ProgramState.STUCK else how)
        self._on_end()

    def _ended_as_asked(self, how: str) -> None:
        """Handle the end of a child that was released, so that it can be requested again, or stopped for good."""
        was_replaced = self.state is ProgramState.REPLACED
        was_released = was_replaced or self.state is ProgramState.RELEASED
        self.state = ProgramState.IDLE if was_released else ProgramState.STOPPED
        self.policy.stopped(how)
        self._on_change()
        if was_replaced:
            self._start_after_request()

    def _restart(self, how: str) -> None:
        was_in_crash_loop = self.policy.in_crash_loop
        wait_s = self.policy.exited(self._reactor.now(), how)
        self._start_in(wait_s)
        self._reactor.after(LOOP_WINDOW_S + 1.0, self._on_change)  # then the status no longer counts this exit
        name = self.program.name
        times = self.policy.exits_within_a_minute(self._reactor.now())
        if not self.policy.in_crash_loop:
            often = f", {times} times within a minute" if times >= notes.OFTEN else ""
            log.warning("%s ended (%s)%s: starting it again in %.1f s", name, how, often, wait_s)
        elif not was_in_crash_loop:
            log.error(
                "%s ended %d times within %d s, last: %s. Trying again every %d s",
                name, LOOP_EXITS, LOOP_WINDOW_S, how, wait_s,
            )  # fmt: skip
        self._on_change()
