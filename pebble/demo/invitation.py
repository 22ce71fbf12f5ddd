"""What a visitor can paste into another terminal while the demo runs: a line for each of the README's next sections."""

import shlex
import sys
from pathlib import Path

from pebble.contract import DRIVE
from pebble.contract.identity import Identity
from pebble.rig.processes import HOST

ROBOT = Identity("pebble", "robots", "goob")


def broker_url(port: int) -> str:
    return f"mqtt://{HOST}:{port}"


def lines(port: int) -> dict[str, str]:
    """Return lines for a shell, by what they do; each works as it is, in the folder in which the demo was started."""
    pebble, url = _pebble(), broker_url(port)
    drive = f'mosquitto_pub -h {HOST} -p {port} -t {DRIVE.topic(ROBOT.base)} -m \'{{"x": 0, "z": 0.3}}\''
    return {
        "look at its drive commands": f"{pebble} topic echo {DRIVE.metric} --robot {ROBOT.id} --url {url}",
        "drive Goob, by any MQTT client": drive,
        "record all robots until Ctrl-C": f"{pebble} record --url {url}",
        "stop Goob, whoever drives it": f"{pebble} estop {ROBOT.id} --url {url}",
        "let it go again": f"{pebble} estop reset {ROBOT.id} --url {url}",
    }


def _pebble() -> str:
    """The program of the environment that this one runs in, as short as it can be written here."""
    program = Path(sys.executable).with_name("pebble")
    if not program.exists():
        return f"{shlex.quote(sys.executable)} -m pebble"
    here = Path.cwd()
    return shlex.quote(str(program.relative_to(here) if program.is_relative_to(here) else program))
