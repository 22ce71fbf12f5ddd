"""The output of ``pebble topic``: messages, rates and lists, without terminal control characters."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Container, Iterable, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import typer

from pebble.config.visible import shown
from pebble.contract.identity import parse_topic
from pebble.contract.payloads import EstopState
from pebble.extensions.media.rate_meter import RateMeter
from pebble.extensions.operator.client.discovery import Discovery
from pebble.extensions.operator.client.names import Names, id_of
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.operator.client.stamps import stamp_of
from pebble.runtime.output import console
from pebble.runtime.output import discard_output as discard_output
from pebble.transports import Message

if TYPE_CHECKING:
    from rich.text import Text

_TOPIC_LIMIT = 10_000  # topics in one listing
_WINDOW = 1000
_DUMPED = 32  # bytes of a binary payload that are shown
#: Binary payloads by their first bytes.
RECOGNISERS = {b"PBAT": "PBAT sound", b"PBVD": "PBVD picture", b"\xff\xd8": "JPEG picture"}


def print_table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str | Text]],
    *,
    whole: Container[str] = ("time",),
    right: Container[str] = (),
) -> None:
    """Print rows of untrusted text; the columns ``whole`` and ``right`` are never wrapped."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="dim")
    for column in columns:
        is_number = column in right
        justify: Literal["left", "right"] = "right" if is_number else "left"
        table.add_column(column, justify=justify, no_wrap=is_number or column in whole, overflow="fold")
    for row in rows:
        table.add_row(*(Text(shown(cell).replace("\n", "\\u000a")) if isinstance(cell, str) else cell for cell in row))
    console().print(table)


def body(payload: bytes, width: int) -> str:
    """Return a payload as text: JSON on one line if it fits, else indented; binary data as a hex dump."""
    if not payload:
        return "(empty: removes the retained message)"
    plain = parsed(payload)
    if plain is not None:
        with suppress(RecursionError):
            line = json.dumps(plain, ensure_ascii=False)
            return shown(line if len(line) <= width else json.dumps(plain, ensure_ascii=False, indent=2))
    binary_format = recognised(payload)
    if binary_format is None and _is_text(payload):
        return shown(payload.decode())
    return f"{binary_format or 'binary'}, {len(payload)} bytes\n{hex_dump(payload[:_DUMPED], width)}"


def parsed(payload: bytes) -> Any:
    """Return the JSON value; None if the payload is ``null``, or not JSON."""
    try:
        return json.loads(payload)
    except (ValueError, RecursionError):
        return None


def recognised(payload: bytes) -> str | None:
    """Return the name of a binary format, by its first bytes; None if it is unknown."""
    return next((name for start, name in RECOGNISERS.items() if payload.startswith(start)), None)


def hex_dump(raw: bytes, width: int) -> str:
    """Return lines of offset, bytes and ASCII, as long as the width allows."""
    per_line = 16 if width >= 76 else 8
    lines = []
    for start in range(0, len(raw), per_line):
        part = raw[start : start + per_line]
        text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in part)
        lines.append(f"  {start:04x}  {part.hex(' '):<{per_line * 3 - 1}}  {text}")
    return "\n".join(lines)


def headline(message: Message, now: float) -> str:
    """Return topic, size, QoS, "retained", and the age by the payload's stamp. ``now``: epoch seconds."""
    parts = [shown(message.topic), f"{len(message.payload)} B", f"qos {int(message.qos)}"]
    if message.retain:
        parts.append("retained")
    elif message.retain_requested:
        parts.append("to be retained")
    stamp = stamp_of(parsed(message.payload))
    if stamp is not None:
        parts.append(f"stamped {age(now - stamp)}")
    return "  ".join(parts)


def age(seconds: float) -> str:
    """Return an age: ``12 ms ago``, ``3.2 s ago``, ``2 h ago``; or ``… ahead`` if the other clock is ahead."""
    return f"{duration(abs(seconds))} {'ago' if seconds >= 0 else 'ahead'}"


def duration(seconds: float) -> str:
    """Return a duration: ``12 ms``, ``3.2 s``, ``2 h``."""
    if seconds < 1:
        return f"{seconds * 1000:.0f} ms"
    if seconds < 100:
        return f"{seconds:.1f} s"
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def counted(number: int, noun: str) -> str:
    """Return a number of things: ``1 file``, ``1,200 messages``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def size(count: float) -> str:
    """Return a size: ``19 B``, ``1.2 kB``, ``3.4 MB``."""
    if count < 1000:
        return f"{count:.0f} B"
    return f"{count / 1e3:.1f} kB" if count < 1e6 else f"{count / 1e6:.1f} MB"


def rate_line(meter: RateMeter, now: float) -> str | None:
    """Return the rates of messages and of payload bits in a line; None before the second message."""
    hz, arrivals = meter.rate(now), meter.arrivals(now)
    if not hz:
        return None
    gaps = [later.at - earlier.at for earlier, later in pairwise(arrivals)]
    kbit = hz * statistics.fmean(arrival.size for arrival in arrivals) * 8 / 1000
    limits = f"min {min(gaps):.4f} s  max {max(gaps):.4f} s"
    return f"{hz:.3f} Hz  {kbit:.1f} kbit/s  {limits}  std dev {statistics.pstdev(gaps):.5f} s  window {len(gaps)}"


def _is_text(payload: bytes) -> bool:
    try:
        return not any(ord(character) < 9 for character in payload.decode())
    except UnicodeDecodeError:
        return False


class TopicRecord:
    """The newest message of one topic, and the rate of live ones."""

    def __init__(self) -> None:
        self.retained = False
        self.last: Message | None = None
        self.arrived = 0.0
        self.meter = RateMeter(window_s=math.inf, limit=_WINDOW)

    def add(self, message: Message, now: float) -> None:
        self.retained = self.retained or message.retain or bool(message.retain_requested)
        self.last, self.arrived = message, now
        if not message.retain:
            self.meter.add(now, len(message.payload))


class Listing:
    """Topics by name. ``add`` takes monotonic seconds."""

    def __init__(self, names: Names) -> None:
        self.names = names
        self.records: dict[str, TopicRecord] = {}
        self.omitted = 0  # messages of topics beyond the limit

    def add(self, message: Message, now: float) -> None:
        if message.topic not in self.records and len(self.records) >= _TOPIC_LIMIT:
            self.omitted += 1
            return
        self.records.setdefault(message.topic, TopicRecord()).add(message, now)


def print_listing(listing: Listing, now: float, wall: float) -> None:
    """Print the topics, grouped by component: the first three levels are the same for many lines."""
    from rich.text import Text

    if not listing.records:
        typer.echo("no topics received; a longer --seconds may show slower ones")
        return
    base: str | None = None
    rows: list[Sequence[str | Text]] = []
    for topic in sorted(listing.records):
        address = parse_topic(topic)
        if address is not None and address.identity.base != base:
            base = address.identity.base
            rows.append([Text(shown(base), style="bold")])
        name = topic if address is None else f"  {address.direction}/{address.metric}"
        kind, style = _kind(listing.names, topic)
        rows.append([name, *_cells(listing.records[topic], now, wall), Text(kind, style=style)])
    columns = ("topic", "retained", "rate", "size", "age", "kind")
    print_table(columns, rows, whole=("retained", "kind"), right=("rate", "size", "age"))
    if listing.omitted:
        typer.echo(f"omitted: {listing.omitted} messages of further topics")


def remarks(listing: Listing, wall: float) -> list[str]:
    """Return a line for each stopped robot, and one for each with a thin link."""
    discovery = Discovery()
    for record in listing.records.values():
        if record.last is not None:
            discovery.receive(record.last, record.arrived, wall)
    robots = sorted(discovery.all_robots(), key=lambda robot: robot.base)
    slow = [
        f"{shown(robot.name)} has a slow connection: commands take {robot.slow_s:.1f} s"
        for robot in robots
        if robot.slow_s is not None
    ]
    return [stopped_line(robot.estop, wall) for robot in robots if robot.latched] + slow


def stopped_line(robot: RobotEstop, wall: float) -> str:
    """Return a line such as ``goob is stopped by ann@desk, 3 min ago: a dog``; empty if it is not stopped."""
    state = robot.stopped_by
    return "" if state is None else f"{shown(id_of(robot.base))} is {stopped(state, wall)}"


def stopped(state: EstopState, wall: float) -> str:
    """Return who stopped a motor owner, when and why, from its cleaned state."""
    when = f", {age(wall - state.since / 1000)}" if state.since else ""
    return f"stopped by {state.by or 'unknown'}{when}" + (f": {state.why}" if state.why else "")


def _cells(record: TopicRecord, now: float, wall: float) -> tuple[str, str, str, str]:
    """Return the cells retained, rate, size and age of a topic; ``now`` is monotonic, ``wall`` epoch seconds."""
    retained = "yes" if record.retained else ""
    if record.last is None:
        return retained, "", "", ""
    hz = record.meter.rate(now)
    rate = "once" if record.meter.count else ""
    if hz:
        rate = f"{hz:.1f} Hz"
    return retained, rate, size(len(record.last.payload)), _age(record, record.last, now, wall)


def _age(record: TopicRecord, last: Message, now: float, wall: float) -> str:
    """Return the age of a message: if live, since its arrival; if retained, since the stamp in its payload."""
    if not last.retain:
        return duration(now - record.arrived)
    stamp = stamp_of(parsed(last.payload))
    return "?" if stamp is None else duration(max(0.0, wall - stamp))


def _kind(names: Names, topic: str) -> tuple[str, str]:
    """Return the kind of a topic's channel, and the style in which to print it."""
    channel = names.channel(topic)
    if channel is None:
        return "not in the contract", "dim"
    synonym = f" (like {channel.synonym_of})" if channel.synonym_of else ""
    return f"{channel.kind.name.lower()}{synonym}", ""
