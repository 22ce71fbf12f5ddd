"""The processes of a robot, those of extensions included, in the order in which they are started."""

import gc
import logging
import os
from collections.abc import Iterable, Iterator
from importlib import import_module

from pebble.config import Config
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.extension import Program, Stage, programs_of
from pebble.transports import module_of

log = logging.getLogger(__name__)


def programs(config: Config) -> tuple[Program, ...]:
    """Return the processes of this robot. Raises ConfigError if two have the same name.

    Devices start before connections: motors have received a stop before any command can arrive.
    """
    core = [program for enabled, program in _core(config) if enabled]
    of_extensions = programs_of(config.installed, config, core=(program.name for program in core))
    return tuple(sorted([*core, *of_extensions], key=lambda program: (program.on_demand, program.stage)))


def _core(config: Config) -> Iterator[tuple[bool, Program]]:
    """Yield Pebble's own processes, each with True if this robot runs it."""
    bridge, mirror = config.services.mqtt_bridge, config.transport.mqtt_mirror
    yield True, _announcer(config)
    arguments = (str(config.path),)
    for instance, line in config.serial_instances().items():
        words = (*arguments, instance) if instance else arguments
        yield True, Program(program_of(instance), SERIAL_PROTOCOLS[line.protocol].service, words, Stage.DEVICE)
    shares: list[str] = []  # modules of extensions that the bridge loads
    for extension in config.installed:
        places = (extension.observer, extension.step, extension.private, *extension.requests)
        shares += [place.partition(":")[0] for place in places if place]
    service = "pebble.services.mqtt_bridge.service:MqttBridge"
    yield bridge.enabled, Program("mqtt_bridge", service, arguments, may_request=True, shares=tuple(shares))
    yield mirror is not None, Program("mqtt_mirror", "pebble.services.mqtt_mirror.service:MqttMirror", arguments)


def shared_modules(config: Config, table: Iterable[Program]) -> list[str]:
    """Return the modules to import before the first fork: those of the programs, and those that programs share."""
    programs = list(table)
    shared = dict.fromkeys(module for program in programs for module in program.shares)
    entries = (program.module.partition(":")[0] for program in programs if program.preloaded)
    return [*_transport_modules(config), *shared, *entries]


def preload(modules: Iterable[str]) -> None:
    """Import ``modules`` in the launcher: children share its memory, as far as it was written before the fork.

    A module that cannot be imported is skipped: the process that runs it reports the error.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # else numpy starts threads, and no fork may follow
    for name in modules:
        try:
            import_module(name)
        except Exception:
            log.debug("%s cannot be imported", name, exc_info=True)
    gc.freeze()  # a collection writes into every object, and a written page is no longer shared
    gc.enable()  # pebble.cli has disabled it: to look for the little garbage of imports takes a tenth of their time


def _transport_modules(config: Config) -> tuple[str, ...]:
    """Return the modules of the transports that a process of this robot opens."""
    bridge = config.services.mqtt_bridge
    kinds = {config.transport.kind}
    if config.transport.mqtt_mirror is not None:
        kinds.add("mqtt")
    if bridge.enabled:  # without ``remote`` its remote side is ``remote_mqtt``
        kinds.add("mqtt" if bridge.remote is None else bridge.remote.kind)
    modules = map(module_of, sorted(kinds))
    return tuple(module for module in modules if module is not None)


def program_of(instance: str) -> str:
    """Return the name of the program of a serial line."""
    return f"serial_mcu_bridge:{instance}" if instance else "serial_mcu_bridge"


def _announcer(config: Config) -> Program:
    """Return the program that publishes the launcher's messages; on a Zenoh robot it is the hub as well."""
    has_hub = config.transport.kind == "zenoh"
    name, stage = ("zenoh_hub", Stage.LOCAL_TRANSPORT) if has_hub else ("announcer", Stage.ANNOUNCER)
    hub = ("pebble.runtime.hub",) if has_hub else ()
    arguments = (str(config.path),)
    return Program(name, "pebble.launcher.announcer", arguments, stage, reads_announcer_pipe=True, shares=hub)
