"""Takes a script's signature off drive commands from outside. Pure.

A signature names the run that may drive, so it counts only from programs on the robot. From outside a signed command
that moves anything does not pass, and a signed zero stops the motors as a person's.
"""

from msgspec import UNSET
from msgspec.structs import replace

from pebble.contract import DRIVE, codec
from pebble.contract.payloads import SCRIPT, Drive
from pebble.errors import PayloadError

_SCRIPT, _BACKSLASH = SCRIPT.encode(), 0x5C


def unsigned(payload: bytes) -> bytes | None:
    """Return a drive command without a script's signature; None if it may not pass. Hot: a person's is rarely decoded.

    JSON may write the name of a signature's field plainly or with backslashes. A payload that contains either and
    cannot be decoded does not pass: the parser of a board may be more lenient.
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
