"""Makes numpy views of Zenoh's shared memory, which its Python API cannot do yet (zenoh-python #33, #730).

A `ZShm` or `ZShmMut` is a Rust struct inside a Python object, and one of its words is the address of its bytes. The
place of that word is known for certain versions; a self-test in every process finds it again, without a network. If
anything differs, `why_unavailable` explains it, and frames are copied instead.
"""

import ctypes
import logging
import re
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
import zenoh.shm

from pebble.extensions.media.frames.frame import Bytes

log = logging.getLogger(__name__)

#: Versions of eclipse-zenoh whose buffers this module was tested with: tests/ext/media/frames/test_views.py.
KNOWN_VERSIONS = frozenset({"1.10.2"})

_TEST_SIZES = (1, 100, 4096, 50_000)  # bytes
_TEST_POOL = 1 << 17
_POINTER = re.compile(r"\bbuf: PtrInSegment \{ ptr: (0x[0-9a-f]+)")
_WORD = ctypes.sizeof(ctypes.c_void_p)
_HEAD = object.__basicsize__  # before that is Python's own: reference count and type

Buffer = Any  # zenoh.shm.ZShm | zenoh.shm.ZShmMut


class UnexpectedLayoutError(Exception):
    """Zenoh's buffers have an unknown layout."""


class SelfTest:
    """Result of the self-test of this process."""

    def __init__(self) -> None:
        self._once = threading.Lock()
        self.offset: int | None = None  # in a buffer object, of the address of its bytes
        self.problem: str | None = None  # None: not tested yet

    def test(self) -> str:
        """Return the problem; "" if views work. The first call tests it."""
        if self.problem is not None:
            return self.problem
        with self._once:
            if self.problem is None:  # no other thread has tested it meanwhile
                try:
                    self.offset = _calibrate()
                    self.problem = ""
                except (UnexpectedLayoutError, zenoh.ZError) as error:
                    self.problem = str(error)
                    log.warning("frames are copied: %s", self.problem)
            return self.problem


self_test = SelfTest()


def why_unavailable() -> str:
    """Return why views do not work in this process; "" if they do. The first call takes milliseconds to test it."""
    return self_test.test()


def array(buffer: Buffer, size: int, *, writable: bool = False, owner: object = None) -> Bytes | None:
    """Return the ``size`` bytes of a `ZShm` or `ZShmMut` as an array; None if views do not work here.

    The array and its slices keep ``buffer`` and ``owner`` alive. Unless ``writable`` it cannot be made writable either.
    A `ZShmMut` that was sent does not own its bytes any more: ``owner`` must then be the provider, so that the memory
    stays mapped.
    """
    if self_test.test() or self_test.offset is None:  # the test returns the problem, if there is one
        return None
    return _array(buffer, size, self_test.offset, writable=writable, owner=owner)


def _array(buffer: Buffer, size: int, offset: int, *, writable: bool, owner: object = None) -> Bytes:
    raw = (ctypes.c_ubyte * size).from_address(_read_word(buffer, offset))
    raw._owners = (buffer, owner)  # type: ignore[attr-defined]  # keeps both alive
    view = memoryview(raw)
    return np.frombuffer(view if writable else view.toreadonly(), np.uint8)


def _read_word(buffer: Buffer, offset: int) -> int:
    return ctypes.c_size_t.from_address(id(buffer) + offset).value


# -- the self-test


def _calibrate() -> int:
    """Return the offset, in a buffer object, of the address of its bytes. Raises UnexpectedLayoutError if unsure."""
    if sys.implementation.name != "cpython":
        raise UnexpectedLayoutError(f"id() is not an address in {sys.implementation.name}")
    if (version := zenoh_version()) not in KNOWN_VERSIONS:
        raise UnexpectedLayoutError(
            f"zenoh {version or 'of unknown version'} is not one of {', '.join(sorted(KNOWN_VERSIONS))}"
        )
    pool = zenoh.shm.ShmProvider.default_backend(_TEST_POOL)
    offset = _only([_offsets(pool.alloc(size)) for size in _TEST_SIZES])
    for size in _TEST_SIZES:
        _check(pool.alloc(size), size, offset)
    return offset


def zenoh_version() -> str:
    """Return Zenoh's version, from the name of its folder: `importlib.metadata` takes several MB of memory."""
    folders = sorted(Path(zenoh.__file__).parent.parent.glob("eclipse_zenoh-*.dist-info"))
    return folders[-1].name.removeprefix("eclipse_zenoh-").removesuffix(".dist-info") if folders else ""


def _offsets(buffer: Buffer) -> set[int]:
    """Return the offsets in the buffer object at which its address stands; Zenoh prints that address."""
    address = _printed(buffer)
    words = range(_HEAD, type(buffer).__basicsize__ - _WORD + 1, _WORD)
    return {offset for offset in words if _read_word(buffer, offset) == address}


def _printed(buffer: Buffer) -> int:
    text = repr(buffer)
    printed = _POINTER.search(text)
    if printed is None:
        raise UnexpectedLayoutError(f"{type(buffer).__name__} does not print its address")
    return int(printed[1], 16)


def _only(offsets: list[set[int]]) -> int:
    """Return the offset that is in all sets. Raises UnexpectedLayoutError if there is not exactly one."""
    common = set.intersection(*offsets)
    if len(common) != 1:
        raise UnexpectedLayoutError(
            f"the address of a buffer is at {sorted(common) or 'none'} of its words, not at one"
        )
    return common.pop()


def _check(buffer: Buffer, size: int, offset: int) -> None:
    """Check that writes to the buffer appear in the view and the other way round, before and after it is sent."""
    address = _printed(buffer)
    _expect(offset + _WORD <= zenoh.shm.ZShm.__basicsize__, "a received buffer is too small for its address")
    _expect(_read_word(buffer, offset) == address, "the address of a buffer has moved")
    first, second = _pattern(size, 7), _pattern(size, 11)
    buffer[:] = first
    view = _array(buffer, size, offset, writable=True)
    _expect(view.tobytes() == first, "a view does not see what was written")
    view[:] = np.frombuffer(second, np.uint8)
    _expect(bytes(buffer) == second, "what a view writes is not in the buffer")
    received: Buffer = zenoh.ZBytes(buffer).as_shm()
    _expect(
        received is not None and _read_word(received, offset) == address, "a received buffer has its address elsewhere"
    )
    _expect(_array(received, size, offset, writable=False).tobytes() == second == bytes(received), "a view reads wrong")


def _expect(holds: bool, otherwise: str) -> None:
    if not holds:
        raise UnexpectedLayoutError(otherwise)


def _pattern(size: int, step: int) -> bytes:
    return bytes((step * index + 1) % 251 for index in range(size))
