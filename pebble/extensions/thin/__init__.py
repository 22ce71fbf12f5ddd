"""A bridge over a thin link: it measures what the link carries, sends no more than that, and tells operators.

A *group* is one message with several commands for a robot, or with the newest values of several of its streams. An
*expander* beside the remote broker takes groups of streams apart again.
"""

from pebble.extension import Extension

EXTENSION = Extension(
    name="thin",
    needs=("media",),
    rules="pebble.extensions.thin.rules:RULES",
    uplink="pebble.extensions.thin.uplink:make_uplink",
    offers="pebble.extensions.thin.group_gate:offers",
    page="docs/thin-links.md",
)
