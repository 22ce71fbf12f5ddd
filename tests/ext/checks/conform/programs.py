"""The samples of docs/your-robot.md: how they are made, and how they are started."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from pebble.contract import ONLINE
from pebble.extensions.checks.observer import Observer
from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.certificates import CA_CERT
from pebble.extensions.fleet.roles import Account
from pebble.extensions.operator.client.connection import Target, connected
from tests.ext.fleet.brokers import HOST, FleetBroker
from tests.kit.npm import package
from tests.support import ROOT, Broker, Child
from tests.transports.brokers import MAKERS, named_nats

Command = list[str | Path]
Sample = Callable[[Path], Command]  # makes it in a folder

ROBOT_PY = ROOT / "examples" / "your-robot" / "robot.py"
OPERATOR_PY = ROOT / "examples" / "your-operator" / "my_operator.py"
CJSON = Path("/usr/include/cjson/cJSON.h")
WARNINGS = ("-Wall", "-Wextra", "-Werror", "-O2")


def robot_in_python(_folder: Path) -> Command:
    return [sys.executable, ROBOT_PY]


def operator_in_python(_folder: Path) -> Command:
    return [sys.executable, OPERATOR_PY]


def mutant(sample: Path, folder: Path, old: str, new: str) -> Path:
    """Return a copy of a sample, with ``new`` in place of ``old`` in all files of its folder that have it."""
    copy = shutil.copytree(sample.parent, folder / "mutant", ignore=shutil.ignore_patterns("__pycache__"))
    files = [file for file in copy.iterdir() if old in file.read_text()]
    assert files, f"no file has {old!r}"
    for file in files:
        file.write_text(file.read_text().replace(old, new))
    return copy / sample.name


def operator_in_javascript(_folder: Path) -> Command:
    package("mqtt")
    return ["node", OPERATOR_PY.with_name("operator.mjs")]


def robot_in_arduino(folder: Path) -> Command:
    return sketch(ROBOT_PY.with_name("robot.cpp"), folder / "robot")


def sketch(sample: Path, program: Path) -> Command:
    """A stand-in takes the place of Arduino's libraries; its TLS is the openssl program."""
    if shutil.which("g++") is None or shutil.which("openssl") is None or not CJSON.exists():
        missing("needs a compiler, OpenSSL and cJSON (apt install g++ openssl libcjson-dev)")
    board = ROOT / "tests/ext/checks/conform/arduino"
    command: Command = ["g++", "-std=gnu++17", *WARNINGS, "-I", board, "-o", program, board / "main.cpp"]
    subprocess.run([*command, sample, "-lcjson", "-pthread"], check=True)
    return [program]


def robot_in_micropython(_folder: Path) -> Command:
    """The real interpreter, as WebAssembly; sockets and flash of a board are this machine's."""
    interpreter = package("@micropython/micropython-webassembly-pyscript")
    board = ROOT / "tests/ext/checks/conform/micropython"
    return ["node", board / "run.mjs", interpreter, ROBOT_PY.with_name("robot-micropython.py")]


def missing(what: str) -> None:
    (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(what)


ROBOTS = (robot_in_python, robot_in_arduino, robot_in_micropython)
OPERATORS = (operator_in_python, operator_in_javascript)


WITHOUT_NATS = pytest.mark.skipif(MAKERS["nats"].missing(), reason="needs NATS: make long PART=brokers")
PASSWORDS = {"mine": "any robot", "ann": "any person"}


class Named(NamedTuple):
    """A broker with TLS where the robot ``mine`` and the person ``ann`` have accounts, and what they need to know."""

    port: int
    folder: Path
    passwords: Mapping[str, str] = PASSWORDS


Hall = Callable[[Path], AbstractContextManager[Named]]


@contextmanager
def ended(broker: Broker) -> Iterator[Broker]:
    try:
        yield broker
    finally:
        broker.stop()


@contextmanager
def believing(folder: Path) -> Iterator[Named]:
    """A mosquitto that believes every name: by it, one account sends as another, and without any."""
    certificate, key = _certificate(folder)
    with ended(Broker(folder, f"certfile {certificate}", f"keyfile {key}")) as broker:
        yield Named(broker.port, folder)


@contextmanager
def named_by_nats(folder: Path) -> Iterator[Named]:
    with ended(named_nats(folder, "mine", "ann", PASSWORDS, _certificate(folder))) as broker:
        yield Named(broker.port, folder)


@contextmanager
def named_by_the_fleet(folder: Path) -> Iterator[Named]:
    """A mosquitto with the files of `pebble fleet`."""
    people = {
        "mine": Account(roles=("robot",), bases=("pebble/robots/mine",)),
        "ann": Account(roles=("driver", "safety")),
    }
    with FleetBroker(folder, people, level="named") as broker:
        yield Named(broker.port, folder, broker.passwords)


def _certificate(folder: Path) -> tuple[Path, Path]:
    certificates.init(folder, [HOST])
    return folder / certificates.SERVER_CERT, folder / certificates.SERVER_KEY


Place = tuple[Command, Target]
LOOKS_S = 2.0


@contextmanager
def switched_on(program: Command, place: Place, folder: Path, *filters: str) -> Iterator[tuple[Child, Observer]]:
    """A robot, which saves its stop in ``folder``, and who looks at it through its broker, or at ``filters`` there."""
    arguments, target = place
    command = [*program, *arguments[:3], folder / "stop.json", *arguments[3:]]
    process = Child([str(word) for word in command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        with connected(target) as (transport, names):
            robot = Observer(target, transport, names, filters)
            robot.wait(lambda: robot.view.capabilities, 30)
            robot.look(LOOKS_S)
            robot.wait(lambda: len(robot.of(ONLINE)) > 2, LOOKS_S)  # its interval is seen by three of them
            yield process, robot
    finally:
        process.kill()
        process.wait()


def at_open(broker: Broker) -> Place:
    """What a program is started with, and how others reach its robot."""
    return ["mine", "127.0.0.1", str(broker.port)], Target(url=f"mqtt://127.0.0.1:{broker.port}", robot="mine")


def at_named(broker: Named, folder: Path) -> Place:
    """Return the same for accounts: ``mine`` of the robot, and ``ann`` of the other side."""
    for name in PASSWORDS:
        (folder / name).write_text(broker.passwords[name])
        (folder / name).chmod(0o600)
    url, ca = f"mqtts://ann@{HOST}:{broker.port}", broker.folder / CA_CERT
    target = Target(url=url, robot="mine", password_file=folder / "ann", ca_cert=ca)
    return ["mine", HOST, str(broker.port), "mine", folder / "mine", ca], target
