"""A reader of hall samples like the original's ``wheel-odometry``: a POSIX shared memory by its name."""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path
from typing import NamedTuple

_HEADER, _SLOT = struct.Struct("<8sHHIQ"), struct.Struct("<QQiiii")


class Sample(NamedTuple):
    number: int
    at_ns: int
    a0: int
    a1: int
    a2: int
    charging: int


class HallReader:
    """A reader that maps the memory once. Raises FileNotFoundError without one, ValueError for another form."""

    def __init__(self, name: str) -> None:
        descriptor = os.open(Path("/dev/shm") / name, os.O_RDWR)
        self.memory = mmap.mmap(descriptor, 0)
        os.close(descriptor)
        magic, version, self.slots, zero, self.number = _HEADER.unpack_from(self.memory)
        if (magic, version, zero) != (b"PBODRAW1", 1, 0) or len(self.memory) < 24 + 32 * self.slots:
            raise ValueError(f"no ring of samples: {magic!r}")

    @property
    def newest(self) -> int:
        return int(_HEADER.unpack_from(self.memory)[-1])

    def read(self) -> list[Sample]:
        """Return the samples since the last call that are still there."""
        newest = self.newest
        first = max(self.number, newest - self.slots) + 1
        found = [
            Sample(*_SLOT.unpack_from(self.memory, 24 + (at - 1) % self.slots * 32)) for at in range(first, newest + 1)
        ]
        self.number = newest
        return [sample for at, sample in enumerate(found, first) if sample.number == at]
