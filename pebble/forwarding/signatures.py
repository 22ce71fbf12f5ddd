"""Removes a script's signature from drive commands from outside the robot. Pure.

A signature names the script run that may drive, so it counts only if a program on the robot sends it. A signed command
from outside does not pass if it moves anything. A signed zero passes as a person's, and stops the motors.
"""

from msgspec import UNSET
from msgspec.structs import replace

from pebble.contract import DRIVE, codec
from pebble.contract.payloads import SCRIPT, Drive
from pebble.errors import PayloadError

_SCRIPT, _BACKSLASH = SCRIPT.encode(), 0x5C


def unsigned(payload: bytes) -> bytes | None:
    """Return a drive command without a script's signature, or the same object if it has none; None: it must not pass.

    Must be fast: a person's command is rarely decoded. JSON may spell SCRIPT, a script's source, with backslashes. A
    payload with SCRIPT or a backslash that cannot be decoded does not pass: a board's parser may be more lenient.
    """
    if _BACKSLASH not in payload and _SCRIPT not in payload:
        return payload
    try:
        drive: Drive = codec.decode(DRIVE, payload)
    except PayloadError:
        return None
    if not drive.signed:
        return payload
    return None if drive.moves else codec.encode(DRIVE, replace(drive, source=UNSET, run=UNSET))
