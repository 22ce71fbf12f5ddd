"""Another maker's streaming program: it runs while the service runs, and never longer."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from pebble.contract import MQTT_VIDEO, VIDEO_CONTROL
from pebble.contract.payloads import MediaRequest
from pebble.services.mqtt_bridge.requests.media import Media, ProgramRequest
from tests.kit.robot import ProgramRobot
from tests.support import WAIT_S, Broker, gone, until

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


class Stream(ProgramRobot):
    """The service as a process of its own, with ``command`` to run."""

    def __init__(self, port: int, *command: str, there: bool = True) -> None:
        """``there``: in the robot's folder, with a variable of its own."""
        super().__init__("mqtt", port, {}, robot="pitcam")
        place = ("env", "-C", str(self.folder), "STREAM_NAME=pit") if there else ()
        section = {"command": [*place, *command]}
        bridge = {"enabled": True, "remote_mqtt": REMOTE}
        self.raw["services"] = {"mqtt_bridge": bridge, "video_stream": {"enabled": True, **section}}
        self.write()
        self.process = self.run("pebble.services.video_stream.service:VideoStream")

    def pids(self) -> list[int]:
        """The process ids of the program and of what it started."""
        assert until((self.folder / "pids").exists)
        return [int(word) for word in (self.folder / "pids").read_text().split()]


Make = Callable[..., Stream]


@pytest.fixture
def make(local: Broker, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    monkeypatch.setenv("UPLINK", "topsecret")
    with ExitStack() as ends:
        yield lambda *command, **options: ends.enter_context(Stream(local.port, *command, **options))


DEAF = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
POLITE = "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit(print('goodbye')))\n"


@pytest.mark.parametrize(("manner", "last"), [(DEAF, ""), (POLITE, "goodbye")])
def test_the_program_ends_with_all_it_started_also_if_it_does_not_want_to(make: Make, manner: str, last: str) -> None:
    stream = make(sys.executable, "-c", manner + STREAMER)
    pids = stream.pids()
    assert not any(gone(pid) for pid in pids)
    assert stream.process.end() == 0
    assert until(lambda: all(gone(pid) for pid in pids))
    assert f"streaming as pit ''\n{last}" in stream.process.stdout.read() + stream.process.printed


def test_a_killed_service_leaves_no_program(make: Make) -> None:
    stream = make(sys.executable, "-c", STREAMER)
    program, child = stream.pids()
    stream.process.kill()
    assert until(lambda: gone(program))
    os.kill(child, signal.SIGKILL)  # its own children are its own business then


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ([sys.executable, "-c", "raise SystemExit(3)"], f"{sys.executable} ended: exit code 3"),
        (["no-such-streamer"], "cannot start no-such-streamer: [Errno 2]"),
    ],
)
def test_a_program_that_ends_or_never_starts_ends_the_service_with_the_reason(
    make: Make, command: list[str], reason: str
) -> None:
    process = make(*command, there=False).process
    assert process.wait(WAIT_S) == 1
    assert reason in process.printed


def test_operators_switch_it_as_they_switch_a_camera() -> None:
    media = Media(("video_stream",))
    media.allow(MQTT_VIDEO, True)
    media.request(VIDEO_CONTROL, MediaRequest(enabled=True))
    assert media.requests() == {"video_stream": ProgramRequest(on=True)}
    media.request(VIDEO_CONTROL, MediaRequest(enabled=False))
    assert media.requests() == {"video_stream": ProgramRequest(on=False)}
