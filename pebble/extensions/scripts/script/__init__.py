"""Programs that move a robot by themselves: `from pebble import Robot, run`. See docs/ext/scripts.md."""

from pebble.contract import Channel, Kind
from pebble.extensions.scripts.script.neighbour import NotGrantedError
from pebble.extensions.scripts.script.program import run
from pebble.extensions.scripts.script.robot import EXIT_ENDED, Robot, Stopped

__all__ = ["EXIT_ENDED", "Channel", "Kind", "NotGrantedError", "Robot", "Stopped", "run"]
