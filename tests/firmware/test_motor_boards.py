"""Goob's and Fred's boards, whatever the host does: motors stop in time, nothing blocks the loop, faults reset them.

Also what is different with MicroPython's official image for the XIAO SAMD21, without select and sys.stdin.buffer, and
the loop of every board.
"""

from __future__ import annotations

import random
import re
import runpy
import sys
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import pytest

from pebble.extensions.lab.simulation.micropython.modules.machine import Machine
from pebble.extensions.lab.simulation.micropython.ports import SAMD21_OFFICIAL
from pebble.extensions.lab.simulation.micropython.timers import BoardReset
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Type
from tests.firmware.benches import ASK, Bench, of
from tests.support import ROOT, some

pytestmark = pytest.mark.computing

KINDS = ("goob", "fred")
STARTS = {"goob": 2, "fred": 4}  # pins of motors that come first: Goob's headlights take a timer channel between them


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
    assert pins.index(next(pin for pin in pins if pin not in motor_pins)) == STARTS[kind]
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
    assert bench.board.console.unread > 0
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
            firmware.run(f"{self.kind}/main.py") if main else firmware.module("common.run").run(self._built, {})

    def lines(self, pattern: bytes) -> list[float]:
        """The times of output lines like this."""
        return [when for when, data in self.output for line in data.splitlines() if re.fullmatch(pattern, line)]

    def _built(self, _settings: object) -> Any:
        return self.robot

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


# -- the loop of every board


class WasReset(BaseException):
    """machine.reset() does not return."""


def run(monkeypatch: pytest.MonkeyPatch, **errors: BaseException | type[BaseException]) -> list[Any]:
    """Run the loop with a robot whose third step fails, and ``errors`` of ``stop`` or ``sleep_ms``; return calls."""
    board = Mock()
    board.micropython.const = int
    board.robot.port = None
    board.robot.step.side_effect = (None, None, MemoryError)
    board.robot.stop.side_effect = errors.get("stop")
    board.time.sleep_ms.side_effect = errors.get("sleep_ms")
    board.machine.reset.side_effect = WasReset
    for name in ("machine", "time", "micropython"):
        monkeypatch.setitem(sys.modules, name, getattr(board, name))
    loop = runpy.run_path(str(ROOT / "firmware" / "common" / "run.py"))
    with pytest.raises(KeyboardInterrupt if "sleep_ms" in errors else WasReset):
        loop["run"](lambda _settings: board.robot, {})
    return [(name.rpartition(".")[2], *arguments) for name, arguments, _ in board.mock_calls]


@pytest.mark.parametrize("errors", [{}, {"stop": MemoryError}])
def test_a_robot_that_fails_stops_and_starts_anew_also_if_it_cannot_stop(
    monkeypatch: pytest.MonkeyPatch, errors: dict[str, Any]
) -> None:
    calls = run(monkeypatch, **errors)
    assert calls[:4] == [("kbd_intr", 3), ("sleep_ms", 1000), ("kbd_intr", -1), ("WDT",)], "Ctrl-C works until then"
    assert calls[4:] == [("step",), ("feed",)] * 2 + [("step",), ("stop",), ("reset",)]


def test_who_comes_in_by_that_door_finds_no_watchdog(monkeypatch: pytest.MonkeyPatch) -> None:
    assert ("WDT",) not in run(monkeypatch, sleep_ms=KeyboardInterrupt)
