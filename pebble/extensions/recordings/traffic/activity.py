"""The use of a robot that a message shows, such as driving, watching, a sound or a script. Pure."""

import re
from collections.abc import Callable
from enum import IntEnum
from typing import Final

from pebble.contract import channels as c
from pebble.contract import codec
from pebble.errors import PayloadError


class Activity(IntEnum):
    """The uses of a robot that a message can show. The numbers are stored in the index of the traffic."""

    NONE = 0
    DRIVE = 1
    LIGHTS = 2
    MEDIA_REQUEST = 3
    MEDIA = 4
    SOUND = 5
    AUTONOMY = 6
    WARNING = 7


SESSION: Final = range(Activity.DRIVE, Activity.WARNING)

_RESTING: Final = 0.02  # a stick that is let go shows up to this
_WARNING: Final = re.compile(rb'"level"\s*:\s*"(?:WARN|ERR|CRIT)', re.IGNORECASE)
_BY_SUFFIX: Final = {
    c.LIGHTS_SOLID.suffix: Activity.LIGHTS,
    c.LIGHTS_FLASH.suffix: Activity.LIGHTS,
    c.VIDEO_CONTROL.suffix: Activity.MEDIA_REQUEST,
    c.AUDIO_CONTROL.suffix: Activity.MEDIA_REQUEST,
    c.MQTT_VIDEO.suffix: Activity.MEDIA_REQUEST,
    c.MQTT_AUDIO.suffix: Activity.MEDIA_REQUEST,
    c.SOUNDBOARD_COMMAND.suffix: Activity.SOUND,
    c.AUTONOMY_COMMAND.suffix: Activity.AUTONOMY,
}


def activity_of(suffix: str) -> Callable[[bytes], Activity]:
    """Return a function from a payload to its activity, for a topic below the base (``incoming/drive-values``).

    Not for media.
    """
    if suffix == c.DRIVE.suffix:
        return _drive
    if suffix == c.LOGS.suffix:
        return _log
    activity = _BY_SUFFIX.get(suffix, Activity.NONE)
    return lambda _payload: activity


def _drive(payload: bytes) -> Activity:
    try:
        wanted = codec.decode(c.DRIVE, payload)
    except PayloadError:
        return Activity.NONE
    moves = max(abs(wanted.x), abs(wanted.y), abs(wanted.z)) > _RESTING
    return Activity.DRIVE if moves else Activity.NONE


def _log(payload: bytes) -> Activity:
    return Activity.WARNING if _WARNING.search(payload) else Activity.NONE
