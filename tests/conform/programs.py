"""The sample programs of docs/your-robot.md in each language: how they are made, and how they are started."""

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

from pebble.client.connection import Target
from pebble.fleet import certificates
from pebble.fleet.certificates import CA_CERT
from pebble.fleet.roles import Account
from tests.fleet.brokers import HOST, FleetBroker
from tests.kit.npm import package
from tests.support import ROOT, Broker
from tests.transports.brokers import MAKERS, named_nats

Command = list[str | Path]
Language = Callable[[str, Path], Command]  # makes its "robot" or "operator" in a folder

EXAMPLES = ROOT / "examples"
CJSON = Path("/usr/include/cjson/cJSON.h")
WARNINGS = ("-Wall", "-Wextra", "-Werror", "-O2")


def source(program: str, ending: str) -> Path:
    return EXAMPLES / f"your-{program}" / f"{program}.{ending}"


def in_python(program: str, _folder: Path) -> Command:
    return [sys.executable, source(program, "py")]


def in_javascript(program: str, _folder: Path) -> Command:
    package("mqtt")
    return ["node", source(program, "mjs")]


def in_c(program: str, folder: Path) -> Command:
    if shutil.which("gcc") is None or not Path("/usr/include/mosquitto.h").exists() or not CJSON.exists():
        missing("needs a compiler and libraries (apt install gcc libc6-dev libmosquitto-dev libcjson-dev)")
    libraries = ("-lmosquitto", "-lcjson", "-lm")
    subprocess.run(["gcc", *WARNINGS, "-o", folder / program, source(program, "c"), *libraries], check=True)
    return [folder / program]


def in_arduino(program: str, folder: Path) -> Command:
    return sketch(source(program, "cpp"), folder / program)


def sketch(file: Path, program: Path) -> Command:
    """A stand-in takes the place of Arduino's libraries; its TLS is the openssl program."""
    if shutil.which("g++") is None or shutil.which("openssl") is None or not CJSON.exists():
        missing("needs a compiler, OpenSSL and cJSON (apt install g++ openssl libcjson-dev)")
    board = ROOT / "tests" / "conform" / "arduino"
    command: Command = ["g++", "-std=gnu++17", *WARNINGS, "-I", board, "-o", program, board / "main.cpp"]
    subprocess.run([*command, file, "-lcjson", "-pthread"], check=True)
    return [program]


def in_micropython(program: str, _folder: Path) -> Command:
    """The real interpreter, as WebAssembly; sockets, flash and console of a board are this machine's."""
    interpreter = package("@micropython/micropython-webassembly-pyscript")
    board, mqtt = ROOT / "tests" / "conform" / "micropython", source("robot", "py").with_name("mqtt.py")
    sample = source(program, "py").with_name(f"{program}-micropython.py")
    return ["node", board / "run.mjs", interpreter, mqtt, sample]


def missing(what: str) -> None:
    (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(what)


ROBOTS = (in_python, in_javascript, in_c, in_arduino, in_micropython)
OPERATORS = ROBOTS


NATS = MAKERS["nats"]
WITHOUT_NATS = pytest.mark.skipif(NATS.missing(), reason="needs NATS: make long PART=brokers")
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


def at_open(broker: Broker) -> tuple[Command, Target]:
    """What a program is started with, and how others reach its robot."""
    return ["mine", "127.0.0.1", str(broker.port)], Target(url=f"mqtt://127.0.0.1:{broker.port}", robot="mine")


def at_named(broker: Named, folder: Path, program: str, other: str) -> tuple[Command, Target]:
    """The same for accounts: that of the program, and that of the other side."""
    for name in (program, other):
        (folder / name).write_text(broker.passwords[name])
        (folder / name).chmod(0o600)
    url, ca = f"mqtts://{other}@{HOST}:{broker.port}", broker.folder / CA_CERT
    target = Target(url=url, robot="mine", password_file=folder / other, ca_cert=ca)
    return ["mine", HOST, str(broker.port), program, folder / program, ca], target
