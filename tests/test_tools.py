"""What `make test` runs it collects once, and `make demo` checks its options first."""

from __future__ import annotations

import math
import shutil
import subprocess
from pathlib import Path

import pytest

from pebble.extensions.lab.demo.main import SHORTEST_S
from tests.kit import rows
from tests.support import ROOT, WAIT_S


def test_each_test_of_which_some_rows_run_is_there() -> None:
    for name in rows.table():
        file, *_, test = name.split("::")
        assert f"def {test}(" in (ROOT / "tests" / file).read_text(), name


@pytest.mark.parametrize(
    ("options", "why"), [("SECONDS=25", "takes 26 s: give it at least that many"), ("SECONDS=soon", "takes 26 s")]
)
def test_a_demo_with_wrong_options_is_refused_before_the_set_up(tmp_path: Path, options: str, why: str) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)  # without anything to set up
    command = ["make", "demo", *options.split()]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=WAIT_S, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 2
    assert why in done.stderr
    assert list(tmp_path.iterdir()) == [tmp_path / "Makefile"]
    assert math.ceil(SHORTEST_S) == 26
