"""A serial board in virtual time whose loop turns at a steady pace, and the host on its line."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from pebble.extensions.lab.simulation.bodies import body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.modules.machine import Machine
from pebble.extensions.lab.simulation.micropython.ports import Port
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, FrameError, Type, decode, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import Manifest, parse_describe

ASK = encode(Frame(Type.DESCRIBE_REQ))


class _ChangedMachine:
    """Stands where a radio would: the modules of a boot, of which it provides ``machine``."""

    def __init__(self, change: Callable[[Machine], None]) -> None:
        self.change = change
        self.board: Any = None

    def modules(self) -> dict[str, Any]:
        machine = Machine(self.board)
        self.change(machine)
        return {"machine": machine}


class Bench:
    """``change`` gets the ``machine`` module of each boot, before the firmware does."""

    def __init__(
        self,
        kind: str,
        *,
        turn_ms: int = 1,
        change: Callable[[Machine], None] = lambda _machine: None,
        port: Port | None = None,
    ) -> None:
        self.kind, self.turn_ms = kind, turn_ms
        self.clock = VirtualClock()
        changed = _ChangedMachine(change)
        self.board = Board(self.clock, changed, port=port)
        changed.board = self.board
        self.body: Any = body_of(kind, self.board)
        self.motors: list[tuple[float, tuple[float, float]]] = []
        self.body.on_motors = lambda now, motors: self.motors.append((now, motors))
        self.robot: Any = self.board.load(kind, {})
        self.turns = self.damaged = 0
        self._rest = b""

    def turn(self, seconds: float) -> None:
        for _ in range(round(1000 * seconds / self.turn_ms)):
            self.turns += 1
            self.clock.advance(self.turn_ms / 1000)
            self.robot.step()
            self.body.end_turn()

    def send(self, line: bytes) -> None:
        self.board.console.type(line + b"\n")

    def read(self, data: bytes) -> list[Frame]:
        """The whole frames in what the host has received by now; ``damaged`` counts what is none."""
        *whole, self._rest = (self._rest + data).split(b"\0")
        found = []
        for raw in filter(None, whole):
            try:
                found.append(decode(raw))
            except FrameError:
                self.damaged += 1
        return found

    def frames(self, seconds: float = 0.2) -> list[Frame]:
        """What the host reads during that time."""
        self.turn(seconds)
        return self.read(self.board.console.take_output())

    def asked(self, kind: Type, payload: bytes = b"", *, interface: int = 0, sequence: int = 1) -> list[Frame]:
        self.board.console.type(encode(Frame(kind, payload, interface=interface, sequence=sequence)))
        return self.frames()

    def manifest(self) -> Manifest:
        return next(parse_describe(frame.payload) for frame in of(self.asked(Type.DESCRIBE_REQ), Type.DESCRIBE))


def of(frames: Iterable[Frame], kind: Type) -> list[Frame]:
    return [frame for frame in frames if frame.type is kind]
