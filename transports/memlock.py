"""May this process lock memory? Zenoh locks what it shares; a reader that may not loses every shared frame silently."""

from __future__ import annotations

import ctypes
import mmap
import resource

_MLOCK_ONFAULT = 1  # asks for the permission without touching the pages (Linux 4.4)
_libc = ctypes.CDLL(None, use_errno=True)


def lockable(size: int) -> bool:
    """May this process lock ``size`` bytes more than it has locked already?"""
    if not hasattr(_libc, "mlock2"):
        return _unlimited()
    with mmap.mmap(-1, size) as memory:
        probe = ctypes.c_char.from_buffer(memory)
        address = ctypes.c_void_p(ctypes.addressof(probe))
        allowed = _libc.mlock2(address, ctypes.c_size_t(size), _MLOCK_ONFAULT) == 0
        _libc.munlock(address, ctypes.c_size_t(size))
        del probe
    return bool(allowed)


def complaint(size: int, what: str) -> str:
    """One sentence for people, when ``lockable(size)`` is false."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return (
        f"{what} cannot use shared memory, frames are sent as bytes: this process may lock {limit >> 10} KiB "
        f"and needs {size >> 10} KiB more; set LimitMEMLOCK=infinity in its systemd unit, or `ulimit -l unlimited`"
    )


def _unlimited() -> bool:
    return resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
