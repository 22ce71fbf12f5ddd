"""Log lines of an MCU, made printable."""

from dataclasses import dataclass, field

LIMIT = 200  # characters


@dataclass(frozen=True, slots=True)
class DeviceLogLine:
    """A line for the log: an answer, a boot message, a malformed report. ``level`` is one of logging's.

    ``known``: it is in the protocol's own words; other text may be noise, or come from whatever else runs there.
    """

    level: int
    text: str
    known: bool = field(default=False, compare=False)


def is_known(report: object) -> bool:
    """True if a report of a text protocol shows that the board speaks it."""
    return not isinstance(report, DeviceLogLine) or report.known


def printable(raw: bytes) -> str:
    """Return at most 200 printable characters; invalid UTF-8 is escaped, so that the rest is not lost."""
    text = raw.strip()[: 4 * LIMIT].decode("utf-8", "backslashreplace")[:LIMIT]
    if text.isprintable():
        return text
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)
