"""What is installed is bounded, pinned, hashed and named, and what was not checked is said."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support import ROOT

sys.path.insert(0, str(ROOT / "tools"))
import lock  # type: ignore[import-not-found]
import sbom  # type: ignore[import-not-found]

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
BOUNDS = {"<", "<=", "~=", "=="}
PIN = re.compile(
    r"^(?P<name>[a-z0-9.-]+)==(?P<version>[^ ;\\]+)( ; (?P<marker>[^\\]+))? \\\n"
    r"    --hash=sha256:[0-9a-f]{64}( \\\n    --hash=sha256:[0-9a-f]{64})*",
    re.MULTILINE,
)


def required() -> list[tuple[str, Requirement]]:
    """Every direct dependency with what asks for it."""
    extras = PROJECT["project"]["optional-dependencies"]
    lists = {"": PROJECT["project"]["dependencies"], **extras, "build": PROJECT["build-system"]["requires"]}
    lists["tools"] = PROJECT["dependency-groups"]["tools"]
    wanted = [(extra, Requirement(line)) for extra, lines in lists.items() for line in lines]
    return [(extra, one) for extra, one in wanted if one.name != PROJECT["project"]["name"]]


def locked(kind: str) -> str:
    command = ["sh", str(ROOT / "tools" / "locked.sh"), kind]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def versions(kind: str) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for pin in PIN.finditer(locked(kind)):
        found.setdefault(pin["name"], set()).add(pin["version"])
    return found


def test_every_dependency_has_an_upper_bound() -> None:
    open_ended = [str(one) for _, one in required() if not BOUNDS & {part.operator for part in one.specifier}]
    assert open_ended == []


# -- requirements.txt


def test_every_line_of_the_lock_is_a_pin_with_hashes_and_its_uses() -> None:
    text = lock.LOCK.read_text()
    assert PIN.search(text)
    rest = [line for line in PIN.sub("", text).splitlines() if line.strip()]
    assert rest[0].startswith("# Written by make lock")
    kinds = {*lock.KINDS, lock.TOOLS}
    assert all(line.startswith("    # for ") and set(line.split()[2:]) <= kinds for line in rest[1:]), "nothing else"
    assert len(rest[1:]) == len(PIN.findall(text))


@pytest.mark.parametrize("kind", [*lock.KINDS, lock.TOOLS])
def test_the_lock_has_what_pyproject_asks_for(kind: str) -> None:
    """If not: make lock."""
    extras = {lock.TOOLS} if kind == lock.TOOLS else {"", "build", *lock.KINDS[kind]}
    there = versions(kind)
    for extra, wanted in required():
        if extra in extras:
            assert canonicalize_name(wanted.name) in there, f"the lock has no {wanted.name} for {kind}"
            for version in there[canonicalize_name(wanted.name)]:
                assert wanted.specifier.contains(version), f"the lock has {wanted.name} {version}, not {wanted}"


def test_a_slot_without_a_lock_on_32_bits_has_what_the_lock_of_robots_has() -> None:
    assert f"[{','.join(lock.KINDS['robot'])}]" in (ROOT / "configs" / "slot" / "pebble-slot").read_text()


FAKE_PIP = """#!/bin/sh
echo "$*" >>"$CALLS"
case "$*" in
*--version*) exit 0 ;;
*--require-hashes*) [ -z "$LOCKED_FAILS" ] || { echo "ERROR: $LOCKED_FAILS"; exit 1; } ;;
esac
"""


def set_up(folder: Path, locked_fails: str) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """tools/setup.sh for the demo, with a Python that only writes down what pip is asked for."""
    for file in ("tools/setup.sh", "tools/locked.sh", "requirements.txt"):
        (folder / file).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / file, folder / file)
    python = folder / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(FAKE_PIP)
    python.chmod(python.stat().st_mode | stat.S_IXUSR)
    calls = folder / "calls"
    environment = {**os.environ, "CALLS": str(calls), "LOCKED_FAILS": locked_fails}
    command = ["sh", str(folder / "tools" / "setup.sh"), "demo"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)
    return done, [line.partition(" install ")[2] for line in calls.read_text().splitlines() if " install " in line]


def test_a_clone_installs_what_is_locked(tmp_path: Path) -> None:
    done, installed = set_up(tmp_path, "")
    assert done.returncode == 0, done.stderr
    *parts, own = installed
    assert own == "--disable-pip-version-check --no-compile --no-deps --no-build-isolation --editable ."
    asked = (
        "--disable-pip-version-check --no-compile --require-hashes --no-deps --only-binary :all: --no-binary esptool"
    )
    files = {line.removeprefix(f"{asked} -r ") for line in parts}
    assert len(files) == 2, installed
    text = "".join((tmp_path / file).read_text() for file in sorted(files))
    assert sorted(PIN.findall(text)) == sorted(PIN.findall(locked("demo")))


@pytest.mark.parametrize(
    ("why", "code", "last", "said"),
    [
        ("No matching distribution found for numpy==2.4.6", 0, "--editable .[demo]", "cannot be installed here"),
        ("THESE PACKAGES DO NOT MATCH THE HASHES FROM", 1, "", "has other files than requirements.txt, see above"),
    ],
    ids=["a Python without these wheels installs the newest", "a file with another hash ends the installation"],
)
def test_what_is_locked_cannot_be_installed(tmp_path: Path, why: str, code: int, last: str, said: str) -> None:
    done, installed = set_up(tmp_path, why)
    assert done.returncode == code
    assert installed[-1].endswith(last)
    assert (len(installed) == 2) == (code == 1)
    assert said in done.stdout + done.stderr


# -- what is in it


def test_the_sbom_names_every_vendored_file_and_package_once() -> None:
    entries = json.loads(sbom.VENDOR.read_text())
    components = sbom.vendored(entries)
    assert {part["purl"] for part in components} == {
        f"pkg:npm/{one['name'].replace('@', '%40')}@{one['version']}" for one in entries
    }
    assert len({part["bom-ref"] for part in components}) == len(components)
    files = {(file["name"], file["hashes"][0]["content"]) for part in components for file in part["components"]}
    assert files == {(one["file"], one["sha256"]) for one in entries}


def test_every_package_of_a_robot_is_on_the_page_of_licences() -> None:
    page = (ROOT / "docs" / "licences.md").read_text()
    table = page.partition("## Packages of a robot")[2].partition("## What PyAV")[0]
    cells = ", ".join(re.findall(r"^\| .* \| (.*) \|$", table, re.MULTILINE)[1:])
    assert set(re.split(r"[,;] ", re.sub(r" \([^)]*\)", "", cells))) == set(versions("robot"))
    for package, name in (("av", "PyAV"), ("opencv-python-headless", "OpenCV")):  # its libraries: read the wheel again
        (version,) = versions("robot")[package]
        assert f"version {version}" in page.partition(f"What {name}'s wheel contains")[2]
