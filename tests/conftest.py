"""What holds for every test."""

import gc
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from pebble.transports import segments
from tests.kit import rows
from tests.recordings.replayed import recording as recording  # a fixture for all tests
from tests.support import Broker, cases

# Started in the background of a shell or by nohup, this process ignores signals, and so would every program it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# httpx reads the authorities of the whole web for each client, which takes 50 ms; those that tests meet are here.
os.environ["SSL_CERT_FILE"] = str(Path(__file__).parent / "data" / "tls" / "ca.crt")

gc.disable()  # until the tests are collected, of which nothing is garbage: a fifth of the time that it takes

# An example may take long on a busy machine.
settings.register_profile("pebble", deadline=None, max_examples=cases(30, 100))
settings.load_profile("pebble")

# What robots save belongs to the run, not to the user who runs it.
_STATE = tempfile.mkdtemp(prefix="pebble-tests-")
os.environ.pop("STATE_DIRECTORY", None)
os.environ["XDG_STATE_HOME"] = _STATE

#: Modules that take longest begin first: begun last, one of them would delay the end of the run.
_LONG = (
    *("robot/test_closed_loop.py", "web/robots/test_controls.py", "web/robots/test_actions.py"),
    *("selftest/test_robot.py", "conform/test_conform.py", "conform/test_operators.py", "robot/test_names.py"),
    *("robot/test_media.py", "robot/test_robot.py", "transports/zenoh/test_mesh.py", "robot/test_faults.py"),
    *("robot/test_driveable.py", "robot/test_hostile.py", "robot/test_runs.py", "commands/test_fleet.py"),
    *("robot/test_surroundings.py", "robot/test_retained.py", "web/test_attacks.py", "web/test_hostile_broker.py"),
    "forwarding/links/test_table.py",
    *("commands/test_estop.py", "commands/test_drive.py", "launcher/test_launcher.py", "flash/test_steps.py"),
    *("web/test_types.py", "firmware/test_heap.py", "firmware/test_deadman_virtual.py", "web/test_driving_lockstep.py"),
)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    """One for this test alone; in some folders there is one for a whole module."""
    running = Broker(tmp_path)
    yield running
    running.stop()


@pytest.fixture
def brokers(tmp_path: Path) -> Iterator[tuple[Broker, Broker]]:
    """Two, of which a test ends one."""
    first, second = Broker(tmp_path), Broker(tmp_path)
    yield first, second
    first.kill()
    second.kill()


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for row in rows.fewer(items):
        row.add_marker(pytest.mark.thorough)
    places = {path: _place(path) for path in {item.path for item in items}}
    items.sort(key=lambda item: places[item.path])


def _place(path: Path) -> int:
    """When a module begins."""
    return next((at for at, end in enumerate(_LONG) if path.as_posix().endswith(end)), len(_LONG))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """What robots save in one worker is nothing to those of another one."""
    own = Path(_STATE, str(os.getpid()))
    own.mkdir(exist_ok=True)
    os.environ["XDG_STATE_HOME"] = str(own)


def pytest_collection_finish() -> None:
    """Garbage is looked for among what tests make, not among all there are: that takes 0.3 s (measured), on a busy
    machine more, and everything in this process, services and transports too, stands still meanwhile."""
    gc.enable()
    gc.collect()
    gc.freeze()


def pytest_sessionfinish() -> None:
    gc.unfreeze()
    shutil.rmtree(_STATE, ignore_errors=True)
    _remove_segments()


def _remove_segments() -> None:
    """Zenoh leaves files of shared memory behind, however its processes end, and keeps those of this one locked."""
    for _, _, path in segments.mappings():
        Path(path).unlink(missing_ok=True)
    if any(segments.SHM.glob("*.zenoh")):
        time.sleep(segments.YOUNG_S)
        segments.sweep()
