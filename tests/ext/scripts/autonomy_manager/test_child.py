"""A script whose file exists and cannot be executed is refused with the fix."""

from __future__ import annotations

import errno
import os
import signal
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.services.autonomy_manager.child import Launch, Process


def started(path: Path) -> Process:
    return Process(Launch("turn", (str(path),), path.parent, dict(os.environ), signal.SIGKILL))


def script(folder: Path, text: str, mode: int) -> Path:
    path = folder / "turn.sh"
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.parametrize(
    ("first", "mode", "problem"),
    [
        ("#!/bin/sh\n", 0o644, "^{path} is not executable: chmod \\+x {path}$"),
        ("#!/no/such/sh -e\n", 0o755, "there is no '/no/such/sh', which its first line names"),
        ("#!/bin/sh\r\n", 0o755, r"there is no '/bin/sh\\r', which its first line names"),
    ],
)
def test_what_cannot_be_executed_is_named_with_the_reason(first: str, mode: int, problem: str, tmp_path: Path) -> None:
    path = script(tmp_path, first, mode)
    with pytest.raises(PebbleError, match=problem.format(path=path)):
        started(path)


def denied(_pid: int) -> int:
    raise PermissionError(errno.EPERM, "Operation not permitted")


FIRST_LINES = ["#!/bin/sh\n", "#!/bin/sh\t-e\n", "#!/usr/bin/env -S sh -e\n", "\n"]


@pytest.mark.parametrize(("first", "may"), [*((line, True) for line in FIRST_LINES), (FIRST_LINES[0], False)])
def test_others_start_and_their_end_is_noticed_also_where_pidfd_open_is_denied(
    first: str, may: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not may:
        monkeypatch.setattr(os, "pidfd_open", denied)
    codes: list[int] = []
    process = started(script(tmp_path, f"{first}exit 7\n", 0o755))
    process.watch(codes.append)
    process.wait(10)
    assert codes == [7]
