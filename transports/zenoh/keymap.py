"""Topics and filters as Zenoh key expressions and back: bijective, with MQTT's matching rules (T1, T2).

Zenoh forbids empty chunks and the characters ``* $ ? #`` and treats a chunk that starts with ``@`` as verbatim: no
wildcard ever matches it. So forbidden characters are percent-escaped, an empty level is written ``%``, a level that
starts with ``@`` is escaped, and a first level that starts with ``$`` *becomes* verbatim, because MQTT's wildcards
skip it. Ordinary topics map to themselves.
"""

import re

from pebble.transports.topics import remembered

_FORBIDDEN = re.compile(r"[%*$?#]")  # what Zenoh forbids in a chunk, and the escape character itself
_ESCAPE = re.compile(r"%([0-9A-F]{2})")
_EMPTY = "%"  # no escaped level looks like this


@remembered
def topic_to_key(topic: str) -> str:
    """Return the key of a checked topic (see topics.check_topic)."""
    return _join([_level(level) for level in topic.split("/")])


@remembered
def filter_to_key(filter_: str) -> str:
    """Return the key expression of a checked filter (see topics.check_filter)."""
    wildcards = {"+": "*", "#": "**"}
    return _join([wildcards[level] if level in wildcards else _level(level) for level in filter_.split("/")])


@remembered
def key_to_topic(key: str) -> str:
    """Return the topic that ``topic_to_key`` made ``key`` from."""
    chunks = ("" if chunk == _EMPTY else chunk for chunk in key.removeprefix("@").split("/"))
    return "/".join(_ESCAPE.sub(lambda match: chr(int(match.group(1), 16)), chunk) for chunk in chunks)


def _join(levels: list[str]) -> str:
    if levels[0].startswith("%24"):
        levels[0] = "@" + levels[0]
    return "/".join(levels)


def _level(level: str) -> str:
    if not level:
        return _EMPTY
    escaped = _FORBIDDEN.sub(lambda match: f"%{ord(match.group()):02X}", level)
    return "%40" + escaped[1:] if escaped.startswith("@") else escaped
