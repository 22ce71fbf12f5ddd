"""The capabilities of a robot, with effective topics, from its config (paper A.8.6)."""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import Any

import msgspec
from msgspec import UNSET

from pebble import contract as c
from pebble.config import Config, SystemControl
from pebble.contract import capabilities as offers
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.errors import PebbleError
from pebble.extension import call
from pebble.runtime.addresses import Addresses
from pebble.runtime.process import view_of

log = logging.getLogger(__name__)


def capabilities(
    config: Config, addresses: Addresses, lacking: Collection[str] = (), found: Collection[str] = ()
) -> dict[str, Any]:
    """Return the ``value`` of a capabilities message, completed by extensions.

    ``lacking`` and ``found`` are features that the robot's processes report now (pebble.launcher.features).
    """
    drive, estop, lights, telemetry = _motor(config, addresses, lacking)
    value = offers.CapabilitiesValue(
        identity=_identity(config),
        transport=offers.TransportOffer(kind=config.transport.kind),
        system=_system(config, addresses),
        drive=drive,
        estop=estop,
        lights=lights,
        telemetry=telemetry,
        outlets=_outlets(config, found),
        named=config.security.named or UNSET,
    )
    for extension in config.installed:
        if extension.offers:
            try:
                value = call(extension, "offers", offers.CapabilitiesValue, config, value)
            except PebbleError as error:  # the rest of the robot has something to offer
                log.error("%s", error)
    built: dict[str, Any] = msgspec.to_builtins(value)
    return built


def _identity(config: Config) -> offers.RobotIdentity:
    robot = config.robot
    looks = {key: getattr(robot, key) for key in ("name", "description", "colour", "picture", "battery_cells")}
    known_looks: dict[str, Any] = {key: value for key, value in looks.items() if value is not None}
    return offers.RobotIdentity(system=robot.system, type=robot.type, id=robot.id, **known_looks)


def _system(config: Config, addresses: Addresses) -> offers.SystemOffer:
    bridge = config.services.mqtt_bridge

    def flag(control: SystemControl, channel: c.Channel) -> offers.FlagOffer:
        controls = bridge.enabled and bool(control.command)
        return offers.FlagOffer(available=True, controls=controls, flag_topic=addresses[channel].topic)

    return offers.SystemOffer(
        reboot=flag(bridge.reboot_control, c.REBOOT),
        service_restart=flag(bridge.service_restart_control, c.SERVICE_RESTART),
        git_pull=flag(bridge.git_pull_control, c.GIT_PULL),
    )


def _motor(
    config: Config, addresses: Addresses, lacking: Collection[str]
) -> tuple[offers.DriveOffer, offers.EstopOffer, offers.LightsOffer, offers.TelemetryOffer]:
    """Return the offers of the motor MCU's line: drive, stop, lights and telemetry. ``lacking``: see `capabilities`."""
    lines, owned = config.motor_lines(), bool(config.motor_owners)
    present = bool(lines)
    name = next(iter(lines), "")  # the first of several lines; "": the section is the only line, or there is none
    line = lines.get(name, config.services.serial_mcu_bridge)
    if name:
        addresses = Addresses(view_of(config, name))
    drive = offers.DriveOffer(
        available=owned,
        controls=owned,
        topic=addresses[c.DRIVE].topic,
        arbitrates=owned or UNSET,
        axes=["x", "z"] if owned else UNSET,  # a line has speeds of two wheels
        control=(owned and "control" not in lacking) or UNSET,
    )
    lights = offers.LightsOffer(
        solid=present,
        flash=present,
        solid_topic=addresses[c.LIGHTS_SOLID].topic,
        flash_topic=addresses[c.LIGHTS_FLASH].topic,
    )
    imu, imu_topic = _imu(config)
    touch = present and line.telemetry.publish_touch_sensors
    telemetry = offers.TelemetryOffer(
        touch_sensors=touch,
        charging_status=present,
        touch_topic=addresses[c.TOUCH_SENSORS].topic,
        charging_topic=addresses[c.CHARGING_STATUS].topic,
        charging_level_topic=addresses[c.CHARGING_LEVEL].topic,
        wheel_odometry=False,  # unless an extension offers it
        wheel_odometry_topic=addresses[c.WHEEL_ODOMETRY].topic,
        imu=imu,
        imu_topic=imu_topic,
    )
    stoppable = [] if "estop" in lacking else [*config.motor_owners]
    return drive, _estop(config, stoppable), lights, telemetry


def _estop(config: Config, owners: list[str]) -> offers.EstopOffer:
    """Return the offer of an emergency stop, with the topics of ``owners``; not available if there are none."""
    return offers.EstopOffer(
        available=bool(owners),
        topic=c.ESTOP.topic(config.base),
        reset_topic=c.ESTOP_RESET.topic(config.base),
        owners=owners,
        status_topics=[c.ESTOP_STATE.topic(config.base, owner=owner) for owner in owners],
    )


def _imu(config: Config) -> tuple[bool, str]:
    """Return (whether a serial line has an inertial sensor, the sensor's topic)."""
    lines = [name for name, line in config.serial_instances().items() if SERIAL_PROTOCOLS[line.protocol].has_imu(name)]
    addresses = Addresses(view_of(config, lines[0]) if lines else config)
    return bool(lines), addresses[c.IMU].topic


def _outlets(config: Config, features: Collection[str]) -> offers.OutletsOffer:
    """Return the power outlets in use, with their topics. ``features``: ``outlets/NAME/power`` or status of each."""
    topics_of: dict[str, dict[str, str]] = {}  # by the outlet's name
    for key, channel in (("status_topic", c.OUTLET_STATUS), ("command_topic", c.OUTLET_COMMAND)):
        for feature in sorted(features):
            if name := channel.names(f"{config.base}/{channel.direction}/{feature}").get("outlet"):
                topics_of.setdefault(name, {})[key] = channel.topic(config.base, outlet=name)
    outlets = [
        offers.OutletOffer(name=name, controls="command_topic" in topics, **topics)
        for name, topics in sorted(topics_of.items())
    ]
    controls = any(outlet.controls for outlet in outlets)
    return offers.OutletsOffer(available=bool(outlets), controls=controls, outlets=outlets)
