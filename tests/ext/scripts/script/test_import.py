"""A program that imports pebble pays for what it uses, and not for scripts."""

from __future__ import annotations

import subprocess
import sys

import pytest


def modules_after(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_pebble_alone_is_nothing_but_its_version() -> None:
    loaded = {name for name in modules_after("import pebble") if name.startswith("pebble")}
    assert loaded == {"pebble", "pebble.public_names", "pebble.version"}


def test_the_camera_does_not_bring_scripts() -> None:
    loaded = modules_after("from pebble import camera")
    assert not [name for name in loaded if name.startswith(("pebble.extensions.scripts.script", "argparse", "paho"))]


def test_scripts_bring_a_transport_or_pictures_only_when_they_use_them() -> None:
    loaded = modules_after("from pebble import Robot, run, Stopped, Channel, Kind")
    assert "pebble.extensions.scripts.script.program" in loaded
    assert loaded.isdisjoint({"zenoh", "paho", "numpy", "cv2", "pebble.extensions.media.cameras"})


def test_what_is_not_there_is_named() -> None:
    import pebble

    with pytest.raises(AttributeError, match="has no attribute 'Rover'"):
        _ = pebble.Rover
