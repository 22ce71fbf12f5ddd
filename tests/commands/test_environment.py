"""What a command's environment may lack: a home, a name for the user, an encoding, an output that takes anything."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import pytest

from tests.support import ROOT, cases, some

_PATH = {"PATH": os.defpath}
_NO_USER = ("setpriv", "--reuid=12345", "--regid=12345", "--clear-groups")
changes_users = pytest.mark.skipif(
    os.getuid() != 0 or subprocess.run([*_NO_USER, sys.executable, "-c", ""], capture_output=True).returncode != 0,
    reason="needs root, and a Python that other users may run",
)

#: Words before the command, the environment, and what the command says instead of ending with a traceback.
ENVIRONMENTS = [
    pytest.param(_NO_USER, {}, "~/.local/state: the home folder is not known; set HOME", marks=changes_users),
    pytest.param(_NO_USER, {"HOME": ""}, "", marks=changes_users),
    pytest.param(_NO_USER, {"HOME": "/nonexistent"}, "", marks=changes_users),
    ((), {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}, "pebble/robots/gö🤖b"),
    ((), {"PYTHONIOENCODING": "ascii"}, "pebble/robots/g\\xf6\\U0001f916b"),
    ((), {"PYTHONIOENCODING": "latin-1"}, "\\U0001f916b"),
    ((), {"LC_ALL": "xx_YY.UTF-8"}, "pebble/robots/gö🤖b"),
    ((), {"HOME": "/", "TMPDIR": "/nonexistent", "PATH": ""}, "pebble/robots/gö🤖b"),
]
COMMANDS = [["check"], ["check", "--json"]]


@pytest.fixture
def config() -> Iterator[Path]:
    """A copy in a folder that every user may read."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    path = folder / "robot.json"
    services = {"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": 1}}}
    path.write_text(json.dumps({"robot": {"id": "gö🤖b"}, "transport": {"kind": "zenoh"}, "services": services}))
    yield path
    shutil.rmtree(folder)


@pytest.mark.parametrize(("before", "environment", "printed"), ENVIRONMENTS)
def test_a_command_runs_or_names_what_is_missing(
    config: Path, before: tuple[str, ...], environment: dict[str, str], printed: str
) -> None:
    for words in COMMANDS[: 1 if printed.startswith("~") else cases(1, 2)]:
        command = [*before, sys.executable, "-m", "pebble.cli", *words, str(config)]
        env = {**_PATH, "HOME": str(config.parent), **environment, "PYTHONPATH": str(ROOT)}
        if printed.startswith("~"):
            del env["HOME"]
        done = subprocess.run(command, env=env, cwd="/", capture_output=True, timeout=60)
        text = (done.stdout + done.stderr).decode(errors="replace")
        assert "Traceback" not in text
        assert "Error" not in text
        assert done.returncode == int(printed.startswith("~")), text
        assert printed in text or words != ["check"], text


OUTPUTS = [">/dev/full", "2>/dev/full", ">/dev/full 2>&1", "| true"]


@pytest.mark.parametrize(
    ("words", "outputs"), some(product([*COMMANDS, ["--help"], ["topic", "contract"], ["nonsense"]], OUTPUTS), 5)
)
def test_an_output_that_is_full_or_gone_ends_a_command_in_order(config: Path, words: list[str], outputs: str) -> None:
    command = [sys.executable, "-m", "pebble.cli", *words, *([str(config)] if words in COMMANDS else [])]
    done = subprocess.run(["sh", "-c", f'"$@" {outputs}', "sh", *command], cwd=ROOT, capture_output=True, timeout=60)
    assert done.returncode in (0, 1, 2)
    assert b"Traceback" not in done.stderr
    assert b"Exception ignored" not in done.stderr
