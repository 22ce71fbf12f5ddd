"""The robot's status, capabilities and logs, published by the process .announcer, and reports to systemd."""

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
    """A publisher of the states of all supervisors, for operators and for systemd."""

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
        """Return a descriptor for the standard input of a new announcer process; the caller closes it."""
        return self._pipe.connect(self._will())

    def start(self) -> None:
        """Publish status and capabilities now, on every change and at the configured intervals."""
        launcher = self._config.services.launcher
        interval_s = self._config.services.defaults.retained_publish_interval_seconds
        if self._systemd.watchdog_period_s is not None:
            self._reactor.every(self._systemd.watchdog_period_s, self._systemd.watchdog)
        if launcher.enabled:  # the key is for capabilities and logs: the status is always published
            self._publish_capabilities()
            self._reactor.every(interval_s, self._publish_capabilities)
        self.changed()
        self._reactor.every(interval_s, self._publish_status)

    def changed(self) -> None:
        """Publish the status soon, as the state of a program may differ; tell systemd once the robot has started."""
        permanent = (supervisor for supervisor in self._supervisors if not supervisor.program.on_demand)
        if not self._ready_reported and all(supervisor.policy.first_attempt_done for supervisor in permanent):
            self._ready_reported = True
            self._systemd.ready()
        if not self._status_due:
            self._status_due = True
            self._reactor.after(_STATUS_PAUSE_S, self._publish_status)

    def capabilities_changed(self) -> None:
        """Publish the capabilities soon, because the processes' reports have changed."""
        if self._config.services.launcher.enabled and not self._capabilities_due:
            self._capabilities_due = True
            self._reactor.after(_STATUS_PAUSE_S, self._publish_capabilities)

    def publish_log(self, record: LogRecord) -> None:
        launcher = self._config.services.launcher
        if launcher.enabled and launcher.logs.enabled:
            self._pipe.record(self._message(LOGS, record))

    def stood_still(self) -> None:
        """Give systemd a sign of life after this process was suspended: systemd's clock did not stop."""
        if self._systemd.watchdog_period_s is not None:
            self._systemd.watchdog()

    def stopping(self) -> None:
        self._systemd.stopping()

    def publish_last(self) -> None:
        """Publish the status, which says how all other programs ended, before the announcer stops."""
        if self._pipe.dropped:
            text = "messages that were not published (too long, or the announcer was away or busy): %d"
            log.info(text, self._pipe.dropped)
        self._publish_status()

    def close(self) -> None:
        self._pipe.close()

    def _publish_status(self) -> None:
        self._status_due = False
        shown = [supervisor for supervisor in self._supervisors if supervisor.shown]
        in_use = {supervisor.program.name: self._state(supervisor) for supervisor in shown if not _rests(supervisor)}
        self._systemd.status(_summary(in_use))  # without on-demand programs at rest, which operators do see, below
        not_installed = ServiceState(state="failed", last_exit="not installed")
        states = {extension.name: not_installed for extension in self._config.missing}
        states |= {supervisor.program.name: self._state(supervisor) for supervisor in shown}
        urls = [supervisor.program.webrtc_url for supervisor in self._supervisors if supervisor.program.webrtc_url]
        status = self._status(states, self._driveable.mcus, urls[0] if urls else None)
        self._pipe.state(self._message(STATUS, status))

    def _status(
        self, states: dict[str, ServiceState], mcus: dict[str, Any] | None = None, webrtc_url: str | None = None
    ) -> Status:
        """Return the status message. ``webrtc_url``: the address of the pictures that operator pages show."""
        driveable = self._driveable.assessment({name: service.state for name, service in states.items()})
        parts = {"mcu": mcus or None, "driveable": driveable, "webrtc_url": webrtc_url}
        return Status(t=_now_ms(), value={"services": states, **{key: part for key, part in parts.items() if part}})

    def _state(self, supervisor: ProcessSupervisor) -> ServiceState:
        policy = supervisor.policy  # has the state in the words of the status, unlike supervisor.state
        return ServiceState(
            state="held" if supervisor.held else policy.state,
            restarts=policy.restarts,
            last_exit=policy.last_exit,
            restarts_per_minute=policy.exits_within_a_minute(self._reactor.now()) or UNSET,
        )

    def _publish_capabilities(self) -> None:
        self._capabilities_due = False
        value = capabilities(self._config, self._addresses, self._features.lacking, self._features.found)
        self._pipe.state(self._message(CAPABILITIES, Capabilities(t=_now_ms(), value=value)))

    def _will(self) -> Message:
        """Return the will: the status with every service stopped. The broker publishes it when the launcher dies."""
        shown = (supervisor.program.name for supervisor in self._supervisors if supervisor.shown)
        return self._message(STATUS, self._status({name: ServiceState(state="stopped") for name in shown}))

    def _message(self, channel: Channel, value: Any) -> Message:
        address = self._addresses[channel]
        return Message(address.topic, codec.encode(channel, value), QoS(address.qos), retain=address.retain)


def _rests(supervisor: ProcessSupervisor) -> bool:
    """True if the program is on-demand and not requested now. systemd's summary leaves such programs out."""
    return supervisor.program.on_demand and not supervisor.requested and not supervisor.running


def _summary(states: dict[str, ServiceState]) -> str:
    """Return a line such as ``3 of 4 ready; mqtt_bridge restarting``."""
    others = [f"{name} {state.state}" for name, state in states.items() if state.state != "ready"]
    return "; ".join([f"{len(states) - len(others)} of {len(states)} ready", *others])


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
