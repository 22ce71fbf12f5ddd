"""The comparisons that do not run on the engine yet: what the report and the pictures need of them.

Their command lines are in pebble.commands, and their runs in modules of their own.
"""

from __future__ import annotations

from pebble.bench.comparison import Budget, Comparison
from pebble.bench.pictures import ecdf, null_ratios, ratios, tails

CONTROL = Comparison(
    name="control",
    title="Service to service",
    what="A message of a drive command's size goes from one process to another and back, as between a robot's "
    "services: unloaded, with camera frames on the same transport, and beside a process that uses a whole core. "
    "One-way is from just before the publish call until the receiver's handler runs; both ends use the same clock.",
    full=Budget(700),
    quick=Budget(40),
    summary_lines=5,
    pictures=(ecdf("Service to service"), ratios("Service to service", "mqtt")),
)
CONTROL_NULL = Comparison(
    name="control-null",
    title="Service to service: the null test",
    what="One variant against itself, and against itself with a fifth of its usual latency planted by the sender. "
    "The first interval must include 1.00, the second must lie above it; otherwise the comparison above finds "
    "differences that do not exist, or misses some that do.",
    full=Budget(180),
    quick=Budget(10),
    words=("bench", "control"),
    reported=("--null",),
    pictures=(null_ratios("Null test of control"), ecdf("Null test of control")),
)
BRIDGE = Comparison(
    name="bridge",
    title="Operator to wheels, and back",
    what="A whole robot of each kind, with a stock broker between it and the operator. Down is from the operator's "
    "publish call to the last byte of the command's line at the MCU's pty; up is from the "
    "MCU's report to the operator.",
    full=Budget(300),
    quick=Budget(22),
    summary_lines=3,
    reported_full=("--with-media",),
    pictures=(ecdf("Operator to wheels and back"), ratios("Operator to wheels and back", "mqtt")),
)
BRIDGE_PROFILE = Comparison(
    name="bridge-profile",
    title="Operator to wheels: where the time goes",
    what="The same path of a command, hop by hop, from the time stamps of its packets on loopback: for a typical "
    "command, and for the slowest ones.",
    full=Budget(60),
    quick=Budget(12),
    root=True,
    words=("bench", "bridge"),
    reported=("--profile",),
    pictures=(ecdf("Operator to wheels, hop by hop"),),
)
BRIDGE_NULL = Comparison(
    name="bridge-null",
    title="Operator to wheels: the null test",
    what="One robot in three roles that take turns: plain, again, and with a fifth of the usual latency planted by "
    "the operator. The first interval must include 1.00, the second must lie above it.",
    full=Budget(150),
    quick=Budget(14),
    words=("bench", "bridge"),
    reported=("--null",),
    pictures=(null_ratios("Null test of bridge"), ecdf("Null test of bridge")),
)
FRAMES = Comparison(
    name="frames",
    title="Camera frames inside the robot",
    what="BGR pictures at 30 Hz from one process to others on the same machine. The latency is from the last byte "
    "written until the reader has a whole numpy array.",
    full=Budget(330),
    quick=Budget(20),
    summary_lines=4,
    pictures=(tails("Frames between processes"), ecdf("Frames between processes")),
)
FRAMES_NULL = Comparison(
    name="frames-null",
    title="Camera frames: the null test",
    what="One frame transport against itself, and with a fifth of its usual latency planted by the writer. The "
    "first interval must include 1.00, the second must lie above it.",
    full=Budget(130),
    quick=Budget(8),
    words=("bench", "frames"),
    reported=("--null", "zenoh-shm"),
    pictures=(null_ratios("Null test of frames"), ecdf("Null test of frames")),
)
