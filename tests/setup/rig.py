"""A scratch root that stands for a machine, set up inside this process or in a child that is killed."""

from __future__ import annotations

import io
import json
import os
import signal
import stat
import sys
import tarfile
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pebble.setup import manifest, plan
from pebble.setup.backup import make, packed
from pebble.setup.detect import Machine
from pebble.setup.manifest import Manifest
from pebble.setup.places import Places
from pebble.setup.plan import Plan
from pebble.setup.questions import Secrets, combined, plain
from pebble.setup.steps import Engine, Result

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
_RANDOM = (".key", ".pem", ".password", "passwords", ".sqlite", "setup.json", "mosquitto.pid")
_WRITES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.chmod", "os.symlink", "os.truncate"}


def machine_root(folder: Path) -> Path:
    """A machine with mosquitto and polkit, by the files that setup looks for."""
    root = folder / "root"
    for name in ("usr/sbin/mosquitto", "usr/lib/polkit-1/polkitd", "etc/mosquitto/mosquitto.conf"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    (root / "var/lib").mkdir(parents=True)
    return root


def answers_in(folder: Path) -> Path:
    """A file of answers, and one with Ann's password beside it."""
    password, file = folder / "ann", folder / "answers.json"
    password.write_text(f"{PASSWORD}\n")
    file.write_text(json.dumps(ANSWERS | {"password_file": str(password)}))
    return file


def set_up(root: Path, machine: Machine | None = None, **changes: Any) -> list[Result]:
    """All steps once, as the command does them."""
    places = Places(root)
    known = manifest.load(places) or Manifest()
    answers = combined(ANSWERS, known.answers, changes)
    known.answer(plain(answers))
    wanted = Plan(
        places, answers, machine or Machine(), known, Secrets(password=PASSWORD, broker_password=BROKER_PASSWORD)
    )
    engine = Engine(places, known)
    found = list(engine.apply(plan.steps(wanted)))
    engine.finish({robot: plan.removal_of(robot) for robot in known.leaving})
    return found


def tree(root: Path) -> dict[str, tuple[str, bytes]]:
    """All paths with their modes, and their contents where these are no matter of chance."""
    return {str(path.relative_to(root)): _shown(path) for path in sorted(root.rglob("*"))}


def _shown(path: Path) -> tuple[str, bytes]:
    mode = stat.filemode(path.lstat().st_mode)
    if path.is_symlink():
        return mode, str(path.readlink()).encode()
    return mode, b"" if path.is_dir() or path.name.endswith(_RANDOM) else path.read_bytes()


def manifest_is_true(root: Path) -> bool:
    """Whether the manifest has each file that is there, with its one content."""
    known = manifest.load(Places(root))
    assert known is not None
    found = {name: [manifest.sha256(manifest.content_of(root / name[1:]))] for name in known.files}
    return known.files == found


def in_child(act: Callable[[], object], *, kill_at: int | None = None, below: Path | None = None) -> tuple[int, int]:
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


def without_rights(act: Callable[[], str]) -> str:
    """Run it in a fork, as a user without rights. Returns its text."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
            os.write(writer, act().encode())
        except BaseException:
            os.write(writer, traceback.format_exc().encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        text = pipe.read()
    os.waitpid(child, 0)
    return text


def backup_of(root: Path, file: Path) -> Path:
    """What `pebble setup --backup` writes of it."""
    file.write_bytes(packed(make(Places(root))))
    return file


def tar_of(file: Path, members: Sequence[tuple[str, bytes]]) -> Path:
    with tarfile.open(file, "w") as tar:
        for name, content in members:
            _add(tar, name, content, 0o600)
    return file


def _add(tar: tarfile.TarFile, name: str, content: bytes, mode: int) -> None:
    member = tarfile.TarInfo(name)
    member.size, member.mode = len(content), mode
    tar.addfile(member, io.BytesIO(content))
