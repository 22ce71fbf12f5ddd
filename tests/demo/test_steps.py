"""The assessment of a step, with simulated robots that obey and that misbehave."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pebble.demo.operator import COMMAND_PERIOD_S, SCRIPT, CompletedStep, Step, wheels_of
from pebble.demo.steps import StepResult, assess
from pebble.services.serial_mcu_bridge.text.goob_base import STOP, drive_line, lights_line
from pebble.simulation.board import SimulatedMcu
from pebble.simulation.mcu import Snapshot
from pebble.simulation.trace import Entry

TICK_S = 0.01
BEGAN = 100.0


@dataclass
class Performance:
    """A robot that carries out a step, with selectable faults."""

    kind: str = "goob"
    deaf: bool = False  # no command arrives
    mirrored: bool = False  # left for right, ahead for back
    stop_after_s: float | None = 0.02  # from the operator's last act to the stop line; None: there is none
    late_start_s: float = 0.0
    dark: bool = False
    lightless: bool = False

    def of(self, step: Step) -> StepResult:
        mcu = SimulatedMcu(self.kind, BEGAN, failsafe_s=5.0)
        script = self._lines(step)
        reports, entries = [], []
        motors = (0.0, 0.0)
        ended = BEGAN + step.drive_s + step.rest_s
        for tick in range(round((ended - BEGAN) / TICK_S)):
            now = BEGAN + tick * TICK_S
            while script and script[0][0] <= now:
                at, line = script.pop(0)
                mcu.receive(line, now)
                entries.append(Entry(round(at * 1e9), "line", line.decode().strip()))
            mcu.tick(now)
            if mcu.state().drive != motors:
                motors = mcu.state().drive
                entries.append(Entry(round(now * 1e9), "motors", f"{motors[0]:.3f} {motors[1]:.3f}"))
            if tick % 10 == 0:
                reports.append(Snapshot(round(now * 1e9), True, True, mcu.state()))
        done = CompletedStep(self.kind, step, BEGAN, self._released(step), ended)
        return assess(done, reports, entries, stop_s=0.85, has_lights=not self.lightless)

    def _released(self, step: Step) -> float:
        return BEGAN + step.drive_s - (0.0 if step.sends_stop else COMMAND_PERIOD_S)

    def _lines(self, step: Step) -> list[tuple[float, bytes]]:
        lines = [] if self.dark else [(BEGAN, lights_line(0.0, 1.0, 0.0))]
        if self.deaf:
            return lines
        sign = -1 if self.mirrored else 1
        drive = drive_line(*(sign * wheel for wheel in wheels_of(step.drive)))
        count = round((step.drive_s - self.late_start_s) / COMMAND_PERIOD_S)
        lines += [(BEGAN + self.late_start_s + index * COMMAND_PERIOD_S, drive) for index in range(count)]
        if self.stop_after_s is not None:
            lines.append((self._released(step) + self.stop_after_s, STOP))
        return lines


@pytest.mark.parametrize("step", SCRIPT, ids=lambda step: step.name)
@pytest.mark.parametrize("kind", ["goob", "fred"])
def test_a_robot_that_obeys_is_right(kind: str, step: Step) -> None:
    assert Performance(kind).of(step).wrong == ()


@pytest.mark.parametrize("step", SCRIPT, ids=lambda step: step.name)
def test_a_stop_as_late_as_the_watchdogs_is_right(step: Step) -> None:
    assert Performance(stop_after_s=0.775).of(step).wrong == ()


@pytest.mark.parametrize("step", SCRIPT, ids=lambda step: step.name)
@pytest.mark.parametrize(
    ("performance", "complaint"),
    [
        (Performance(deaf=True), "never seen: the wheels turned"),
        (Performance(mirrored=True), "never seen: the wheels turned"),
        (Performance(stop_after_s=None), "never seen: the motors stopped"),
        (Performance(stop_after_s=None), "the wheels still turned at the end"),
        (Performance(dark=True), "no light was switched"),
    ],
    ids=["deaf", "mirrored", "unstoppable", "rolling", "dark"],
)
def test_what_a_robot_does_wrong_is_named(performance: Performance, complaint: str, step: Step) -> None:
    assert complaint in performance.of(step).wrong


def test_a_late_stop_is_wrong() -> None:
    (wrong,) = Performance(stop_after_s=0.9).of(SCRIPT[0]).wrong
    assert wrong in ("the motors stopped only after 0.90 s", "the motors stopped only after 0.91 s")  # seen each 10 ms


def test_a_late_start_is_wrong() -> None:
    assert any("the wheels turned only after 1.1" in line for line in Performance(late_start_s=1.0).of(SCRIPT[0]).wrong)


def test_a_way_too_short_is_wrong() -> None:
    assert any("mm ahead instead of about" in line for line in Performance(late_start_s=0.8).of(SCRIPT[0]).wrong)


def test_an_unseen_robot_is_wrong_in_every_respect() -> None:
    result = assess(CompletedStep("goob", SCRIPT[0], BEGAN, BEGAN + 1, BEGAN + 2), [], [], stop_s=1.0, has_lights=True)
    assert len(result.wrong) == 5


def test_a_robot_without_lights_may_stay_dark() -> None:
    assert Performance(dark=True, lightless=True).of(SCRIPT[0]).wrong == ()
