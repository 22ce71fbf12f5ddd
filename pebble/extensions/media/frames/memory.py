"""The segments of shared memory that hold frames: those mapped by this process, and the room for another."""

import os
from pathlib import Path

from pebble.transports.segments import SHM


def has_room(size: int) -> bool:
    """True if a segment of ``size`` bytes may be made now."""
    try:
        status = os.statvfs(SHM)
    except OSError:
        return False
    return status.f_bavail * status.f_frsize >= size and not status.f_flag & os.ST_RDONLY


def mappings() -> list[tuple[int, int, str]]:
    """Return the mapped segments of this process: first address, the address after the last, and the file."""
    segments = []
    for line in Path("/proc/self/maps").read_text(encoding="utf-8").splitlines():
        place, *_, path = line.split(maxsplit=5)
        if ".zenoh" in path and path.startswith(str(SHM)):
            start, end = (int(address, 16) for address in place.split("-"))
            segments.append((start, end, path))
    return segments
