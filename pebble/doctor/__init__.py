"""Checks whether a machine is ready for a robot; each problem that is found comes with the command that fixes it."""

from functools import partial

from pebble.check_result import CheckResult, State

ok, warn, fail, skip = (partial(CheckResult, state) for state in State)
