"""Files that are there whole or not at all, and may hold secrets."""

import os
from pathlib import Path

from pebble.errors import PebbleError


def write(file: Path, content: bytes, mode: int, error: type[PebbleError]) -> None:
    """Replace the file at once: never half of it, never readable by others for a moment. Raises ``error``."""
    temporary = file.with_name(f".{file.name}.new")
    try:
        temporary.unlink(missing_ok=True)
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as output:
            output.write(content)
            output.flush()
            os.fsync(output.fileno())
        temporary.chmod(mode)
        temporary.replace(file)
    except OSError as why:
        raise error(f"{file}: {why.strerror}") from None
