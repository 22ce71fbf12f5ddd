"""Log lines of an MCU, made printable."""

from dataclasses import dataclass, field

LIMIT = 200  # characters


@dataclass(frozen=True, slots=True)
class DeviceLogLine:
    """A line for the log: an answer, a boot message, or a malformed report. ``level`` is one of logging's.

    ``known``: the text belongs to the protocol. Other text may be noise, or the output of another program on the board.
    """

    level: int
    text: str
    known: bool = field(default=False, compare=False)


def is_known(report: object) -> bool:
    """True if a report of a text protocol shows that the board speaks it."""
    return not isinstance(report, DeviceLogLine) or report.known


def printable(raw: bytes) -> str:
    """Return ``raw`` as at most 200 printable characters, with invalid UTF-8 escaped."""
    text = raw.strip()[: 4 * LIMIT].decode("utf-8", "backslashreplace")[:LIMIT]
    if text.isprintable():
        return text
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)
