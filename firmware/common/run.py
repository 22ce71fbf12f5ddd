"""The main loop of a board: the only place that catches every exception. The motors stop first in any case."""

import time

import machine
from micropython import const, kbd_intr

_WATCHDOG_MS = const(2000)
_INTERRUPT_MS = const(1000)


def run(build, settings: dict) -> None:
    """Make the robot with ``build(settings)``, motors off, and run it. Errors of ``build`` reach the prompt."""
    robot = build(settings)
    if getattr(robot, "ctrl_c", True):  # not where frames of the host may hold its byte: goob_imu/robot.py
        _allow_interrupt()
    watchdog = _watchdog()
    try:
        listen = getattr(getattr(robot, "port", None), "listen", None)
        if listen:  # where reading blocks, a timer runs the turns: common/console.py
            listen(robot, watchdog)
        while True:
            robot.step()
            watchdog.feed()
    except KeyboardInterrupt:
        robot.stop()
        raise
    except Exception:  # noqa: BLE001 - on any error: stop and reset
        try:
            robot.stop()
        finally:
            machine.reset()


def _allow_interrupt() -> None:
    """Allow Ctrl-C for one second without a watchdog, so that `pebble flash` reaches the prompt after a reset."""
    kbd_intr(3)
    time.sleep_ms(_INTERRUPT_MS)
    kbd_intr(-1)


def _watchdog():
    try:
        return machine.WDT(timeout=_WATCHDOG_MS)
    except (TypeError, ValueError):  # an ESP8266 has one fixed timeout, about three seconds
        return machine.WDT()
