"""Which processes a robot has: one table, in the order they start."""

from __future__ import annotations

from typing import Any

from msgspec.json import encode

from pebble.config import Config
from pebble.launcher.program import Program, Stage
from pebble.links import hub_settings
from pebble.transports.registry import BUILT_IN


def programs(config: Config) -> tuple[Program, ...]:
    """The processes of this robot. Hardware comes before links: a motor is told to stop before anyone can steer it."""
    services = config.services
    table = [
        (config.transport.kind == "zenoh", _hub(config)),
        (True, Program("announcer", "pebble.launcher.announcer", (str(config.path),), Stage.NEWS, told=True)),
        *((True, _service(config, "serial_mcu_bridge", Stage.DEVICE, line)) for line in config.serial_instances()),
        (services.av_daemon.enabled, _av_daemon(config)),
        (services.mqtt_bridge.enabled, _service(config, "mqtt_bridge", Stage.LINK, asks=True)),
        (config.transport.mqtt_mirror is not None, _service(config, "mqtt_mirror", Stage.LINK)),
        *((True, _on_demand(config, name)) for name in config.on_demand_programs()),
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


def shared_modules(config: Config) -> tuple[str, ...]:
    """What several programs of this robot import and its launcher does not: once in memory instead of in each."""
    return ("pebble.transports.frames", "pebble.media.sound") if config.media_programs() else ()


def _service(config: Config, name: str, stage: Stage, instance: str = "", **more: Any) -> Program:
    arguments = (str(config.path), instance) if instance else (str(config.path),)
    return Program(f"{name}:{instance}" if instance else name, f"pebble.services.{name}", arguments, stage, **more)


def _av_daemon(config: Config) -> Program:
    section = config.services.av_daemon
    return _service(config, "av_daemon", Stage.DEVICE, preloaded=False, environment=section.env, folder=section.cwd)


def _on_demand(config: Config, name: str) -> Program:
    """Started when the bridge wants it: pictures and sound for operators."""
    if name == "video_stream":
        return _service(config, name, Stage.LINK, on_demand=True)
    bridge = config.services.mqtt_bridge
    control = bridge.video_control if name == "camera_publisher" else bridge.audio_control
    own = control.receiver_env if name == "audio_receiver" else control.publisher_env
    return _service(
        config,
        name,
        Stage.LINK,
        on_demand=True,
        preloaded=False,
        environment={**control.env, **own},
        stop_timeout_s=control.stop_timeout,
    )


def _hub(config: Config) -> Program:
    settings = encode(hub_settings(config), enc_hook=str).decode()  # paths and numbers: nothing secret is in them
    return Program("zenoh_hub", "pebble.hub", (settings,), Stage.FABRIC)
