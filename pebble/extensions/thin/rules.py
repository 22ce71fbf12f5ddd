"""Rules between the config keys of groups and those of links and serial lines."""

from pebble.config.problems import Path
from pebble.config.reader import Reader, Rule
from pebble.config.tree import MqttBridge, Root

_LINK: Path = ("services", "mqtt_bridge", "link")


def _check(reader: Reader, root: Root, _: Path) -> Root:
    """Note a problem if groups of commands are permitted, and serial lines have different topics of drive commands."""
    serial = root.services.serial_mcu_bridge
    topics = {line.topics.drive_values for line in (serial, *serial.instances.values())}
    if root.services.mqtt_bridge.link.groups and len(topics) > 1:
        text = "a group does not say which line it is for: give all the same topics.drive_values, or leave groups out"
        reader.notes.problem((*_LINK, "groups"), text)
    return root


def _check_bridge(reader: Reader, bridge: MqttBridge, path: Path) -> MqttBridge:
    link, remote = bridge.link, bridge.remote
    if link.group_hz and link.profile == "wide":
        reader.notes.problem((*path, "link", "group_hz"), 'has no effect at profile "wide": write "thin" or "auto"')
    if link.short and not link.group_hz:
        reader.notes.problem((*path, "link", "short"), "has no effect without group_hz")
    if link.short and remote is not None and remote.kind != "mqtt":
        reader.notes.problem((*path, "link", "short"), f"{remote.kind} has no short names: leave it out")
    return bridge


RULES: tuple[Rule, ...] = ((Root, _check), (MqttBridge, _check_bridge))
