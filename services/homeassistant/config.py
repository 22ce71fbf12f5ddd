"""The config section of Home Assistant."""

from pathlib import Path
from typing import Annotated, Literal

from pebble.config import Config
from pebble.config.problems import Path as Place
from pebble.config.reader import Reader, Rule
from pebble.config.tree import Root
from pebble.config.types import ServiceSection, Topic, doc
from pebble.extension import Facts, Program

_PLACE: Place = ("services", "homeassistant")


class HomeAssistant(ServiceSection, frozen=True, kw_only=True):
    """Shows the robot as a device of a Home Assistant at the remote broker."""

    prefix: Annotated[Topic, doc("Where Home Assistant looks for devices.")] = "homeassistant"
    expose: Annotated[tuple[Literal["restart", "reboot"], ...], doc("Buttons that it gets besides STOP.")] = ()


def _check(reader: Reader, root: Root, _: Place) -> Root:
    """Note a problem if there is no broker that Home Assistant could use."""
    section: HomeAssistant = root.services.homeassistant  # type: ignore[attr-defined]  # of this extension
    bridge = root.services.mqtt_bridge
    if section.enabled and not (bridge.enabled and bridge.remote is None):  # ``remote``: by Zenoh, not by MQTT
        why = "is not used without a remote broker by MQTT: enable services.mqtt_bridge with remote_mqtt"
        reader.notes.warning((*_PLACE, "enabled"), why)
    return root


RULES: tuple[Rule, ...] = ((Root, _check),)


def saved(config: Config) -> Path:
    """Return the path of the file with the topics that may be retained at the broker."""
    return config.state_file("homeassistant")


def programs(config: Config) -> list[Program]:
    """Return the process; also a disabled one, as long as it may have messages at the broker to remove."""
    bridge = config.services.mqtt_bridge
    runs = config.section(HomeAssistant).enabled or saved(config).exists()
    if not (runs and bridge.enabled and bridge.remote is None):
        return []
    return [Program("homeassistant", "pebble.services.homeassistant.service:HomeAssistantService", preloaded=False)]


def facts(config: Config) -> Facts:
    """Return the line about Home Assistant in the summary of ``pebble check``."""
    section = config.section(HomeAssistant)
    buttons = ", ".join(("stop", *section.expose))
    return Facts((("home assistant", f"{section.prefix}, buttons: {buttons}"),) if section.enabled else ())
