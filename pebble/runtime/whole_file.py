"""Writes files that exist whole or not at all, also after a power cut, and may hold secrets."""

import errno
import logging
import os
from pathlib import Path

from pebble.errors import PebbleError

log = logging.getLogger(__name__)

#: Errors of calls that a file system lacks (FAT, SMB, 9p).
_NOT_HERE = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
_IN_USE = (errno.EACCES, errno.EPERM, errno.EBUSY, errno.ETXTBSY)  # a mount point, or an open file on some systems


def is_root() -> bool:
    """True if this process may change the owner of files; on Windows no process may."""
    return hasattr(os, "geteuid") and os.geteuid() == 0


def _give(file: Path | int, owner: tuple[int, int]) -> None:
    """Change the owner (user and group) of a file, unless it has that owner already. Raises OSError."""
    state = os.stat(file)  # noqa: PTH116
    if (state.st_uid, state.st_gid) != owner:
        os.chown(file, *owner)


def set_mode(file: Path, mode: int, opened: Path | int | None = None) -> None:
    """Set the mode of ``file``; if its file system cannot hide it from others, log that. Raises OSError.

    ``opened``: a path or descriptor through which to do it, if not by the name ``file``.
    """
    opened = file if opened is None else opened
    try:
        os.chmod(opened, mode)  # noqa: PTH101
    except OSError as error:
        if error.errno not in (errno.EPERM, *_NOT_HERE):
            raise
    if os.name == "posix" and os.stat(opened).st_mode & 0o077 & ~mode:  # noqa: PTH116 - SMB may report no error
        log.error("%s: others can read it, which cannot be changed here", file)


def sync_file(descriptor: int, *, data: bool = False) -> None:
    """Write a file to disk, or only its ``data``, where the system can do so. Raises OSError if data may be lost."""
    try:
        (os.fdatasync if data else os.fsync)(descriptor)
    except OSError as error:
        if error.errno not in _NOT_HERE:
            raise


def write(
    file: Path, content: bytes, mode: int, error: type[PebbleError], owner: tuple[int, int] | None = None
) -> None:
    """Replace the file in one step: it is never half written, and others can never read it. Raises ``error``.

    After a power cut the file has the old content or the new one. ``owner`` None: a file that root writes keeps its
    owner, who may be a broker that reads it.
    """
    temporary = file.with_name(f".{file.name}.new")
    try:
        temporary.unlink(missing_ok=True)  # left by a power cut; opening a FIFO would wait for ever
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as output:
            # By the descriptor: in another user's folder its name may be a link by now.
            open_file = output.fileno() if os.chmod in os.supports_fd else temporary
            if owner is None and is_root() and file.exists():
                state = file.lstat()
                owner = state.st_uid, state.st_gid
            if owner is not None:
                _give(open_file, owner)
            set_mode(file, mode, open_file)
            output.write(content)
            output.flush()
            sync_file(output.fileno())
        try:
            temporary.replace(file)
        except OSError as why:
            if why.errno not in _IN_USE or not file.is_file():
                raise
            _write_in_place(file, content, mode)  # as for a file mounted into a container
        sync_folder(file.parent)
    except OSError as why:
        raise error(f"{file}: {why.strerror}") from None


def _write_in_place(file: Path, content: bytes, mode: int) -> None:
    """Write into a file that cannot be replaced, such as a file mounted into a container. Raises OSError."""
    with os.fdopen(os.open(file, os.O_WRONLY | getattr(os, "O_NOFOLLOW", 0)), "wb") as output:
        set_mode(file, mode, output.fileno())
        output.write(content)
        output.truncate()
        output.flush()
        sync_file(output.fileno())
    file.with_name(f".{file.name}.new").unlink()  # which write() could not rename


def make_folder(folder: Path) -> None:
    """Make a folder and its missing parents, so that a power cut does not undo it. Raises OSError."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(mode=0o700, exist_ok=True)
        sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Write the names in a folder to the disk, if the system can. Raises OSError."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        sync_file(descriptor)
    finally:
        os.close(descriptor)
