"""What a config must not say of groups."""

from pebble.config.problems import Path
from pebble.config.reader import Reader, Rule
from pebble.config.tree import Root

_LINK: Path = ("services", "mqtt_bridge", "link")


def _check(reader: Reader, root: Root, _: Path) -> Root:
    """Note groups that would not say which wheels they move."""
    serial = root.services.serial_mcu_bridge
    topics = {line.topics.drive_values for line in (serial, *serial.instances.values())}
    if root.services.mqtt_bridge.link.groups and len(topics) > 1:
        text = "a group does not say which line it is for: give all the same topics.drive_values, or leave groups out"
        reader.notes.problem((*_LINK, "groups"), text)
    return root


RULES: tuple[Rule, ...] = ((Root, _check),)
