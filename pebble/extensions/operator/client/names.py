"""The names of topics and channels as a user types them: ``drive-values``, ``outgoing/online``, a whole topic."""

import difflib
from collections.abc import Iterator
from unicodedata import normalize

from pebble.contract import CHANNELS, INCOMING, OUTGOING, Channel, channel_of
from pebble.contract.identity import Identity, composed, parse_topic
from pebble.errors import PebbleError
from pebble.runtime.addresses import Addresses
from pebble.transports.topics import is_pattern

ANY_ROBOT = "+/+/+"
_USUAL = "pebble/robots/"  # before the id alone


class Names:
    """The names of topics of one robot, including those that its config renames, or of every robot."""

    def __init__(self, base: str = ANY_ROBOT, addresses: Addresses | None = None, account: str | None = None) -> None:
        """Store the robot. ``account``: the user name at the broker, "" for none; None within a robot."""
        self.base, self.account = base, account
        self._addresses = addresses

    def filters(self, name: str) -> list[str]:
        """Return the filters to subscribe to for ``name``: its topic and those of its synonyms (paper Table A.5)."""
        channel = self._find(name, (OUTGOING, INCOMING))
        if channel is None:
            return [name]
        return [self._place(synonym, name) for synonym in _with_synonyms(channel)]

    def topic(self, name: str) -> str:
        """Return the topic to publish to for ``name``. Raises PebbleError unless ``name`` means exactly one topic."""
        channel = self._find(name, (INCOMING, OUTGOING))
        topic = name if channel is None else self._place(channel, name)
        if is_pattern(topic):
            raise PebbleError(
                f"{name} is not one topic: select the robot by --config or --robot, or give a whole topic"
            )
        return topic

    def channel(self, topic: str) -> Channel | None:
        """Return the channel of ``topic``, of any robot."""
        announced = None if self._addresses is None else self._addresses.channel(topic)
        if announced is not None:
            return announced
        address = parse_topic(topic)
        return None if address is None else channel_of(f"{address.direction}/{address.metric}")

    def _find(self, name: str, directions: tuple[str, str]) -> Channel | None:
        """Return the channel of a short name; None for a whole topic.

        If both directions have the name, the first of ``directions`` counts.
        """
        if name.startswith((f"{INCOMING}/", f"{OUTGOING}/")):
            channel = channel_of(name)
        elif parse_topic(name) is not None or is_pattern(name):
            return None
        else:
            channels = (channel_of(f"{direction}/{name}") for direction in directions)
            channel = next((channel for channel in channels if channel is not None), None)
        if channel is None:
            _refuse_misspelt(name)
        return channel

    def _place(self, channel: Channel, name: str) -> str:
        """Return the topic or filter of a channel that was found by ``name``."""
        if channel.is_pattern:
            return f"{self.base}/{channel.direction}/{name.removeprefix(f'{channel.direction}/')}"
        if self._addresses is not None:
            return self._addresses[channel].topic
        return channel.filter(self.base)


def base_of(robot: str) -> str:
    """Return the base topic of ``goob`` or ``pebble/robots/goob``.

    Raises ConfigError for names that no topic can hold.
    """
    levels = robot.split("/")
    if len(levels) == 1:
        levels = f"{_USUAL}{robot}".split("/")
    if len(levels) != 3:
        raise PebbleError(f'--robot {robot}: give its id, or "system/type/id"')
    return Identity(*map(composed, levels)).base  # composed: an accent may come as a character of its own


def spellings(base: str) -> list[str]:
    """Return a base topic with its accents spelled in both ways: robots of other programs may have the rare one."""
    return [*dict.fromkeys((base, normalize("NFD", base)))]


def id_of(base: str) -> str:
    """Return the shortest name that :func:`base_of` accepts for this robot."""
    name = base.removeprefix(_USUAL)
    return base if "/" in name else name


def _with_synonyms(channel: Channel) -> Iterator[Channel]:
    yield channel
    for other in CHANNELS:
        if other.direction == channel.direction and other.synonym_of == channel.metric:
            yield other


def _refuse_misspelt(name: str) -> None:
    """Raise PebbleError if ``name`` looks like a misspelt topic of the contract: it resembles one, or has no slash.

    Other names are allowed, because a broker may carry topics outside the contract.
    """
    spellings = {spelling for channel in CHANNELS for spelling in (channel.metric, channel.suffix)}
    near = difflib.get_close_matches(name, sorted(spellings), n=1)
    if near:
        raise PebbleError(f'there is no topic "{name}": did you mean "{near[0]}"?')
    if "/" not in name:
        raise PebbleError(f'there is no topic "{name}"; `pebble topic contract` lists all topics')
