"""Pebble: one contract for very different robots, over MQTT or Zenoh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pebble import public_names
from pebble.version import __version__ as __version__

public_names.install()

if TYPE_CHECKING:
    from pebble.contract import Channel as Channel
    from pebble.contract import Kind as Kind
    from pebble.extensions.media.cameras import camera as camera
    from pebble.extensions.scripts.script import Robot as Robot
    from pebble.extensions.scripts.script import Stopped as Stopped
    from pebble.extensions.scripts.script import run as run

_FROM = {
    "camera": "pebble.cameras",
    "Channel": "pebble.contract",
    "Kind": "pebble.contract",
    "Robot": "pebble.script",
    "Stopped": "pebble.script",
    "run": "pebble.script",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is used: `from pebble import camera`."""
    if name in _FROM:
        from importlib import import_module

        return getattr(import_module(_FROM[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
