"""Topics that the config renames, and topics that two channels share."""

from collections.abc import Iterable, Iterator
from typing import Any

from pebble.config.problems import Path
from pebble.config.tree import Root, SerialBridge
from pebble.contract import CHANNELS, INCOMING, Channel
from pebble.contract.identity import Identity

_SERIAL = ("services", "serial_mcu_bridge")


def shared_topics(root: Root) -> Iterator[tuple[Path, Channel]]:
    """Yield each key with a topic that belongs to another channel as well, and that channel.

    Several serial lines may share the topics of one channel: all of them obey a drive command.
    """
    base = Identity(root.robot.system, root.robot.type, root.robot.id).base
    renamed: list[tuple[str, Path, Channel]] = []
    owners: dict[str, Channel] = {}
    for channel in CHANNELS:
        for path, topic in _keys(channel, root):
            if topic is not None:
                renamed.append((topic, path, channel))
            elif not channel.is_pattern:
                owners[channel.topic(base)] = channel
    for topic, path, channel in renamed:
        owner = owners.setdefault(topic, channel)
        if owner is not channel:
            yield path, owner


def renamed_commands(root: Root) -> Iterator[tuple[Path, str]]:
    """Yield each key that renames the topic of a command or flag, and its new topic."""
    for channel in CHANNELS:
        if channel.direction == INCOMING:
            yield from ((path, topic) for path, topic in _keys(channel, root) if topic is not None)


def _keys(channel: Channel, root: Root) -> Iterator[tuple[Path, str | None]]:
    """Yield each key that may rename the channel, with its topic (None: not set); serial lines have a key each."""
    if channel.override is None:
        yield (), None  # no key renames it
        return
    keys = tuple(channel.override.split("."))
    if keys[:2] != _SERIAL:
        yield keys, topic_at(root, keys)
        return
    section = root.services.serial_mcu_bridge
    lines: dict[Path, SerialBridge] = {_SERIAL: section}
    lines |= {(*_SERIAL, "instances", name): line for name, line in section.instances.items()}
    for path, line in lines.items():
        yield (*path, *keys[2:]), topic_at(line, keys[2:])


def topic_at(section: Any, keys: Iterable[str]) -> str | None:
    """Return the topic at a path of keys; None where it is not set."""
    for key in keys:
        section = getattr(section, key, None)  # an extension's section is missing with it
    topic: str | None = section
    return topic
