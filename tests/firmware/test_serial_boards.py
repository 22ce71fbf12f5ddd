"""Boards on a serial line, in virtual time: motors stop in time, nothing blocks the loop, faults reset them.

Also what is different with MicroPython's official image for the XIAO SAMD21, without select and sys.stdin.buffer.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from common.frames import crc16
from goob_imu.manifest import MANIFEST
from pebble.extensions.lab.simulation.bodies import body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.modules.machine import Machine
from pebble.extensions.lab.simulation.micropython.ports import SAMD21_OFFICIAL, Port
from pebble.extensions.lab.simulation.micropython.timers import BoardReset
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, FrameError, Type, decode, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import parse_describe, parse_hello
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import unpack
from tests.ext.boards.mcu_wire import IMU
from tests.support import some

pytestmark = pytest.mark.computing

ASK = encode(Frame(Type.DESCRIBE_REQ))


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

        def modules() -> dict[str, Any]:
            machine = Machine(self.board)
            change(machine)
            return {"machine": machine}

        self.board: Board = Board(self.clock, SimpleNamespace(modules=modules), port=port)
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

    def asked(self, kind: Type, *, interface: int = 0, sequence: int = 1) -> list[Frame]:
        self.board.console.type(encode(Frame(kind, interface=interface, sequence=sequence)))
        return self.frames()


def of(frames: Iterable[Frame], kind: Type) -> list[Frame]:
    return [frame for frame in frames if frame.type is kind]


# -- the board of Goob's inertial sensor, and the host's own code


@pytest.fixture
def imu() -> Bench:
    return Bench("goob_imu", turn_ms=2)


def test_half_a_frame_from_before_a_reset_does_not_swallow_its_hello(imu: Bench) -> None:
    """On a serial port without USB, the host has no other sign that the firmware has changed."""
    imu.turn(0.002)
    frames = (encode(Frame(Type.SAMPLE, b"\1" * 18, 1))[:20] + imu.board.console.take_output()).split(b"\0")
    assert Type.HELLO in [decode(one).type for one in frames[1:] if one]


def test_what_it_measures(imu: Bench) -> None:
    fast, slow = parse_describe(MANIFEST).interfaces
    imu.body.imu.tilt_deg = (30.0, -20.0)
    frames = imu.frames(4.0)
    value = unpack(fast.fields, of(frames, Type.SAMPLE)[-1].payload)
    assert value["roll_deg"] == pytest.approx(30.0, abs=1.0)
    assert value["pitch_deg"] == pytest.approx(-20.0, abs=1.0)
    assert [value[axis] for axis in ("gx", "gy", "gz")] == pytest.approx([0.0] * 3, abs=0.5)
    assert 20.0 < value["temp_c"] < 32.0
    assert value["az"] == pytest.approx(9.81 * 0.8138, abs=0.3)
    state = unpack(slow.fields, of(frames, Type.STATE)[-1].payload)
    assert state["accel_norm_g"] == pytest.approx(1.0, abs=0.03)
    assert [state[f"gyro_bias_{axis}_dps"] for axis in "xyz"] == pytest.approx(imu.body.imu.bias_dps, abs=0.05)
    assert (state["samples_error"], state["calibration_samples"]) == (0, 200)
    assert state["samples_ok"] > 390
    assert len(of(frames, Type.STATE)) in (19, 20, 21)


@pytest.mark.parametrize(
    ("kind", "interface", "number", "answer", "payload"),
    [(Type.PING, 0, 0xDEADBEEF, Type.PONG, b""), (Type.CMD, 3, 9, Type.NACK, b"unknown_interface")],
)
def test_it_answers_with_the_number_of_the_question(
    imu: Bench, kind: Type, interface: int, number: int, answer: Type, payload: bytes
) -> None:
    (found,) = of(imu.asked(kind, interface=interface, sequence=number), answer)
    assert (found.payload, found.interface, found.sequence) == (payload, interface, number)


def test_a_host_that_did_not_read_gets_the_number_of_lost_frames(imu: Bench) -> None:
    frames = imu.frames(1.0)
    imu.board.console.reading = False
    imu.turn(3.0)
    imu.board.console.reading = True
    frames += imu.frames(1.0)
    logs = [frame.payload for frame in of(frames, Type.LOG)]
    (lost,) = [int(log.split(b"=")[1]) for log in logs if b"frames_lost=" in log]
    received = len(of(frames, Type.SAMPLE)) + len(of(frames, Type.STATE))
    messages = of(frames, Type.SAMPLE)[-1].sequence + of(frames, Type.STATE)[-1].sequence
    assert lost > 200
    assert messages - received - lost == imu.damaged
    assert imu.damaged <= 1, "the one that was on its way"


def test_it_describes_itself_when_asked_though_its_loop_is_slow_and_ctrl_c_is_a_byte_like_any_other() -> None:
    """Every turn brings a sample then. The question begins with 3: it would stop the board."""
    imu = Bench("goob_imu", turn_ms=12)
    assert (ASK[0], imu.robot.ctrl_c) == (3, False)
    imu.frames(0.3)
    imu.board.console.type(b"\x03\x03\x00" + ASK)
    frames = imu.frames(0.24)
    assert [frame.type for frame in frames if frame.type in (Type.HELLO, Type.DESCRIBE)] == [Type.HELLO, Type.DESCRIBE]
    assert len(of(frames, Type.SAMPLE)) >= 18
    (described,) = of(frames, Type.DESCRIBE)
    assert described.payload == MANIFEST
    assert parse_describe(MANIFEST).hello == parse_hello(of(frames, Type.HELLO)[0].payload)


def test_its_manifest_is_that_of_the_original_but_for_the_board() -> None:
    ours, original = parse_describe(MANIFEST), parse_describe(IMU.describe())
    rest = MANIFEST[49:]  # so long is HELLO, see robot.py
    assert ours.hello.schema_hash == f"goob-imu-{crc16(rest, len(rest)):04x}", "it changes with the interfaces"
    assert (ours.uid, ours.hello.model) == ("goob-imu", "seeed-xiao-samd21")
    for one, other in zip(ours.interfaces, original.interfaces, strict=True):
        fields = [replace(field, unit="") for field in one.fields]
        assert fields == [replace(field, unit="") for field in other.fields]
        assert replace(one, fields=()) == replace(other, fields=())


# -- boards with motors


KINDS = ("goob", "fred")


@pytest.fixture(params=KINDS)
def bench(request: pytest.FixtureRequest) -> Bench:
    return Bench(request.param)


@pytest.mark.parametrize("kind", KINDS)
def test_the_motors_come_first(kind: str) -> None:
    touched: list[tuple[str, str]] = []

    def note(machine: Machine) -> None:
        for name in ("Pin", "PWM", "ADC"):
            setattr(machine, name, noting(name, getattr(machine, name)))

    def noting(name: str, made: Any) -> Any:
        class Noting(made):  # type: ignore[misc]
            def __init__(self, pin: Any, *arguments: Any, **settings: Any) -> None:
                touched.append((name, pin if isinstance(pin, str) else pin.name))
                super().__init__(pin, *arguments, **settings)

        return Noting

    bench = Bench(kind, change=note)
    motor_pins = {*bench.body.pins.LEFT, *bench.body.pins.RIGHT}
    pins = list(dict.fromkeys(pin for _, pin in touched))
    first = pins.index(next(pin for pin in pins if pin not in motor_pins))
    assert first == {"goob": 2, "fred": 4}[kind], "Goob's headlights take a timer channel between them"
    assert all(bench.board.duty(pin) == 0.0 for pin in motor_pins)
    assert "ADC" not in [name for name, _ in touched[:4]]


def test_half_a_line_of_a_dead_host_moves_nothing(bench: Bench) -> None:
    bench.board.console.type(b"M 0.400 0.")
    bench.turn(0.25)
    bench.send(b"M 0.000 0.000")
    bench.turn(0.1)
    assert all(motors == (0.0, 0.0) for _, motors in bench.motors)
    bench.send(b"M 0.500 0.500")
    bench.turn(0.1)
    assert any(bench.motors[-1][1])


@pytest.mark.parametrize("seed", some(range(20), 10))
def test_motors_stop_a_second_after_the_last_command(bench: Bench, seed: int) -> None:
    chance = random.Random(seed)
    last = 0.0
    for _ in range(20):
        bench.send(b"M %.3f %.3f" % (chance.uniform(0.1, 1.0), chance.uniform(0.1, 1.0)))
        bench.send(chance.choice([b"L 1 1 1", b"F 0 1 0 0.1", b"nonsense", b"x" * 300, b"M", b""]))
        last = bench.clock.now()
        bench.turn(chance.uniform(0.0, 0.9))
    for _ in range(20):
        bench.turn(0.1)
        bench.send(b"L 0 0 0")  # lights do not keep the wheels turning
    stopped, motors = bench.motors[-1]
    assert motors == (0.0, 0.0)
    assert 0.999 <= stopped - last <= 1.02


def test_a_host_that_does_not_read_blocks_nothing_and_gets_whole_lines_afterwards(bench: Bench) -> None:
    bench.board.console.reading = False
    bench.turn(10.0)
    bench.send(b"M 0.5 0.5")
    bench.turn(2.1)
    (moved, motors), (stopped, off) = bench.motors
    assert motors != off == (0.0, 0.0)
    assert stopped - moved == pytest.approx(1.0, abs=0.005)
    assert bench.clock.now() == pytest.approx(bench.turns / 1000), "no turn waited for anything"
    bench.board.console.reading = True
    bench.turn(3.0)
    *lines, rest = bench.board.console.take_output().split(b"\r\n")
    assert (bench.board.console.lost, rest) == (0, b"")
    assert {line.split()[0] for line in lines} <= {b"Starting", b"Done!", b"T", b"C", b"OK"}
    assert {line.count(b"=") for line in lines if line.startswith(b"T")} == {3 if bench.kind == "goob" else 4}


def test_a_flood_does_not_keep_the_motors_running(bench: Bench) -> None:
    bench.send(b"M 1 1")
    bench.turn(0.05)
    bench.board.console.type(b"x" * 1_000_000)
    bench.turn(2.0)
    assert bench.board.console.typed
    (began, _), (stopped, motors) = bench.motors
    assert motors == (0.0, 0.0)
    assert stopped - began == pytest.approx(1.0, abs=0.01)


def test_lights_glow_and_freds_share_no_signal_with_his_motors() -> None:
    """Seven signals on six timer channels: a motor's two pins take turns on one."""
    bench = Bench("goob")
    bench.send(b"L 0.1 0.6 0.3")
    bench.turn(0.1)
    assert bench.body.light() == pytest.approx((0.6,) * 3, abs=0.001), "one colour: as bright as the brightest part"
    bench = Bench("fred")
    bench.send(b"L 0.25 0.5 0.75")
    bench.turn(0.4)
    for left, right in ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (0.0, 0.0), (-1.0, -1.0), (0.5, -0.25)):
        bench.turn(0.4)
        bench.send(b"M %.3f %.3f" % (left, right))
        bench.turn(0.05)
        assert bench.body.light() == pytest.approx((0.25, 0.5, 0.75), abs=0.001)
        for wish, pins in ((left, bench.body.pins.LEFT), (right, bench.body.pins.RIGHT)):
            ahead, back = (bench.board.duty(pin) for pin in pins)
            assert (ahead > 0, back > 0) == (wish > 0, wish < 0)


# -- the official image


class SwitchedOff(BaseException):
    """Ends the endless loop of main.py."""


class Endless(Bench):
    """Runs main.py, whose loop a timer turns, and does what ``plan`` has for that time; ``output`` has times."""

    def __init__(self, kind: str = "goob") -> None:
        """Leave a robot on the board that has not run yet."""
        super().__init__(kind, port=SAMD21_OFFICIAL)
        self.output: list[tuple[float, bytes]] = []
        self.plan: list[tuple[float, Callable[[], object]]] = []
        self._end = 0.0
        self.board.timers.on_wait = self._check

    def type(self, typed: dict[float, bytes]) -> None:
        self.plan += [(at, lambda data=data: self.board.console.type(data)) for at, data in typed.items()]  # type: ignore[misc]

    def run(self, seconds: float, *, main: bool = False) -> None:
        """From switching on, for so long; ``main``: by main.py, with a robot of its own."""
        self._end = seconds
        if main:
            self.board.boot()
            self.board.timers.on_wait = self._check
        firmware = self.board.firmware
        with pytest.raises(SwitchedOff):
            firmware.run(f"{self.kind}/main.py") if main else firmware.module("common.run").run(
                lambda _: self.robot, {}
            )

    def lines(self, pattern: bytes) -> list[float]:
        """The times of output lines like this."""
        return [when for when, data in self.output for line in data.splitlines() if re.fullmatch(pattern, line)]

    def _check(self) -> None:
        now = self.clock.now()
        self.body.end_turn()
        if self.board.console.reading and (output := self.board.console.take_output()):
            self.output.append((now, output))
        for entry in [entry for entry in self.plan if entry[0] <= now]:
            self.plan.remove(entry)
            entry[1]()
        if now >= self._end:
            raise SwitchedOff


@pytest.mark.parametrize("kind", KINDS)
def test_with_the_official_image_it_obeys_answers_and_stops_in_silence(kind: str) -> None:
    bench = Endless(kind)
    bench.type({1.5: b"M 0.5 0.5\n", 2.0: b"M 0.5 0.5\r\nL 0 1 0\nX\n", 2.1: b"M 0 \x03 nothing"})
    bench.run(4.0, main=True)
    (began, _), (ended, off) = bench.motors
    assert began == pytest.approx(1.5, abs=0.02)
    assert off == (0.0, 0.0)
    assert 2.99 <= ended <= 3.03
    assert [len(bench.lines(rb"OK M")), len(bench.lines(rb"OK L")), len(bench.lines(rb"ERR .*"))] == [2, 1, 1]
    assert bench.board.resets == 0


def test_with_the_official_image_a_host_that_does_not_read_does_not_keep_the_motors_running() -> None:
    bench = Endless()
    bench.board.console.reading = False
    bench.type({1.2 + 0.1 * count: b"M 1 1\n" for count in range(20)})
    bench.run(6.0)
    assert bench.motors[-1][1] == (0.0, 0.0)
    assert bench.motors[-1][0] - 3.1 <= 1.6, "one wait of half a second may come in between"


def test_with_the_official_image_a_fault_in_a_turn_stops_the_motors_and_resets() -> None:
    """A callback's exception is not propagated."""
    bench = Endless()

    def fail() -> None:
        raise MemoryError

    bench.type({1.5: b"M 1 1\n"})
    bench.plan.append((1.6, lambda: setattr(bench.robot, "step", fail)))
    with pytest.raises(BoardReset):
        bench.run(3.0)
    assert bench.clock.now() == pytest.approx(1.6, abs=0.02)
    assert bench.body.outputs() == (0.0, 0.0)


class SlowUart:
    """A port with a buffer of 64 bytes, which 115,200 baud empty by 11.5 in each turn of a millisecond."""

    def __init__(self, uart: Any) -> None:
        self.any, self.readinto, self.baudrate = uart.any, uart.readinto, uart.baudrate
        self.room, self.sent = 64.0, b""

    def write(self, data: bytes, first: int, count: int) -> int | None:
        taken = min(count, int(self.room))
        self.room -= taken
        self.sent += bytes(data[first : first + taken])
        return taken or None


def test_the_imu_speaks_on_its_two_pins_and_keeps_up_with_its_slow_line() -> None:
    """The buffer of the port takes what 115,200 baud have sent, and nothing beyond."""
    lines: list[SlowUart] = []

    def slow(machine: Machine) -> None:
        kind = machine.UART
        machine.UART = lambda *pins, **more: lines.append(SlowUart(kind(*pins, **more))) or lines[-1]

    bench = Bench("goob_imu", port=SAMD21_OFFICIAL, change=slow)
    (line,) = lines
    assert bench.robot.ctrl_c, "USB is free there, so Ctrl-C may be let in"
    assert line.baudrate == 115200
    bench.board.console.type(ASK)
    for _ in range(3000):
        bench.turn(0.001)
        line.room = min(64.0, line.room + 11.5)
    frames = bench.read(line.sent)
    sequences = [frame.sequence for frame in of(frames, Type.SAMPLE)]
    assert sequences == list(range(1, len(sequences) + 1))
    assert len(sequences) >= 296
    assert len(of(frames, Type.DESCRIBE)) == 1
