"""Publishes the robot's status, capabilities and logs through the announcer, and reports to systemd."""

import logging
import time
from collections.abc import Sequence
from typing import Any

from msgspec import UNSET

from pebble.config import Config
from pebble.contract import CAPABILITIES, LOGS, STATUS, Channel, codec
from pebble.contract.payloads import Capabilities, LogRecord, ServiceState, Status
from pebble.launcher.announcer_pipe import AnnouncerPipe
from pebble.launcher.capabilities import capabilities
from pebble.launcher.driveable import Driveable
from pebble.launcher.features import Features
from pebble.launcher.process_supervisor import ProcessSupervisor
from pebble.launcher.reactor import Reactor
from pebble.launcher.sd_notify import SystemdNotifier
from pebble.runtime.addresses import Addresses
from pebble.transports import Message, QoS

_STATUS_PAUSE_S = 0.2  # changes this close together share one message: a service starts in about 0.1 s

log = logging.getLogger(__name__)


class StatusPublisher:
    """Turns the states of all supervisors into messages for operators and for systemd."""

    def __init__(
        self,
        config: Config,
        reactor: Reactor,
        supervisors: Sequence[ProcessSupervisor],
        features: Features,
        driveable: Driveable,
    ) -> None:
        self._config, self._addresses = config, Addresses(config)
        self._reactor, self._supervisors = reactor, supervisors
        self._features, self._driveable = features, driveable
        self._pipe = AnnouncerPipe(reactor)
        self._systemd = SystemdNotifier()
        self._status_due = self._capabilities_due = False
        self._ready_reported = False

    def connect_announcer(self) -> int:
        """Return the standard input of a new announcer process: a descriptor, which the caller closes."""
        return self._pipe.connect(self._will())

    def start(self) -> None:
        """Publish now, on every change and on the configured intervals."""
        launcher = self._config.services.launcher
        interval_s = self._config.services.defaults.retained_publish_interval_seconds
        if self._systemd.watchdog_period_s is not None:
            self._reactor.every(self._systemd.watchdog_period_s, self._systemd.watchdog)
        if launcher.enabled:
            self._publish_capabilities()
            self._reactor.every(interval_s, self._publish_capabilities)
        self.changed()
        self._reactor.every(interval_s, self._publish_status)

    def changed(self) -> None:
        """Note that the state of a supervisor may have changed: publish soon."""
        always = (supervisor for supervisor in self._supervisors if not supervisor.program.on_demand)
        if not self._ready_reported and all(supervisor.policy.first_attempt_done for supervisor in always):
            self._ready_reported = True
            self._systemd.ready()
        if not self._status_due:
            self._status_due = True
            self._reactor.after(_STATUS_PAUSE_S, self._publish_status)

    def capabilities_changed(self) -> None:
        """Note that what the processes report has changed: publish soon."""
        if self._config.services.launcher.enabled and not self._capabilities_due:
            self._capabilities_due = True
            self._reactor.after(_STATUS_PAUSE_S, self._publish_capabilities)

    def publish_log(self, record: LogRecord) -> None:
        launcher = self._config.services.launcher
        if launcher.enabled and launcher.logs.enabled:
            self._pipe.record(self._message(LOGS, record))

    def stood_still(self) -> None:
        """systemd's clock has run on."""
        if self._systemd.watchdog_period_s is not None:
            self._systemd.watchdog()

    def stopping(self) -> None:
        self._systemd.stopping()

    def publish_last(self) -> None:
        """Before the announcer stops: the status with how all other programs ended."""
        if self._pipe.dropped:
            log.info(
                "log records that were not published, because the announcer was away or busy: %d", self._pipe.dropped
            )
        self._publish_status()

    def close(self) -> None:
        self._pipe.close()

    def _publish_status(self) -> None:
        self._status_due = False
        shown = [supervisor for supervisor in self._supervisors if supervisor.shown]
        relevant = {s.program.name: self._state(s) for s in shown if not _rests(s)}
        self._systemd.status(_summary(relevant))
        states = {one.name: ServiceState(state="failed", last_exit="not installed") for one in self._config.missing}
        states |= {supervisor.program.name: self._state(supervisor) for supervisor in shown}
        url = next((one.program.webrtc_url for one in self._supervisors if one.program.webrtc_url), None)
        self._publish_state(STATUS, self._status(states, self._driveable.mcus, url))

    def _status(
        self, states: dict[str, ServiceState], mcus: dict[str, Any] | None = None, webrtc_url: str | None = None
    ) -> Status:
        """Operator pages show what is at ``webrtc_url``."""
        driveable = self._driveable.assessment({name: one.state for name, one in states.items()})
        more = {"mcu": mcus or None, "driveable": driveable, "webrtc_url": webrtc_url}
        value = {"services": states, **{name: one for name, one in more.items() if one is not None}}
        return Status(t=_now_ms(), value=value)

    def _state(self, supervisor: ProcessSupervisor) -> ServiceState:
        policy = supervisor.policy
        return ServiceState(
            state="held" if supervisor.held else policy.state,
            restarts=policy.restarts,
            last_exit=policy.last_exit,
            restarts_per_minute=policy.exits_within_a_minute(self._reactor.now()) or UNSET,
        )

    def _publish_capabilities(self) -> None:
        self._capabilities_due = False
        value = capabilities(self._config, self._addresses, self._features.lacking, self._features.found)
        self._publish_state(CAPABILITIES, Capabilities(t=_now_ms(), value=value))

    def _publish_state(self, channel: Channel, value: Any) -> None:
        self._pipe.state(self._message(channel, value))

    def _will(self) -> Message:
        """Return the status with every service stopped: children die with the launcher, whose end publishes it."""
        shown = (supervisor.program.name for supervisor in self._supervisors if supervisor.shown)
        return self._message(STATUS, self._status({name: ServiceState(state="stopped") for name in shown}))

    def _message(self, channel: Channel, value: Any) -> Message:
        address = self._addresses[channel]
        return Message(address.topic, codec.encode(channel, value), QoS(address.qos), retain=address.retain)


def _rests(supervisor: ProcessSupervisor) -> bool:
    """True if it is an on-demand program that is not requested: systemd's summary leaves it out."""
    return supervisor.program.on_demand and not supervisor.requested and not supervisor.running


def _summary(states: dict[str, ServiceState]) -> str:
    """``3 of 4 ready; mqtt_bridge restarting``."""
    others = [f"{name} {state.state}" for name, state in states.items() if state.state != "ready"]
    return "; ".join([f"{len(states) - len(others)} of {len(states)} ready", *others])


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
