"""What a visitor can paste into another terminal while the demo runs: a line for each of the README's next sections."""

import shlex
import sys
from pathlib import Path
from typing import NamedTuple

from pebble.contract import DRIVE
from pebble.contract.identity import Identity
from pebble.rig.processes import HOST

ROBOT = Identity("pebble", "robots", "goob")


class Line(NamedTuple):
    """A line for a shell, and what it does."""

    what: str
    line: str


def broker_url(port: int) -> str:
    return f"mqtt://{HOST}:{port}"


def lines(port: int) -> tuple[Line, ...]:
    """The lines for the demo's broker; each can be pasted as it is, in the folder in which the demo was started."""
    pebble, url = _pebble(), broker_url(port)
    drive = f'mosquitto_pub -h {HOST} -p {port} -t {DRIVE.topic(ROBOT.base)} -m \'{{"x": 0, "z": 0.3}}\''
    return (
        Line("look at its drive commands", f"{pebble} topic echo {DRIVE.metric} --robot {ROBOT.id} --url {url}"),
        Line("drive Goob, by any MQTT client", drive),
        Line("record all robots until Ctrl-C", f"{pebble} record --url {url}"),
        Line("stop Goob, whoever drives it", f"{pebble} estop {ROBOT.id} --url {url}"),
        Line("let it go again", f"{pebble} estop reset {ROBOT.id} --url {url}"),
    )


def _pebble() -> str:
    """The program of the environment that this one runs in, as short as it can be written here."""
    program = Path(sys.executable).with_name("pebble")
    if not program.exists():
        return f"{shlex.quote(sys.executable)} -m pebble"
    here = Path.cwd()
    return shlex.quote(str(program.relative_to(here) if program.is_relative_to(here) else program))
