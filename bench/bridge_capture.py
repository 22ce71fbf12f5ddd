"""Records when drive commands pass between TCP ports of loopback, with the kernel's time stamps. Linux, root only."""

from __future__ import annotations

import ctypes
import re
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Self

from pebble.bench.bridge_operator import Wheels, wheels_of
from pebble.errors import PebbleError

_ETH_P_IP = 0x0800
_SO_ATTACH_FILTER, _SO_RCVBUFFORCE, _SO_TIMESTAMPNS = 26, 33, 35  # asm-generic/socket.h
_INSTRUCTION = struct.Struct("HBBI")  # of linux/filter.h: code, jump if true, jump if false, k
_LOAD_HEADER_LENGTH, _LOAD_HALF_AFTER, _JUMP_IF_EQUAL, _RETURN = 0xB1, 0x48, 0x15, 0x06
_BUFFER = 64 * 1024 * 1024  # bytes: the traffic of a minute
_LARGEST = 65_536
_ETHERNET, _TCP = 14, 6
_TIMESPEC = struct.Struct("qq")
_COMMAND = re.compile(rb'/drive-values.{0,3}?(\{"x": [-+.0-9e]+, "z": [-+.0-9e]+\})', re.DOTALL)  # a packet's number

PassageTimes = dict[tuple[int, int], dict[Wheels, int]]
"""By source and destination port: when (CLOCK_MONOTONIC, ns) each command first passed."""


class PacketCapture:
    """Captures from ``with`` on; packets are read only in :meth:`passed`, which keeps the measurement undisturbed."""

    def __init__(self, ports: Sequence[int]) -> None:
        self._ports = ports

    def __enter__(self) -> Self:
        """Raises PebbleError without permission to capture."""
        try:
            self._socket = socket.socket(
                socket.AF_PACKET, socket.SOCK_RAW
            )  # without a protocol: it receives nothing yet
        except PermissionError:
            raise PebbleError("--profile captures packets on loopback, which requires root: run it with sudo") from None
        try:
            self._listen()
        except OSError as error:
            self._socket.close()
            raise PebbleError(f"--profile cannot capture on loopback: {error.strerror}; run it with sudo") from None
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def _listen(self) -> None:
        program = port_filter(self._ports)  # otherwise other programs' traffic fills the buffer
        code = ctypes.create_string_buffer(program, len(program))
        short = struct.pack("HL", len(program) // _INSTRUCTION.size, ctypes.addressof(code))
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, short)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._socket.setblocking(False)
        self._socket.bind(("lo", _ETH_P_IP))

    def passed(self) -> PassageTimes:
        """All commands since the last call."""
        offset = time.time_ns() - time.monotonic_ns()  # the kernel stamps packets by the wall clock
        found: PassageTimes = {}
        with suppress(BlockingIOError):
            while True:
                frame, stamps, _, _ = self._socket.recvmsg(_LARGEST, 64)
                ns = _stamp(stamps) - offset
                for way, wheels in commands(frame):
                    found.setdefault(way, {}).setdefault(wheels, ns)
        return found


def port_filter(ports: Sequence[int]) -> bytes:
    """A BPF program that accepts only packets from or to these ports."""
    passes = 1 + 2 * (1 + len(ports)) + 1  # index of the accepting instruction
    program = [(_LOAD_HEADER_LENGTH, 0, 0, _ETHERNET)]
    for offset in (0, 2):  # source, destination
        program.append((_LOAD_HALF_AFTER, 0, 0, _ETHERNET + offset))
        for port in ports:
            program.append((_JUMP_IF_EQUAL, passes - len(program) - 1, 0, port))
    program += [(_RETURN, 0, 0, 0), (_RETURN, 0, 0, _LARGEST)]
    return b"".join(_INSTRUCTION.pack(*instruction) for instruction in program)


def commands(frame: bytes) -> list[tuple[tuple[int, int], Wheels]]:
    """The drive commands in an Ethernet frame: source and destination port, and the wheel speeds."""
    packet = frame[_ETHERNET:]
    if len(packet) < 40 or packet[9] != _TCP:
        return []
    segment = packet[4 * (packet[0] & 15) :]
    source, destination = struct.unpack_from("!HH", segment)
    return [((source, destination), wheels_of(found)) for found in _COMMAND.findall(segment)]


def _stamp(stamps: list[tuple[int, int, bytes]]) -> int:
    if len(stamps[0][2]) != _TIMESPEC.size:
        raise PebbleError("--profile cannot read this kernel's time stamps: it requires a 64-bit Linux")
    seconds, ns = _TIMESPEC.unpack(stamps[0][2])
    return int(seconds) * 1_000_000_000 + int(ns)
