"""Shows where a command spends its time between the operator and the wheels, hop by hop. Linux, root only.

Between the operator's publish call and the MCU's pty, the kernel records when the command's packets pass on loopback.
Zenoh's traffic inside the robot uses other sockets, so that part counts as one hop.
"""

from __future__ import annotations

import ctypes
import re
import socket
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise

from rich.table import Table

from pebble.bench.bridge_operator import DrivenRobot, Wheels, arrivals, wheels_of
from pebble.bench.comparison import Case
from pebble.bench.results import Cell, grouped, percentile
from pebble.bench.tables import figure, plain_table
from pebble.errors import PebbleError

#: By transport, in order: the component that holds the command. Results are compared by these names.
HOPS = {
    "mqtt": ("operator's client", "remote broker", "bridge", "robot's broker", "serial bridge"),
    "zenoh": ("operator's client", "remote broker", "bridge, fabric, serial bridge"),
}
ALL = "all the way"
_STARTUP_S = 1.0
_SLOWEST = 99  # per cent
_LEAST = 5  # commands among the slowest; fewer may be chance

Times = list[tuple[float, ...]]
"""For each command the time of each hop, ms."""

_ETH_P_IP = 0x0800
_SO_ATTACH_FILTER, _SO_RCVBUFFORCE, _SO_TIMESTAMPNS = 26, 33, 35  # asm-generic/socket.h
_INSTRUCTION = struct.Struct("HBBI")  # of linux/filter.h: code, jump if true, jump if false, k
_LOAD_HEADER_LENGTH, _LOAD_HALF_AFTER, _JUMP_IF_EQUAL, _RETURN = 0xB1, 0x48, 0x15, 0x06
_BUFFER = 64 * 1024 * 1024  # bytes: the traffic of a minute
_LARGEST = 65_536
_ETHERNET, _TCP = 14, 6
_TIMESPEC = struct.Struct("qq")
_COMMAND = re.compile(rb'/drive-values.{0,3}?(\{"x": [-+.0-9e]+, "z": [-+.0-9e]+\})', re.DOTALL)  # a packet's number

_SOURCE, _DESTINATION = 0, 1
PassageTimes = dict[tuple[int, int], dict[Wheels, int]]
"""By a port and whether it was the source or the destination: when (CLOCK_MONOTONIC, ns) each command first passed."""


def trace_commands(case: Case) -> Iterator[Cell]:
    """Drives a fresh robot and follows each command. Raises PebbleError."""
    with DrivenRobot(case.variant) as driven, PacketCapture(driven.subject.broker_ports) as wire:
        driven.wait()
        time.sleep(_STARTUP_S)
        wire.passed()
        segment = driven.drive(case.run["seconds"])
        driven.match_arrivals([segment])  # waits for the last ones
        pty, passed = arrivals(driven.subject.lines(segment.began)), wire.passed()
        ends = [(port, end) for port in driven.subject.broker_ports for end in (_DESTINATION, _SOURCE)]
        times = hops(segment.sent, [*(passed.get(end, {}) for end in ends), pty])
    for number, name in enumerate((*HOPS[case.variant], ALL)):
        yield case.cell("hop", "ms", [(*one, sum(one))[number] for one in times], {"hop": name})


def hops(sent: Mapping[Wheels, int], stations: Sequence[Mapping[Wheels, int]]) -> Times:
    """The hop times of every command that passed all stations."""
    ways = (
        [ns, *(station[speeds] for station in stations)]
        for speeds, ns in sent.items()
        if all(speeds in station for station in stations)
    )
    return [tuple((there - here) / 1e6 for here, there in pairwise(way)) for way in ways]


def typical(times: Times) -> Times:
    """The tenth of the commands that is closest to the median."""
    ordered = sorted(times, key=sum)
    return ordered[len(ordered) * 45 // 100 : max(1, len(ordered) * 55 // 100 + 1)]


def slowest(times: Times) -> Times:
    """The slowest hundredth of the commands, at least one."""
    limit = percentile([sum(one) for one in times], _SLOWEST)
    return [one for one in times if sum(one) >= limit]


def _times_by_kind(cells: Sequence[Cell]) -> dict[str, Times]:
    hops = grouped((cell for cell in cells if cell.params["hop"] != ALL), lambda cell: cell.variant)
    return {kind: list(zip(*(cell.samples for cell in own), strict=True)) for kind, own in hops.items()}


def profile_tables(cells: Sequence[Cell]) -> Iterator[Table]:
    for kind, times in _times_by_kind(cells).items():
        table = plain_table(f"{kind}: {len(times)} commands, mean of each hop, ms", ["hop", "typical", "slowest 1 %"])
        rows = [[*_means(few), sum(_means(few))] for few in (typical(times), slowest(times))]
        for name, *row in zip((*HOPS[kind], ALL), *rows, strict=True) if times else ():
            table.add_row(name, *map(figure, row))
        yield table


def profile_assessment(cells: Sequence[Cell]) -> Iterator[str]:
    """Names the hop in which the slowest commands lose their time, if there are enough of them."""
    for kind, times in _times_by_kind(cells).items():
        late = slowest(times)
        if not times:
            yield f"{kind}: no command was traced all the way"
        elif len(late) < _LEAST:
            yield f"{kind}: {len(times)} commands are too few to tell where the slowest lose their time."
        else:
            more = [slow - usual for slow, usual in zip(_means(late), _means(typical(times)), strict=True)]
            most, hop = max(zip(more, HOPS[kind], strict=True), key=lambda one: one[0])
            share = 100 * most / sum(more) if sum(more) > 0 else 0.0
            yield (
                f"{kind}: of what the slowest {len(late)} of {len(times)} commands take longer than a typical one"
                f" ({sum(more):.2f} ms), {share:.0f} % is spent in: {hop}."
            )


def _means(times: Times) -> list[float]:
    return [sum(hop) / len(times) for hop in zip(*times, strict=True)]


# -- packets on loopback


class PacketCapture(socket.socket):
    """Captures from its construction on; packets are read only in :meth:`passed`: the measurement is not disturbed."""

    def __init__(self, ports: Sequence[int]) -> None:
        """Raises PebbleError without permission to capture."""
        program = port_filter(ports)  # otherwise other programs' traffic fills the buffer
        code = ctypes.create_string_buffer(program, len(program))
        short = struct.pack("HL", len(program) // _INSTRUCTION.size, ctypes.addressof(code))
        try:
            super().__init__(socket.AF_PACKET, socket.SOCK_RAW)  # no protocol: it receives nothing yet
            self.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, short)
            self.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _BUFFER)
            self.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            self.setblocking(False)
            self.bind(("lo", _ETH_P_IP))
        except PermissionError:
            raise PebbleError("--profile captures packets on loopback, which requires root: run it with sudo") from None
        except OSError as error:
            raise PebbleError(f"--profile cannot capture on loopback: {error.strerror}; run it with sudo") from None

    def passed(self) -> PassageTimes:
        """All commands since the last call."""
        offset = time.time_ns() - time.monotonic_ns()  # the kernel stamps packets by the wall clock
        found: PassageTimes = {}
        with suppress(BlockingIOError):
            while True:
                frame, stamps, _, _ = self.recvmsg(_LARGEST, 64)
                ns = _stamp(stamps) - offset
                for (source, destination), wheels in commands(frame):
                    found.setdefault((source, _SOURCE), {}).setdefault(wheels, ns)
                    found.setdefault((destination, _DESTINATION), {}).setdefault(wheels, ns)
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
