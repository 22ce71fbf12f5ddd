"""`make test` checks its downloads, and downloads once."""

from __future__ import annotations

import http.server
import math
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.demo.main import SHORTEST_S
from tests.kit import rows
from tests.support import ROOT, free_port, gone, until

PATH = "/@micropython/micropython-webassembly-pyscript/-/micropython-webassembly-pyscript-1.29.0-6.tgz"


class Registry(http.server.BaseHTTPRequestHandler):
    """Serves the same wrong content at every path."""

    asked: list[str]

    def do_GET(self) -> None:
        self.asked.append(self.path)
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"something else")

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def registry() -> Iterator[tuple[str, list[str]]]:
    Registry.asked = []
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Registry)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}", Registry.asked
    server.shutdown()
    server.server_close()


def fetch(folder: Path, registry: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "NPM_CONFIG_REGISTRY": registry, "no_proxy": "127.0.0.1"}
    environment.pop("npm_config_registry", None)
    command = [sys.executable, ROOT / "tools" / "fetch_npm.py", folder, "micropython"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)


def test_a_micropython_that_is_another_one_is_refused(tmp_path: Path, registry: tuple[str, list[str]]) -> None:
    url, asked = registry
    done = fetch(tmp_path / "there", url)
    assert done.returncode == 1
    assert done.stderr == f"{url}{PATH} does not have the expected checksum\n"
    assert asked == [PATH]
    assert not list(tmp_path.rglob("*.wasm"))


def test_one_that_is_there_is_not_fetched_again() -> None:
    assert fetch(ROOT / ".venv", f"http://127.0.0.1:{free_port()}").returncode == 0


def test_no_registry_is_one_line(tmp_path: Path) -> None:
    done = fetch(tmp_path, f"http://127.0.0.1:{free_port()}")
    assert done.returncode == 1
    assert done.stderr.startswith("cannot fetch http://127.0.0.1:")
    assert done.stderr.count("\n") == 1


FLAKY = """
import pathlib, pytest
@pytest.mark.parametrize("name", ["a/b [c]", "d e"])
def test_second_time(name):
    flag = pathlib.Path(name[0])
    seen = flag.exists()
    flag.touch()
    assert seen
def test_first_time(): pass
"""


def run_tests(folder: Path, content: str, workers: int = 1, *more: str) -> tuple[int, str]:
    (folder / "test_it.py").write_text(content)
    options = ["-q", "--workers", str(workers), f"--rootdir={folder}", *more]
    command = [sys.executable, str(ROOT / "tools/run_tests.py"), *options]
    plugins = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_PLUGINS": ""}  # others take seconds to import
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **plugins}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=100, env=environment)
    return done.returncode, done.stdout


def test_each_test_of_which_some_rows_run_is_there() -> None:
    for name in rows.table():
        file, *_, test = name.split("::")
        assert f"def {test}(" in (ROOT / "tests" / file).read_text(), name


def test_few_failed_tests_run_once_more_alone_and_are_named(tmp_path: Path) -> None:
    code, output = run_tests(tmp_path, FLAKY, workers=2)
    assert code == 0
    assert "UNRELIABLE, passed only the second time" in output
    assert "test_it.py::test_second_time[a/b [c]]" in output.partition("UNRELIABLE")[2]


def test_what_fails_twice_fails(tmp_path: Path) -> None:
    assert run_tests(tmp_path, FLAKY.replace("assert seen", "assert not name"))[0] == 1


def test_many_failures_are_no_coincidence(tmp_path: Path) -> None:
    code, output = run_tests(tmp_path, FLAKY.replace('["a/b [c]", "d e"]', "list('abcdefghijk')"))
    assert (code, "once more" in output) == (1, False)


def test_an_error_in_a_test_file_fails(tmp_path: Path) -> None:
    assert run_tests(tmp_path, "import nothing_like_this")[0] not in (0, 5)


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
    code, output = run_tests(tmp_path, DIES, workers=2)
    assert code != 0
    assert "the process that ran test_it.py::test_dies died" in output
    assert "1 failed, 3 passed" in output
    once_and_for_the_second_time = "xx"
    assert (tmp_path / "collected").read_text() == once_and_for_the_second_time
    assert (tmp_path / "made").read_text() == "xxx"  # by two workers, and for the second time


MEET = """
import pathlib, pytest, time
def meet(own, other):
    pathlib.Path(own).touch()
    deadline = time.monotonic() + 10
    while not pathlib.Path(other).exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
@pytest.fixture(scope="module")
def made(): pathlib.Path("made").open("a").write("x")
def test_first(made): pass
def test_second(made): pass
def test_one(): meet("one", "other")
def test_other(): meet("other", "one")
"""


def test_tests_that_share_no_fixture_need_not_wait_for_each_other(tmp_path: Path) -> None:
    assert run_tests(tmp_path, MEET, 2, "--spread")[0] == 0
    assert (tmp_path / "made").read_text() == "x"


LEAVES = """
import subprocess
def test_leaves():
    subprocess.Popen(["sleep", "60"], start_new_session=True)
"""


def test_processes_that_a_test_leaves_behind_are_named_and_ended(tmp_path: Path) -> None:
    code, output = run_tests(tmp_path, LEAVES)
    assert code == 1
    left = re.search(r"LEFT BEHIND, please report: (\d+) sleep 60 PYTEST_CURRENT_TEST=test_it.py::test_leaves", output)
    assert left is not None
    assert until(lambda: gone(int(left[1])))


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
