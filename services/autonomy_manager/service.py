"""Offers the robot's scripts to operators, and runs one at a time."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
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
from pebble.motion.arbiter import HOLD_MS
from pebble.runtime.addresses import Addresses
from pebble.runtime.process import view_of
from pebble.runtime.runs import LocalScripts, following, next_run
from pebble.runtime.service import Service, on
from pebble.services.autonomy_manager.child import Processes, Spawn
from pebble.services.autonomy_manager.gate.activity import SILENT_S
from pebble.services.autonomy_manager.gate.config_copy import broker_of
from pebble.services.autonomy_manager.local_media import LocalMedia
from pebble.services.autonomy_manager.motor_owners import OVERRIDDEN, Baseline, MotorOwners
from pebble.services.autonomy_manager.offer import Offer
from pebble.services.autonomy_manager.runner import Runner
from pebble.services.autonomy_manager.script import Plan, Script, StartError, UnknownScriptError, plan
from pebble.transports import QoS

if TYPE_CHECKING:
    from pebble.services.autonomy_manager.gate.gate import Gate

_START = frozenset(("start", "run", "play", "enable", "enabled", "on"))
_HALTS_S = (0.1, 0.3)  # after the first one
_HOLD_S = HOLD_MS / 1000
_SCAN_S = 5.0  # between two looks into the folder of scripts
_LOOK_S = 2.0  # between two looks at whether a script waits
_CLOSE_S = 1.0  # for scripts to end after SIGTERM when this process ends; it is killed after 3 s


class AutonomyManager(Service):
    """``spawn`` and ``scripts`` replace processes and folders in tests."""

    name = "autonomy_manager"
    publishes = (AUTONOMY_FILES, AUTONOMY_STATUS, DRIVE)

    def __init__(
        self, *arguments: Any, spawn: Spawn | None = None, scripts: Mapping[str, Script] | None = None, **options: Any
    ) -> None:
        super().__init__(*arguments, **options)
        self._section = self.config.services.autonomy_manager
        motors = self.config.motor_lines()
        self.addresses = Addresses(view_of(self.config, next(iter(motors), "")))
        self._local = LocalScripts(self.config)
        self._owners = MotorOwners(self.config.motor_owners)
        processes = Processes(self.config.run_dir() / "scripts.lock")
        self.on_stop(processes.close)
        self._runner = Runner(self, spawn or processes, self._section.stop_timeout_seconds)
        self._offer = Offer(self.config, self.post, self._publish_files, scripts)
        self._overridden_until = self._refused_until = float("-inf")
        self._status: AutonomyStatus | None = None
        self._connected_before = False
        self._media, self._began = LocalMedia(self.config), 0.0
        self._gate: tuple[int, Gate] | None = None  # of the present run, if one of its scripts needs it

    def start(self) -> None:
        if self._offer.begin():
            self.timers.add(self.clock(), self._offer.scan, period=_SCAN_S)
        self.timers.add(self.clock(), self._look, period=_LOOK_S)
        self.changed()

    def stop(self) -> None:
        self._offer.close()
        self._runner.close(_CLOSE_S)

    def on_connected(self) -> None:
        if not self._connected_before:  # a predecessor may have been killed together with its script
            self._connected_before = True
            if self.config.security.named:
                self.listen(CONTROL_STATE, self._control)
            try:
                self.halt(next_run(self.config, self._owners.barred))
            except PebbleError as error:
                self.log.error("%s", error)

    # -- what operators send

    @on(AUTONOMY_COMMAND)
    def command(self, command: AutonomyCommand) -> None:
        word = (command.action or "").strip().lower()
        begin = True if word in _START else False if word in STOP_WORDS else command.enabled
        if begin is None:
            self.log_limited.warning("command", "ignored a command that neither starts nor stops a script")
        elif begin:
            by = command.by if isinstance(command.by, str) else None
            self._start_script((command.file or "").strip(), command.config or {}, by)
        else:
            self._runner.stop()

    def _start_script(self, file: str, config: Mapping[str, Any], by: str | None) -> None:
        """``by`` None: a program of the robot asks, which needs no control."""
        try:
            if by is not None and self.config.security.named and (holder := self._owners.holder_beside(by)):
                raise StartError(f"{holder} has control, and starts scripts")
            if not file:
                raise StartError("Start command missing file")
            wanted = self._plan(file, config)
            self._check(wanted)
        except StartError as error:
            self.log_limited.log("refused", logging.WARNING, "%s", error)
            self._runner.refuse(str(error))
        else:
            self._runner.start(wanted)

    def _plan(self, file: str, config: Mapping[str, Any]) -> Plan:
        try:
            return plan(self._offer.scripts, file, config)
        except UnknownScriptError as error:
            if self._offer.complete:
                raise
            raise StartError(f"{error}: scripts are still being listed, try again") from None

    def _check(self, wanted: Plan) -> None:
        """Raise StartError if this robot cannot run ``wanted`` at present."""
        problem = self._owners.refusal
        if not problem and self.clock() < self._refused_until:
            problem = f"{OVERRIDDEN} just now: start it again in {_HOLD_S:g} s"
        if any(step.script.needs_gate for step in (wanted.main, *wanted.dependencies)):
            try:
                broker_of(self.config)
            except PebbleError as error:
                problem = str(error)
        if problem:
            raise StartError(f"Failed to start {wanted.main.script.file}: {problem}")

    # -- what the motors and people do

    @on(ESTOP_STATE)
    def motor_owner(self, state: EstopState, owner: str) -> None:
        self._owners.receive(owner, state)
        run = self._runner.unfinished
        if run is not None and (why := self._owners.ending(run.number, run.baseline)):
            self._runner.stop(why)

    def _control(self, state: ControlState, owner: str) -> None:
        self._owners.receive_control(owner, state)

    @on(DRIVE, direct=True)
    def drive(self, drive: Drive, _arrived: float) -> None:
        """On the transport's thread. A person's commands all mean the same here."""
        if not drive.signed:
            if (gate := self._gate) is not None:
                gate[1].override(self.addresses[DRIVE].topic, _HOLD_S)
            self.post(self._person_drives, newest_of="person")
            if not drive.moves and drive.valid_ms == 0:
                self.post(self._person_stops, newest_of="person stops")
        elif isinstance(drive.run, int):
            self._owners.note_run(drive.run)

    def _person_drives(self) -> None:
        now = self.clock()
        if self._runner.active is not None and self._section.on_override == "stop":
            self._runner.stop(OVERRIDDEN)
        if now >= self._overridden_until:
            self.call_at(now + _HOLD_S, self._check_override)
        self._overridden_until = now + _HOLD_S
        self.changed()

    def _person_stops(self) -> None:
        """The arbiter bars what starts during the hold of such a zero, too: it may have been asked for before."""
        self._refused_until = self.clock() + _HOLD_S

    def _check_override(self) -> None:
        if self.clock() < self._overridden_until:
            self.call_at(self._overridden_until, self._check_override)
        else:
            self.changed()

    # -- what a runner needs

    def begin_run(self) -> tuple[int, Baseline]:
        if refusal := self._owners.refusal:
            raise StartError(refusal)
        self._began = self.clock()
        self._local.hold()
        try:
            run = self._owners.newest_run = next_run(self.config, self._owners.barred, self._owners.newest_run)
        except PebbleError:
            self._local.release()
            raise
        for step in self._owners.steps_to(run):
            self.halt(step)
        return run, self._owners.baseline()

    def config_path(self, script: Script, run: int) -> Path:
        if not script.needs_gate:
            return self.config.path or self.config.folder
        if self._gate is None:
            from pebble.services.autonomy_manager.gate.gate import (
                Gate,  # asyncio and ssl cost 2 MB, which few robots need
            )

            gate = Gate(self.config, self._publish_signed, run)
            gate.open()
            self._gate = (run, gate)
            if (left := self._overridden_until - self.clock()) > 0:
                gate.override(self.addresses[DRIVE].topic, left)
        return self._gate[1].config_path

    def end_run(self, run: int) -> None:
        if self._gate is not None and self._gate[0] == run:
            self._gate[1].close()
            self._gate = None
        self._owners.note_run(following(run))  # a person may bar it, too, before the next run
        self.halt(following(run))  # bars this run: a process of it may have escaped
        self._local.release()

    def halt(self, run: int) -> None:
        if self._gate is not None and self._gate[0] == run:
            self._gate[1].halt()
        self.publish(DRIVE, Drive(source=SCRIPT, run=run))

    def _publish_signed(self, topic: str, payload: bytes) -> None:
        """On a thread of the gate."""
        self.transport.publish(topic, payload, qos=QoS.DELIVERED)

    def halt_repeatedly(self, run: int) -> None:
        self.halt(run)
        for seconds in _HALTS_S:
            self.later(seconds, lambda: self.halt(run))

    def later(self, seconds: float, job: Callable[[], None]) -> None:
        self.call_at(self.clock() + seconds, job)

    def on_thread(self, job: Callable[[], None]) -> None:
        self.post_first(job)

    def changed(self) -> None:
        """Publish the status if it differs from the last one; only once between two scripts."""
        status, last = self._present_status(), self._status
        still_down = last is not None and not (last.running or status.running)
        if status != last and not (still_down and self._runner.switching):
            self._status = status
            self.publish(AUTONOMY_STATUS, replace(status, timestamp=time.time()))

    def _present_status(self) -> AutonomyStatus:
        run = self._runner.run
        main = None if run is None or run.main is None or run.main.ended else run.main
        parts = [] if run is None else run.dependencies
        status = AutonomyStatus(
            running=main is not None,
            timestamp=0.0,
            file=None if main is None else main.file,
            pid=None if main is None else main.child.pid,
            dependencies=[
                AutonomyDependency(file=part.file, pid=part.child.pid, running=not part.ended) for part in parts
            ],
            error=self._runner.error,
            config=None if self._runner.config is None else dict(self._runner.config),
        )
        overridden = main is not None and self.clock() < self._overridden_until
        waiting_for = self._waiting_for() if main is not None else ""
        return replace(
            status,
            overridden=True if overridden else msgspec.UNSET,
            waiting_for=waiting_for or msgspec.UNSET,
        )

    def _publish_files(self, found: list[dict[str, object]]) -> None:
        self.publish(AUTONOMY_FILES, AutonomyFiles(files=found, timestamp=time.time()))

    def _look(self) -> None:
        """A script that begins to wait says nothing: ask again and again."""
        if self._runner.active is not None:
            self.changed()

    def _waiting_for(self) -> str:
        """What the present run waits for; empty: it does something, or that is unknown."""
        run = self._runner.active
        if run is None or self.clock() - self._began < SILENT_S:
            return ""
        for step, part in zip(run.plan.dependencies, run.dependencies, strict=False):
            if not part.ended and (absent := self._media.absent(step.script.needs)):
                return f"{part.file}, which waits for {absent}"
        activity = None if self._gate is None else self._gate[1].activity
        if activity is not None and not activity.silent:
            return ""
        needs = run.plan.main.script.needs
        known = self._media.absent(needs)
        if known or activity is None:
            return known
        media = {"pictures": needs.pictures, "sound": needs.sound, "hall samples": needs.hall}
        return next((what for what, needed in media.items() if needed), activity.waits_for)
