"""What must hold on Goob's and Fred's boards whatever the host does: motors stop in time, nothing blocks the loop."""

from __future__ import annotations

import random
from typing import Any

import pytest

from pebble.simulation.bodies import body_of
from pebble.simulation.micropython.board import Board
from pebble.simulation.micropython.clock import VirtualClock

KINDS = ("goob", "fred")
Motors = tuple[float, float]


class Bench:
    """A board whose loop turns every millisecond of a virtual clock, which moves by itself if something blocks."""

    def __init__(self, kind: str) -> None:
        self.clock = VirtualClock()
        self.board = Board(self.clock)
        self.body = body_of(kind, self.board)
        self.motors: list[tuple[float, Motors]] = []
        self.body.on_motors = lambda now, motors: self.motors.append((now, motors))
        self.robot = self.board.load(kind, {})
        self.turns = 0

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1000)):
            self.turns += 1
            self.clock.advance(0.001)
            self.robot.step()
            self.body.end_turn()

    def send(self, line: bytes) -> None:
        self.board.type(line + b"\n")


class NosyBoard(Board):
    """Notes the names of the pins in the order in which the firmware first touches them, and what for."""

    def _modules(self) -> dict[str, Any]:
        modules = super()._modules()
        machine = modules["machine"]
        self.touched: list[tuple[str, str]] = []

        def noting(name: str, kind: Any) -> Any:
            def make(pin: Any, *arguments: Any, **settings: Any) -> Any:
                self.touched.append((name, pin if isinstance(pin, str) else pin.name))
                return kind(pin, *arguments, **settings)

            for constant in ("IN", "OUT", "PULL_DOWN", "PULL_UP"):
                setattr(make, constant, getattr(kind, constant, None))
            return make

        machine.Pin, machine.PWM, machine.ADC = (noting(name, getattr(machine, name)) for name in ("Pin", "PWM", "ADC"))
        return modules


@pytest.mark.parametrize("kind", KINDS)
def test_the_motors_come_first(kind: str) -> None:
    board = NosyBoard(VirtualClock())
    body = body_of(kind, board)
    board.load(kind, {})
    motor_pins = {*body.pins.LEFT, *body.pins.RIGHT}
    pins = list(dict.fromkeys(pin for _, pin in board.touched))
    first = pins.index(next(pin for pin in pins if pin not in motor_pins))
    expected = 2 if kind == "goob" else 4  # Goob's headlights take their timer channel between the motors
    assert first == expected
    assert all(board.duty(pin) == 0.0 for pin in motor_pins)
    assert [name for name, _ in board.touched][:4].count("ADC") == 0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("half", [b"M 0.900", b"M 0.400 0."])
def test_half_a_line_of_a_dead_host_moves_nothing(kind: str, half: bytes) -> None:
    bench = Bench(kind)
    bench.board.type(half)
    bench.run(0.25)
    bench.send(b"M 0.000 0.000")
    bench.run(0.1)
    assert all(motors == (0.0, 0.0) for _, motors in bench.motors)
    bench.send(b"M 0.500 0.500")
    bench.run(0.1)
    assert any(bench.motors[-1][1])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(20))
def test_motors_stop_a_second_after_the_last_command(kind: str, seed: int) -> None:
    bench = Bench(kind)
    chance = random.Random(seed)
    last = 0.0
    for _ in range(20):
        bench.send(b"M %.3f %.3f" % (chance.uniform(0.1, 1.0), chance.uniform(0.1, 1.0)))
        bench.send(chance.choice([b"L 1 1 1", b"F 0 1 0 0.1", b"nonsense", b"x" * 300, b"M", b""]))
        last = bench.clock.now()
        bench.run(chance.uniform(0.0, 0.9))
    bench.run(2.0)
    stopped, motors = bench.motors[-1]
    assert motors == (0.0, 0.0)
    assert 0.999 <= stopped - last <= 1.02


@pytest.mark.parametrize("kind", KINDS)
def test_a_host_that_does_not_read_blocks_nothing(kind: str) -> None:
    bench = Bench(kind)
    bench.board.console.reading = False
    bench.run(20.0)
    bench.send(b"M 0.5 0.5")
    bench.run(0.1)
    assert bench.motors[-1][1] != (0.0, 0.0)
    bench.run(2.0)
    moved, stopped = bench.motors
    assert stopped[1] == (0.0, 0.0)
    assert stopped[0] - moved[0] == pytest.approx(1.0, abs=0.005)
    assert bench.clock.now() == pytest.approx(bench.turns / 1000), "no turn waited for anything"


@pytest.mark.parametrize("kind", KINDS)
def test_lines_stay_whole_when_the_host_was_away(kind: str) -> None:
    bench = Bench(kind)
    bench.board.console.reading = False
    bench.run(20.0)
    bench.board.console.reading = True
    bench.run(3.0)
    output = bench.board.take_output()
    assert bench.board.console.lost == 0
    *lines, rest = output.split(b"\r\n")
    assert rest == b""
    assert {line.split()[0] for line in lines} <= {b"Starting", b"Done!", b"T", b"C"}
    assert all(line.count(b"=") == (3 if kind == "goob" else 4) for line in lines if line.startswith(b"T"))


@pytest.mark.parametrize("kind", KINDS)
def test_ctrl_c_does_not_stop_the_firmware(kind: str) -> None:
    bench = Bench(kind)
    bench.run(0.01)
    bench.board.take_output()
    bench.board.type(b"\x03\x03\nM 0.5 0.5\n")
    bench.run(0.05)
    assert b"ERR unknown command\r\nOK M\r\n" in bench.board.take_output()
    assert bench.motors[-1][1] != (0.0, 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_flood_does_not_keep_the_motors_running(kind: str) -> None:
    bench = Bench(kind)
    bench.send(b"M 1 1")
    bench.run(0.05)
    bench.board.type(b"x" * 1_000_000)
    bench.run(2.0)
    assert bench.board.unread > 0
    (began, _), (stopped, motors) = bench.motors
    assert motors == (0.0, 0.0)
    assert stopped - began == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_noise(kind: str) -> None:
    bench = Bench(kind)
    chance = random.Random(3)
    for _ in range(20_000):
        bench.board.type(chance.randbytes(chance.randrange(30)) + chance.choice([b"\n", b"\r\n", b" ", b""]))
        bench.robot.step()
        bench.board.take_output()
    bench.board.type(b"\n")
    while bench.board.unread:
        bench.robot.step()
    bench.board.take_output()
    bench.send(b"M 0.5 0.5")
    bench.run(0.02)
    assert b"OK M\r\n" in bench.board.take_output()


def test_goobs_headlights_show_the_brightest_part() -> None:
    bench = Bench("goob")
    bench.send(b"L 0.1 0.6 0.3")
    bench.run(0.1)
    assert bench.body.light().red == pytest.approx(0.6, abs=0.001)
    bench.send(b"L 0 0 0")
    bench.run(0.1)
    assert bench.body.light().red == 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_lights_fade(kind: str) -> None:
    bench = Bench(kind)
    bench.send(b"F 0 0 1 1")
    seen = []
    for _ in range(40):
        bench.run(0.05)
        seen.append(bench.body.light().red)
    assert max(seen) > 0.9
    assert min(seen) < 0.1
    assert seen[:20] == pytest.approx(seen[20:], abs=0.1)


def test_fred_shows_three_colours() -> None:
    bench = Bench("fred")
    bench.send(b"L 0.25 0.5 1")
    bench.run(0.1)
    light = bench.body.light()
    assert (light.blue, light.green, light.red) == pytest.approx((0.25, 0.5, 1.0), abs=0.001)


def test_freds_motors_and_lights_share_no_signal() -> None:
    """Seven signals on six timer channels: a motor's two pins take turns on one."""
    bench = Bench("fred")
    bench.send(b"L 0.25 0.5 0.75")
    bench.run(0.4)
    for left, right in ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (0.0, 0.0), (-1.0, -1.0), (0.5, -0.25)):
        bench.run(0.4)
        bench.send(b"M %.3f %.3f" % (left, right))
        bench.run(0.05)
        light = bench.body.light()
        assert (light.blue, light.green, light.red) == pytest.approx((0.25, 0.5, 0.75), abs=0.001)
        for wish, pins in ((left, bench.body.pins.LEFT), (right, bench.body.pins.RIGHT)):
            ahead, back = (bench.board.duty(pin) for pin in pins)
            assert (ahead > 0, back > 0) == (wish > 0, wish < 0)
