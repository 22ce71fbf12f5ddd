"""An MCU's own words, made fit for a log."""

from __future__ import annotations

LIMIT = 200  # characters


def printable(raw: bytes) -> str:
    """Short and printable, whatever it was: half a UTF-8 character is no reason to lose the rest."""
    text = raw.strip()[: 4 * LIMIT].decode("utf-8", "backslashreplace")[:LIMIT]
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)
