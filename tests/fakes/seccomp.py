"""Makes the kernel refuse a system call to this process and its children, as a container's filter does."""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct

CALLS = {
    "x86_64": {"pidfd_open": 434, "eventfd2": 290, "prctl": 157, "setpgid": 109},
    "aarch64": {"pidfd_open": 434, "eventfd2": 19, "prctl": 167, "setpgid": 154},
}.get(platform.machine(), {})

_SET_NO_NEW_PRIVS, _SET_SECCOMP, _FILTER = 38, 22, 2
_ALLOW, _ERRNO = 0x7FFF0000, 0x00050000


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


def deny(call: str, error: str) -> None:
    """Refuse ``call`` with the errno of that name, for ever. Raises OSError."""
    refused = _ERRNO | getattr(errno, error)
    code = [(0x20, 0, 0, 0), (0x15, 0, 1, CALLS[call]), (0x06, 0, 0, refused), (0x06, 0, 0, _ALLOW)]
    raw = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in code))
    libc, program = ctypes.CDLL(None, use_errno=True), _Program(len(code), ctypes.addressof(raw))
    if libc.prctl(_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or libc.prctl(_SET_SECCOMP, _FILTER, ctypes.byref(program)):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
