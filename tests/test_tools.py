"""What `make test` runs it collects once, and `make demo` checks its options first."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.extensions.lab.demo.main import SHORTEST_S
from tests.kit import rows
from tests.support import ROOT


def run_tests(folder: Path, content: str) -> tuple[int, str]:
    (folder / "test_it.py").write_text(content)
    command = [sys.executable, "-m", "pytest", "-p", "tests.kit.workers", "--workers", "2", f"--rootdir={folder}"]
    plugins = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_PLUGINS": ""}  # others take seconds to import
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **plugins}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=100, env=environment)
    return done.returncode, done.stdout


def test_each_test_of_which_some_rows_run_is_there() -> None:
    for name in rows.table():
        file, *_, test = name.split("::")
        assert f"def {test}(" in (ROOT / "tests" / file).read_text(), name


DIES = """
import os, pathlib, pytest
pathlib.Path("collected").open("a").write("x")
@pytest.fixture(scope="module")
def made(): pathlib.Path("made").open("a").write("x")
def test_first(made): pass
def test_dies(made): os._exit(3)
def test_goes_on(made): pass
"""


def test_tests_are_collected_once_and_a_worker_that_dies_fails_its_test_only(tmp_path: Path) -> None:
    (tmp_path / "test_other.py").write_text("def test_elsewhere(): pass")
    code, output = run_tests(tmp_path, DIES)
    assert code != 0
    assert "the process that ran test_it.py::test_dies died" in output
    assert "1 failed, 3 passed" in output
    assert (tmp_path / "collected").read_text() == "x"
    assert (tmp_path / "made").read_text() == "xx"  # by two workers


@pytest.mark.parametrize(
    ("options", "why"), [("SECONDS=25", "takes 26 s: give it at least that many"), ("SECONDS=soon", "takes 26 s")]
)
def test_a_demo_with_wrong_options_is_refused_before_the_set_up(tmp_path: Path, options: str, why: str) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)  # without anything to set up
    command = ["make", "demo", *options.split()]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=20, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 2
    assert why in done.stderr
    assert list(tmp_path.iterdir()) == [tmp_path / "Makefile"]
    assert math.ceil(SHORTEST_S) == 26
