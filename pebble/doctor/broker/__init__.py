"""Judges a broker: what a robot and its operators have of it, found out below topics of its own."""

from functools import partial
from typing import Final

from pebble.check_result import CheckResult, State

ok, warn, fail, skip = (
    partial(CheckResult, level, "") for level in State
)  # a probe has its name in the table of probes
MOSQUITTO: Final = "in mosquitto.conf: "
OTHER: Final = "use another broker"
