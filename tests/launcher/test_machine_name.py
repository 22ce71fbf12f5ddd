"""Other users' processes at the name by which launchers of a robot find each other; real processes, as root only."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.launcher.machine_name import MachineName
from pebble.launcher.run_lock import RunLock
from tests.support import ROOT, further

BASE = "x/y/z"
STRANGER, PI = 65534, 1234
SQUAT = """
import os, socket, sys
how, name = sys.argv[1:]
kind = {"datagrams": socket.SOCK_DGRAM, "packets": socket.SOCK_SEQPACKET}.get(how, socket.SOCK_STREAM)
held = [socket.socket(socket.AF_UNIX, kind) for _ in range(500 if how == "many" else 1)]
for number, one in enumerate(held):
    one.bind(f"\\0{name}" + f" {number}" * bool(number))
    if how not in ("binds", "connects", "datagrams"):
        one.listen(0)
if how == "connects":
    other = socket.socket(socket.AF_UNIX); other.bind(""); other.listen(); held[0].connect(other.getsockname())
if how == "full":
    asking = [socket.socket(socket.AF_UNIX)]; asking[0].connect(f"\\0{name}")
if how == "lock file":
    fake = open(os.path.join(__import__("tempfile").mkdtemp(), "launcher.lock"), "w")
if how == "undumpable":
    __import__("ctypes").CDLL(None).prctl(4, 0)
if how == "parent ends" and os.fork():
    os._exit(0)
print("bound", flush=True)
sys.stdin.read()
"""
LAUNCH = """
import logging, sys
from pathlib import Path
from pebble.launcher.run_lock import RunLock
logging.basicConfig(stream=sys.stdout, format="%(message)s")
try:
    with RunLock(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3])) as lock:
        print("bound", flush=True)
        for line in sys.stdin:
            lock.keep()
            print("answered", flush=True)
except Exception as error:
    print(error, flush=True)
"""

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture(scope="module")
def other_users() -> None:
    if os.getuid() != 0:
        pytest.skip("only root starts processes of other users")
    command = ["setpriv", f"--reuid={STRANGER}", "--clear-groups", sys.executable, "-c", "import pebble.launcher"]
    if subprocess.run(command, cwd="/", env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True).returncode:
        pytest.skip("the checkout is not open to other users")


@pytest.fixture
def start(other_users: None) -> Iterator[Start]:
    """Starts a script as a user; what it prints first is awaited by the caller."""
    with ExitStack() as running:

        def run(
            user: int, script: str, *words: object, groups: tuple[int, ...] = (), prefix: tuple[str, ...] = ()
        ) -> subprocess.Popen[str]:
            process = running.enter_context(
                subprocess.Popen(
                    [*prefix, sys.executable, "-c", script, *map(str, words)],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                    user=user, group=user, extra_groups=groups, cwd="/", env={"PYTHONPATH": str(ROOT)},
                )
            )  # fmt: skip
            running.callback(process.kill)
            return process

        yield run


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as made:
        Path(made).chmod(0o755)
        yield Path(made)


def config_of(folder: Path, user: int, mode: int = 0o644, group: int = 0) -> Path:
    config = folder / "robot.json"
    config.touch()
    os.chown(config, user, group)
    config.chmod(mode)
    return config


def name_of(config: Path) -> str:
    """The name that a launcher of ``config`` binds."""
    bound = MachineName.take(BASE, config)
    bound.close()
    return bound.name


def run_dir_of(folder: Path, user: int) -> Path:
    made = folder / f"run-{user}-{len(list(folder.iterdir()))}"
    made.mkdir(0o700)
    os.chown(made, user, user)
    return made


def first_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


@pytest.mark.parametrize("user", [STRANGER, further(0)], ids=["another user", "this user"])
@pytest.mark.parametrize(
    "how", ["listens", "binds", "connects", "full", "many", "lock file", "undumpable", "parent ends"]
)
def test_a_process_that_is_no_launcher_keeps_no_robot_down(
    how: str, user: int, start: Start, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    if (how, user) == ("lock file", 0):
        pytest.skip("a program of this user with a lock file open is as good as a launcher")
    config = config_of(folder, PI)
    squatter = start(user, SQUAT, how, name_of(config))
    assert first_line(squatter) == "bound"
    with caplog.at_level(logging.WARNING), RunLock(folder / "a", BASE, config):
        (record,) = caplog.records
        line = record.getMessage()
        assert f"of user {user} ('{sys.executable} -c" in line
        assert how == "parent ends" or f"process {squatter.pid} " in line
        assert line.endswith(f"sudo kill {line.split('process ')[1].split()[0]}")
        assert (" and 499 more has" in line) == (how == "many")
        with pytest.raises(PebbleError, match=f"with another run directory: process {os.getpid()} of user 0"):
            RunLock(folder / "b", BASE, config).take()
        squatter.kill()
        squatter.wait()
        with pytest.raises(PebbleError, match=f"with another run directory: process {os.getpid()} of user 0"):
            RunLock(folder / "b", BASE, config).take()


@pytest.mark.parametrize("how", ["datagrams", "packets"])
def test_a_name_of_another_kind_is_another_name(
    how: str, start: Start, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = config_of(folder, PI)
    assert first_line(start(STRANGER, SQUAT, how, name_of(config))) == "bound"
    with RunLock(folder / "a", BASE, config):
        assert not caplog.records


@pytest.mark.parametrize("how", ["listens", "binds", "full"])
@pytest.mark.parametrize("prefix", [(), ("unshare", "-Ur")], ids=["", "in a user namespace"])
def test_a_user_who_may_not_look_into_it_starts_as_well(
    how: str, prefix: tuple[str, ...], start: Start, folder: Path
) -> None:
    config = config_of(folder, PI)
    assert first_line(start(STRANGER, SQUAT, how, name_of(config), prefix=prefix)) == "bound"
    launcher = start(PI, LAUNCH, run_dir_of(folder, PI), BASE, config)
    warning = first_line(launcher)
    assert warning.startswith(f"{BASE} starts although ")
    assert (f"of user {STRANGER} (" in warning) == (how == "listens")
    assert ("find it with: sudo ss -xap | grep 'pebble up " in warning) == (how != "listens")
    assert first_line(launcher) == "bound"


@pytest.mark.parametrize(
    ("first", "second", "mode", "refused"),
    [
        pytest.param(PI, 0, 0o644, True, id="its owner before root"),
        pytest.param(0, PI, 0o644, True, id="root before its owner"),
        pytest.param(PI, PI, 0o644, True, id="its owner twice"),
        pytest.param(STRANGER, STRANGER, 0o644, True, id="a stranger twice"),
        pytest.param(STRANGER, 0, 0o664, True, id="of the group that may write it"),
        pytest.param(STRANGER, PI, 0o640, True, id="of the group that alone may read it"),
        pytest.param(STRANGER, 0, 0o644, False, id="one who may read it as all may"),
        pytest.param(STRANGER, PI, 0o666, False, id="one who may write it as all may"),
    ],
)
@pytest.mark.parametrize("squatted", [False, further(True)], ids=["", "beside a stranger's process"])
def test_a_second_launcher_is_refused_if_the_first_may_run_the_robot(
    first: int, second: int, mode: int, refused: bool, squatted: bool, start: Start, folder: Path
) -> None:
    config = config_of(folder, PI, mode, group=4321)
    if squatted:
        assert first_line(start(5555, SQUAT, "listens", name_of(config))) == "bound"
    holder = start(first, LAUNCH, run_dir_of(folder, first), BASE, config, groups=(4321,))
    assert "starts although" not in (printed := first_line(holder)) or squatted
    assert "bound" in (printed, squatted and first_line(holder))
    asked = start(second, LAUNCH, run_dir_of(folder, second), BASE, config, groups=(4321,))
    fact = "already runs from" if refused else "starts although"
    assert f"{BASE} {fact}" in (line := first_line(asked))
    assert not refused or line.endswith(f": process {holder.pid} of user {first}; end that one first")


def test_a_launcher_is_found_however_many_have_asked(start: Start, folder: Path) -> None:
    config = config_of(folder, PI)
    name = name_of(config)
    holder = start(0, LAUNCH, run_dir_of(folder, 0), BASE, config)
    assert first_line(holder) == "bound"
    with ExitStack() as asking:
        one = asking.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK))
        while one.connect_ex(f"\0{name}") == 0:
            one = asking.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK))
    assert holder.stdin is not None
    print(file=holder.stdin, flush=True)
    assert first_line(holder) == "answered"
    second = start(PI, LAUNCH, run_dir_of(folder, PI), BASE, config)
    assert f"process {holder.pid} of user 0; end that one first" in first_line(second)
