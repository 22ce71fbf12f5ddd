"""What ``pebble topic list`` has seen, and its table."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from pebble import codec
from pebble.commands import show
from pebble.commands.names import Names
from pebble.commands.rates import Rates
from pebble.identity import parse_topic
from pebble.transports import Message

_TOPIC_LIMIT = 10_000  # topics that one listing remembers
_WINDOW = 1000


class Seen:
    """One topic: its newest message, and how often live ones came."""

    def __init__(self) -> None:
        self.kept = False
        self.last: Message | None = None
        self.arrived = 0.0
        self.rates = Rates(_WINDOW)

    def add(self, message: Message, now: float) -> None:
        self.kept = self.kept or message.retain or bool(message.keep)
        self.last, self.arrived = message, now
        if not message.retain:
            self.rates.add(now, len(message.payload))


class Listing:
    """Topics by name. ``add`` takes monotonic seconds."""

    def __init__(self, names: Names) -> None:
        self.names = names
        self.seen: dict[str, Seen] = {}
        self.left_out = 0  # messages of topics beyond the limit

    def add(self, message: Message, now: float) -> None:
        if message.topic not in self.seen and len(self.seen) >= _TOPIC_LIMIT:
            self.left_out += 1
            return
        self.seen.setdefault(message.topic, Seen()).add(message, now)


def print_listing(listing: Listing, now: float, wall: float) -> None:
    """Grouped by component: the first three levels are the same for many lines."""
    console = Console(highlight=False)
    if not listing.seen:
        console.print("no topics seen; a longer --seconds may show slower ones")
        return
    table = Table(box=None, pad_edge=False, header_style="dim")
    table.add_column("topic", overflow="fold")
    table.add_column("kept")
    for name in ("rate", "size", "age"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("what", no_wrap=True)
    base = None
    for topic in sorted(listing.seen):
        address = parse_topic(topic)
        if address is not None and address.identity.base != base:
            base = address.identity.base
            table.add_row(Text(show.printable(base), style="bold"))
        shown = topic if address is None else f"  {address.direction}/{address.metric}"
        table.add_row(Text(show.printable(shown)), *_cells(listing.seen[topic], now, wall), _what(listing.names, topic))
    console.print(table)
    if listing.left_out:
        console.print(f"and {listing.left_out} messages of further topics")


def _cells(seen: Seen, now: float, wall: float) -> tuple[str, str, str, str]:
    kept = "yes" if seen.kept else ""
    if seen.last is None:
        return kept, "", "", ""
    hz = seen.rates.hz
    rate = f"{hz:.1f} Hz" if hz is not None else "once" if seen.rates.count else ""
    return kept, rate, show.size(len(seen.last.payload)), _age(seen, seen.last, now, wall)


def _age(seen: Seen, last: Message, now: float, wall: float) -> str:
    """By the payload's own stamp for a kept copy, whose arrival says nothing; by arrival for a live message."""
    if not last.retain:
        return show.duration(now - seen.arrived)
    stamp = codec.stamp_of(show.parsed(last.payload))
    return "?" if stamp is None else show.duration(max(0.0, wall - stamp))


def _what(names: Names, topic: str) -> Text:
    channel = names.channel(topic)
    if channel is None:
        return Text("not in the contract", style="dim")
    synonym = f" (like {channel.synonym_of})" if channel.synonym_of else ""
    return Text(f"{channel.kind.name.lower()}{synonym}")
