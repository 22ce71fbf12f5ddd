"""The JSON lines between the trials and the operator's process. All times are ns of CLOCK_MONOTONIC."""

from __future__ import annotations

import msgspec


class TrialRequest(msgspec.Struct, kw_only=True, tag="trial"):
    """Requests one trial. An encoding of None leaves the choice to the robot."""

    video: str | None
    audio: str | None
    alone_s: float  # driving and heartbeat only
    window_s: float  # of video, and then of audio
    grace_s: float  # for sound of the window that is still in flight
    off_s: float  # after video was switched off, and after audio was
    clip_s: float  # at most, for a clip to be played to its end


class RecoveryRequest(msgspec.Struct, kw_only=True, tag="recover"):
    """Requests a wait until the last trial is ``quiet_s`` ago, and heartbeats arrive without delay."""

    quiet_s: float


class Command(msgspec.Struct, array_like=True, frozen=True):
    """A drive command, identified by the wheel speeds that it sets."""

    left: float
    right: float
    sent_ns: int


class Heartbeat(msgspec.Struct, array_like=True, frozen=True):
    sent_ns: int
    arrived_ns: int
    online: bool = True


class Picture(msgspec.Struct, array_like=True, frozen=True):
    """A decoded picture; ``captured_ns`` is None if its message did not contain it."""

    captured_ns: int | None
    arrived_ns: int


class Sound(msgspec.Struct, array_like=True, frozen=True):
    """A sound packet."""

    captured_ns: int  # its first sample
    arrived_ns: int
    seconds: float
    sequence: int


class Window(msgspec.Struct, frozen=True):
    """A measured time window; ``first_s``: from the request to the first picture or sound, if any arrived."""

    began_ns: int
    ended_ns: int
    first_s: float | None = None

    @property
    def seconds(self) -> float:
        return (self.ended_ns - self.began_ns) / 1e9

    def holds(self, ns: int) -> bool:
        return self.began_ns <= ns < self.ended_ns


class ClipCommand(msgspec.Struct, array_like=True, frozen=True):
    """The command to play a clip; ``playing_ns`` is when the robot's status arrived, None if it did not in time."""

    sent_ns: int
    playing_ns: int | None = None


class Record(msgspec.Struct, kw_only=True):
    """Everything the operator recorded in one trial."""

    commands: list[Command]
    heartbeats: list[Heartbeat]
    pictures: list[Picture]
    sounds: list[Sound]
    alone: Window
    video: Window
    audio: Window
    video_off: Window
    audio_off: Window
    clip: ClipCommand
    payloads: int  # of video that arrived, decoded or not

    @property
    def whole(self) -> Window:
        """The time in which the robot was driven."""
        return Window(self.alone.began_ns, self.audio.ended_ns)


class OperatorReport(msgspec.Struct, kw_only=True, omit_defaults=True):
    """A line from the operator; one of the fields is set."""

    ready: bool = False  # the robot is ready, or has recovered
    phase: str | None = None  # "alone", "video", "video off", "audio" or "audio off" begins now; "": it ended
    record: Record | None = None
    problem: str | None = None
