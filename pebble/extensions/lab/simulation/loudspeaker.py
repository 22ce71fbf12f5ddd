"""A loudspeaker in software: takes aplay's arguments, plays in real time, and records what was played.

``python -m pebble.simulation.loudspeaker FILE.wav`` plays a file, ``… -t raw -f S16_LE -c CHANNELS -r RATE -`` what
comes from standard input. Each playback adds a ``begin`` and an ``end`` to FOLDER/events.jsonl, and a WAV file.
"""

import argparse
import fcntl
import os
import signal
import sys
import time
import wave
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, Literal

import msgspec

from pebble.extensions.lab.simulation.trace import complete_lines

_CHUNK_S = 0.02
_DELAY_LIMIT_S = 0.1  # what it is late by, it catches up, but never more than this
_EVENTS = "events.jsonl"
_BUSY = "loudspeaker: audio open error: Device or resource busy"


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    """``ns`` is time.monotonic_ns() when the first sample was played, or the last one. ``file`` is ``-`` for raw sound.

    ``recording`` is the WAV file in the same folder; ``seconds`` were played until the end; ``stopped``: by a signal.
    """

    ns: int
    event: Literal["begin", "end"]
    pid: int
    file: str
    rate: int
    channels: int
    recording: str
    seconds: float = 0.0
    stopped: bool = False


class Playback(msgspec.Struct, frozen=True):
    """One sound that was played. ``ended_ns`` is None while it plays, and if its player was killed."""

    file: str
    began_ns: int
    ended_ns: int | None
    seconds: float
    stopped: bool
    rate: int
    channels: int
    recording: Path
    pid: int

    def frames(self) -> bytes:
        """The samples that were played so far, interleaved as in a WAV file."""
        with wave.open(str(self.recording), "rb") as file:
            return file.readframes(file.getnframes())


def playbacks(folder: Path) -> list[Playback]:
    """The playbacks that a loudspeaker recorded in ``folder``, oldest first."""
    path = folder / _EVENTS
    lines = complete_lines(path)[0] if path.exists() else []
    events = [msgspec.json.decode(line, type=Event) for line in lines]
    ends = {event.recording: event for event in events if event.event == "end"}
    return [_playback(folder, event, ends.get(event.recording)) for event in events if event.event == "begin"]


def _playback(folder: Path, begin: Event, end: Event | None) -> Playback:
    return Playback(
        file=begin.file,
        began_ns=begin.ns,
        ended_ns=None if end is None else end.ns,
        seconds=0.0 if end is None else end.seconds,
        stopped=end is not None and end.stopped,
        rate=begin.rate,
        channels=begin.channels,
        recording=folder / begin.recording,
        pid=begin.pid,
    )


class _StoppedError(Exception):
    """SIGTERM or SIGINT."""


class _Sound(msgspec.Struct):
    """Where sound comes from: ``read(count)`` returns at most that many frames, b"" at the end."""

    file: str
    rate: int
    channels: int
    width: int  # bytes of a sample
    read: Callable[[int], bytes]

    def chunks(self) -> Iterator[bytes]:
        size = self.channels * self.width
        while chunk := self.read(round(self.rate * _CHUNK_S)):
            yield chunk[: len(chunk) // size * size]


class _Recorder:
    """Writes events and samples; without a folder, events to standard output."""

    def __init__(self, sound: _Sound, folder: Path | None, resources: ExitStack) -> None:
        self._sound, self._folder = sound, folder
        self._name = f"{time.monotonic_ns():020}-{os.getpid()}.wav"
        self._out: wave.Wave_write | None = None
        self._resources = resources
        self._begun = False

    def begin(self) -> None:
        if self._folder is not None:
            raw: BinaryIO = self._resources.enter_context((self._folder / self._name).open("wb", buffering=0))
            self._out = self._resources.enter_context(wave.open(raw, "wb"))  # noqa: SIM115 - so it is
            self._out.setnchannels(self._sound.channels)
            self._out.setsampwidth(self._sound.width)
            self._out.setframerate(self._sound.rate)
            self._out.writeframes(b"")  # the header: the file can be read from now on
        self._begun = True  # before it is written: a signal may come at any time
        self._write("begin")

    def add(self, chunk: bytes) -> None:
        if self._out is not None:
            self._out.writeframes(chunk)

    def end(self, frames: int, *, stopped: bool) -> None:
        if self._begun:
            self._write("end", seconds=round(frames / self._sound.rate, 4), stopped=stopped)

    def _write(self, event: Literal["begin", "end"], *, seconds: float = 0.0, stopped: bool = False) -> None:
        sound = self._sound
        written = Event(
            time.monotonic_ns(),
            event,
            os.getpid(),
            sound.file,
            sound.rate,
            sound.channels,
            self._name,
            seconds,
            stopped,
        )
        line = msgspec.json.encode(written) + b"\n"
        if self._folder is None:
            os.write(sys.stdout.fileno(), line)
            return
        with (self._folder / _EVENTS).open("ab", buffering=0) as file:  # one write: players share the file
            file.write(line)


def _play(sound: _Sound, recorder: _Recorder) -> bool:
    """Play in real time until the end or a signal; False if it was stopped."""
    due, frames, size = 0.0, 0, sound.channels * sound.width
    try:
        for number, chunk in enumerate(sound.chunks()):
            if number == 0:
                recorder.begin()
                due = time.monotonic()
            recorder.add(chunk)
            frames += len(chunk) // size
            due = max(due, time.monotonic() - _DELAY_LIMIT_S) + len(chunk) / size / sound.rate
            time.sleep(max(0.0, due - time.monotonic()))
    except _StoppedError:
        _ignore_signals()
        recorder.end(frames, stopped=True)
        return False
    _ignore_signals()
    recorder.end(frames, stopped=False)
    return True


def main(arguments: list[str]) -> int:
    """Play as aplay would with these ``arguments``; the exit codes are aplay's, 1 after a signal, too."""
    options = _parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, _stop)
    folder: Path | None = options.record
    with ExitStack() as resources:
        try:
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
                _lock(folder, exclusive=options.exclusive, resources=resources)
            sound = _open(options, resources)
            complete = _play(sound, _Recorder(sound, folder, resources))
        except _StoppedError:
            complete = False
        except BlockingIOError:
            sys.stderr.write(f"{_BUSY}\n")
            return 1
        except (OSError, EOFError, wave.Error) as error:
            sys.stderr.write(f"loudspeaker: {options.file}: {error}\n")
            return 1
    return 0 if complete else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="pebble sim loudspeaker", description=__doc__)
    parser.add_argument("file", help="a WAV file, or - for standard input")
    parser.add_argument(
        "--record", type=Path, metavar="FOLDER", help="for events.jsonl and WAV files of what is played"
    )
    parser.add_argument(
        "--exclusive", action="store_true", help="play one sound at a time, as a sound card without a mixer does"
    )
    parser.add_argument("-t", "--file-type", choices=("wav", "raw"), default="wav")
    parser.add_argument("-f", "--format", choices=("S16_LE",), default="S16_LE")
    parser.add_argument("-c", "--channels", type=int, default=1)
    parser.add_argument("-r", "--rate", type=int, default=8000)
    parser.add_argument("-D", "--device", help="accepted and not used")
    parser.add_argument("-q", "--quiet", action="store_true", help="accepted and not used")
    return parser


def _open(options: argparse.Namespace, resources: ExitStack) -> _Sound:
    raw: BinaryIO = sys.stdin.buffer
    if options.file != "-":
        raw = resources.enter_context(Path(options.file).open("rb"))  # noqa: SIM115 - closed with the others
    if options.file_type == "raw":
        width = 2 * options.channels
        return _Sound(options.file, options.rate, options.channels, 2, lambda count: raw.read(count * width))
    source = resources.enter_context(wave.open(raw, "rb"))  # noqa: SIM115
    return _Sound(options.file, source.getframerate(), source.getnchannels(), source.getsampwidth(), source.readframes)


def _lock(folder: Path, *, exclusive: bool, resources: ExitStack) -> None:
    """Raises BlockingIOError while another player has an exclusive loudspeaker."""
    file = resources.enter_context((folder / "device").open("ab"))
    if exclusive:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _stop(_number: int, _frame: object) -> None:
    raise _StoppedError


def _ignore_signals() -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
