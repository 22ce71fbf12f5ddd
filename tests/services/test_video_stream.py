"""Somebody else's streaming program: it runs while the service runs, and never longer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import MQTT_VIDEO, VIDEO_CONTROL
from pebble.contract.payloads import MediaRequest
from pebble.runtime.parent import ProgramRequest
from pebble.services.mqtt_bridge.media import Media
from tests.support import Child, gone, until

#: Leaves its number and that of a child of its own, and says something.
STREAMER = """
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
print("streaming as", os.environ["STREAM_NAME"], repr(os.environ["UPLINK"]), flush=True)
open("pids.new", "w").write(f"{os.getpid()} {child.pid}")
os.rename("pids.new", "pids")
time.sleep(60)
"""


REMOTE = {"host": "far", "username": "pit", "password_env": "UPLINK"}


class Stream:
    """The service as a process of its own, with ``command`` to run."""

    def __init__(self, folder: Path, command: list[str], **more: Any) -> None:
        self.folder = folder
        section = {"enabled": True, "command": command, "cwd": str(folder), "env": {"STREAM_NAME": "pit"}, **more}
        raw = {
            "robot": {"id": "pitcam"},
            "transport": {"kind": "zenoh", "run_dir": str(folder / "run")},
            "services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": REMOTE}, "video_stream": section},
        }
        config = folder / "pitcam.json"
        config.write_text(json.dumps(raw))
        self.process = Child(
            [sys.executable, "-m", "pebble.services.video_stream", str(config)],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env={**os.environ, "UPLINK": "topsecret"},
        )  # fmt: skip

    def pids(self) -> list[int]:
        """The process ids of the program and of what it started."""
        assert until((self.folder / "pids").exists, 15)
        return [int(word) for word in (self.folder / "pids").read_text().split()]

    def ended(self) -> tuple[int, str]:
        output, _ = self.process.communicate(timeout=15)
        return self.process.returncode, output


@pytest.fixture
def streaming(tmp_path: Path) -> Iterator[Stream]:
    stream = Stream(tmp_path, [sys.executable, "-c", STREAMER])
    yield stream
    stream.process.kill()
    stream.process.wait()


def test_the_program_runs_and_ends_with_all_it_started(streaming: Stream) -> None:
    pids = streaming.pids()
    assert not any(gone(pid) for pid in pids)
    streaming.process.terminate()
    code, output = streaming.ended()
    assert (code, "streaming as pit ''" in output) == (0, True)
    assert until(lambda: all(gone(pid) for pid in pids), 5)


def test_a_program_that_will_not_end_is_killed(tmp_path: Path) -> None:
    stubborn = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n{STREAMER}"
    stream = Stream(tmp_path, [sys.executable, "-c", stubborn])
    pids = stream.pids()
    stream.process.terminate()
    assert stream.ended()[0] == 0
    assert until(lambda: all(gone(pid) for pid in pids), 5)


def test_a_killed_service_leaves_no_program(streaming: Stream) -> None:
    program = streaming.pids()[0]
    os.kill(streaming.process.pid, signal.SIGKILL)
    assert until(lambda: gone(program), 5)
    for pid in streaming.pids()[1:]:  # its own children are its own business then
        os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ([sys.executable, "-c", "raise SystemExit(3)"], f"{sys.executable} ended: exit code 3"),
        (["no-such-streamer"], "cannot start no-such-streamer: [Errno 2]"),
    ],
)
def test_a_program_that_ends_or_never_starts_ends_the_service_with_the_reason(
    tmp_path: Path, command: list[str], reason: str
) -> None:
    code, output = Stream(tmp_path, command).ended()
    assert code == 1
    assert reason in output


def test_operators_switch_it_as_they_switch_a_camera() -> None:
    media = Media(("video_stream",))
    media.allow(MQTT_VIDEO, True)
    media.request(VIDEO_CONTROL, MediaRequest(enabled=True))
    assert media.requests() == {"video_stream": ProgramRequest(on=True)}
    media.request(VIDEO_CONTROL, MediaRequest(enabled=False))
    assert media.requests() == {"video_stream": ProgramRequest(on=False)}
