"""A run of a script with the scripts that it needs: how it starts and stops, and what follows if a process ends."""

from __future__ import annotations

import logging
import signal
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pebble.errors import PebbleError
from pebble.extensions.operator.client.forms import Value
from pebble.extensions.scripts.runs import CONFIG, RUN
from pebble.services.autonomy_manager.child import Launch, Process, Spawn
from pebble.services.autonomy_manager.environment import environment
from pebble.services.autonomy_manager.motor_owners import Baseline
from pebble.services.autonomy_manager.script import Plan, Step, StoppedError

if TYPE_CHECKING:
    from pebble.services.autonomy_manager.service import AutonomyManager

log = logging.getLogger(__name__)

_BY_SIGNAL = 128  # exit codes above it: a program that a signal has ended, by itself and in order


@dataclass
class Part:
    """A process of a run."""

    file: str
    label: str
    child: Process
    ended: bool = False


@dataclass
class Run:
    """A run of a script, from its start until its last process has ended."""

    number: int
    plan: Plan
    baseline: Baseline
    since: float = field(default_factory=time.time)  # epoch seconds
    main: Part | None = None
    dependencies: list[Part] = field(default_factory=list)
    ending: bool = False

    @property
    def parts(self) -> list[Part]:
        return self.dependencies if self.main is None else [self.main, *self.dependencies]

    @property
    def running(self) -> Part | None:
        """The script's own process; None before its start and after its end."""
        return None if self.main is None or self.main.ended else self.main


class Runner:
    """A runner of scripts, one at a time. Used on the service's thread only."""

    def __init__(self, service: AutonomyManager, spawn: Spawn, stop_timeout_s: float) -> None:
        self.error: str | None = None
        self.stopped = False  # the error is an emergency stop: no failure, and it ends with the reset
        self._service, self._spawn, self._stop_timeout_s = service, spawn, stop_timeout_s
        self._run: Run | None = None
        self._next: Plan | None = None  # waits for the end of the present run

    @property
    def run(self) -> Run | None:
        """The present run, also while its processes are ending."""
        return self._run

    @property
    def active(self) -> Run | None:
        """The present run, unless it is being ended."""
        return None if self._run is None or self._run.ending else self._run

    @property
    def switching(self) -> bool:
        """True if another start waits for the end of the present run."""
        return self._next is not None

    @property
    def stoppable(self) -> Run | None:
        """The active run or, while a start waits, the ending one; None if neither run nor start may move the robot."""
        if not self.drives:
            return None
        return self.active if self._next is None else self._run

    @property
    def config(self) -> Mapping[str, Value] | None:
        """The settings of the script that runs; None while none does."""
        return None if self._run is None or self._run.running is None else self._run.plan.config

    @property
    def drives(self) -> bool:
        """True if the present run, or its successor, may move the robot."""
        plans = (self._next, None if self._run is None else self._run.plan)
        return any(plan is not None and plan.drives for plan in plans)

    def refuse(self, error: str | None, *, stopped: bool = False) -> None:
        """Refuse all starts for the reason ``error``; None: permit them again. The present run continues."""
        self.error, self.stopped = error, stopped
        self._service.changed()

    def start(self, plan: Plan) -> None:
        """Start ``plan`` once the present run has ended; a newer plan replaces a waiting one."""
        self.error, self.stopped, self._next = None, False, plan
        self._end()
        self._go_on()

    def stop(self, error: str | None = None, *, stopped: bool = False) -> None:
        """End the present run because of ``error``; None: on request. ``stopped``: by an emergency stop."""
        if error is not None:
            log.warning("%s", error)
        self.error, self.stopped, self._next = error, stopped, None
        self._end()
        self._go_on()

    def close(self, wait_s: float) -> None:
        """End all processes and wait for their end, because this process ends."""
        self._next = None
        run = self._run
        if run is None:
            return
        self._service.halt(run.number)
        for number in (signal.SIGTERM, signal.SIGKILL):
            end = time.monotonic() + wait_s
            for part in run.parts:
                part.child.signal(number)
            for part in run.parts:
                part.child.wait(end - time.monotonic())
        self._service.halt(run.number)  # again: a script may have driven until its end
        self._run = None
        self._service.end_run(run.number)
        self._service.changed()

    def _go_on(self) -> None:
        if self._run is None and self._next is not None:
            plan, self._next = self._next, None
            self._begin(plan)
        self._service.changed()

    def _begin(self, plan: Plan) -> None:
        script = plan.main.script
        try:
            number, baseline = self._service.begin_run(plan)  # baseline: the motor owners' states before it
            self._run = run = Run(number, plan, baseline)
            self._service.halt(number)  # now the motor owner knows the run, so a person can stop it before it drives
            for step in plan.dependencies:
                run.dependencies.append(self._start_part(run, step))
            run.main = self._start_part(run, plan.main)
        except (OSError, ValueError, PebbleError) as error:
            self.error, self.stopped = f"Failed to start {script.label}: {error}", isinstance(error, StoppedError)
            log.warning("%s", self.error)
            self._end()
            return
        log.info("started %s, run %d, pid %d", script.file, number, run.main.child.pid)

    def _start_part(self, run: Run, step: Step) -> Part:
        """Start one process of ``run``: a script that the main one needs, or the main one."""
        script = step.script
        path = str(self._service.config_path)
        variables = {CONFIG: path}
        if script.ours:
            variables[RUN] = str(run.number)
        launch = Launch(
            file=script.file,
            command=(*script.command, "--config", path, *step.options),
            folder=script.folder,
            environment=environment(script.environment, variables, ours=script.ours),
            tie=signal.SIGTERM if script.ours else signal.SIGKILL,  # if this process dies: ours then end in order
        )
        part: Part

        def on_end(code: int) -> None:
            self._service.post_first(lambda: self._on_end(run, part, code))

        part = Part(script.file, script.label, self._spawn(launch, on_end))
        return part

    def _end(self) -> None:
        """Begin to end the present run: first the wheels, then the script, then the scripts that it needed."""
        run = self._run
        if run is None or run.ending:
            return
        run.ending = True
        self._service.halt(run.number)
        if run.running is not None:
            self._terminate(run.running)
        else:
            self._end_dependencies(run)

    def _end_dependencies(self, run: Run) -> None:
        for part in reversed(run.dependencies):
            self._terminate(part)
        self._forget_if_ended(run)

    def _terminate(self, part: Part) -> None:
        """Ask a process to end, by SIGTERM; kill it if it has not ended in time."""
        if part.ended:
            return

        def kill() -> None:
            if not part.ended:
                log.warning("%s did not end within %g s: killed", part.file, self._stop_timeout_s)
                part.child.signal(signal.SIGKILL)

        part.child.signal(signal.SIGTERM)
        self._service.later(self._stop_timeout_s, kill)

    def _on_end(self, run: Run, part: Part, code: int) -> None:
        """Handle the end of a process: the others end with it, and after the last one the run is forgotten."""
        part.ended = True
        if run is not self._run:  # of a run that was closed
            return
        by_signal = _BY_SIGNAL < code < _BY_SIGNAL + signal.NSIG  # as a script says it; the system: below 0
        signal_ = code - _BY_SIGNAL if by_signal else -code
        how = f"was ended by signal {signal_}" if by_signal or code < 0 else f"exited with code {code}"
        log.info("%s %s", part.file, how)
        if part is run.main:
            self._service.halt_repeatedly(run.number)
            if not run.ending:
                run.ending = True
                self.error = f"{part.label} {how}" if code else None
                self.stopped = False
            self._end_dependencies(run)  # and forgets the run if all have ended
        else:  # a script that the main one needs
            if not run.ending:
                self.error, self.stopped = f"dependency {part.label} {how}", False
                self._end()
            self._forget_if_ended(run)
        self._go_on()

    def _forget_if_ended(self, run: Run) -> None:
        if all(part.ended for part in run.parts):
            self._run = None
            self._service.end_run(run.number)
