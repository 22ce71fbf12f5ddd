"""Makes the recordings in tests/data/recordings from a run of the demo.

Program: ``python -m tests.recordings.make_fixtures [RECORDINGS]``; with RECORDINGS, a folder of ``pebble record``, no
demo runs. Needs mosquitto, and a machine with nothing else to do.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import msgspec

from pebble.media.decode import encoding_of
from pebble.recordings.files.recorded import Recorded
from pebble.recordings.files.rewrite import Copy
from pebble.recordings.files.writer import RecordingWriter
from pebble.recordings.library import files, merged
from tests.recordings.demo_robots import DRIVE, MEDIA
from tests.support import ROOT, Child, listening, until

_DEMO_S = 40
_DRIVE_S = 16.5  # of the recording: four steps, the emergency stop and its reset
_PART_S = 1.5  # of each encoding
_ROBOT = "pebble/robots/fred"  # whose pictures and sound are taken: its camera counts the pictures
_PICTURES, _SOUND = f"{_ROBOT}/outgoing/front-camera", f"{_ROBOT}/outgoing/audio"
_EVENTS = "$recorder/events"  # about the recorder's machine
_MEDIA = ("/outgoing/front-camera", "/outgoing/audio")
#: Robots' logs and cards name their serial ports, which are in the demo's folder.
_FOLDER = re.compile(rb"/[^\s\"']*/pebble-demo-[^/]*")
_NEUTRAL = b"/run/robots"


def main(arguments: list[str]) -> None:
    with tempfile.TemporaryDirectory(prefix="pebble-fixtures-") as folder:
        source = Path(arguments[0]) if arguments else _record(Path(folder))
        recorded = [_neutral(message) for message in merged(files([source]))]
    DRIVE.parent.mkdir(parents=True, exist_ok=True)
    for path, messages in ((DRIVE, _drive(recorded)), (MEDIA, _media(recorded))):
        count = _write(path, messages)
        sys.stdout.write(f"{path.relative_to(ROOT)}: {count} messages, {path.stat().st_size / 1000:.0f} kB\n")


def _record(folder: Path) -> Path:
    """Run the demo, and record its operators' broker."""
    pebble = [sys.executable, "-m", "pebble.cli"]
    environment = {**os.environ, "TMPDIR": str(folder)}
    demo = Child([*pebble, "demo", "--seconds", str(_DEMO_S)], cwd=ROOT, env=environment)
    assert until(lambda: _listening(folder), 20), "the demo starts no broker"
    recordings = folder / "recordings"
    url = f"mqtt://127.0.0.1:{_listening(folder)}"
    recorder = Child([*pebble, "record", "--url", url, "--into", str(recordings)], cwd=ROOT)
    assert demo.wait(_DEMO_S + 90) == 0, "the demo failed"
    recorder.send_signal(signal.SIGINT)
    recorder.wait(20)
    return recordings


def _listening(folder: Path) -> int | None:
    """The port of the demo's operators' broker; None before it accepts connections."""
    configs = [path.read_text().split() for path in folder.glob("pebble-demo-*/remote-broker.conf")]
    ports = [int(words[1]) for words in configs if len(words) > 1]
    return next((port for port in ports if listening(port)), None)


def _neutral(message: Recorded) -> Recorded:
    if message.channel.topic.endswith(_MEDIA):
        return message
    return msgspec.structs.replace(message, payload=_FOLDER.sub(_NEUTRAL, message.payload))


def _drive(recorded: list[Recorded]) -> Iterator[Recorded]:
    """All robots' messages of the first seconds, without pictures and sound."""
    until_ns = recorded[0].log_ns + int(_DRIVE_S * 1e9)
    return (
        one
        for one in recorded
        if one.log_ns < until_ns and one.channel.topic != _EVENTS and not one.channel.topic.endswith(_MEDIA)
    )


def _media(recorded: list[Recorded]) -> Iterator[Recorded]:
    """One robot's pictures and sound, the first part of each encoding: they begin with a key frame."""
    began: dict[tuple[str, str | int | None], int] = {}
    for message in recorded:
        topic, payload = message.channel.topic, message.payload
        if topic in (_PICTURES, _SOUND):
            form = encoding_of(payload) if topic == _PICTURES else payload[5]
            if message.log_ns < began.setdefault((topic, form), message.log_ns) + int(_PART_S * 1e9):
                yield message


def _write(path: Path, messages: Iterable[Recorded]) -> int:
    with path.open("wb", buffering=0) as file:
        writer = RecordingWriter(file)
        writer.metadata("pebble.recording", {"format": "1", "exported": "1"})
        copy = Copy(writer)
        for message in messages:
            copy.add(message)
        writer.finish()
    return writer.messages


if __name__ == "__main__":
    main(sys.argv[1:])
