"""The manifest of a station of switched sockets: the payload of DESCRIBE, whose beginning is that of HELLO. Pure.

Outlet n has two interfaces: 2n - 1 takes commands, 2n reports. The layout is that of docs/mcu.md.
"""

from micropython import const

HELLO_SIZE = const(47)

_SET = b"\0\x01\x03\0\0\0\x06o%d_set\x10outlets/o%d/power\x10outlet.switch.v1\x01\x01"  # in, command, no flags
_STATE = b"\0\x02\x02\x01\0\0\x08o%d_state\x11outlets/o%d/status\x10outlet.switch.v1\x01\x03"  # out, state, retained
_BOOLEAN = b"\x01\0\0\x80\x3f\0\0\0\0\0"  # scale 1, offset 0, no unit


def manifest(outlets: int) -> bytes:
    """Describe so many outlets, at most nine."""
    parts = [b"\x01", bytes((2 * outlets,)), b"\x0chs105-sta-v1\x09hs105-sta\x030.1\x11seeed-xiao-samd21"]
    for n in range(1, outlets + 1):
        parts += (bytes((2 * n - 1,)), _SET % (n, n), b"\x02on", _BOOLEAN)
        parts += (bytes((2 * n,)), _STATE % (n, n), b"\x05bound", _BOOLEAN)
        parts += (b"\x09reachable", _BOOLEAN, b"\x02on", _BOOLEAN)
    return b"".join(parts)
