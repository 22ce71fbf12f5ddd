"""Reads the text files that people write, on every system and in every locale as UTF-8."""

import codecs
import os
from pathlib import Path

from pebble.errors import PebbleError

PASSWORD = "PEBBLE_PASSWORD"  # noqa: S105 - the name of an environment variable
_WIDE = (
    (codecs.BOM_UTF32_LE, "UTF-32"),
    (codecs.BOM_UTF32_BE, "UTF-32"),
    (codecs.BOM_UTF16_LE, "UTF-16"),
    (codecs.BOM_UTF16_BE, "UTF-16"),
)
_SAMPLE = 1024  # bytes; where a third of them are zero, each letter takes two


class NotTextError(PebbleError):
    """A file is not UTF-8. Example: ``is UTF-16 ("Unicode" in Notepad) from its byte 0 on: save it as UTF-8``."""


def read_text(path: Path) -> str:
    """The file's text, without a byte order mark and with ``\\n`` after each line. Raises OSError and NotTextError."""
    return text_of(path.read_bytes())


def read_password(file: Path, option: str) -> str:
    """The text of the file that ``option`` names, without its final newline. Raises PebbleError.

    It does not repeat the name of the file, which may be the password itself.
    """
    try:
        return read_text(file).rstrip("\n")
    except OSError as error:
        raise PebbleError(f"{option}: {error.strerror}: name a file with the password in it") from None
    except NotTextError as error:
        raise PebbleError(f"{option}: the file {error}") from None


def password(file: Path | None) -> str | None:
    """The broker's password in the file, else in the environment. Raises PebbleError."""
    return os.environ.get(PASSWORD) if file is None else read_password(file, "--password-file")


def text_of(data: bytes) -> str:
    """The text in the bytes of a file. Raises NotTextError, which repeats none of them."""
    if wide := next((name for mark, name in _WIDE if data.startswith(mark)), ""):
        raise NotTextError(_saved_as(wide, 0))
    zero = data.find(b"\0")
    if zero >= 0:
        sample = data[:_SAMPLE]
        if sample.count(0) * 3 >= len(sample):
            raise NotTextError(_saved_as("UTF-16", zero))
        raise NotTextError(f"is not text: its byte {zero} is zero")
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise NotTextError(
            f"is not UTF-8 at its byte {error.start}, in line {line}, but Latin-1 or Windows-1252, it seems: "
            "save it as UTF-8"
        ) from None
    return text.lstrip("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def _saved_as(encoding: str, byte: int) -> str:
    return f'is {encoding} ("Unicode" in Notepad), to tell from its byte {byte}: save it as UTF-8'
