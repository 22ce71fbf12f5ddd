"""How two hubs that were apart agree on what they retain: the newer value counts, by its age. Pure.

No clock is compared: each hub says how long ago it received a value. The hub with the smaller name decides for both.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import msgspec

from pebble.transports.base import QoS
from pebble.transports.zenoh.wire import digest

TIE_S = 0.1  # ages that differ by less are equal: two hubs receive a message at different times
#: What does not fit into a link within `session.BLOCK_MS` ends it, so messages are small: in one, about,
MAX_ROWS = 1000  # of a table
MAX_BYTES = 1 << 16  # of values

_UNKNOWN = float("inf")


class Row(msgspec.Struct, frozen=True, array_like=True):
    """What a hub has of one key. ``digest`` None: it was removed. ``age_s`` may be infinite: from before a restart."""

    digest: int | None
    origin: str
    retained_count: int
    age_s: float


class Table(msgspec.Struct, frozen=True, array_like=True):
    """A part of all rows; the rest is in the first one. ``wills``: clients that have left one.

    ``recalled``: those of them whose wills are of before a restart, with the keys of these wills.
    """

    rows: dict[str, Row]
    alive: list[str]
    wills: list[str]
    recalled: dict[str, str]


class Value(msgspec.Struct, frozen=True, array_like=True):
    """A row with its payload; an empty one is a removal."""

    key: str
    payload: bytes
    qos: QoS
    retained_count: int
    origin: str
    age_s: float


def row_of(value: Value) -> Row:
    of = digest(value.payload) if value.payload else None
    return Row(of, value.origin, value.retained_count, value.age_s)


class Exchange(msgspec.Struct, frozen=True, array_like=True):
    """What the hub ``asker`` wants and gives, or a part of it.

    ``ages``: of what the other one has, too, from before a restart. ``forget``: the clients whose wills it, or another,
    has published; in the last part, else None.
    """

    asker: str
    want: list[str]
    give: list[Value]
    ages: dict[str, float]
    forget: list[str] | None


def is_newer(theirs: Row, mine: Row | None, alive: Collection[str]) -> bool:
    """Whether ``theirs`` replaces ``mine``. What a client that is ``alive`` wrote itself is left to its own hello."""
    if mine is None:
        return theirs.digest is not None
    if mine.digest == theirs.digest:
        return False
    if mine.origin == theirs.origin:
        if mine.origin in alive:
            return False
        if mine.retained_count and theirs.retained_count and mine.retained_count != theirs.retained_count:
            return theirs.retained_count > mine.retained_count
    if abs(mine.age_s - theirs.age_s) > TIE_S:  # false for two infinite ones
        return theirs.age_s < mine.age_s
    return (theirs.origin, theirs.digest or 0) > (mine.origin, mine.digest or 0)


def compare(mine: Mapping[str, Row], theirs: Mapping[str, Row], alive: Collection[str]) -> tuple[list[str], list[str]]:
    """The keys to want from the other hub, and those to give to it."""
    want = [key for key, row in theirs.items() if is_newer(row, mine.get(key), alive)]
    give = [key for key, row in mine.items() if is_newer(row, theirs.get(key), alive)]
    return want, give


def is_overtaken(mine: Row | None, since_s: float) -> bool:
    """Whether something has come since the hubs compared their tables, ``since_s`` seconds ago."""
    return mine is not None and mine.age_s < since_s


def known_ages(mine: Mapping[str, Row], theirs: Mapping[str, Row]) -> dict[str, float]:
    """The ages in ``theirs`` of what is the same here, from before a restart.

    Without them a third hub's older value, whose age is known, would count as the newer one.
    """
    same = {key: row for key, row in theirs.items() if key in mine and mine[key].digest == row.digest}
    return {key: row.age_s for key, row in same.items() if mine[key].age_s == _UNKNOWN > row.age_s}


def published(recalled: Mapping[str, str], rows: Mapping[str, Row], wills: Collection[str]) -> list[str]:
    """The ``recalled`` clients whose wills another hub, with these ``rows`` and ``wills``, has published.

    It has no such will any more, but something on its topic. One that knows nothing of a client has just begun itself.
    """
    return [name for name, key in recalled.items() if name not in wills and key in rows]


def in_parts(values: Iterator[Value]) -> Iterator[list[Value]]:
    """``values`` in lists that are not much larger than MAX_BYTES; at least one."""
    part: list[Value] = []
    size = 0
    for value in values:
        part.append(value)
        size += len(value.key) + len(value.payload) + len(value.origin)
        if size >= MAX_BYTES:
            yield part
            part, size = [], 0
    yield part


encode = msgspec.msgpack.encode
_tables = msgspec.msgpack.Decoder(Table)
_exchanges = msgspec.msgpack.Decoder(Exchange)
_values = msgspec.msgpack.Decoder(list[Value])


def decode_table(data: bytes) -> Table:
    """Raises ValueError, as the others do, for what is none."""
    table = _tables.decode(data)
    for row in table.rows.values():
        _check_age(row.age_s)
    return table


def decode_exchange(data: bytes) -> Exchange:
    exchange = _exchanges.decode(data)
    for age_s in (*(value.age_s for value in exchange.give), *exchange.ages.values()):
        _check_age(age_s)
    return exchange


def decode_values(data: bytes) -> list[Value]:
    values = _values.decode(data)
    for value in values:
        _check_age(value.age_s)
    return values


def _check_age(age_s: float) -> None:
    if not age_s >= 0:  # nor is it NaN
        raise ValueError(f"an age of {age_s} s")
