"""The rights on a robot, and the commands that each permits.

pebble/extensions/fleet/roles.py gives rights to roles. A robot uses this table for commands without an account.
"""

from collections.abc import Mapping
from enum import StrEnum

from pebble.contract import Channel
from pebble.contract import channels as c


class Right(StrEnum):
    LOOK = "look"
    STOP = "stop"
    DRIVE = "drive"
    RESET = "reset"
    TAKE = "take"
    SYSTEM = "system"
    EXPAND = "expand"
    PEOPLE = "people"


#: The commands that a right allows: channels of the contract, or metrics below ``incoming/``.
WRITES: Mapping[Right, tuple[Channel | str, ...]] = {
    Right.LOOK: (c.VIDEO_CONTROL,),
    Right.STOP: (c.ESTOP,),
    Right.DRIVE: (
        c.DRIVE,
        c.GROUP,  # all that may be in it is in this right
        c.CONTROL,
        c.LIGHTS_SOLID,
        c.LIGHTS_FLASH,
        c.AUDIO_CONTROL,
        c.AUDIO_STREAM,
        c.SOUNDBOARD_COMMAND,
        c.AUTONOMY_COMMAND,
        c.MCU_COMMAND,
        c.OUTLET_COMMAND,
        c.MIP_RAW,
        c.MQTT_AUDIO,
        c.MQTT_VIDEO,
    ),
    Right.RESET: (c.ESTOP_RESET,),
    Right.TAKE: (c.CONTROL_TAKE,),
    Right.SYSTEM: (c.REBOOT, c.SERVICE_RESTART, c.GIT_PULL, c.REMOTE_MIRROR),
    Right.EXPAND: (c.EXPANDER,),  # who may not publish streams must not say so: a robot would send none by themselves
}
