"""Files are written where a file system lacks what others have, and a refusal has its reason."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Any

import pytest

from pebble.errors import PebbleError
from pebble.runtime.whole_file import write
from tests.support import refused

#: The call that is refused, its error, and what is in the file after a write; or the reason that is given.
REFUSALS = {
    "no modes (FAT)": ("os.chmod", errno.EPERM, "new"),
    "no sync (SMB)": ("os.fsync", errno.EINVAL, "new"),
    "a disk that fails": ("os.fsync", errno.EIO, "Input/output error"),
    "a mount point": ("pathlib.Path.replace", errno.EBUSY, "new"),
    "another disk": ("pathlib.Path.replace", errno.EXDEV, "Invalid cross-device link"),
}


@pytest.mark.parametrize(("call", "number", "expected"), REFUSALS.values(), ids=REFUSALS)
def test_calls_that_a_file_system_lacks_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, number: int, expected: str
) -> None:
    file = tmp_path / "state"
    file.write_bytes(b"the old content")
    file.chmod(0o600)
    with monkeypatch.context() as patch:
        patch.setattr(call, refused(number))
        patch.setattr(os, "supports_fd", {*os.supports_fd, os.chmod})
        why = ""
        try:
            write(file, b"new", 0o600, PebbleError)
        except PebbleError as error:
            why = str(error).removeprefix(f"{file}: ")
    assert why or file.read_text() == expected
    assert [path.name for path in tmp_path.iterdir() if not why] in ([], ["state"])
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_a_file_that_others_can_read_is_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any) -> None:
    def refuse(file: int, _mode: int) -> None:
        os.fchmod(file, 0o644)  # as all files have it there
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr("os.chmod", refuse)
    monkeypatch.setattr(os, "supports_fd", {refuse})
    write(tmp_path / "state", b"new", 0o600, PebbleError)
    assert "state: others can read it, which cannot be changed here: Operation not permitted" in caplog.text
