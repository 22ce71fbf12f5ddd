"""Recordings of the messages of robots and operators, in MCAP files."""

from pebble.extension import Command, Extension

EXTENSION = Extension(
    name="recordings",
    needs=("operator", "media"),
    extra="record",
    commands={
        "record": Command("pebble.extensions.recordings.commands.record:record", "record robots", "measure", 10),
        "recordings": Command(
            "pebble.extensions.recordings.commands.group", "list, search, mend and export recordings", "measure", 20
        ),
        "replay": Command(
            "pebble.extensions.recordings.commands.replay:replay",
            "play recordings as if their robots were there",
            "measure",
            30,
        ),
        "analyse": Command(
            "pebble.extensions.recordings.commands.analyse:analyse",
            "report bandwidth, outages and latency of recordings",
            "measure",
            40,
        ),
    },
    page="docs/ext/recordings.md",
)
