"""Topics and filters as MQTT defines them, and the limits that hold on every transport (T1, T2)."""

import re
from collections.abc import Callable
from functools import lru_cache

from pebble.errors import TransportError

MAX_BYTES = 1024  # our own limit; MQTT's is 65,535
MAX_LEVELS = 200  # mosquitto closes the connection beyond it (TOPIC_HIERARCHY_LIMIT)

REMEMBERED_LENGTH = 128  # characters of topics whose translations are remembered: strangers' may have 64 KB each
_REMEMBERED = 4096  # topics whose levels are remembered

# Control characters and Unicode non-characters: MQTT lets a receiver close the connection on them, and mosquitto does.
_NON_CHARACTERS = "\ufdd0-\ufdef" + "".join(
    chr(plane * 0x10000 + last) for plane in range(17) for last in (0xFFFE, 0xFFFF)
)
_WILDCARD = re.compile(r"/?[+#]")
_FORBIDDEN = re.compile(f"[\x00-\x1f\x7f-\x9f{_NON_CHARACTERS}]")


def remembered(translate: Callable[[str], str]) -> Callable[[str], str]:
    """Return ``translate`` with a memory of its results for topics of usual length; 2 MB at most."""
    cached = lru_cache(_REMEMBERED)(translate)

    def look_up(topic: str) -> str:
        usual = isinstance(topic, str) and len(topic) <= REMEMBERED_LENGTH
        return cached(topic) if usual else translate(topic)

    return look_up


def _check(what: str, text: str) -> None:
    """Raise TransportError if ``text`` breaks a limit of topics and filters alike; ``what`` says which it is."""
    if not isinstance(text, str) or not text:
        raise TransportError(f"{what} must be a non-empty string, not {text!r}")
    try:
        size = len(text.encode())
    except UnicodeEncodeError:
        raise TransportError(f"{what} {text!r} cannot be written as UTF-8") from None
    if size > MAX_BYTES:
        raise TransportError(f"{what} {text[:40]!r}… has {size} bytes, more than {MAX_BYTES}")
    if text.count("/") >= MAX_LEVELS:
        raise TransportError(f"{what} {text[:40]!r}… has more than {MAX_LEVELS} levels")
    if bad := _FORBIDDEN.search(text):
        raise TransportError(f"{what} {text!r} contains the control or non-character {bad.group()!r}")


@remembered
def check_topic(topic: str) -> str:
    """Return ``topic`` if it may be published to; raise TransportError naming what is wrong with it."""
    _check("topic", topic)
    if "+" in topic or "#" in topic:
        raise TransportError(f"topic {topic!r} contains a wildcard; wildcards belong in filters")
    if topic.startswith("$"):
        raise TransportError(f"topic {topic!r} starts with $: those belong to the broker")
    return topic


@remembered
def check_filter(filter_: str) -> str:
    """Return ``filter_`` if it may be subscribed to; raise TransportError naming what is wrong with it."""
    _check("filter", filter_)
    levels = filter_.split("/")
    if levels[0] == "$share":
        raise TransportError(f"filter {filter_!r}: shared subscriptions are not supported")
    for index, level in enumerate(levels):
        if "#" in level and (level != "#" or index != len(levels) - 1):
            raise TransportError(f"filter {filter_!r}: # must stand alone as the last level")
        if "+" in level and level != "+":
            raise TransportError(f"filter {filter_!r}: + must stand alone in its level")
    return filter_


def is_pattern(filter_: str) -> bool:
    return "+" in filter_ or "#" in filter_


@remembered
def beginning(filter_: str) -> str:
    """Return the text with which all topics that match ``filter_`` begin, to rule out most filters fast."""
    return _WILDCARD.split(filter_, maxsplit=1)[0]


def matches(filter_: str, topic: str) -> bool:
    """True if ``filter_`` matches ``topic``, by MQTT's rules.

    ``+`` is one level, a final ``#`` is the rest and its parent, and wildcards skip topics that begin with ``$``.
    """
    if filter_ == topic:
        return True
    if not topic.startswith(beginning(filter_)):
        return False
    filter_levels, topic_levels = filter_.split("/"), topic.split("/")
    if topic.startswith("$") and filter_levels[0] in ("+", "#"):
        return False
    for index, level in enumerate(filter_levels):
        if level == "#":
            return True
        if index >= len(topic_levels) or level not in ("+", topic_levels[index]):
            return False
    return len(filter_levels) == len(topic_levels)
