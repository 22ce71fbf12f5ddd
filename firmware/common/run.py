"""The endless loop on a board. The only place that catches everything: whatever happens, the motors stop first."""

import time

import machine
from micropython import kbd_intr

_WATCHDOG_MS = 2000
_DOOR_MS = 1000


def run(build, settings: dict) -> None:
    """``build(settings)`` makes the robot, motors off. Its errors reach the prompt: nothing moves yet."""
    robot = build(settings)
    if getattr(robot, "door", True):
        _leave_door_open()
    watchdog = _watchdog()
    try:
        listen = getattr(getattr(robot, "port", None), "listen", None)
        if listen:  # where reading waits, a timer makes the turns: common/console.py
            listen(robot, watchdog)
        while True:
            robot.step()
            watchdog.feed()
    except KeyboardInterrupt:
        robot.stop()
        raise
    except Exception:  # noqa: BLE001 - whatever it is: stop and start anew
        try:
            robot.stop()
        finally:
            machine.reset()


def _leave_door_open() -> None:
    """One second in which Ctrl-C leads to the prompt, and no watchdog runs: so `pebble flash` gets in after a reset."""
    kbd_intr(3)
    time.sleep_ms(_DOOR_MS)
    kbd_intr(-1)


def _watchdog():
    try:
        return machine.WDT(timeout=_WATCHDOG_MS)
    except (TypeError, ValueError):  # an ESP8266 has one time only, about three seconds
        return machine.WDT()
