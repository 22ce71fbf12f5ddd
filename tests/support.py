"""Helpers of many tests: waiting, free ports, real brokers, and child processes that end with pytest."""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest

from pebble.extensions.lab.rig.processes import free_port as free_port
from pebble.extensions.lab.rig.processes import mosquitto_command
from pebble.extensions.media.child import tied_to_parent

#: The checkout: tests that start programs of ours start them here.
ROOT = Path(__file__).resolve().parent.parent

T = TypeVar("T")

_LONGEST_PAUSE_S = 0.03

#: For what comes at once on a machine with nothing else to do: a wait ends with it, so only failures take as long.
WAIT_S = 30.0
#: For what must not wait for something that lasts WAIT_S or longer: a busy machine's share, and far from that.
SOON_S = 5.0


#: `make test THOROUGH=1` sets it: tests with many cases then try all of them.
THOROUGH = bool(os.environ.get("PEBBLE_THOROUGH"))


def cases(some: int, all_: int) -> int:
    """Return how many cases a test with random inputs tries."""
    return all_ if THOROUGH else some


def further(*values: Any) -> Any:
    """Return parameters of a rule that other rows prove as well, marked to run with ``make test THOROUGH=1``."""
    return pytest.param(*values, marks=pytest.mark.thorough)


def some(all_: Iterable[T], step: int) -> list[T]:
    """Return every ``step``-th of a test's parameters; all of them if asked to be thorough."""
    return list(all_)[:: 1 if THOROUGH else step]


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root makes other users' files, mounts and networks")


@contextmanager
def beside(work: Callable[[], object], ending: threading.Event) -> Iterator[None]:
    """Run ``work`` on another thread during the block; it must return once ``ending`` is set."""
    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()


def until(condition: Callable[[], object], timeout: float = WAIT_S, *, step: float = 0.003) -> bool:
    """Wait until ``condition()`` is true; return False if that takes more than ``timeout`` seconds.

    The pauses between two checks grow from ``step``: many tests wait at the same time, and checking takes processor
    time.
    """
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(step)
        step = max(step, min(1.2 * step, _LONGEST_PAUSE_S))
    return bool(condition())


@contextmanager
def quickly(seconds: float = SOON_S) -> Iterator[None]:
    """Check that the block takes less than ``seconds``: it waits for nothing that holds others up."""
    began = time.monotonic()
    yield
    assert time.monotonic() - began < seconds


def errors(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return what was logged as an error."""
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]


class Clock:
    """A clock that stands still between two changes of ``now``."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


def gone(pid: int) -> bool:
    """True if this process has ended. A zombie counts: a container without init does not reap it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def process_name(pid: int) -> str:
    """Return the first 15 bytes of a process's name, as the kernel knows it; "" if it has ended."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except (FileNotFoundError, ProcessLookupError):
        return ""


class Child(subprocess.Popen[Any]):
    """A child process that the kernel ends when pytest is killed."""

    def __init__(self, command: Sequence[str], **options: Any) -> None:
        super().__init__(tied_to_parent(command), **options)


def listening(port: int, address: str = "127.0.0.1") -> bool:
    """True if a server accepts connections on this port of a loopback address."""
    try:
        socket.create_connection((address, port), 0.2).close()
    except OSError:
        return False
    return True


class Broker:
    """A real mosquitto on a free loopback port. ``stop``/``kill`` then ``start`` keep port and persistence.

    With ``persistence`` it saves after each change; without ``autosave`` only when asked to.
    """

    def __init__(
        self,
        folder: Path,
        *options: str,
        port: int | None = None,
        persistence: bool = False,
        autosave: bool = True,
        host: str = "127.0.0.1",
    ) -> None:
        self.host = host
        self.port = port or free_port()
        lines = list(options)
        self.store = folder / f"store-{self.port}"
        if persistence:
            self.store.mkdir(parents=True, exist_ok=True)
            self.store.chmod(0o777)
            lines += [
                "persistence true",
                f"persistence_location {self.store}/",
                f"autosave_on_changes {str(autosave).lower()}",
                f"autosave_interval {int(autosave)}",
            ]
        self._command = mosquitto_command(self.port, folder / f"mosquitto-{self.port}", lines, host)
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def running(self) -> bool:
        return self._process is not None

    def start(self) -> None:
        self._process = Child(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        assert until(self.answers), f"mosquitto did not start: {self._command}"

    def stop(self) -> None:
        """Stop with SIGTERM: persistence is written. With its security plugin it has been seen to hang then, once."""
        try:
            self.end(lambda process: process.terminate())
        except subprocess.TimeoutExpired:
            self.kill()

    def kill(self) -> None:
        """Stop with SIGKILL: what was not saved is lost."""
        self.end(lambda process: process.kill())

    def save(self) -> None:
        """Let it write its persistence now, and wait for that."""
        file = self.store / "mosquitto.db"
        before = file.stat().st_mtime_ns if file.exists() else 0
        os.kill(self.pid, signal.SIGUSR1)
        assert until(lambda: file.exists() and file.stat().st_mtime_ns != before), "mosquitto did not save"

    def forget(self) -> None:
        """Delete what a stopped broker saved."""
        for file in self.store.glob("*"):
            file.unlink(missing_ok=True)

    def freeze(self) -> None:
        """Stop with SIGSTOP: it keeps its connections and answers nothing."""
        os.kill(self.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        os.kill(self.pid, signal.SIGCONT)

    def end(self, how: Callable[[subprocess.Popen[bytes]], None]) -> None:
        if self._process is not None:
            how(self._process)
            self._process.wait(WAIT_S)
            self._process = None

    def answers(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, "mosquitto exited at once"
        return listening(self.port, self.host)


def refusal(rules: Path, filters: Sequence[str]) -> list[str]:
    """Return options of a mosquitto that refuses subscriptions to ``filters``, spelled exactly so; write ``rules``.

    It does so in its SUBACK. With an `acl_file` it would grant them, and deliver nothing.
    """
    acls = [{"acltype": "subscribeLiteral", "topic": filter_, "allow": False} for filter_ in filters]
    allowed = ("publishClientSend", "publishClientReceive", "subscribe", "unsubscribe")
    security = {
        "defaultACLAccess": dict.fromkeys(allowed, True),
        "clients": [],
        "groups": [{"groupname": "all", "roles": [{"rolename": "all"}]}],
        "roles": [{"rolename": "all", "acls": acls}],
        "anonymousGroup": "all",
    }
    rules.write_text(json.dumps(security))
    rules.chmod(0o600)
    plugin = next(Path("/usr/lib").glob("*/mosquitto_dynamic_security.so"))
    return [f"plugin {plugin}", f"plugin_opt_config_file {rules}"]


class RefusingBroker(Broker):
    """A broker that refuses subscriptions to certain filters, which :meth:`refuse` sets."""

    def __init__(self, folder: Path) -> None:
        port = free_port()
        self._rules = folder / f"rules-{port}.json"
        super().__init__(folder, *refusal(self._rules, ()), port=port)

    def refuse(self, *filters: str) -> None:
        """Restart so that these filters are refused, and no others."""
        self.stop()
        refusal(self._rules, filters)
        self.start()


class AmqttBroker:
    """An amqtt broker in a process: no bridge mode, no MQTT 5."""

    def __init__(self) -> None:
        self.port = free_port()
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-m", "pebble.extensions.lab.demo.brokers", str(self.port)]
        self._process = Child(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        assert until(lambda: listening(self.port)), "amqtt did not start"

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(WAIT_S)
            self._process = None


def refused(number: int) -> Callable[..., Any]:
    """Return a function that raises this error, as a file system that refuses does."""

    def refuse(*_arguments: Any, **_options: Any) -> None:
        raise OSError(number, os.strerror(number))

    return refuse
