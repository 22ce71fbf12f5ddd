"""A robot at a broker that a test plays: it has no motors, but the real latch and lease, and records messages."""

from __future__ import annotations

import json
import threading
import time
from types import TracebackType
from typing import Any, Self

import msgspec

from pebble.contract import ONLINE, codec
from pebble.contract.names import without_name
from pebble.contract.payloads import Heartbeat
from pebble.transports import Message, MqttSettings, QoS, create
from tests.ext.operator.client import estop_robot
from tests.ext.operator.client.estop_robot import KeepingRobot

HEARTBEAT_S = 0.25


class RecordingRobot:
    """A robot that publishes heartbeats and capabilities, takes stops, and records what arrives.

    ``keeps``: it keeps control itself, as ``keeping`` does. ``named``: it takes commands with names, as a bridge gives
    them to a robot, and drive commands of strangers; ``wire`` has the topics as they arrived. ``deaf``: it answers no
    stop and no reset; ``late_s``: it answers them after this time.
    """

    def __init__(
        self,
        broker_port: int,
        base: str,
        *owners: str,
        capabilities: dict[str, Any] | None = None,
        keeps: bool = False,
        named: bool = False,
        persisted: bool | None = True,
        heartbeats: bool = True,
        **login: Any,
    ) -> None:
        self.base, self.named = base, named
        self.id = base.rpartition("/")[2]
        self.wire: set[str] = set()
        self.received: list[tuple[float, str, Any]] = []
        self.deaf, self.late_s = False, 0.0
        self.motors = estop_robot.Robot(base, *(owners or ("serial",)), persisted=persisted)
        self.keeping = KeepingRobot(base, *owners) if keeps else None
        for owner in self.keeping.owners if self.keeping else ():
            owner.named = named
        self._answering = threading.Lock()
        self._late: list[threading.Timer] = []
        self._transport = create(
            "mqtt", f"robot-{base.replace('/', '-')}", MqttSettings(host="127.0.0.1", port=broker_port, **login)
        )
        self._transport.open()
        self._transport.subscribe(f"{base}/incoming/#", self._receive, direct=True)
        value = self.motors.value if capabilities is None else capabilities
        if capabilities is None:
            value["drive"] |= {"controls": True} | ({"control": True} if keeps else {})
        if value:
            self.publish_capabilities(value | ({"named": True} if named else {}))
        self._publish_all(self.keeping.states() if self.keeping else [])
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._heartbeats, daemon=True)
        if heartbeats:
            self._thread.start()

    @property
    def latched(self) -> bool:
        """True if all motor owners are stopped."""
        return all(owner.latch.latched for owner in self.motors.owners)

    def publish_capabilities(self, value: dict[str, Any]) -> None:
        self.publish("capabilities", {"schema": "pebble-capabilities/v1", "t": 1, "value": value}, retain=True)

    def drives(self, since: float = 0.0) -> list[dict[str, Any]]:
        """Return the drive commands that have arrived since ``since``."""
        topic = f"{self.base}/incoming/drive-values"
        return [payload for at, name, payload in list(self.received) if name == topic and at >= since]

    def times(self, metric: str) -> list[float]:
        """Return the times at which commands of a metric have arrived."""
        return [at for at, topic, _ in list(self.received) if topic == f"{self.base}/incoming/{metric}"]

    def count(self, metric: str) -> int:
        return len(self.times(metric))

    def publish(self, metric: str, value: Any, *, retain: bool = False) -> None:
        topic = f"{self.base}/outgoing/{metric}"
        self._transport.publish(topic, msgspec.json.encode(value), qos=QoS.DELIVERED, retain=retain)

    def remove(self, metric: str) -> None:
        """Remove a retained message."""
        self._transport.publish(f"{self.base}/outgoing/{metric}", b"", qos=QoS.DELIVERED, retain=True)

    def start(self) -> None:
        """Begin to send heartbeats."""
        self._thread.start()

    def silent(self) -> None:
        """Stop the heartbeats."""
        self._ending.set()
        if self._thread.ident:
            self._thread.join()

    def close(self) -> None:
        self._ending.set()
        for answer in self._late:
            answer.join()
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def beat(self) -> None:
        """Publish one heartbeat."""
        payload = codec.encode(ONLINE, Heartbeat(t=int(1000 * time.time()), online=True))
        self._transport.publish(ONLINE.topic(self.base), payload, qos=QoS.DELIVERED, retain=True)

    def _heartbeats(self) -> None:
        while True:
            self.beat()
            self.answer([])
            if self._ending.wait(HEARTBEAT_S):
                return

    def answer(self, messages: list[Message]) -> None:
        """Handle requests for control, or, without messages, only the passing of time."""
        with self._answering:
            self._publish_all(self.keeping.take(messages, time.monotonic()) if self.keeping else [])

    def command(self, metric: str, body: object) -> None:
        """Publish a command to the robot, as another client does."""
        payload = msgspec.json.encode(body)
        self._transport.publish(f"{self.base}/incoming/{metric}", payload, qos=QoS.DELIVERED)

    def stop(self, name: str = "0123456789abcdef", by: str = "ann@desk", why: str = "dog") -> None:
        """Stop the robot as another client does."""
        body = msgspec.json.encode({"stop": name, "by": by, "why": why})
        self._publish_all(self.motors.take([Message(f"{self.base}/incoming/estop", body)]))

    def publish_states(self) -> None:
        """Publish the states of control and of the emergency stop."""
        self._publish_all(self.keeping.states() if self.keeping else [])
        self._publish_all([owner.state() for owner in self.motors.owners])

    def _publish_all(self, states: list[Message]) -> None:
        for state in states:
            self._transport.publish(state.topic, state.payload, qos=QoS.DELIVERED, retain=True)

    def _receive(self, message: Message) -> None:
        try:
            payload = json.loads(message.payload)
        except ValueError:
            payload = message.payload
        self.wire.add(message.topic)
        if (named := without_name(message.topic)) is not None and self.named:
            person = payload.get("by") if isinstance(payload, dict) else None
            by = f"{named.account}/{person}" if person else named.account
            payload = payload | {"by": by} if isinstance(payload, dict) else payload
            message = Message(named.topic, msgspec.json.encode(payload), message.qos)
        elif self.named and not message.topic.endswith(("/drive-values", "/estop")):
            return
        self.received.append((time.monotonic(), message.topic, payload))
        self.answer([message])
        if self.deaf or not message.topic.endswith(("/estop", "/estop-reset")):
            return
        states = self.motors.take([message])
        if states and self.late_s:
            self._late.append(threading.Timer(self.late_s, self._publish_all, [states]))
            self._late[-1].start()
        else:
            self._publish_all(states)
