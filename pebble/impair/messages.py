"""What the operator's process is told and what it tells: JSON lines. All times are ns of CLOCK_MONOTONIC."""

from __future__ import annotations

import msgspec


class Order(msgspec.Struct, kw_only=True, tag="trial"):
    """One trial. Encodings that are None are left to the robot."""

    video: str | None
    audio: str | None
    alone_s: float  # driving and heartbeat only
    window_s: float  # of video, and then of audio
    grace_s: float  # for sound of the window that is still on its way


class Settle(msgspec.Struct, kw_only=True, tag="settle"):
    """Wait until the last trial is so long over, and its traces are gone."""

    quiet_s: float


class Command(msgspec.Struct, array_like=True, frozen=True):
    """A drive command, told apart by the speeds of the wheels that it asks for."""

    left: float
    right: float
    sent_ns: int


class Beat(msgspec.Struct, array_like=True, frozen=True):
    sent_ns: int
    arrived_ns: int
    online: bool = True


class Picture(msgspec.Struct, array_like=True, frozen=True):
    """One that was decoded; ``captured_ns`` None: its message did not say."""

    captured_ns: int | None
    arrived_ns: int


class Sound(msgspec.Struct, array_like=True, frozen=True):
    """One packet."""

    captured_ns: int  # its first sample
    arrived_ns: int
    seconds: float
    sequence: int


class Window(msgspec.Struct, frozen=True):
    """A stretch of time that is looked at; ``first_s``: from the request to the first picture or sound, if one came."""

    began_ns: int
    ended_ns: int
    first_s: float | None = None

    @property
    def seconds(self) -> float:
        return (self.ended_ns - self.began_ns) / 1e9

    def holds(self, ns: int) -> bool:
        return self.began_ns <= ns < self.ended_ns


class Record(msgspec.Struct, kw_only=True):
    """One trial as the operator lived through it."""

    commands: list[Command]
    beats: list[Beat]
    pictures: list[Picture]
    sounds: list[Sound]
    alone: Window
    video: Window
    audio: Window
    payloads: int  # of video that arrived, decoded or not

    @property
    def whole(self) -> Window:
        """As long as the robot was driven."""
        return Window(self.alone.began_ns, self.audio.ended_ns)


class Said(msgspec.Struct, kw_only=True, omit_defaults=True):
    """A line of the operator: one of these."""

    ready: bool = False  # the robot is up; or it has settled
    phase: str | None = None  # "alone", "video", "audio" begins now; "" : the last one is over
    record: Record | None = None
    problem: str | None = None
