"""A loudspeaker in software: takes aplay's arguments, plays in real time, and records what was played.

``python -m pebble.simulation.loudspeaker FILE.wav`` plays a file, ``… -t raw -f S16_LE -c CHANNELS -r RATE -`` what
comes from standard input. With ``--record FOLDER`` each playback is a WAV file there, and two lines of events.jsonl: as
it began, and as it ended.
"""

import argparse
import os
import signal
import sys
import time
import wave
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO

import msgspec

from pebble.extensions.lab.simulation.trace import complete_lines

_CHUNK_S = 0.02
_DELAY_LIMIT_S = 0.1  # a delay is made up for, but no more of it than this
_EVENTS = "events.jsonl"


class Playback(msgspec.Struct, omit_defaults=True):
    """A sound that was played; times are those of time.monotonic_ns(), of the first sample and the last.

    ``file`` is ``-`` for raw sound, ``recording`` the path of the WAV file. ``ended_ns`` is None while it plays, and
    if its player was killed; ``stopped``: by a signal.
    """

    pid: int
    file: str
    rate: int
    channels: int
    recording: str
    began_ns: int
    ended_ns: int | None = None
    seconds: float = 0.0
    stopped: bool = False

    def frames(self) -> bytes:
        """Return the samples that were played so far, interleaved as in a WAV file."""
        with wave.open(self.recording, "rb") as file:
            return file.readframes(file.getnframes())


def playbacks(folder: Path) -> list[Playback]:
    """Return the playbacks that a loudspeaker recorded in ``folder``, oldest first."""
    path = folder / _EVENTS
    lines = complete_lines(path)[0] if path.exists() else []
    events = [msgspec.json.decode(line, type=Playback) for line in lines]
    return list({event.recording: event for event in events}.values())  # the newest event of each, in its first place


class _StoppedError(Exception):
    """SIGTERM or SIGINT."""


class _Sound(msgspec.Struct):
    """A source of sound: ``read(count)`` returns at most that many frames, b"" at the end.

    A frame is a sample of each channel.
    """

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
    """A recorder of events and samples in a folder, from the first sample on."""

    def __init__(self, sound: _Sound, folder: Path, resources: ExitStack) -> None:
        now = time.monotonic_ns()
        path = folder / f"{now:020}-{os.getpid()}.wav"
        raw: BinaryIO = resources.enter_context(path.open("wb", buffering=0))
        self._events = folder / _EVENTS
        self._out = resources.enter_context(wave.open(raw, "wb"))  # noqa: SIM115 - closed with the others
        self._out.setnchannels(sound.channels)
        self._out.setsampwidth(sound.width)
        self._out.setframerate(sound.rate)
        self._out.writeframes(b"")  # the header: the file can be read from now on
        self._playback = Playback(os.getpid(), sound.file, sound.rate, sound.channels, str(path), now)
        self._write()
        self.add = self._out.writeframes

    def end(self, frames: int, *, stopped: bool) -> None:
        self._playback.ended_ns, self._playback.stopped = time.monotonic_ns(), stopped
        self._playback.seconds = round(frames / self._playback.rate, 4)
        self._write()

    def _write(self) -> None:
        with self._events.open("ab", buffering=0) as file:  # one write: players share the file
            file.write(msgspec.json.encode(self._playback) + b"\n")


def _play(sound: _Sound, folder: Path | None, resources: ExitStack) -> bool:
    """Play in real time until the end or a signal, and record it in ``folder``; False if it was stopped."""
    due, frames, stopped = 0.0, 0, False
    recorder: _Recorder | None = None
    try:
        for chunk in sound.chunks():
            if not frames:  # the first chunk
                recorder = None if folder is None else _Recorder(sound, folder, resources)
                due = time.monotonic()
            if recorder is not None:
                recorder.add(chunk)
            count = len(chunk) // (sound.channels * sound.width)
            frames += count
            due = max(due, time.monotonic() - _DELAY_LIMIT_S) + count / sound.rate  # what is later than that stays late
            time.sleep(max(0.0, due - time.monotonic()))
    except _StoppedError:
        stopped = True
    for number in (signal.SIGTERM, signal.SIGINT):  # else a second signal could interrupt what follows
        signal.signal(number, signal.SIG_IGN)
    if recorder is not None:
        recorder.end(frames, stopped=stopped)
    return not stopped


def main(arguments: list[str]) -> int:
    """Play as aplay would with these ``arguments``; the exit codes are aplay's, 1 after a signal, too."""
    options = _parser().parse_args(arguments)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _stop)
    folder: Path | None = options.record
    with ExitStack() as resources:
        try:
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
            complete = _play(_open(options, resources), folder, resources)
        except _StoppedError:
            complete = False
        except (OSError, EOFError, wave.Error) as error:
            sys.stderr.write(f"loudspeaker: {options.file}: {error}\n")
            return 1
    return 0 if complete else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m pebble.simulation.loudspeaker", description=__doc__)
    parser.add_argument("file", help="a WAV file, or - for standard input")
    parser.add_argument("--record", type=Path, metavar="FOLDER", help="for events.jsonl, and a WAV file of each sound")
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


def _stop(_number: int, _frame: object) -> None:
    raise _StoppedError


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
