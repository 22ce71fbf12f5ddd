"""Which processes a robot has: one table, in the order they start."""

import gc
import logging
import os
from collections.abc import Iterable
from enum import IntEnum
from importlib import import_module
from typing import Any

from msgspec import Struct
from msgspec.json import encode

from pebble.config import Config, SerialBridge
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.runtime.connections import hub_settings
from pebble.transports import module_of

log = logging.getLogger(__name__)


class Stage(IntEnum):
    """Programs of one stage stop together; the highest stage stops first."""

    LOCAL_TRANSPORT = 0  # what the others publish through
    ANNOUNCER = 1  # publishes how the others ended
    DEVICE = 2  # owns hardware
    CONNECTION = 3  # is connected to other machines


class Program(Struct, frozen=True):
    """One process: its name in logs and status, and the module that it runs with ``arguments``, as ``python -m`` would.

    The launcher imports the module, or ``entry``, before it forks: importing must do nothing. What that module imports
    later, because only some robots need it, is in the memory of those robots only.
    """

    name: str
    module: str
    arguments: tuple[str, ...]
    stage: Stage
    reads_announcer_pipe: bool = False  # on its stdin; the others' stdin is empty
    runs_scripts: bool = False  # lines of its output may be a script's
    may_request: bool = False  # may request on-demand programs
    on_demand: bool = False  # runs only while it is requested
    preloaded: bool = True  # False: its imports are needed by few, and would cost every process their memory
    entry: str = ""  # what the package that is run begins with; "": the module is no package
    stop_timeout_s: float = 10.0  # after this an on-demand program that was released is killed


def programs(config: Config) -> tuple[Program, ...]:
    """The processes of this robot.

    Devices start before connections, so that a motor has received its stop before any command can arrive.
    """
    services, mirror = config.services, config.transport.mqtt_mirror
    table = [
        (config.transport.kind == "zenoh", _hub(config)),
        (True, _announcer(config)),
        *((True, _serial_line(config, *line)) for line in config.serial_instances().items()),
        (services.av_daemon.enabled, _av_daemon(config)),
        (services.autonomy_manager.enabled, _package(config, "autonomy_manager", Stage.CONNECTION, runs_scripts=True)),
        (services.mqtt_bridge.enabled, _package(config, "mqtt_bridge", Stage.CONNECTION, may_request=True)),
        (mirror is not None, _package(config, "mqtt_mirror", Stage.CONNECTION)),
        (services.soundboard_handler.enabled, _package(config, "soundboard_handler", Stage.CONNECTION)),
        (services.web_handler.enabled, _web_handler(config)),
        (services.neighbours.enabled, _service(config, "neighbours", Stage.CONNECTION, preloaded=False)),
        (services.recorder.enabled, _service(config, "recorder", Stage.CONNECTION, preloaded=False)),
        *((True, _on_demand(config, name)) for name in config.on_demand_programs()),
    ]
    return tuple(program for enabled, program in table if enabled)


def shared_modules(config: Config, table: Iterable[Program]) -> list[str]:
    """The modules to import before the first fork: what the programs run, and what several of them use."""
    media = ["pebble.transports.frames", "pebble.extensions.media.sound"] if config.media_programs() else []
    return [*_transport_modules(config), *media, *(one.entry or one.module for one in table if one.preloaded)]


def preload(modules: Iterable[str]) -> None:
    """Import ``modules``: what is in memory before a fork, parent and children share.

    A module that cannot be imported is left to the process that runs it, which reports what is wrong.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # else numpy starts threads, and no fork may follow
    for name in modules:
        try:
            import_module(name)
        except Exception:
            log.debug("%s cannot be imported", name, exc_info=True)
    gc.collect()
    gc.freeze()  # a collection writes into every object it visits, and a page that is written to is no longer shared


def _transport_modules(config: Config) -> tuple[str, ...]:
    """The modules of Pebble's own transports that some process of this robot opens."""
    bridge = config.services.mqtt_bridge
    kinds = {config.transport.kind}
    if config.transport.mqtt_mirror is not None:
        kinds.add("mqtt")
    if bridge.enabled:
        kinds.add("mqtt" if bridge.remote is None else bridge.remote.kind)
    return tuple(module for kind in sorted(kinds) if (module := module_of(kind)) is not None)


def program_of(instance: str, name: str = "serial_mcu_bridge") -> str:
    """The name of the program of a serial line, or of another service's instance."""
    return f"{name}:{instance}" if instance else name


def _service(config: Config, name: str, stage: Stage, instance: str = "", **more: Any) -> Program:
    arguments = (str(config.path), instance) if instance else (str(config.path),)
    return Program(program_of(instance, name), f"pebble.services.{name}", arguments, stage, **more)


def _package(config: Config, name: str, stage: Stage, **more: Any) -> Program:
    return _service(config, name, stage, entry=f"pebble.services.{name}.service", **more)


def _serial_line(config: Config, instance: str, line: SerialBridge) -> Program:
    """Its process imports the bridge of its protocol, not those of others."""
    entry = SERIAL_PROTOCOLS[line.protocol].module
    return _service(config, "serial_mcu_bridge", Stage.DEVICE, instance, entry=entry)


def _av_daemon(config: Config) -> Program:
    return _service(config, "av_daemon", Stage.DEVICE, preloaded=False)


def _web_handler(config: Config) -> Program:
    """The operator page; its module is above the launcher, which only starts it, and may miss what it imports."""
    arguments = (str(config.path),)
    return Program("web_handler", "pebble.extensions.page.run", arguments, Stage.CONNECTION, preloaded=False)


def _on_demand(config: Config, name: str) -> Program:
    """A program that the bridge requests while operators want its video or audio."""
    if name == "video_stream":
        return _package(config, name, Stage.CONNECTION, on_demand=True)
    return _service(config, name, Stage.CONNECTION, on_demand=True, preloaded=False)


def _announcer(config: Config) -> Program:
    arguments = (str(config.path),)
    return Program("announcer", "pebble.launcher.announcer", arguments, Stage.ANNOUNCER, reads_announcer_pipe=True)


def _hub(config: Config) -> Program:
    settings = encode(hub_settings(config), enc_hook=str).decode()  # paths and numbers: nothing secret is in them
    return Program("zenoh_hub", "pebble.runtime.hub", (settings,), Stage.LOCAL_TRANSPORT)
