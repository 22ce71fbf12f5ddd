"""The recorder on the robot."""

from pebble.extension import Extension, Program

EXTENSION = Extension(
    name="recorder",
    needs=("recordings",),
    extra="record",
    packages=("mcap",),
    sections={"services.recorder": "pebble.extensions.recordings.config:Recorder"},
    program=Program("recorder", "pebble.services.recorder.service:RobotRecorder", preloaded=False),
    checks="pebble.services.recorder.checks:checks",
    page="docs/ext/recordings.md",
)
