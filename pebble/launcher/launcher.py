"""Runs a robot: starts its processes in order, keeps them running, tells how they fare, and stops them in order."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from typing import Any

from pebble import codec
from pebble.addresses import Addresses
from pebble.capabilities import capabilities
from pebble.config import Config
from pebble.contract import CAPABILITIES, LOGS, STATUS, Channel
from pebble.errors import ConfigError
from pebble.launched import LAUNCHER_PID
from pebble.launcher.child import Child
from pebble.launcher.keeper import Keeper
from pebble.launcher.log_forwarding import LogForwarder, OwnRecords
from pebble.launcher.news import News
from pebble.launcher.on_demand import OnDemand
from pebble.launcher.preload import preload
from pebble.launcher.program import Program, Stage
from pebble.launcher.programs import programs, shared_modules, transport_modules
from pebble.launcher.reactor import Reactor
from pebble.launcher.run_lock import RunLock
from pebble.launcher.sd_notify import SystemdNotifier
from pebble.launcher.stop_signals import StopSignals
from pebble.launcher.supervisor import Life
from pebble.links import check_kinds
from pebble.payloads import Capabilities, LogRecord, ServiceState, Status
from pebble.transports import Message, QoS, segments

_STATUS_PAUSE_S = 0.2  # changes this close together are told in one message: a service starts in about 0.1 s
_REAP_S = 2.0  # the kernel needs this long at most to end what was killed

log = logging.getLogger(__name__)


class Launcher:
    """One robot on this machine. Raises ConfigError for a config that does not run here.

    ``table`` replaces what the config says; tests and other products use it. Its programs are forked from this
    process, which therefore has no second thread and opens no transport (docs/decisions/0006).
    """

    def __init__(self, config: Config, *, table: Sequence[Program] | None = None) -> None:
        if config.robot.platform != "linux":
            raise ConfigError(
                f"robot.platform: {config.robot.platform} runs on its own MCU, there is nothing to start here:"
                " `pebble flash` brings its firmware onto it, `pebble sim` runs it without one"
            )
        if config.path is None:
            raise ConfigError("the robot's processes read its config from a file, and this one has none")
        check_kinds(config)
        self._config, self._addresses = config, Addresses(config)
        self._reactor = Reactor()
        self._systemd = SystemdNotifier()
        self._environment = _environment()
        self._keepers = [self._keeper(program) for program in (programs(config) if table is None else table)]
        self._always = [keeper for keeper in self._keepers if not keeper.program.on_demand]
        self._on_demand = OnDemand(
            self._reactor, {keeper.program.name: keeper for keeper in self._keepers if keeper.program.on_demand}
        )
        self._news = News(self._reactor)
        self._logs = LogForwarder(self._record, config.services.launcher.logs)
        self._signals = StopSignals(self._kill_all)
        self._status_due = self._said_ready = False

    def run(self) -> int:
        """Live until a stop signal; 0 after a polite stop, 1 after one that had to be enforced by a second signal.

        Raises PebbleError if the robot runs already or its run directory cannot be used. Main thread only.
        """
        own_records = OwnRecords(self._logs, self._config.log_level_of("launcher"))
        with RunLock(self._config.run_dir(), self._config.base), self._signals, own_records:
            try:
                self._start()
                self._reactor.run_until(self._must_stop)
                self._stop()
            finally:
                self._end(self._keepers)
                self._news.close()
                self._reactor.close()
                segments.sweep()  # Zenoh leaves its files in /dev/shm even when its processes end politely
        return 0 if self._signals.received <= 1 else 1

    # -- starting

    def _start(self) -> None:
        """Nobody waits for anybody: every process connects by itself as soon as it can."""
        self._reactor.watch(self._signals.wake, self._signals.drain)
        preload([*transport_modules(self._config), *shared_modules(self._config), *_preloaded(self._keepers)])
        for keeper in self._always:
            if self._must_stop():
                return
            keeper.start()
        for warning in self._config.warnings:
            log.warning("%s", warning)
        self._set_timers()

    def _set_timers(self) -> None:
        launcher = self._config.services.launcher
        if self._systemd.watchdog_period_s is not None:
            self._reactor.every(self._systemd.watchdog_period_s, self._systemd.watchdog)
        if launcher.enabled and launcher.capabilities.enabled:
            self._say_capabilities()
            self._reactor.every(launcher.capabilities.publish_interval_seconds, self._say_capabilities)
        self._changed()
        self._reactor.every(launcher.retained_publish_interval_seconds, self._say_status)

    def _keeper(self, program: Program) -> Keeper:
        return Keeper(
            program,
            Life(self._config.services.launcher.restart_delay_seconds),
            self._reactor,
            spawn=self._spawn,
            on_line=lambda pid, line: self._logs.child_line(program.name, pid, line, published=not program.told),
            on_note=lambda line: self._on_demand.hear(program, line),
            on_change=self._changed,
            on_end=lambda: self._on_demand.ended(program),
        )

    def _spawn(self, program: Program) -> Child:
        self._logs.child_started(program.name)
        stdin = self._news.connect(self._will()) if program.told else os.open(os.devnull, os.O_RDONLY)
        try:
            return Child(program, self._environment_of(program), stdin=stdin)
        finally:
            os.close(stdin)

    def _environment_of(self, program: Program) -> dict[str, str]:
        """The config's variables replace what we were given, and never what we have to say to our children."""
        inherited, ours = self._environment, {LAUNCHER_PID: str(os.getpid()), **self._on_demand.environment(program)}
        return {**inherited, **program.environment, **ours}

    # -- stopping

    def _must_stop(self) -> bool:
        return self._signals.received > 0

    def _stop(self) -> None:
        """Stage by stage, each with its share of the time: nobody who hangs takes it from those who come later."""
        log.info("stopping")
        self._systemd.stopping()
        end = time.monotonic() + self._config.services.launcher.shutdown_timeout_seconds
        stages = sorted(Stage, reverse=True)
        for index, stage in enumerate(stages):
            if stage is Stage.NEWS:
                self._say_last()
            share = (end - time.monotonic()) / (len(stages) - index)
            self._stop_stage([keeper for keeper in self._keepers if keeper.program.stage is stage], max(0.0, share))

    def _stop_stage(self, keepers: list[Keeper], limit_s: float) -> None:
        for keeper in keepers:
            keeper.stop()
        if self._signals.received > 1:
            self._kill_all()
        if not self._reactor.run_until(lambda: not _running(keepers), limit_s):
            log.warning("did not stop in time: %s", ", ".join(_running(keepers)))
            self._end(keepers)

    def _end(self, keepers: list[Keeper]) -> None:
        """Nothing is left running, and nothing starts again."""
        for keeper in keepers:
            keeper.stop()
            keeper.kill()
        self._reactor.run_until(lambda: not _running(keepers), _REAP_S)

    def _kill_all(self) -> None:
        for keeper in self._keepers:
            keeper.kill()

    # -- telling

    def _changed(self) -> None:
        if not self._said_ready and all(keeper.life.settled for keeper in self._always):
            self._said_ready = True
            self._systemd.ready()
        if not self._status_due:
            self._status_due = True
            self._reactor.after(_STATUS_PAUSE_S, self._say_status)

    def _say_status(self) -> None:
        self._status_due = False
        states = {keeper.program.name: _state(keeper.life) for keeper in self._keepers if keeper.shown}
        self._systemd.status(_summary({name: state for name, state in states.items() if name not in self._resting()}))
        self._say_state(STATUS, _status(states, self._webrtc_url()))

    def _resting(self) -> set[str]:
        """Stopped because nobody wants them: nothing to worry about."""
        return {k.program.name for k in self._keepers if k.program.on_demand and not k.wanted and not k.running}

    def _say_capabilities(self) -> None:
        value = capabilities(self._config, self._addresses)
        self._say_state(CAPABILITIES, Capabilities(t=_now_ms(), value=value))

    def _say_last(self) -> None:
        if self._news.dropped:
            log.info(
                "log records that were not published, because the announcer was away or busy: %d", self._news.dropped
            )
        self._say_status()

    def _say_state(self, channel: Channel, value: Any) -> None:
        self._news.state(self._message(channel, value))

    def _webrtc_url(self) -> str | None:
        stream = self._config.services.video_stream
        return stream.webrtc_url if stream.enabled else None

    def _will(self) -> Message:
        """Children die with us, so that is what others are to believe when we are gone."""
        shown = (keeper.program.name for keeper in self._keepers if keeper.shown)
        gone = _status({name: ServiceState(state="stopped") for name in shown})
        return self._message(STATUS, gone)

    def _record(self, record: LogRecord) -> None:
        launcher = self._config.services.launcher
        if launcher.enabled and launcher.logs.enabled:
            self._news.record(self._message(LOGS, record))

    def _message(self, channel: Channel, value: Any) -> Message:
        address = self._addresses[channel]
        return Message(address.topic, codec.encode(channel, value), QoS(address.qos), retain=address.retain)


def _running(keepers: list[Keeper]) -> list[str]:
    return [keeper.program.name for keeper in keepers if keeper.running]


def _preloaded(keepers: list[Keeper]) -> list[str]:
    return [keeper.program.module for keeper in keepers if keeper.program.preloaded]


def _environment() -> dict[str, str]:
    """Children do not speak to systemd in our name."""
    return {name: value for name, value in os.environ.items() if name not in SystemdNotifier.VARIABLES}


def _state(life: Life) -> ServiceState:
    return ServiceState(state=life.state, restarts=life.restarts, last_exit=life.last_exit)


def _status(states: dict[str, ServiceState], webrtc_url: str | None = None) -> Status:
    """Operator pages show what they find under ``webrtc_url``."""
    value: dict[str, Any] = {"services": states}
    if webrtc_url is not None:
        value["webrtc_url"] = webrtc_url
    return Status(t=_now_ms(), value=value)


def _summary(states: dict[str, ServiceState]) -> str:
    """``3 of 4 ready; mqtt_bridge restarting``."""
    others = [f"{name} {state.state}" for name, state in states.items() if state.state != "ready"]
    return "; ".join([f"{len(states) - len(others)} of {len(states)} ready", *others])


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
