"""Publishes where the robot is, from its wheels' hall sensors and what its motors are commanded."""

import json
import queue
import time
from collections.abc import Callable
from typing import Annotated, Any

from msgspec import Meta, convert
from msgspec.json import decode
from msgspec.structs import replace

from pebble import Robot, run
from pebble.contract import IMU_FAST, MOTOR_POWER, TOUCH_SENSORS, WHEEL_ODOMETRY
from pebble.contract.payloads import WheelOdometry
from pebble.extensions.scripts.perception.odometry import (
    CALIBRATION,
    Calibration,
    Odometry,
    OdometrySettings,
    calibrated,
)
from pebble.extensions.scripts.perception.rate import Rate
from pebble.runtime.rate_limit import RateLimitedLog

TUNE_STATE = "auto_tune_state.json"  # in the config's folder
WAITING = 500  # inputs: 3 s of samples
SILENCE_S = 3.0  # without a sample: none is published
NO_SAMPLES = "no hall sensors: set services.serial_mcu_bridge.telemetry.publish_touch_sensors to true"


def main(robot: Robot, options: OdometrySettings) -> None:
    odometry = Odometry(tuned(robot, options), time.monotonic())
    inputs: queue.Queue[tuple[Callable[..., None], Any, float]] = queue.Queue(WAITING)

    log = RateLimitedLog(robot.log)

    def take(method: Callable[..., None]) -> Callable[..., None]:
        """Return a handler that queues a call: samples and commands are handled in the order of their arrival."""

        def receive(value: Any, **_: str) -> None:
            try:
                inputs.put_nowait((method, value, time.monotonic()))
            except queue.Full:
                log.warning("busy", "too busy: samples are lost, and the position with them")

        return receive

    def touched(touch: Any, now: float) -> None:
        odometry.touch(touch.value, now)

    robot.on(MOTOR_POWER, take(odometry.power))
    robot.on(TOUCH_SENSORS, take(touched))
    robot.on(IMU_FAST, take(odometry.imu))
    rate = Rate(options.publish_rate_hz)
    silent_at: float | None = time.monotonic() + SILENCE_S  # None: a sample has arrived, or the warning is logged
    while True:
        try:
            method, value, now = inputs.get(timeout=0.05)
            method(value, now)
            if method is touched:
                silent_at = None
        except queue.Empty:
            robot.sleep(0)  # raises Stopped when the script must end
            now = time.monotonic()
        if silent_at is not None and now >= silent_at:
            silent_at = None
            robot.log.warning(NO_SAMPLES)
        rate.hz = options.publish_rate_hz if odometry.moving(now) else options.idle_publish_rate_hz
        if rate.due(now):
            payload = WheelOdometry(source=WHEEL_ODOMETRY.metric, value=odometry.value(), timestamp=time.time())
            robot.publish(WHEEL_ODOMETRY, payload)


def tuned(robot: Robot, options: OdometrySettings) -> OdometrySettings:
    """Return the settings with the calibration in the config's folder.

    Without it, ``use_tune_state`` takes the track width from the tuning program of the original Pebble.
    """
    try:
        raw = (robot.config.folder / CALIBRATION).read_bytes()
        return calibrated(options, decode(raw, type=Calibration))
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        robot.log.warning("%s: %s; the geometry counts", CALIBRATION, error)
    width_mm = tuned_width_mm(robot) if options.use_tune_state else None
    return replace(options, track_width_mm=width_mm or options.track_width_mm)


def tuned_width_mm(robot: Robot) -> float | None:
    """Return the track's width by the original's tuning program, None if it has none.

    Its step lengths are not used: they are 0.5 to 0.6 of the truth, as that program counts steps twice.
    """
    try:
        width_mm = json.loads((robot.config.folder / TUNE_STATE).read_bytes())["current_values"]["track_width_mm"]
        width_mm = convert(width_mm, Annotated[float, Meta(gt=0, le=5000)])
    except (OSError, ValueError, KeyError, TypeError) as error:
        robot.log.warning("%s: %s; the geometry counts", TUNE_STATE, error)
        return None
    robot.log.warning("%s: only track_width_mm is used: the program that wrote it counts steps twice", TUNE_STATE)
    return float(width_mm)


if __name__ == "__main__":
    run(
        main,
        label="Wheel odometry",
        summary="Works out where the robot is from its turning wheels, and draws it on the map.",
        main_options=("wheel_diameter_mm", "track_width_mm", "magnets"),
        drives=False,
    )
