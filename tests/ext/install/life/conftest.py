"""Machines on which a robot is installed: built once, because a slot has half a gigabyte."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.kit.machine import Machine, missing
from tests.kit.releases import Key
from tests.support import ROOT

sys.path.insert(0, str(ROOT / "tools"))
import release  # type: ignore[import-not-found]

WHEELS = ROOT / ".venv" / "wheels"
OLD, NEW = "0.1.0", "0.2.0"
EPOCH = "1790000000"


@dataclass(frozen=True)
class Packages:
    """Two releases, signed by ``key``, which both trust."""

    folder: Path
    key: Key

    def of(self, version: str) -> Path:
        return self.folder / version

    def build(self, version: str, into: Path) -> None:
        os.environ["SOURCE_DATE_EPOCH"] = EPOCH
        source = into.with_name(f"source-{into.name}")
        release.copied(ROOT, source)
        place = source / "pebble/version.py"
        place.write_text(re.sub(r'"[0-9.]+"', f'"{version}"', place.read_text()))
        fields = {"sequence": int(version.split(".")[1]), "from": OLD, "keys": [self.key.public]}
        (source / "configs/debian/release.json").write_text(json.dumps(fields))
        release.build(source, into)
        shutil.rmtree(source)


@pytest.fixture(scope="session")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Packages:
    made = Packages(tmp_path_factory.mktemp("releases"), Key.fresh())
    for version in (OLD, NEW):
        made.build(version, made.of(version))
        made.key.sign(made.of(version) / "RELEASE.json")
    return made


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory, packages: Packages) -> Iterator[Machine]:
    """A machine that is off, with the old package and its slot."""
    if reason := missing():
        pytest.skip(reason)
    if not any(WHEELS.glob("*.whl")):  # what a slot is built from where there is no network
        pytest.skip("needs the wheels of a robot: make long PART=life fetches them")
    machine = Machine(tmp_path_factory.mktemp("installed"), [packages.folder, WHEELS])
    try:
        machine.boot()
        machine.sh(f"apt-get install --quiet --yes /mnt/{packages.folder.name}/{OLD}/*.deb", timeout=300)
        machine.run("pebble-slot", "take", "--wheels", "/mnt/wheels", timeout=600)
        machine.cut()
        yield machine
    finally:
        machine.cut()
        shutil.rmtree(machine.disk)


@pytest.fixture
def machine(tmp_path: Path, installed: Machine, packages: Packages) -> Iterator[Machine]:
    """One that has just been installed, and runs."""
    with Machine(tmp_path / "machine", [packages.folder, WHEELS], installed) as booted:
        yield booted
