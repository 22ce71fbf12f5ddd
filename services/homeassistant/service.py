"""The service that announces the robot to Home Assistant, over a connection of its own."""

from typing import Any

import msgspec

from pebble.contract import CAPABILITIES, CHARGING_LEVEL
from pebble.contract.payloads import Capabilities, ChargingLevel
from pebble.errors import PebbleError
from pebble.runtime.connections import remote_transport
from pebble.runtime.service import Service, every, on
from pebble.runtime.whole_file import write
from pebble.services.homeassistant.config import HomeAssistant, saved
from pebble.services.homeassistant.discovery import discovery, object_id
from pebble.transports import Message, QoS, State

APART_S = 5.0  # between two messages
_TICK_S = 0.25


class HomeAssistantService(Service):
    """The publisher of the discovery message, and of the empty message that removes it."""

    name = "homeassistant"

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._section = self.config.section(HomeAssistant)
        self._remote = remote_transport(self.config, "homeassistant")
        self._discovery_topic = f"{self._section.prefix}/device/{object_id(self.config.base)}/config"
        self._capabilities: dict[str, Any] = {}
        self._unit = ""  # of the battery's level, as the robot publishes it
        self._wanted = self._sent = b""  # the discovery message: as it should be, and as it was sent last
        self._due = False  # it must be sent again, although it has not changed
        self._sent_at = float("-inf")
        self._file = saved(self.config)
        self._retained = self._load()  # topics that the broker may retain
        self._emptied: set[str] = set()  # topics that got an empty message on this connection; it may not be confirmed

    def start(self) -> None:
        self._remote.on_state(lambda state: self.post(self._on_connection) if state is State.CONNECTED else None)
        self._remote.open(timeout=0.0)
        self.on_stop(self._remote.close)
        if self._section.enabled:
            self._remote.subscribe(f"{self._section.prefix}/status", self._on_status, echo=False, direct=True)

    @on(CAPABILITIES)
    def capabilities(self, capabilities: Capabilities) -> None:
        self._capabilities = capabilities.value
        self._update()

    @on(CHARGING_LEVEL)
    def level(self, level: ChargingLevel) -> None:
        if level.unit != self._unit:
            self._unit = str(level.unit)
            self._update()

    def _update(self) -> None:
        if self._section.enabled and self._capabilities:
            self._wanted = discovery(self.config.base, self._capabilities, self._section.expose, self._unit)

    def _on_status(self, message: Message) -> None:
        """Handle Home Assistant's own status message, on the transport's thread."""
        if message.payload == b"online":
            self.post(self._on_connection)

    def _on_connection(self) -> None:
        self._due = True
        self._emptied.clear()

    @every(_TICK_S)
    def send(self) -> None:
        """Send the message if it is due, and empty ones on topics of an earlier config."""
        if self._remote.state is not State.CONNECTED:
            return
        now = self.clock()
        is_due = self._due or self._wanted != self._sent
        if self._wanted and is_due and now - self._sent_at >= APART_S:
            self._save({*self._retained, self._discovery_topic})  # first: it is to be emptied even after a kill now
            if self._publish(self._discovery_topic, self._wanted):
                self._sent, self._sent_at, self._due = self._wanted, now, False
        in_use = {self._discovery_topic} if self._section.enabled else set()
        old = self._retained - in_use
        all_are_emptied = old <= self._emptied and not self._remote.outgoing.waiting  # and the broker has confirmed it
        if old and all_are_emptied:
            self._save(self._retained - old)
        for topic in old - self._emptied:
            if self._publish(topic, b""):
                self._emptied.add(topic)

    def _publish(self, topic: str, payload: bytes) -> bool:
        return self._remote.publish(topic, payload, qos=QoS.DELIVERED, retain=True)

    def _load(self) -> set[str]:
        try:
            return set(msgspec.json.decode(self._file.read_bytes(), type=list[str]))
        except FileNotFoundError:
            return set()
        except (OSError, msgspec.MsgspecError):  # it may be there
            return {self._discovery_topic}

    def _save(self, topics: set[str]) -> None:
        """Save the topics. Without topics the file is removed: a disabled service is then not started next time."""
        if topics == self._retained:
            return
        try:
            if topics:
                write(self._file, msgspec.json.encode(sorted(topics)), 0o600, PebbleError)
            else:
                self._file.unlink(missing_ok=True)
        except (OSError, PebbleError) as error:
            self.log.warning("%s: Home Assistant may keep the robot when it is disabled: %s", self._file, error)
        self._retained = topics  # even if they are not in the file: this process goes on
