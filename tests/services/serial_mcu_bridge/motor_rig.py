"""A motor bridge on a real pty, and an operator who drives and stops it."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pebble.config import parse
from pebble.errors import TransportError
from pebble.services.serial_mcu_bridge.text.motor_bridge import MotorBridge
from pebble.simulation.pty import PtyMcu
from pebble.transports import Message, MqttSettings, QoS, create
from pebble.transports.memory import MemoryHub
from tests.support import Broker, until

BASE = "pebble/robots/rover"
STOP = {"stop": "c9a9f10cc9a9f10c", "by": "eve", "why": "a test"}


class Bench:
    """The service in a thread of its own, an MCU, and an operator on the same network: in memory, or at a broker."""

    def __init__(self, folder: Path, kind: str, *, broker: Broker | None = None, **section: Any) -> None:
        self.mcu = PtyMcu(kind, folder / "tty")
        self.mcu.__enter__()
        serial = {"enabled": True, "serial": {"port": str(folder / "tty")}, **section}
        transport = {"kind": "mqtt", "state_dir": str(folder / "state"), "run_dir": str(folder / "run")}
        raw = {"robot": {"id": "rover"}, "transport": transport, "services": {"serial_mcu_bridge": serial}}
        config = parse(raw, folder=folder, env={})
        settings = MemoryHub() if broker is None else MqttSettings(host="127.0.0.1", port=broker.port)
        network = "memory" if broker is None else "mqtt"
        self.operator = create(network, "operator", settings).open()
        self.received: list[Message] = []
        self.operator.subscribe(f"{BASE}/outgoing/#", self.received.append)
        self.failure: TransportError | None = None  # what ended the service
        self._new_service = lambda: MotorBridge(config, create(network, "robot", settings))
        self.start()

    def start(self) -> None:
        self.service = self._new_service()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        assert until(lambda: len(self.mcu.trace.lines()) >= 2, 5)  # the stop after opening and after booting

    def _run(self) -> None:
        try:
            self.service.run()
        except TransportError as error:
            self.failure = error

    @contextmanager
    def occupied(self) -> Iterator[None]:
        """Keeps the service's thread busy: what arrives meanwhile waits."""
        begun, ends = threading.Event(), threading.Event()

        def work() -> None:
            begun.set()
            ends.wait(5)

        self.service.post(work)
        assert begun.wait(5)
        try:
            yield
        finally:
            ends.set()

    def send(self, suffix: str, body: Any) -> None:
        self.operator.publish(f"{BASE}/{suffix}", json.dumps(body).encode(), qos=QoS.DELIVERED)

    def payloads(self, metric: str) -> list[Any]:
        topic = f"{BASE}/outgoing/{metric}"
        return [json.loads(message.payload) for message in self.received if message.topic == topic and message.payload]

    def line(self, text: str) -> bool:
        return until(lambda: text in self.mcu.trace.lines(), 5)

    def stop(self) -> None:
        self.service.quit()
        self._thread.join(5)

    def close(self) -> None:
        self.stop()
        self.operator.close()
        self.mcu.__exit__(None, None, None)


def state(bench: Bench) -> dict[str, Any]:
    states = bench.payloads("estop/serial")
    return states[-1] if states else {}


def stopped(bench: Bench) -> bool:
    return until(lambda: state(bench).get("latched") and state(bench)["persisted"], 5)


def send_reset(bench: Bench) -> None:
    bench.send("incoming/estop-reset", {"boot": state(bench)["boot"], "count": state(bench)["count"], "by": "eve"})


def reset(bench: Bench) -> bool:
    send_reset(bench)
    return until(lambda: not state(bench)["latched"], 5)
