"""What holds for every test."""

import signal
import time
from pathlib import Path

import pytest

from pebble.transports import segments

# Started in the background of a shell or by nohup, this process ignores signals, and so would every program it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

#: Modules of few tests that take long. They begin first: whoever began one of them last would be waited for.
_LONG = (
    *("robot/test_hostile.py", "test_demo.py", "firmware/test_deadman_virtual.py", "transports/test_frames_faults.py"),
    *("services/test_camera_publisher.py", "services/test_bridge_media.py", "services/test_mcu_private.py"),
    *("bench/test_frames.py", "transports/test_views.py"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: not item.path.as_posix().endswith(_LONG))


def pytest_sessionfinish() -> None:
    """Zenoh leaves files of shared memory behind, however its processes end, and keeps those of this one locked."""
    for _, _, path in segments.mappings():
        Path(path).unlink(missing_ok=True)
    if any(segments.SHM.glob("*.zenoh")):
        time.sleep(segments.YOUNG_S)
        segments.sweep()
