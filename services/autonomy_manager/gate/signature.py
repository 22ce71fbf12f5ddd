"""Signs the drive commands of a script with its run. Pure."""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from pebble.contract import DRIVE, codec
from pebble.contract.payloads import SCRIPT
from pebble.errors import PayloadError

_encode = msgspec.json.Encoder().encode


class SignedCommand(NamedTuple):
    """A drive command as it is published; ``moves`` is False for one whose axes are all 0."""

    payload: bytes
    moves: bool


def sign(payload: bytes, run: int) -> SignedCommand:
    """``payload`` with ``source`` and ``run`` in the object that holds the axes, bare or under ``value``.

    Raises PayloadError for a command that a motor owner would refuse.
    """
    plain = codec.plain(DRIVE, payload)
    if not isinstance(plain, dict):
        raise PayloadError(f"{DRIVE.metric}: an object is needed")
    inner = plain.get("value")
    signature = {"source": SCRIPT, "run": run}
    plain = {**plain, "value": inner | signature} if isinstance(inner, dict) else plain | signature
    try:
        signed = _encode(plain)
    except (ValueError, OverflowError, msgspec.MsgspecError) as error:
        raise PayloadError(f"{DRIVE.metric}: {error}") from None
    return SignedCommand(signed, codec.decode(DRIVE, signed).moves)


def zero(run: int) -> bytes:
    """The command of a script that stops the wheels."""
    return sign(b'{"x":0.0,"z":0.0}', run).payload
