"""What holds for every test."""

import gc
import os
import shutil
import signal
import tempfile
import time
from pathlib import Path

import pytest
from hypothesis import settings

from pebble.transports import segments
from tests.recordings.replayed import recording as recording  # a fixture for all tests

# Started in the background of a shell or by nohup, this process ignores signals, and so would every program it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# An example may take long on a busy machine.
settings.register_profile("pebble", deadline=None)
settings.load_profile("pebble")

# What robots save belongs to the run, not to the user who runs it.
_STATE = tempfile.mkdtemp(prefix="pebble-tests-")
os.environ.pop("STATE_DIRECTORY", None)
os.environ["XDG_STATE_HOME"] = _STATE

#: Modules of few tests that take long. They begin first: begun last, they would delay the end of the run.
_LONG = (
    *(
        "robot/test_hostile.py",
        "test_demo.py",
        "firmware/test_deadman_virtual.py",
        "transports/frames/test_frames_faults.py",
    ),
    *(
        "services/camera_publisher/test_service.py",
        "services/mqtt_bridge/test_bridge_media.py",
        "services/serial_mcu_bridge/test_mcu_private.py",
    ),
    *("bench/test_frames.py", "transports/frames/test_views.py"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: not item.path.as_posix().endswith(_LONG))


def pytest_collection_finish() -> None:
    """Garbage is looked for among what tests make, not among all there are: that takes 0.3 s (measured), on a busy
    machine more, and everything in this process, services and transports too, stands still meanwhile."""
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
