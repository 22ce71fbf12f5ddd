"""Fixtures and hooks for every test."""

import atexit
import gc
import os
import secrets
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

# What tests and robots save belongs to the run, not to the user who runs it. Short: it holds unix sockets.
os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", tempfile.gettempdir())
_FOLDER = tempfile.mkdtemp(prefix="t")
Path(_FOLDER).chmod(0o1777)  # some tests are run by other users as well
atexit.register(shutil.rmtree, _FOLDER, ignore_errors=True)  # before others remove what is in it
os.environ["TMPDIR"] = tempfile.tempdir = _FOLDER
os.environ.pop("STATE_DIRECTORY", None)
os.environ["XDG_STATE_HOME"] = f"{_FOLDER}/state"

import pytest
from hypothesis import settings

from pebble.extensions.media.frames import memory
from pebble.transports import segments
from tests.kit import rows
from tests.kit.workers import pytest_addoption as pytest_addoption  # of the initial conftest
from tests.kit.workers import pytest_configure as pytest_configure
from tests.support import ROOT, Broker, cases

# Started in the background of a shell or by nohup, this process ignores signals, and so would every program it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# httpx reads the authorities of the whole web for each client, which takes 50 ms; those that tests meet are here.
os.environ["SSL_CERT_FILE"] = str(Path(__file__).parent / "data" / "tls" / "ca.crt")

gc.disable()  # until the tests are collected, of which nothing is garbage: a fifth of the time that it takes

# An example may take long on a busy machine.
settings.register_profile("pebble", deadline=None, max_examples=cases(30, 100))
settings.load_profile("pebble")

# Node.js, which tests of the page and of the firmware need, is the one that is locked.
os.environ["PATH"] = f"{ROOT / 'node_modules' / '.bin'}:{os.environ['PATH']}"

#: A variable of every process that a test starts.
_RUN = f"PEBBLE_TEST_RUN={secrets.token_hex(8)}"
os.environ.update([_RUN.split("=")])
_ENDING_S = 5.0  # for processes that are about to end

#: Folders and modules of tests that check no times.
_COMPUTING = (
    *("commands/", "config/", "contract/", "core/test_extensions", "ext/checks/test_check.", "ext/media/"),
    *("ext/install/setup/test_steps.", "ext/page/modules/", "ext/recordings/exports/", "ext/recordings/files/"),
    *("ext/recordings/seek/", "ext/recordings/test_unread", "ext/recordings/traffic/", "ext/scripts/perception/"),
    "motion/",
)
#: Modules that take longest begin first: begun last, one of them would delay the end of the run.
_LONG = (
    *(
        "conform/test_conform.py",
        "ext/page/robots/test_controls.py",
        "robot/test_scripts.py",
        "robot/test_media.py",
    ),
    *(
        "ext/operator/commands/test_estop.py",
        "ext/page/test_drive_command.py",
        "transports/test_contract.py",
        "transports/test_mqtt.py",
        "ext/recordings/recorder",
    ),
    *("robot/test_lockstep.py", "firmware/test_heap.py", "ext/page/test_types.py"),
    *("firmware/test_deadman_virtual.py", "motion/test_motion.py"),
)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    """Yield a broker for this test alone; in some folders there is one for a whole module."""
    running = Broker(tmp_path)
    yield running
    running.stop()


@pytest.fixture
def brokers(tmp_path: Path) -> Iterator[tuple[Broker, Broker]]:
    """Yield two brokers; a test ends one of them."""
    first, second = Broker(tmp_path), Broker(tmp_path)
    yield first, second
    first.kill()
    second.kill()


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for row in rows.fewer(items):
        row.add_marker(pytest.mark.thorough)
    computing = tuple(f"{Path(__file__).parent}/{place}" for place in _COMPUTING)
    for item in items:
        if str(item.path).startswith(computing):
            item.add_marker(pytest.mark.computing)
        if item.get_closest_marker("computing"):
            item.add_marker(pytest.mark.timeout(600))  # they wait for the processors
    places = {path: _place(path) for path in {item.path for item in items}}
    items.sort(key=lambda item: places[item.path])


def _place(path: Path) -> int:
    """Return when a module begins, as a sort key."""
    return next((at for at, part in enumerate(_LONG) if part in path.as_posix()), len(_LONG))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Give each worker other state folders, so that robots do not find those of another worker."""
    own = Path(_FOLDER, "state", str(os.getpid()))
    own.mkdir(parents=True, exist_ok=True)
    os.environ["XDG_STATE_HOME"] = str(own)


def pytest_collection_finish() -> None:
    """Exclude the present objects from garbage collection: a search of all stops this process for 0.3 s or more."""
    gc.enable()
    gc.collect()
    gc.freeze()


def pytest_sessionfinish(session: pytest.Session) -> None:
    gc.unfreeze()
    if session.config.getoption("--workers"):  # otherwise what this process started ends with it
        for pid, description in _processes_left().items():
            sys.stdout.write(f"\npebble: LEFT BEHIND: {description}\n")
            session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED
            with suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        shutil.rmtree(_FOLDER, ignore_errors=True)
    _remove_segments()


def _processes_left() -> dict[int, str]:
    """Return the command lines and tests of processes that tests have left behind, by pid; on Linux only."""
    deadline = time.monotonic() + _ENDING_S
    while left := {pid: text for pid in _pids() if (text := _described(pid))}:
        if time.monotonic() > deadline:
            break
        time.sleep(0.1)
    return left


def _pids() -> list[int]:
    return [int(path.name) for path in Path("/proc").glob("[0-9]*") if int(path.name) != os.getpid()]


def _described(pid: int) -> str:
    """Return the command line and the test of a process of this run; empty for others."""
    with suppress(OSError):
        variables = Path(f"/proc/{pid}/environ").read_bytes().decode(errors="replace").split("\0")
        command = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").replace("\0", " ")
        if _RUN in variables and command:
            test = next((one for one in variables if one.startswith("PYTEST_CURRENT_TEST=")), "")
            return f"{pid} {command}{test}"
    return ""


def _remove_segments() -> None:
    """Remove files of shared memory that Zenoh leaves behind; those of this process stay locked."""
    for _, _, path in memory.mappings():
        Path(path).unlink(missing_ok=True)
    if any(segments.SHM.glob("*.zenoh")):
        time.sleep(segments.YOUNG_S)
        segments.sweep()
