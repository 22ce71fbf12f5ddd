"""Files that are there whole or not at all, also after a power cut, and may hold secrets."""

import os
from pathlib import Path

from pebble.errors import PebbleError


def is_root() -> bool:
    """Whether this process may give files away; on Windows none does."""
    return hasattr(os, "geteuid") and os.geteuid() == 0


def write(
    file: Path, content: bytes, mode: int, error: type[PebbleError], owner: tuple[int, int] | None = None
) -> None:
    """Replace the file at once: never half of it, never readable by others for a moment. Raises ``error``.

    After a power cut the file holds the old content or the new one.
    ``owner`` None: for root it stays the file of its owner, who may be a broker that reads it.
    """
    temporary = file.with_name(f".{file.name}.new")
    try:
        temporary.unlink(missing_ok=True)  # left by a power cut; to open a FIFO would wait for ever
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as output:
            # By the descriptor: in a folder of somebody else's its name may be a link by now.
            open_file = output.fileno() if os.chmod in os.supports_fd else temporary
            if owner is None and is_root() and file.exists():
                found = file.lstat()
                owner = found.st_uid, found.st_gid
            if owner is not None:
                os.chown(open_file, *owner)
            os.chmod(open_file, mode)  # noqa: PTH101
            output.write(content)
            output.flush()
            os.fsync(output.fileno())
        temporary.replace(file)
        sync_folder(file.parent)
    except OSError as why:
        raise error(f"{file}: {why.strerror}") from None


def write_new(file: Path, content: bytes) -> None:
    """Write a file for people that was not there before, where others cannot read it. Raises PebbleError."""
    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o600)
    except OSError as error:
        raise PebbleError(f"{file}: cannot be written: {error.strerror}") from None
    try:
        with os.fdopen(descriptor, "wb") as output:
            if os.fstat(descriptor).st_mode & 0o077:
                why = "others can read every file on its file system: name one on another, or mount it umask=077"
                raise PebbleError(f"{file}: {why}")
            output.write(content)
            output.flush()
            os.fsync(descriptor)
        sync_folder(file.parent)
    except BaseException as error:
        file.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise PebbleError(f"{file}: {error.strerror}") from None
        raise


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, durably. Raises OSError."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(mode=0o700, exist_ok=True)
        sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable, where the system can. Raises OSError."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
