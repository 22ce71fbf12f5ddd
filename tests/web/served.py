"""A server of the operator page in a thread, a page without a browser, and a robot that only records."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from types import TracebackType
from typing import Any, Self

import msgspec
import uvicorn
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from pebble.client.page import WebSettings
from pebble.contract import ESTOP_STATE, ONLINE, codec
from pebble.contract.names import without_name
from pebble.contract.payloads import EstopState, Heartbeat
from pebble.transports import Message, MqttSettings, QoS, create
from pebble.web.serve import listen, server_config
from tests.client.control_robot import KeepingRobot
from tests.support import until

HEARTBEAT_S = 0.25
#: The state of a motor owner that is not stopped.
FREE = {"latched": False, "boot": "b", "count": 0, "recent": [], "by": "", "why": "", "since": 0}


class Served:
    """One server on a free loopback port; everything runs in this process, except the broker."""

    def __init__(self, broker_port: int, **settings: Any) -> None:
        broker = MqttSettings(host="127.0.0.1", port=broker_port)
        self.settings = WebSettings(**{"broker": broker, "port": 0, "server": "hall", **settings})
        self.listener = listen(self.settings)
        self.port = int(self.listener.getsockname()[1])
        self._uvicorn = uvicorn.Server(server_config(self.settings))
        self._thread = threading.Thread(target=self._run, name="served", daemon=True)

    @property
    def app(self) -> Any:
        return self._uvicorn.config.app

    @property
    def version(self) -> str:
        return str(self.app.state.version)

    @property
    def open(self) -> set[Any]:
        """The connections that are open."""
        return self._uvicorn.server_state.connections

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self._thread.start()
        assert until(lambda: self._uvicorn.started, 10), "the server did not start"
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._uvicorn.should_exit = True
        self._thread.join(10)
        self.listener.close()
        assert not self._thread.is_alive(), "the server did not end"

    def page(self, **options: Any) -> Page:
        return Page(self, **options)

    def _run(self) -> None:
        asyncio.run(self._uvicorn.serve(sockets=[self.listener]))


class Page:
    """What a page's control socket does: hello, echoes, and whatever a test sends."""

    def __init__(
        self,
        served: Served,
        *,
        device: str = "test",
        name: str = "",
        token: str = "",
        version: str | None = None,
        cookie: str = "",
    ) -> None:
        headers = {"cookie": cookie} if cookie else None
        self.state: dict[tuple[str, str], Any] = {}
        self.refused: list[dict[str, Any]] = []
        self.done: list[dict[str, Any]] = []
        self.logs: list[dict[str, Any]] = []  # with their lines
        self.welcome: dict[str, Any] = {}
        self.bye: dict[str, Any] = {}
        self.closed = False
        self.answers = True  # False: as a page that stands still
        self.echo_offset_ms = 0.0
        self._socket: ClientConnection = connect(
            f"ws://127.0.0.1:{served.port}/ws/control", origin=served.origin, additional_headers=headers, max_size=None
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        version = served.version if version is None else version
        self.send("hello", version=version, device=device, name=name, token=token)
        assert until(lambda: self.welcome or self.closed, 30)

    def send(self, op: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"op": op, **fields}))

    def send_raw(self, data: str | bytes) -> None:
        self._socket.send(data)

    def drive(self, ref: str, g: int, *, x: float = 0.0, z: float = 0.0, age_ms: float = 0.0, **more: Any) -> None:
        self.send("drive", ref=ref, g=g, t=now_ms() - age_ms, x=x, z=z, **more)

    def take(self, ref: str, *, over: bool = False) -> bool:
        self.send("lease", ref=ref, take=True, over=over)
        return until(lambda: self.value(ref, "web/driver", "you") is True, 3)

    def value(self, ref: str, metric: str, field: str | None = None) -> Any:
        value = self.state.get((ref, metric))
        return value if field is None or value is None else value.get(field)

    def knows(self, ref: str, timeout: float = 5.0) -> bool:
        """Whether the component has become online."""
        return until(lambda: self.value(ref, "web/liveness", "online") is True, timeout)

    def ready(self) -> bool:
        """Whether enough echoes were exchanged to drive."""
        return until(lambda: self.state.get(("", "round trip"), -1) >= 0, 3)

    def close(self) -> None:
        self._socket.close()

    def abort(self) -> None:
        """Vanish without a goodbye."""
        self._socket.socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _read(self) -> None:
        try:
            for text in self._socket:
                self._take(json.loads(text))
        except (ConnectionClosed, OSError):
            pass
        self.closed = True

    def _take(self, message: dict[str, Any]) -> None:
        match message["op"]:
            case "ping":
                self.state["", "round trip"] = message["round_trip_ms"]
                if self.answers:
                    self.send("echo", n=message["n"], t=now_ms() + self.echo_offset_ms)
            case "state":
                self.state |= {(ref, metric): value for ref, metric, value, _ in message["set"]}
                for ref in message["gone"]:
                    self.state = {key: value for key, value in self.state.items() if key[0] != ref}
            case "logs":
                self.logs.append(message)
            case "done":
                self.done.append(message)
            case "refused":
                self.refused.append(message)
            case "welcome":
                self.welcome = message
            case "bye":
                self.bye = message


def now_ms() -> float:
    """The page's clock, which has nothing to do with the server's."""
    return 1000 * time.monotonic() % 1e9 + 1e6


class RecordingRobot:
    """Publishes heartbeats and capabilities, and records what arrives; it also takes stops.

    ``keeps``: it keeps control itself, as ``keeping`` does. ``named``: it takes commands with names, as a bridge gives
    them to a robot, and drive commands of strangers; ``wire`` has the topics as they arrived. ``pace``: of the clock by
    which it keeps control.
    """

    def __init__(
        self,
        broker_port: int,
        base: str,
        *,
        capabilities: dict[str, Any] | None = None,
        keeps: bool = False,
        named: bool = False,
        pace: float = 1.0,
        **login: Any,
    ) -> None:
        self.base, self.named, self._pace = base, named, pace
        self.wire: set[str] = set()
        self.received: list[tuple[float, str, Any]] = []
        self.latched = False
        self._count = 0
        self._recent: list[str] = []
        self.keeping = KeepingRobot(base, "serial") if keeps else None
        for owner in self.keeping.owners if self.keeping else ():
            owner.named = named
        self._answering = threading.Lock()
        self._transport = create(
            "mqtt", f"robot-{base.replace('/', '-')}", MqttSettings(host="127.0.0.1", port=broker_port, **login)
        )
        self._transport.open()
        self._transport.subscribe(f"{base}/incoming/#", self._receive, direct=True)
        drive = {"available": True, "controls": True, "topic": f"{base}/incoming/drive-values", "arbitrates": True}
        drive |= {"control": True} if keeps else {}
        estop = {"available": True, "owners": ["serial"]}
        value = {"drive": drive, "estop": estop} if capabilities is None else capabilities
        if value:
            self.publish_capabilities(value | ({"named": True} if named else {}))
        self._publish_all(self.keeping.states() if self.keeping else [])
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._heartbeats, daemon=True)
        self._thread.start()

    def publish_capabilities(self, value: dict[str, Any]) -> None:
        self.publish("capabilities", {"schema": "pebble-capabilities/v1", "t": 1, "value": value}, retain=True)

    def drives(self, since: float = 0.0) -> list[dict[str, Any]]:
        """The drive commands that have arrived."""
        topic = f"{self.base}/incoming/drive-values"
        return [payload for at, name, payload in list(self.received) if name == topic and at >= since]

    def topics(self) -> set[str]:
        return {topic for _, topic, _ in list(self.received)}

    def publish(self, metric: str, value: Any, *, retain: bool = False) -> None:
        topic = f"{self.base}/outgoing/{metric}"
        self._transport.publish(topic, msgspec.json.encode(value), qos=QoS.DELIVERED, retain=retain)

    def remove(self, metric: str) -> None:
        """Remove a retained value."""
        self._transport.publish(f"{self.base}/outgoing/{metric}", b"", qos=QoS.DELIVERED, retain=True)

    def silent(self) -> None:
        """Stop the heartbeats."""
        self._ending.set()
        self._thread.join()

    def close(self) -> None:
        self._ending.set()
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _heartbeats(self) -> None:
        while True:
            payload = codec.encode(ONLINE, Heartbeat(t=int(1000 * time.time()), online=True))
            self._transport.publish(ONLINE.topic(self.base), payload, qos=QoS.DELIVERED, retain=True)
            self.answer([])
            if self._ending.wait(HEARTBEAT_S):
                return

    def answer(self, messages: list[Message]) -> None:
        """Requests for control reach it, or only time."""
        with self._answering:
            self._publish_all(self.keeping.take(messages, self._pace * time.monotonic()) if self.keeping else [])

    def stranger(self, **drive: float) -> None:
        """A program publishes a drive command without any control, as the original's page does."""
        self._transport.publish(f"{self.base}/incoming/drive-values", msgspec.json.encode(drive), qos=QoS.DELIVERED)

    def publish_states(self) -> None:
        """Publish who has control."""
        self._publish_all(self.keeping.states() if self.keeping else [])

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
        if message.topic.endswith("/incoming/estop"):
            self._stop(payload)
        elif message.topic.endswith("/estop-reset") and payload.get("count") == self._count:
            self.latched = False
            self._publish_state("")

    def _stop(self, payload: dict[str, Any]) -> None:
        if payload["stop"] not in self._recent:
            self.latched = True
            self._count += 1
            self._recent.insert(0, payload["stop"])
        self._publish_state(payload.get("by", ""))

    def _publish_state(self, by: str) -> None:
        state = EstopState(
            latched=self.latched,
            boot="b",
            count=self._count,
            recent=self._recent[:8],
            by=by,
            why="",
            since=1,
            persisted=True,
        )
        topic = ESTOP_STATE.topic(self.base, owner="serial")
        self._transport.publish(topic, codec.encode(ESTOP_STATE, state), qos=QoS.DELIVERED, retain=True)
