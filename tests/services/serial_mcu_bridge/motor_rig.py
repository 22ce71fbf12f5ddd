"""A motor bridge on a real pty, and an operator who drives and stops it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pebble.config import parse
from pebble.extensions.lab.simulation.pty import PtyMcu
from pebble.runtime.process import view_of
from pebble.services.serial_mcu_bridge.text.motor_bridge import MotorBridge
from pebble.transports import MqttSettings, create
from pebble.transports.memory import MemoryHub
from tests.kit.robot import BASE as BASE
from tests.kit.robot import ROBOT, Listener, Running
from tests.support import Broker, until

STOP = {"stop": "c9a9f10cc9a9f10c", "by": "eve", "why": "a test"}
STOPPED = "M 0.000 0.000"


class Bench:
    """The service in a thread of its own, an MCU, and an operator on the same network: in memory, or at a broker.

    It is the motor owner ``instance`` of the robot; ``peer`` is listed as another one.
    """

    service: MotorBridge
    running: Running

    def __init__(
        self,
        folder: Path,
        kind: str,
        *,
        broker: Broker | None = None,
        instance: str = "",
        peer: str = "",
        groups: bool = False,
        **section: Any,
    ) -> None:
        folder.mkdir(exist_ok=True)
        self._owner = instance or "serial"
        self.mcu = PtyMcu(kind, folder / "tty")
        self.mcu.__enter__()
        serial = {"enabled": True, "serial": {"port": str(folder / "tty")}, **section}
        lines = {instance: serial}
        if peer:
            lines[peer] = {**serial, "serial": {"port": str(folder / peer)}}
        serial = {"instances": lines} if instance else serial
        transport = {"kind": "mqtt", "state_dir": str(folder / "state"), "run_dir": str(folder / "run")}
        bridge = {
            "enabled": True,
            "remote_mqtt": {"host": "localhost", "port": 1},
            "link": {"groups": groups},
        }  # beside one, silence alone ends no control
        services = {"serial_mcu_bridge": serial, "mqtt_bridge": bridge}
        raw = {"robot": {"id": ROBOT}, "transport": transport, "services": services}
        config = parse(raw, folder=folder, env={})
        config = view_of(config, instance) if instance else config
        settings = MemoryHub() if broker is None else MqttSettings(host="127.0.0.1", port=broker.port)
        network = "memory" if broker is None else "mqtt"
        self.world = Listener(create(network, "operator", settings))
        self.operator = self.world.transport
        name = f"robot-{instance}"
        self._new_service = lambda: MotorBridge(config, create(network, name, settings), instance=instance)
        self.start()

    def start(self) -> None:
        before = len(self.lines)
        self.service = self._new_service()
        self.running = Running(self.service)
        assert until(lambda: len(self.lines) >= before + 2, 5)  # the stop after opening and after booting

    @property
    def lines(self) -> list[str]:
        """What the MCU has received."""
        return self.mcu.trace.lines()

    def send(self, metric: str, body: Any) -> None:
        self.world.command(metric, body)

    def drive(self, z: float = 0.0, **more: Any) -> None:
        self.send("drive-values", {"z": z, **more})

    def moves(self, z: float, **more: Any) -> bool:
        """Drive straight, and wait until the MCU is told so."""
        self.drive(z, **more)
        return self.line(f"M {z:.3f} {z:.3f}")

    def shines(self, **colours: float) -> bool:
        """Switch the lights on, and wait until the MCU is told so: what was sent before has been handled."""
        self.send("lights-solid", colours)
        return self.line("L " + " ".join(f"{colours.get(name, 0):.3f}" for name in "bgr"))

    def payloads(self, metric: str) -> list[Any]:
        return self.world.payloads(metric)

    def line(self, text: str) -> bool:
        return until(lambda: text in self.lines, 5)

    @property
    def state(self) -> dict[str, Any]:
        """The newest state of the emergency stop."""
        state: dict[str, Any] = self.world.newest(f"estop/{self._owner}")
        return state

    def stopped(self) -> bool:
        return until(lambda: self.state.get("latched") and self.state["persisted"], 5)

    def send_reset(self) -> None:
        self.send("estop-reset", {"boot": self.state["boot"], "count": self.state["count"], "by": "eve"})

    def reset(self) -> bool:
        self.send_reset()
        return until(lambda: not self.state["latched"], 5)

    def stop(self) -> None:
        self.running.stop()

    def restart(self) -> None:
        """Stop it, and start it again; returns once that one has published its state."""
        boot = self.state.get("boot")
        self.stop()
        self.start()
        assert until(lambda: self.state.get("boot") not in (boot, None), 5)

    def close(self) -> None:
        self.stop()
        self.operator.close()
        self.mcu.__exit__(None, None, None)
