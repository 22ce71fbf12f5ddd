"""The host's side of ``pebble_serial_v1``: requests the manifest of an MCU, decodes its readings and encodes commands.

Pure: bytes and clock values in, events out; the bytes to send are events too. The wire: docs/ext/serial-protocol.md.
"""

import logging
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from pebble.errors import PayloadError
from pebble.runtime.lines import LineSplitter
from pebble.services.serial_mcu_bridge.pebble_serial_v1 import struct_v1
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import (
    END,
    FRAME_LIMIT,
    Frame,
    FrameError,
    Type,
    decode,
    encode,
)
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import (
    Direction,
    Hello,
    Interface,
    Manifest,
    parse_describe,
    parse_hello,
)
from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine, printable

ASK_AFTER_OPENING_S = 1.0  # a board that resets when its port is opened has booted by then
ASK_AFTER_HELLO_S = 0.25
ASK_AGAIN_S = 2.0
PING_S = 5.0  # of silence
SILENCE_S = 15.0  # despite pings: the device counts as gone
ANSWER_S = 10.0  # an outlet controller that switches a power outlet over Wi-Fi takes seconds

_DOUBT_S = 10.0  # between two requests because of readings that do not fit the manifest
_REMEMBERED = 16  # manifests
_OPEN_COMMANDS = 64  # that wait for their answers
WAITING = 8  # commands of an interface, and groups of them, that may wait to be sent; a newer one replaces the oldest
_U32 = 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class Send:
    """An event: bytes to send. A newer one of the same ``kind`` replaces one that still waits."""

    kind: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Described:
    """An event: the MCU's manifest is known, from a DESCRIBE now or earlier."""

    manifest: Manifest


@dataclass(frozen=True, slots=True)
class Gone:
    """An event: the described device is gone, or now describes itself differently."""

    why: str


@dataclass(frozen=True, slots=True)
class Reading:
    """An event: values of an interface. ``mcu_ms`` is the MCU's clock."""

    interface: Interface
    sequence: int
    mcu_ms: int
    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Answer:
    """An event: the answer to a command. ``accepted`` is None if none was received in time."""

    command: str
    sequence: int
    accepted: bool | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class RefusedInput:
    """An event: received bytes that could not be used. ``subject`` is the kind of error, for counters."""

    subject: str
    reason: str
    level: int = logging.WARNING


Event: TypeAlias = Send | Described | Gone | Reading | Answer | DeviceLogLine | RefusedInput


@dataclass(frozen=True, slots=True)
class _Command:
    name: str
    due: float


class Session:
    """The dialogue with one MCU on one serial line. ``now`` is a monotonic time, ``wall_ms`` epoch milliseconds.

    Call :meth:`opened` and :meth:`closed` when the serial line opens and closes, :meth:`feed` with received bytes, and
    :meth:`tick` at ``due``.
    """

    def __init__(self, base: str = "") -> None:
        """Start without a device; all topics of the robot begin with ``base``."""
        self.manifest: Manifest | None = None
        self.frames = 0  # valid ones from a device
        self.mcu_ms: int | None = None  # what its clock showed when it sent something of its own accord
        self._base = base
        self._splitter = LineSplitter(FRAME_LIMIT, END)
        self._too_long = 0  # frames that were too long, as far as they were reported
        self._by_id: dict[int, Interface] = {}  # the interfaces of the manifest
        self.known: OrderedDict[Hello, Manifest] = OrderedDict()  # manifests that need not be requested again
        self._commands: OrderedDict[int, _Command] = OrderedDict()  # without an answer yet; the first is due first
        self._slots: dict[str, int] = {}  # by interface, or "group": its newest command's slot, see :meth:`commands`
        self._sequence = 0  # the number of our newest frame
        self._ask_at: float | None = None  # when to ask for the manifest; None: it is known, or there is no line
        # When the last frame came, and when the last ping and the last request for the manifest were sent.
        self._received_at = self._pinged_at = self._asked_at = float("-inf")

    @property
    def due(self) -> float | None:
        """Time at which :meth:`tick` has something to do; None for never."""
        times = [] if self._ask_at is None else [self._ask_at]
        if self._commands:
            times.append(next(iter(self._commands.values())).due)
        if self.manifest is not None:
            times.append(min(max(self._received_at, self._pinged_at) + PING_S, self._received_at + SILENCE_S))
        return min(times, default=None)

    def opened(self, now: float) -> None:
        """Note that the line is open; the device is unknown."""
        self._splitter.reset()
        self._commands.clear()
        self._received_at = now
        self._ask_at = now + ASK_AFTER_OPENING_S

    def closed(self) -> list[Event]:
        self._ask_at = None
        self._commands.clear()
        return self._forget("the line is gone")

    def feed(self, chunk: bytes, now: float) -> list[Event]:
        """Return the events of the frames that ``chunk`` completes. Never raises."""
        events: list[Event] = []
        for stuffed in filter(None, self._splitter.feed(chunk)):
            events += self._receive(stuffed, now)
        discarded = self._splitter.discarded_lines - self._too_long
        self._too_long += discarded
        return events + [RefusedInput("too long", f"a frame of more than {FRAME_LIMIT} bytes")] * discarded

    def tick(self, now: float, wall_ms: int) -> list[Event]:
        """Return the events that are due: requests for the manifest, pings and timeouts."""
        events: list[Event] = []
        if self.manifest is not None and now - self._received_at >= SILENCE_S:
            events += self._forget(f"has been silent for {SILENCE_S:g} s")
            self._ask_at = now
        if self._ask_at is not None and now >= self._ask_at:
            self._ask_at, self._asked_at = now + ASK_AGAIN_S, now
            # the zero before it ends the part of a frame that the MCU may hold from an earlier host
            events.append(Send("ask", END + self._frame(Type.DESCRIBE_REQ, wall_ms)))
        elif self.manifest is not None and now - max(self._received_at, self._pinged_at) >= PING_S:
            self._pinged_at = now
            events.append(Send("ping", self._frame(Type.PING, wall_ms)))
        while self._commands and next(iter(self._commands.values())).due <= now:
            sequence, command = self._commands.popitem(last=False)
            events.append(Answer(command.name, sequence, None))
        return events

    def commands(self, wanted: Sequence[tuple[Interface, Mapping[str, Any]]], now: float, wall_ms: int) -> Send:
        """Return the frames that set several interfaces, for one write. Raises PayloadError if any cannot be set."""
        data, payloads = b"", [_packed(interface, values) for interface, values in wanted]
        for (interface, _), payload in zip(wanted, payloads, strict=True):
            data += self._frame(Type.CMD, wall_ms, interface.id, payload)
            # by the number of the frame just made
            self._commands[self._sequence] = _Command(interface.name, now + ANSWER_S)
            if len(self._commands) > _OPEN_COMMANDS:
                self._commands.popitem(last=False)
        kind = str(wanted[0][0].id) if len(wanted) == 1 else "group"
        # A line replaces a waiting one of its kind. With WAITING kinds, used in turn, as many commands can wait.
        slot = self._slots[kind] = (self._slots.get(kind, 0) + 1) % WAITING
        return Send(f"command {kind}/{slot}", data)

    def _receive(self, stuffed: bytes, now: float) -> Iterator[Event]:
        """Yield the events of a frame. One with a refused payload ends the silence, but does not count as valid."""
        try:
            frame = decode(stuffed)
            self._received_at = now
            yield from self._understand(frame, now)
            self.frames += 1
            if frame.type in (Type.HELLO, Type.SAMPLE, Type.STATE):
                self.mcu_ms = frame.timestamp
        except FrameError as error:
            yield RefusedInput(error.subject, str(error))
        except PayloadError as error:
            yield RefusedInput(frame.type.name.lower(), f"{frame.type.name} refused: {error}")

    def _understand(self, frame: Frame, now: float) -> Iterator[Event]:
        match frame.type:
            case Type.HELLO:
                yield from self._hello(parse_hello(frame.payload), now)
            case Type.DESCRIBE:
                yield from self._take_manifest(parse_describe(frame.payload, self._base))
            case Type.SAMPLE | Type.STATE:
                yield from self._reading(frame, now)
            case Type.ACK | Type.NACK:
                yield from self._answer(frame)
            case Type.LOG:
                yield DeviceLogLine(logging.INFO, printable(frame.payload))
            case Type.PONG:
                return
            case _:
                raise PayloadError("only a host sends this type")

    def _hello(self, hello: Hello, now: float) -> Iterator[Event]:
        if self.manifest is not None and self.manifest.hello == hello:
            return  # it has restarted, and its manifest is the same
        yield from self._forget("its HELLO differs")
        manifest = self.known.get(hello)
        if manifest is not None:
            self.known.move_to_end(hello)
            yield from self._begin(Described(manifest))
        else:  # a repeated HELLO does not delay the request
            self._ask_at = min(now + ASK_AFTER_HELLO_S, self._ask_at or float("inf"))

    def _take_manifest(self, manifest: Manifest) -> Iterator[Event]:
        """Remember a manifest that was received, and begin with it unless it is the present one."""
        self.known[manifest.hello] = manifest
        self.known.move_to_end(manifest.hello)
        if len(self.known) > _REMEMBERED:
            self.known.popitem(last=False)
        if manifest == self.manifest:
            self._ask_at = None  # the present manifest is right: no further request
            return
        yield from self._forget("its manifest differs")
        yield from self._begin(Described(manifest))

    def _begin(self, described: Described) -> Iterator[Event]:
        self._ask_at = None
        self.manifest = described.manifest
        self._by_id = {interface.id: interface for interface in described.manifest.interfaces}
        self._slots.clear()
        yield described

    def _reading(self, frame: Frame, now: float) -> Iterator[Event]:
        """Yield the values in a frame. If they do not fit the manifest, request it again: the MCU may have another."""
        if self.manifest is None:
            yield RefusedInput("early", "a reading before the manifest", logging.DEBUG)
            return
        interface = self._by_id.get(frame.interface)
        try:
            if interface is None or interface.direction is not Direction.OUT:
                raise PayloadError(f"there is no interface {frame.interface} that sends values")
            values = struct_v1.unpack(interface.fields, frame.payload)
        except PayloadError:
            self._doubt(now)
            raise
        yield Reading(interface, frame.sequence, frame.timestamp, values)

    def _answer(self, frame: Frame) -> Iterator[Event]:
        command = self._commands.pop(frame.sequence, None)
        reason = "" if frame.type is Type.ACK else printable(frame.payload)
        if command is None:
            raise PayloadError(f"answers no command of ours, number {frame.sequence} {reason}".rstrip())
        yield Answer(command.name, frame.sequence, frame.type is Type.ACK, reason)

    def _doubt(self, now: float) -> None:
        """Request the manifest again, at most every 10 s, because the device may run other firmware now."""
        if self._ask_at is None and now - self._asked_at >= _DOUBT_S:
            self._ask_at = now

    def _forget(self, why: str) -> list[Event]:
        if self.manifest is None:
            return []
        self.manifest, self._by_id = None, {}
        return [Gone(why)]

    def _frame(self, kind: Type, wall_ms: int, interface: int = 0, payload: bytes = b"") -> bytes:
        self._sequence = self._sequence % _U32 + 1
        return encode(Frame(kind, payload, interface, self._sequence, wall_ms & _U32))


def _packed(interface: Interface, values: Mapping[str, Any]) -> bytes:
    try:
        return struct_v1.pack(interface.fields, values)
    except PayloadError as error:
        raise PayloadError(f"{interface.name}: {error}") from None
