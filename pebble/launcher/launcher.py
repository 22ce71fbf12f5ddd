"""The launcher: starts a robot's processes in order, supervises them, and stops them in order."""

import logging
import os
from collections.abc import Callable, Collection, Sequence
from typing import Any

from pebble.config import Config
from pebble.config.rules.doors import warning_of_open
from pebble.errors import ConfigError, PebbleError
from pebble.extension import Program, Stage, motors_of, part
from pebble.launcher.child import Child
from pebble.launcher.driveable import Driveable
from pebble.launcher.features import Features
from pebble.launcher.log_forwarding import LogForwarder, OwnRecords
from pebble.launcher.on_demand import OnDemand
from pebble.launcher.process_supervisor import ProcessSupervisor
from pebble.launcher.programs import preload, program_of, programs, shared_modules
from pebble.launcher.reactor import Reactor, StopSignals
from pebble.launcher.restart_policy import RestartPolicy
from pebble.launcher.run_lock import RunLock
from pebble.launcher.sd_notify import SystemdNotifier
from pebble.launcher.status import StatusPublisher
from pebble.runtime import notes
from pebble.runtime.as_owner import require_own
from pebble.runtime.connections import check_connections
from pebble.runtime.parent import LAUNCHER_PID
from pebble.transports import segments

_RUN_DIR_S = 1.0
_REAP_S = 2.0  # the kernel needs this long at most to end killed processes

log = logging.getLogger(__name__)


class Launcher:
    """A running robot. Raises ConfigError for a config that cannot run on this machine.

    ``table`` replaces the programs of the config, for tests. Programs are forked from this process, which therefore has
    no second thread and opens no transport (docs/decisions/0006).
    """

    def __init__(self, config: Config, *, table: Sequence[Program] | None = None) -> None:
        _check_runs_here(config)
        self._config = config
        #: Without systemd's variables: children do not report to systemd.
        self._environment = {name: value for name, value in os.environ.items() if name not in SystemdNotifier.VARIABLES}
        self._reactor = Reactor(on_stall=self._stood_still)
        self._supervisors = [self._supervise(program) for program in (programs(config) if table is None else table)]
        self._on_demand = OnDemand(self._reactor, self._supervisors)
        self._features = Features(lambda: self._status.capabilities_changed())
        self._driveable = self._driveable_by({supervisor.program.name for supervisor in self._supervisors})
        self._status = StatusPublisher(config, self._reactor, self._supervisors, self._features, self._driveable)
        self._handlers: dict[type[notes.Note], Callable[[Program, Any], None]] = {
            notes.Wanted: self._on_demand.want,
            notes.Held: self._on_demand.hold,
            notes.Feature: lambda program, note: self._features.receive(program.name, note),
            notes.Local: lambda program, note: self._driveable.local(program.name, note),
            notes.Mcu: lambda program, note: self._driveable.mcu(program.name, note),
            notes.Reach: lambda program, note: self._driveable.reach(program.name, note),
        }
        self._logs = LogForwarder(self._status.publish_log)
        self._signals = StopSignals(self._kill_all)
        self._lost = False  # another launcher has taken the run directory

    def run(self) -> int:
        """Run until a stop signal; return 0 after an orderly stop, 1 if a second signal or a lost lock enforced it.

        Raises PebbleError if the robot runs already or its run directory cannot be used. Main thread only.
        """
        config = self._config
        if config.path is not None:
            # root must not run the commands that another user writes into a config; there=True: it has to exist
            require_own(config.path, does="runs nothing of it", there=True)
        own_records = OwnRecords(self._logs, config.log_level)
        lock_in_state_dir = config.state_file("launcher").with_suffix(".lock")
        with own_records, RunLock(config.run_dir(), config.base, lock_in_state_dir) as lock:
            self._signals.install()
            for place in filter(None, (extension.prepare for extension in config.installed)):
                part(place)(config)
            try:
                self._reactor.every(_RUN_DIR_S, lambda: self._keep(lock))
                self._start()
                self._reactor.run_until(self._stop_requested)
                self._stop()
            finally:
                self._end(self._supervisors)
                self._status.close()
                self._reactor.close()
                segments.sweep()  # Zenoh leaves files in /dev/shm even if its processes end in order
        return 0 if self._signals.received <= 1 and not self._lost else 1

    def _start(self) -> None:
        """Start all programs, without waiting for any to be ready."""
        self._reactor.watch(self._signals.wakeup.fileno(), self._signals.wakeup.clear)
        preload(shared_modules(self._config, [supervisor.program for supervisor in self._supervisors]))
        for supervisor in self._supervisors:
            if self._stop_requested():
                return
            if not supervisor.program.on_demand:
                supervisor.start()
        for warning in (*self._config.warnings, warning_of_open(self._config)):
            if warning:
                log.warning("%s", warning)
        self._status.start()

    def _supervise(self, program: Program) -> ProcessSupervisor:
        return ProcessSupervisor(
            program,
            RestartPolicy(self._config.services.launcher.restart_delay_seconds),
            self._reactor,
            spawn=self._spawn,
            on_line=lambda pid, line: self._log_line(program, pid, line),
            on_note=lambda note: self._handlers[type(note)](program, note),
            on_change=lambda: self._status.changed(),
            on_end=lambda: self._ended(program),
            is_stopping=self._stop_requested,
        )

    def _driveable_by(self, running: Collection[str]) -> Driveable:
        """Return the `Driveable` of the programs ``running``: of their motors, and of serial lines without motors."""
        line_names = {program_of(name): self._config.motor_owner(name) for name in self._config.serial_instances()}
        motor_names = {program: name for name, program in motors_of(self._config.installed, self._config).items()}
        owners = [*map(program_of, self._config.motor_lines()), *motor_names]
        return Driveable(
            {program: name for program, name in (line_names | motor_names).items() if program in running},  # lines
            [program for program in owners if program in running],  # owners: with motors
            ["mqtt_bridge"] if "mqtt_bridge" in running else [],  # ways: through which drive commands come
            lambda: self._status.changed(),
        )

    def _log_line(self, program: Program, pid: int, line: str) -> None:
        if program.runs_scripts:
            self._logs.tagged_line(program.name, pid, line)
        else:
            self._logs.child_line(program.name, pid, line, published=program.stage is not Stage.ANNOUNCER)

    def _ended(self, program: Program) -> None:
        self._features.ended(program.name)
        self._driveable.ended(program.name)
        self._on_demand.ended(program)

    def _spawn(self, program: Program) -> Child:
        announcer = program.reads_announcer_pipe
        stdin = self._status.connect_announcer() if announcer else os.open(os.devnull, os.O_RDONLY)
        environment = {**self._environment, LAUNCHER_PID: str(os.getpid()), **self._on_demand.environment(program)}
        try:
            return Child(program, environment, self._config, stdin=stdin)
        finally:
            os.close(stdin)

    def _stood_still(self, seconds: float) -> None:
        self._status.stood_still()
        log.warning("stood still for %.1f s (suspended, or too busy a machine): this time counts for no limit", seconds)

    def _stop_requested(self) -> bool:
        return self._signals.received > 0 or self._lost

    def _keep(self, lock: RunLock) -> None:
        """Restart all programs if the run directory had to be made again; end the robot if another launcher has it."""
        if self._lost:
            return
        try:
            if lock.keep():
                log.warning("%s was removed and is made again: all programs start again", lock.path)
                for supervisor in self._supervisors:
                    supervisor.restart()
        except PebbleError as error:
            self._lost = True
            log.error("%s", error)

    def _stop(self) -> None:
        """Stop stage by stage. A process that still runs after its stage's share of the timeout is killed."""
        log.info("stopping")
        self._status.stopping()
        end = self._reactor.now() + self._config.services.launcher.shutdown_timeout_seconds
        stages = sorted(Stage, reverse=True)
        for index, stage in enumerate(stages):
            if stage is Stage.ANNOUNCER:
                self._status.publish_last()
            share_s = (end - self._reactor.now()) / (len(stages) - index)
            in_stage = [supervisor for supervisor in self._supervisors if supervisor.program.stage is stage]
            self._stop_stage(in_stage, max(0.0, share_s))

    def _stop_stage(self, supervisors: Sequence[ProcessSupervisor], limit_s: float) -> None:
        for supervisor in supervisors:
            supervisor.stop()
        if self._signals.received > 1:  # a second one asks to end at once
            self._kill_all()
        if not self._reactor.run_until(lambda: not _running(supervisors), limit_s):
            log.warning("did not stop in time: %s", ", ".join(_running(supervisors)))
            self._end(supervisors)

    def _end(self, supervisors: Sequence[ProcessSupervisor]) -> None:
        """Kill the programs that still run, and wait for their end. None is started again."""
        for supervisor in supervisors:
            supervisor.stop()
            supervisor.kill()
        self._reactor.run_until(lambda: not _running(supervisors), _REAP_S)

    def _kill_all(self) -> None:
        for supervisor in self._supervisors:
            supervisor.kill()


def _check_runs_here(config: Config) -> None:
    if config.robot.platform != "linux":
        raise ConfigError(
            f"robot.platform: {config.robot.platform} runs on its own MCU, there is nothing to start here:"
            " `pebble flash` brings its firmware onto it, `pebble sim` runs it without one"
        )
    if config.path is None:
        raise ConfigError("the robot's processes know its config by its file, and this one has none")
    # A robot without one of its motor owners does not start; without other extensions it starts.
    missing_owners = [f"{extension.key}: {extension.reason}" for extension in config.missing if extension.drives]
    if missing_owners:
        raise ConfigError(missing_owners)
    check_connections(config)


def _running(supervisors: Sequence[ProcessSupervisor]) -> list[str]:
    return [supervisor.program.name for supervisor in supervisors if supervisor.running]
