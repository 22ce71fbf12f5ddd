"""The identity of a component, three levels of a topic, and how topics are built and parsed."""

import json
import re
from collections.abc import Iterable
from functools import lru_cache
from unicodedata import normalize

from msgspec import Struct

from pebble.contract.channels import INCOMING, OUTGOING
from pebble.errors import ConfigError, PebbleError

# ``/ + # $`` belong to MQTT; brokers close the connection on control characters and Unicode non-characters.
_RESERVED = r"/+#$\x00-\x1f\x7f-\x9f\ufdd0-\ufdef\ufffe\uffff"
#: One level of a topic. The last group keeps Python's ``$`` from accepting a final newline; other dialects ignore it.
LEVEL = rf"^[^{_RESERVED}]{{1,64}}$(?!\n)"
LEVEL_RULE = "a topic level: 1 to 64 characters, without / + # $ and control characters"

#: The types of operators' servers and of gateways, which publish below their own identity but are no robots.
SERVERS, GATEWAYS = "servers", "gateways"

_REMEMBERED, _REMEMBERED_LENGTH = 1024, 128  # topics, and characters of each: 1.5 MB at most

_valid_level = re.compile(LEVEL).search


class Identity(Struct, frozen=True):
    """The identity ``{system}/{type}/{id}`` of a component. Raises ConfigError for levels that no topic can hold.

    Example: ``Identity("pebble", "robots", "goob").outgoing("online")`` is ``pebble/robots/goob/outgoing/online``.
    """

    system: str
    type: str
    id: str

    def __post_init__(self) -> None:
        wrong = [
            f"robot.{name}: must be {LEVEL_RULE}, not {level!r}"
            for name, level in (("system", self.system), ("type", self.type), ("id", self.id))
            if not _valid_level(level)
        ]
        if wrong:
            raise ConfigError(wrong)

    def __str__(self) -> str:
        return self.base

    @property
    def base(self) -> str:
        """The first three levels of all topics of this component, without a final slash."""
        return f"{self.system}/{self.type}/{self.id}"

    @property
    def is_server(self) -> bool:
        """True for an operators' server or a gateway: it does not drive, and is not listed with robots."""
        return self.type in (SERVERS, GATEWAYS)

    def outgoing(self, metric: str) -> str:
        """Return a topic that this component publishes; ``metric`` may have several levels."""
        return f"{self.base}/{OUTGOING}/{metric}"


class ParsedTopic(Struct, frozen=True):
    """The parts of a topic of the contract: identity, direction and metric (one or more levels)."""

    identity: Identity
    direction: str  # INCOMING or OUTGOING, as seen from the component
    metric: str

    @property
    def topic(self) -> str:
        return f"{self.identity.base}/{self.direction}/{self.metric}"


def composed(name: str) -> str:
    """Return ``name`` in the form that keyboards write: a letter and its accent are one character (Unicode's NFC)."""
    return normalize("NFC", name)


def untypeable(name: str) -> str:
    """Return why no keyboard can type ``name``, and the fix, as words to write behind the name; "" if one can."""
    if name in (".", ".."):
        return "is a folder, and no name: write another"
    return "" if composed(name) == name else f"has a letter that no keyboard writes: write {json.dumps(composed(name))}"


def meant(names: Iterable[str], typed: str) -> str:
    """Return ``typed``, or if it is no name, the one in ``names`` that looks like it. PebbleError if several do."""
    if typed.isascii():  # without accents, which can be written in two ways
        return typed
    alike = [name for name in names if composed(name) == composed(typed)]
    if typed in alike or not alike:
        return typed
    if len(alike) > 1:
        raise PebbleError(f"{len(alike)} names look like this: rename all but one")
    return alike[0]


def parse_topic(topic: str) -> ParsedTopic | None:
    """Return the parts of ``topic``; None if it is not ``{system}/{type}/{id}/{direction}/{metric}``."""
    return _remembered(topic) if len(topic) <= _REMEMBERED_LENGTH else _parse(topic)


def _parse(topic: str) -> ParsedTopic | None:
    levels = topic.split("/", 4)
    if len(levels) < 5 or levels[3] not in (INCOMING, OUTGOING) or not levels[4]:
        return None
    system, type_, id_, direction, metric = levels
    if not (_valid_level(system) and _valid_level(type_) and _valid_level(id_)):
        return None
    return ParsedTopic(Identity(system, type_, id_), direction, metric)


_remembered = lru_cache(_REMEMBERED)(_parse)
