"""The bridge's tasks besides forwarding: system actions, programs for pictures and sound, and earlier names."""

from pebble.extension import Extension

EXTENSION = Extension(
    name="requests",
    prepare="pebble.services.mqtt_bridge.requests.earlier_names:keep_stops",
    requests=(
        "pebble.services.mqtt_bridge.requests.actions:SystemActions",
        "pebble.services.mqtt_bridge.requests.media:MediaRequests",
        "pebble.services.mqtt_bridge.requests.earlier_names:Renaming",
    ),
    page="docs/bridge.md",
)
