"""Which processes a robot has: one table, in the order they start."""

from __future__ import annotations

from msgspec.json import encode

from pebble.config import Config
from pebble.launcher.program import Program, Stage
from pebble.links import hub_settings
from pebble.transports.registry import BUILT_IN


def programs(config: Config) -> tuple[Program, ...]:
    """The processes of this robot. Hardware comes before links: a motor is told to stop before anyone can steer it."""
    table = [
        (config.transport.kind == "zenoh", _hub(config)),
        (True, Program("announcer", "pebble.launcher.announcer", (str(config.path),), Stage.NEWS, told=True)),
        *((True, _service(config, "serial_mcu_bridge", Stage.DEVICE, line)) for line in config.serial_instances()),
        (config.services.mqtt_bridge.enabled, _service(config, "mqtt_bridge", Stage.LINK)),
        (config.transport.mqtt_mirror is not None, _service(config, "mqtt_mirror", Stage.LINK)),
    ]
    return tuple(program for wanted, program in table if wanted)


def transport_modules(config: Config) -> tuple[str, ...]:
    """The modules of our own transports that some process of this robot opens."""
    bridge = config.services.mqtt_bridge
    kinds = {config.transport.kind}
    if config.transport.mqtt_mirror is not None:
        kinds.add("mqtt")
    if bridge.enabled:
        kinds.add("mqtt" if bridge.remote is None else bridge.remote.kind)
    return tuple(BUILT_IN[kind].partition(":")[0] for kind in sorted(kinds) if kind in BUILT_IN)


def _service(config: Config, name: str, stage: Stage, instance: str = "") -> Program:
    arguments = (str(config.path), instance) if instance else (str(config.path),)
    return Program(f"{name}:{instance}" if instance else name, f"pebble.services.{name}", arguments, stage)


def _hub(config: Config) -> Program:
    settings = encode(hub_settings(config), enc_hook=str).decode()  # paths and numbers: nothing secret is in them
    return Program("zenoh_hub", "pebble.hub", (settings,), Stage.FABRIC)
