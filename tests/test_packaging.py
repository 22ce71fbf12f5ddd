"""What an installed Pebble consists of, and that the folders' two names are the same thing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.support import ROOT

pytestmark = pytest.mark.computing

LINKED = ("configs", "firmware", "services", "transports")
NOT_MODULES = ("pebble/firmware/", "pebble/extensions/scripts/shipped/")  # imported by boards; started as programs
SHARED = ".data/data/share/"  # in the name of what is put below the prefix: completions, a program for GStreamer
NOT_SOURCES = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist", "tests", "docs")


def sources() -> dict[str, Path]:
    """Every file of the package, by its path inside the wheel."""
    found = {}
    for folder, inside in ((ROOT / "pebble", "pebble"), *((ROOT / name, f"pebble/{name}") for name in LINKED)):
        for path in folder.rglob("*"):  # does not follow the symlinks
            if path.is_file() and "__pycache__" not in path.parts:
                found[f"{inside}/{path.relative_to(folder)}"] = path
    return found


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Built from a copy: files that a build leaves in the checkout would be part of the next one."""
    folder = tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT, folder / "source", symlinks=True, ignore=NOT_SOURCES)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), "source"]
    built = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


@pytest.mark.parametrize("name", LINKED)
def test_the_top_level_folders_are_inside_the_package_too(name: str) -> None:
    assert os.readlink(ROOT / "pebble" / name) == f"../{name}"  # noqa: PTH115 - the text of the link


def test_every_folder_of_modules_is_a_package() -> None:
    """Python imports one without `__init__.py`, too, but the import rules do not see it."""
    there = sources()
    folders = {path.rpartition("/")[0] for path in there if path.endswith(".py") and not path.startswith(NOT_MODULES)}
    assert [folder for folder in sorted(folders) if f"{folder}/__init__.py" not in there] == []


def test_the_wheel_holds_every_source_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    packed = {name for name in wheel.namelist() if ".dist-info/" not in name}
    shared = {name for name in packed if SHARED in name}
    completions = {path.name for path in (ROOT / "configs" / "completion").iterdir()}
    assert {name.rpartition("/")[2] for name in shared} == {*completions, "gstreamer_sockets.py"}
    assert packed - shared == {name for name in sources() if "/configs/completion/" not in name}


def test_every_module_of_the_wheel_imports_without_the_checkout_and_its_firmware_runs_on_a_simulated_board(
    wheel: zipfile.ZipFile, tmp_path: Path
) -> None:
    wheel.extractall(tmp_path)
    packed = [name for name in wheel.namelist() if SHARED not in name]
    host_files = [name for name in packed if name.endswith(".py") and not name.startswith(NOT_MODULES)]
    names = [name.removesuffix(".py").removesuffix("/__init__") for name in host_files]
    modules = [name.replace("/", ".") for name in names if not name.endswith("__main__")]
    code = """
import importlib, sys
for name in sys.argv[1:]:
    print(importlib.import_module(name).__file__)
mcu = sys.modules["pebble.extensions.lab.simulation.board"].SimulatedMcu("goob", 0.0)
print(mcu.board.firmware.module("goob.robot").__file__)
print(mcu.receive(b"M 1 1\\n", 0.0))
"""
    command, environment = [sys.executable, "-c", code, *modules], {**os.environ, "PYTHONPATH": str(tmp_path)}
    ran = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    *imported, firmware, answer = ran.stdout.splitlines()
    assert all(line.startswith(str(tmp_path)) for line in imported)
    assert len(imported) == len(modules)
    assert (firmware, answer) == (str(tmp_path / "pebble/firmware/goob/robot.py"), r"b'OK M\r\n'")
