"""Text files that people write, read as UTF-8 on every system and in every locale."""

import errno
import os
from pathlib import Path

from pebble.errors import PebbleError
from pebble.ownership import read_for

_LONGEST = 1 << 24  # bytes of a text that a person has written


class NotTextError(PebbleError):
    """An error for a file that is not UTF-8: ``is not UTF-8 at its byte 24, in line 3: save it as UTF-8``."""


def read_text(path: Path) -> str:
    """Return the file's text, without a byte order mark, with ``\\n`` after each line. Raises OSError, NotTextError."""
    with path.open("rb") as file:  # a pipe, too; a device may have no end
        data = file.read(_LONGEST + 1)
    if len(data) > _LONGEST:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
    return text_of(data)


def read_password(file: Path, option: str, place: Path | None = None) -> str:
    """Return the text of the file that ``option`` names, without its final newline. Raises PebbleError.

    The error does not repeat the file's name, which may be the password itself. ``place``: the config that names it, if
    one does: root then reads only what the config's owner may read.
    """
    try:
        return (read_text(file) if place is None else text_of(read_for(place, file))).rstrip("\n")
    except OSError as error:
        raise PebbleError(f"{option}: {error.strerror}: name a file with the password in it") from None
    except NotTextError as error:
        raise PebbleError(f"{option}: the file {error}") from None


def text_of(data: bytes) -> str:
    """Return the text in the bytes of a file. Raises NotTextError, whose message repeats none of the bytes."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        wrong_byte = error.start
    else:
        if "\0" not in text:
            return text.replace("\r\n", "\n").replace("\r", "\n")
        wrong_byte = data.index(b"\0")
    line = data.count(b"\n", 0, wrong_byte) + 1
    raise NotTextError(f"is not UTF-8 at its byte {wrong_byte}, in line {line}: save it as UTF-8")
