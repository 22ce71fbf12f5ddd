"""A few seconds of one robot as bytes for a page: docs/web-messages.md, "Recordings"."""

import struct
from enum import IntFlag
from typing import Final, NamedTuple

from pebble.contract.channels import LOGS
from pebble.recordings.files.recorded import Recorded
from pebble.recordings.seek.archive import Archive, metric_of
from pebble.recordings.stamps import is_media, is_picture

LONGEST_MS: Final = 10_000
MOST_BYTES: Final = 8 << 20
_HEAD: Final = struct.Struct(">IdBH")
_AFTER_LENGTH: Final = _HEAD.size - 4


class Flag(IntFlag):
    """What a message of a segment is."""

    STATE = 1  # from before the segment: the newest of its topic, or a line of the log
    CHAIN = 2  # a picture from before the segment, without which the following ones cannot be decoded
    INCOMING = 4  # was sent to the robot
    PICTURE = 8
    SOUND = 16


class Segment(NamedTuple):
    """The answer to one question of a page."""

    data: bytes
    next_ms: float | None  # where to go on: after a gap the robot's next message; None: nothing follows
    complete: bool  # False: pictures are missing, because it would have been too much


def segment(archive: Archive, robot: str, at_ms: float, for_ms: float, *, seek: bool, media: bool) -> Segment:
    """The messages of a robot from ``at_ms`` to before ``at_ms + for_ms``.

    With ``seek``, before them the state at that time, and the pictures that the one at that time needs.
    """
    at_ns, until_ns = _ns(at_ms), _ns(at_ms + for_ms)
    body, complete = bytearray(), True
    if seek:
        body += _state(archive, robot, at_ns)
        chain = archive.pictures(robot, at_ns) if media else []
        body += b"".join(_packed(one, Flag.CHAIN | Flag.PICTURE) for one in chain)
    messages = archive.messages(robot, at_ns, until_ns, media=media)
    for one in messages:
        flags = _flags(one)
        if flags & (Flag.PICTURE | Flag.SOUND) and len(body) + len(one.payload) > MOST_BYTES:
            complete = False
            continue
        body += _packed(one, flags)
    following = until_ns if messages else archive.next_ns(robot, until_ns)
    return Segment(bytes(body), None if following is None else following / 1e6, complete)


def _state(archive: Archive, robot: str, at_ns: int) -> bytes:
    log = LOGS.topic(robot)
    state = [one for one in archive.state(robot, at_ns) if one.channel.topic != log]
    return b"".join(_packed(one, _flags(one) | Flag.STATE) for one in [*state, *archive.log_lines(robot, at_ns)])


def _flags(one: Recorded) -> Flag:
    flags = Flag.INCOMING if metric_of(one.channel.topic)[1] else Flag(0)
    if is_media(one.payload):
        flags |= Flag.PICTURE if is_picture(one.payload) else Flag.SOUND
    return flags


def _packed(one: Recorded, flags: Flag) -> bytes:
    metric = metric_of(one.channel.topic)[0].encode()
    length = _AFTER_LENGTH + len(metric) + len(one.payload)
    return _HEAD.pack(length, one.log_ns / 1e6, flags, len(metric)) + metric + one.payload


def _ns(ms: float) -> int:
    """Exact to a microsecond."""
    return max(0, round(ms * 1000)) * 1000
