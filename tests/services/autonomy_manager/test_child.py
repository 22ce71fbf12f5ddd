"""A script whose file exists and cannot be executed is refused with the fix."""

from __future__ import annotations

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


def test_a_file_that_is_not_executable_is_named_with_the_command_that_makes_it_so(tmp_path: Path) -> None:
    path = script(tmp_path, "#!/bin/sh\n", 0o644)
    with pytest.raises(PebbleError, match=f"^{path} is not executable: chmod \\+x {path}$"):
        started(path)


@pytest.mark.parametrize(
    ("first", "named"), [("#!/no/such/sh -e\n", "'/no/such/sh'"), ("#!/bin/sh\r\n", r"'/bin/sh\\r'")]
)
def test_a_missing_interpreter_is_named(first: str, named: str, tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match=f"there is no {named}, which its first line names"):
        started(script(tmp_path, first, 0o755))


@pytest.mark.parametrize("first", ["#!/bin/sh\n", "#!/bin/sh\t-e\n", "#!/usr/bin/env -S sh -e\n", "\n"])
def test_others_start(first: str, tmp_path: Path) -> None:
    codes: list[int] = []
    process = started(script(tmp_path, f"{first}exit 7\n", 0o755))
    process.watch(codes.append)
    process.wait(10)
    assert codes == [7]
