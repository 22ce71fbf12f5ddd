"""The service that offers the robot's scripts to operators, and runs one at a time."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from pebble.contract import AUTONOMY_COMMAND, AUTONOMY_FILES, AUTONOMY_STATUS, CONTROL_STATE, DRIVE, ESTOP_STATE
from pebble.contract.payloads import (
    SCRIPT,
    STOP_WORDS,
    AutonomyCommand,
    AutonomyDependency,
    AutonomyFiles,
    AutonomyStatus,
    ControlState,
    Drive,
    EstopState,
)
from pebble.errors import PebbleError
from pebble.extensions.scripts.config import AutonomyManager as AutonomyManagerSection
from pebble.extensions.scripts.runs import LocalScriptsLock, following, next_run
from pebble.motion.arbiter import HOLD_MS
from pebble.runtime.addresses import Addresses
from pebble.runtime.process import view_of
from pebble.runtime.service import Service, on
from pebble.services.autonomy_manager.child import Processes, Spawn
from pebble.services.autonomy_manager.motor_owners import OVERRIDDEN, Baseline, MotorOwners
from pebble.services.autonomy_manager.offer import Offer
from pebble.services.autonomy_manager.runner import Runner
from pebble.services.autonomy_manager.script import Plan, Script, StartError, StoppedError, UnknownScriptError, plan

_START = frozenset(("start", "run", "play", "enable", "enabled", "on"))
_HALTS_S = (0.1, 0.3)  # after the first one
_HOLD_S = HOLD_MS / 1000
_SCAN_S = 5.0  # between two looks into the folder of scripts
_LISTED_S, _AGAIN_S = 3.0, 0.1  # a start waits so long until its script is listed, and looks so often
_CLOSE_S = 1.0  # for scripts to end after SIGTERM when this process ends; it is killed after 3 s


class AutonomyManager(Service):
    """The manager of scripts. ``spawn`` and ``scripts`` replace processes and folders in tests."""

    name = "autonomy_manager"

    def __init__(
        self, *arguments: Any, spawn: Spawn | None = None, scripts: Mapping[str, Script] | None = None, **options: Any
    ) -> None:
        super().__init__(*arguments, **options)
        self._section = self.config.section(AutonomyManagerSection)
        motors = self.config.motor_lines()
        #: With the names of topics that are configured for the serial line of the motors.
        self.addresses = Addresses(view_of(self.config, next(iter(motors), "")))
        self._local = LocalScriptsLock(self.config)
        self._owners = MotorOwners(self.config.motor_owners)
        processes = Processes(self.config.run_dir() / "scripts.lock")
        self.on_stop(processes.close)
        self._runner = Runner(self, spawn or processes, self._section.stop_timeout_seconds)
        self._offer = Offer(self.config, self.post, self._publish_files, scripts)
        self._overridden_until = float("-inf")  # until then a person drives, not the script that runs
        self._refused_until = float("-inf")  # until then the arbiter refuses scripts, so none is started
        self._status: AutonomyStatus | None = None  # as published last
        self._connected_before = False  # on_connected was called
        self._waiting: Callable[[], None] | None = None  # a start, until its script is listed
        self._signs = True  # the newest run's script signs its drive commands; else they look like a person's
        self._unsigned_moves = False  # while it does not sign: the newest command without a signature moves the wheels
        self._person_moves = False  # the newest command that is certainly a person's moves the wheels

    def start(self) -> None:
        if self._offer.begin():
            self.timers.add(self.clock(), self._offer.scan, period=_SCAN_S)
        self.changed()

    def stop(self) -> None:
        self._offer.close()
        self._runner.close(_CLOSE_S)

    def on_connected(self) -> None:
        """Listen, from the first connection on, to who has control; bar the run of an earlier, killed process."""
        if not self._connected_before:
            self._connected_before = True
            self.listen(CONTROL_STATE, self._control)
            try:  # a killed predecessor's script may still drive: the zero of a newer run bars its run
                self.halt(next_run(self.config, self._owners.barred))
            except PebbleError as error:
                self.log.error("%s", error)

    # -- what operators send

    @on(AUTONOMY_COMMAND)
    def command(self, command: AutonomyCommand) -> None:
        """Start a script, or stop the one that runs; ``enabled`` decides only where ``action`` is no known word."""
        word = (command.action or "").strip().lower()
        is_known = word in (*_START, *STOP_WORDS)
        begin = word in _START if is_known else command.enabled
        self._waiting = None  # a newer command takes the place of a start that waits
        if begin is None:
            self.log_limited.warning("command", "ignored a command that neither starts nor stops a script")
        elif begin:
            by = command.by if isinstance(command.by, str) else None
            until = self.clock() + _LISTED_S  # until then the start may wait for the list of scripts
            self._start_script((command.file or "").strip(), command.config or {}, by, until)
        else:
            self._runner.stop()

    def _start_script(self, file: str, config: Mapping[str, Any], by: str | None, until: float) -> None:
        """Start a script, or wait until ``until`` for the list of scripts to name it.

        ``by`` is the person who asks; None: a program of the robot, which needs no control.
        """
        try:
            if by is not None and self.config.security.named and (holder := self._owners.holder_beside(by)):
                raise StartError(f"{holder} has control, and starts scripts")
            if not file:
                raise StartError("Start command missing file")
            wanted = plan(self._offer.scripts, file, config)
            self._check(wanted)
        except StartError as error:
            listing = isinstance(error, UnknownScriptError) and not self._offer.complete
            if listing and self.clock() < until:
                self._try_again(partial(self._start_script, file, config, by, until))
                return
            why = f"{error}: scripts are still being listed, try again" if listing else str(error)
            self.log_limited.log("refused", logging.WARNING, "%s", why)
            self._runner.refuse(why, stopped=isinstance(error, StoppedError))
        else:
            self._runner.start(wanted)

    def _try_again(self, start: Callable[[], None]) -> None:
        """Call ``start`` again soon, unless another command, a person who drives or an emergency stop comes first."""

        def again() -> None:
            if self._waiting is start:
                start()

        self._waiting = start
        self.later(_AGAIN_S, again)

    def _check(self, wanted: Plan) -> None:
        """Raise StartError if this robot cannot run ``wanted`` now."""
        failed = f"Failed to start {wanted.main.script.label}"
        if refusal := self._owners.refusal:
            raise StoppedError(f"{failed}: {refusal}")
        if self.clock() < self._refused_until:
            raise StartError(f"{failed}: {OVERRIDDEN} just now: start it again in {_HOLD_S:g} s")
        # If the person never lets go, :meth:`_check_override` would end it: nothing else holds its commands back.
        if not wanted.main.script.ours and self._person_moves and self.clock() < self._overridden_until:
            raise StartError(f"{failed}: a person drives: start it again after {_HOLD_S:g} s without a command")

    # -- what the motors and people do

    @on(ESTOP_STATE)
    def motor_owner(self, state: EstopState, owner: str) -> None:
        """Handle the state of a motor owner: it may end the run, or show that all stops were reset."""
        self._owners.receive(owner, state)
        if state.latched:
            self._waiting = None
        run, stopped = self._runner.stoppable, bool(self._owners.refusal)  # stopped: an owner is latched now
        if run is not None and (why := self._owners.ending(run.number, run.baseline, self._signs)):
            self._runner.stop(why, stopped=stopped)
        if self._runner.stopped and not stopped:  # its error is a stop, which was reset
            self._runner.refuse(None)  # None: scripts may start again

    def _control(self, state: ControlState, owner: str) -> None:
        self._owners.receive_control(owner, state)

    @on(DRIVE, direct=True)
    def drive(self, drive: Drive, _arrived: float) -> None:
        """Handle a drive command, on the transport's thread.

        While an unsigned script runs, its commands and those of people without a key look alike: neither ends it.
        """
        if drive.signed:
            if isinstance(drive.run, int):
                self._owners.note_run(drive.run)
        elif drive.source == self.name:  # a zero of this manager, see :meth:`halt`
            return
        elif self._signs or drive.key:  # a person's: the script would sign it, or have no key
            self._person_moves = drive.moves
            self.post(self._on_person_drives, newest_of="person")
            if not drive.moves and drive.valid_ms == 0:  # a final zero: no script resumes after it
                self.post(self._on_person_stops, newest_of="person stops")
        else:  # an unsigned script's, or a person's
            self._unsigned_moves = drive.moves

    def _on_person_drives(self) -> None:
        """Let scripts wait for a person who drives, or end them, as the config says."""
        now = self.clock()
        self._waiting = None  # a start that waits is given up
        if self._runner.active is not None and self._runner.drives and self._section.on_override == "stop":
            self._runner.stop(OVERRIDDEN)
        if now >= self._overridden_until:
            self.call_at(now + _HOLD_S, self._check_override)  # it is called once, however many commands come
        self._overridden_until = now + _HOLD_S
        self.changed()

    def _on_person_stops(self) -> None:
        """End an unsigned script, after a person's final zero; start none while the arbiter refuses scripts."""
        self._refused_until = self.clock() + _HOLD_S
        self._end_unsigned()

    def _check_override(self) -> None:
        if self.clock() < self._overridden_until:
            self.call_at(self._overridden_until, self._check_override)
            return
        if self._person_moves:  # and has not let go: the connection was lost
            self._end_unsigned()
        self.changed()

    def _end_unsigned(self) -> None:
        """End a script that does not sign its commands; the motor owner's arbiter ends the others."""
        if self._runner.active is not None and not self._signs:
            self._runner.stop(OVERRIDDEN)

    # -- what a runner needs

    @property
    def config_path(self) -> Path:
        return self.config.path or self.config.folder

    def begin_run(self, plan: Plan) -> tuple[int, Baseline]:
        """Begin a run; return its number, and the motor owners' states, with which later ones are compared.

        Raises PebbleError if none may start now.
        """
        if refusal := self._owners.refusal:
            raise StoppedError(refusal)
        self._local.hold()
        try:
            run = self._owners.newest_run = next_run(self.config, self._owners.barred, self._owners.newest_run)
        except PebbleError:
            self._local.release()
            raise
        self._signs, self._unsigned_moves = plan.main.script.ours, False
        for number in self._owners.steps_to(run):  # a zero of each: else an owner may take ``run`` for older
            self.halt(number)
        return run, self._owners.baseline()

    def end_run(self, run: int) -> None:
        """Note that all processes of this run have ended."""
        self._owners.note_run(following(run))  # a person may bar it, too, before the next run
        self.halt(following(run))  # bars this run: a process of it may have escaped
        self._local.release()

    def halt(self, run: int) -> None:
        """Stop the wheels now, by a zero of this run; motor owners then bar all earlier ones."""
        self.publish(DRIVE, Drive(source=SCRIPT, run=run))
        if self._unsigned_moves and not self._owners.held:  # a person with control drives: leave the wheels alone
            self._unsigned_moves = False
            self.publish(DRIVE, Drive(source=self.name))

    def halt_repeatedly(self, run: int) -> None:
        """Stop the wheels now and twice more: a command of an ended process may still be in a queue."""
        self.halt(run)
        for seconds in _HALTS_S:
            self.later(seconds, lambda: self.halt(run))

    def later(self, seconds: float, job: Callable[[], None]) -> None:
        self.call_at(self.clock() + seconds, job)

    def changed(self) -> None:
        """Publish the status if it has changed; while one script replaces another, only once."""
        status, last = self._present_status(), self._status
        still_down = last is not None and not (last.running or status.running)
        if status != last and not (still_down and self._runner.switching):
            self._status = status
            self.publish(AUTONOMY_STATUS, replace(status, timestamp=time.time()))

    def _present_status(self) -> AutonomyStatus:
        """Return the status. The fields that ``replace`` sets are left out of the message where they do not apply."""
        run = self._runner.run
        main = None if run is None else run.running
        parts = [] if run is None else run.dependencies
        status = AutonomyStatus(
            running=main is not None,
            timestamp=0.0,  # it is set when this is published: statuses are compared without it
            file=None if main is None else main.file,
            pid=None if main is None else main.child.pid,
            dependencies=[
                AutonomyDependency(file=part.file, pid=part.child.pid, running=not part.ended) for part in parts
            ],
            error=self._runner.error,
            config=None if self._runner.config is None else dict(self._runner.config),
        )
        if self._runner.stopped:
            status = replace(status, stopped=True)
        if run is None or main is None:
            return status
        status = replace(status, label=run.plan.main.script.label, since=round(run.since, 3))
        if not run.plan.drives:
            return replace(status, drives=False)
        return replace(status, overridden=True) if self.clock() < self._overridden_until else status

    def _publish_files(self, listed: list[dict[str, object]]) -> None:
        self.publish(AUTONOMY_FILES, AutonomyFiles(files=listed, timestamp=time.time()))
