"""What must hold on Goob's and Fred's boards whatever the host does: motors stop in time, nothing blocks the loop."""

from __future__ import annotations

import random
from typing import Any

import pytest

from pebble.extensions.lab.simulation.micropython.modules.machine import Machine
from tests.firmware.benches import Bench
from tests.support import some

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


@pytest.mark.parametrize("half", [b"M 0.900", b"M 0.400 0."])
def test_half_a_line_of_a_dead_host_moves_nothing(bench: Bench, half: bytes) -> None:
    bench.board.console.type(half)
    bench.turn(0.25)
    bench.send(b"M 0.000 0.000")
    bench.turn(0.1)
    assert all(motors == (0.0, 0.0) for _, motors in bench.motors)
    bench.send(b"M 0.500 0.500")
    bench.turn(0.1)
    assert any(bench.motors[-1][1])


@pytest.mark.parametrize("seed", some(range(20), 7))
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


@pytest.mark.parametrize(
    ("kind", "line", "shown"),
    [
        ("goob", b"L 0.1 0.6 0.3", (0.6, 0.6, 0.6)),  # one colour: as bright as the brightest part
        ("goob", b"L 0 0 0", (0.0, 0.0, 0.0)),
        ("fred", b"L 0.25 0.5 1", (0.25, 0.5, 1.0)),
    ],
)
def test_lights_glow(kind: str, line: bytes, shown: tuple[float, float, float]) -> None:
    bench = Bench(kind)
    bench.send(line)
    bench.turn(0.1)
    assert bench.body.light() == pytest.approx(shown, abs=0.001)


def test_freds_motors_and_lights_share_no_signal() -> None:
    """Seven signals on six timer channels: a motor's two pins take turns on one."""
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
