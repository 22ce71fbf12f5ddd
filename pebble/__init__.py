"""Pebble: one contract for very different robots, over MQTT or Zenoh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pebble.version import __version__ as __version__

if TYPE_CHECKING:
    from pebble.cameras import camera as camera


def __getattr__(name: str) -> Any:
    """`from pebble import camera` imports what it needs only when it is used."""
    if name == "camera":
        from pebble.cameras import camera

        return camera
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
