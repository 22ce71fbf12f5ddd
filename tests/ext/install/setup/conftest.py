"""A scratch root that stands for a machine, set up in this process, by the command, or in a child that is killed."""

from __future__ import annotations

import io
import json
import os
import signal
import stat
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load
from pebble.extensions.install.commands import setup as command
from pebble.extensions.install.setup import system
from pebble.extensions.install.setup.answers import Answers, Secrets
from pebble.extensions.install.setup.robot_config import answers_of
from pebble.extensions.install.setup.steps import Job
from pebble.extensions.install.setup.system import System
from pebble.extensions.operator.places import Places
from tests.commands.command_line import Run

PASSWORD, BROKER_PASSWORD = "sentinel-of-ann-7c1d", "sentinel-of-goob-11fe"
ANSWERS: dict[str, Any] = {
    "id": "goob",
    "port": "/dev/serial/by-id/usb-board",
    "protocol": "goob_base_v1",
    "camera": "synthetic",
    "broker": "here",
    "page": True,
    "user": "ann",
}
#: Where each run has other bytes: keys, what is signed by them, and passwords.
_RANDOM = (".key", ".pem", ".password", "passwords", ".sqlite", "mosquitto.pid")
_WRITES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.chmod", "os.symlink", "os.truncate"}


def machine_root(folder: Path) -> Path:
    """A machine with our package, mosquitto and polkit, by the files that setup looks for."""
    root = folder / "root"
    for name in ("usr/sbin/mosquitto", "usr/lib/polkit-1/polkitd", "etc/mosquitto/mosquitto.conf"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    for name in ("etc/mosquitto/conf.d", "etc/pebble", "var/lib/pebble"):
        (root / name).mkdir(parents=True)
    return root


def machine(root: Path, ran: list[str] | None = None) -> System:
    """Files of this user below a root; programs are not run, but noted."""
    noted = [] if ran is None else ran
    return System(Places(root), run=lambda command: noted.append(" ".join(command)), owner=lambda _names: None)


def answers_in(folder: Path, **changes: Any) -> Path:
    """A file of answers, and one with Ann's password beside it."""
    password, file = folder / "ann", folder / "answers.json"
    password.write_text(f"{PASSWORD}\n")
    file.write_text(json.dumps(ANSWERS | {"password_file": str(password)} | changes))
    return file


def set_up(root: Path, ran: list[str] | None = None, **changes: Any) -> list[str]:
    """All steps once, without a word. Returns those that were done."""
    places = Places(root)
    config = load(places.config) if places.config.exists() else None
    answers = Answers() if config is None else answers_of(config, places)
    secrets = Secrets(password=PASSWORD, broker_password=BROKER_PASSWORD)
    job = Job(machine(root, ran), config, answers, secrets)
    job = job.with_answers((ANSWERS if config is None else {}) | changes)
    steps = job.left()
    job.do(steps)
    return [step.what for step in steps]


def tree(root: Path) -> dict[str, tuple[str, bytes]]:
    """All paths with their modes, and their contents where these are no matter of chance."""
    return {str(path.relative_to(root)): _shown(path) for path in sorted(root.rglob("*"))}


def _shown(path: Path) -> tuple[str, bytes]:
    mode = stat.filemode(path.lstat().st_mode)
    if path.is_symlink():
        return mode, str(path.readlink()).encode()
    return mode, b"" if path.is_dir() or path.name.endswith(_RANDOM) else path.read_bytes()


def in_child(act: Callable[[], object], *, kill_at: int | None = None, below: Path) -> tuple[int, int]:
    """Run it in a fork. Returns how it ended, and how many times it changed files below a folder.

    ``kill_at``: it is killed before that change.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            count = 0

            def watch(event: str, arguments: tuple[Any, ...]) -> None:
                nonlocal count
                writes = event in _WRITES or (
                    event == "open" and arguments[2] and arguments[2] & (os.O_WRONLY | os.O_RDWR)
                )
                if writes and str(arguments[0]).startswith(str(below)):
                    count += 1
                    if count == kill_at:
                        os.kill(os.getpid(), signal.SIGKILL)

            sys.addaudithook(watch)
            act()
            os.write(writer, str(count).encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        counted = int(pipe.read() or 0)
    _, status = os.waitpid(child, 0)
    return status, counted


def tar_of(*members: tuple[str, bytes], kind: bytes = tarfile.REGTYPE) -> bytes:
    """An archive of these files; all but the first one may be of another kind."""
    output = io.BytesIO()
    with tarfile.open(fileobj=output, mode="w") as tar:
        for name, content in members:
            member = tarfile.TarInfo(name)
            member.type = kind if tar.members else tarfile.REGTYPE
            member.size, member.mode, member.linkname = len(content), 0o600, "/etc/passwd"
            tar.addfile(member, io.BytesIO(content))
    return output.getvalue()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return machine_root(tmp_path)


@pytest.fixture
def run(root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    at(root, monkeypatch)
    return Run(monkeypatch, capsys)


def at(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command act on this machine."""
    monkeypatch.setattr(system, "System", lambda: machine(root))
    monkeypatch.setattr(command, "Places", lambda: Places(root))
