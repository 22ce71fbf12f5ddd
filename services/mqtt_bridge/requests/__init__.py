"""Requests to the bridge itself: system actions, and programs for pictures and sound."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="requests",
    requests=(
        "pebble.services.mqtt_bridge.requests.actions:SystemActions",
        "pebble.services.mqtt_bridge.requests.media:MediaRequests",
    ),
    page="docs/bridge.md",
)
