"""System actions: reboot, service-restart and git-pull, each a command of the operating system."""

import fcntl
import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

from msgspec import Struct

from pebble.config import MqttBridge, SystemControl
from pebble.contract import GIT_PULL, REBOOT, SERVICE_RESTART, Channel
from pebble.runtime.environment import child_environment
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.runtime.service import Service
from pebble.services.mqtt_bridge.own_requests import Requests

if TYPE_CHECKING:
    import subprocess

log = logging.getLogger(__name__)

_NEW_FILE: Final = os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW
_MOST, _KEPT = 1 << 20, 1 << 16  # bytes of output: with more the file begins anew with the last ones
LOOK_S = 0.2


class Row(Struct, frozen=True):
    """An action: its channel, its section of services.mqtt_bridge with the command, and the time between two runs."""

    channel: Channel
    section: str
    cooldown_s: float


ACTIONS: Final = (
    Row(REBOOT, "reboot_control", 30.0),
    Row(SERVICE_RESTART, "service_restart_control", 10.0),
    Row(GIT_PULL, "git_pull_control", 60.0),
)


class Action:
    """A command that runs once at a time, and not again before its cooldown is over. Not thread-safe.

    Operators read the log, and a command's words or output may hold a token: these go to a file in ``folder``.
    """

    def __init__(self, row: Row, control: SystemControl, *, folder: Path, clock: Callable[[], float]) -> None:
        self.name, self.control, self._cooldown_s = row.channel.metric, control, row.cooldown_s
        self._output = folder / f"{self.name.rpartition('/')[2]}.log"
        self._clock = clock
        self._ran_at: float | None = None  # when it was last started
        self._process: subprocess.Popen[bytes] | None = None
        self._warned = False  # the log says that the config has no command for it
        self._log = RateLimitedLog(log, period_s=2.0)  # 3 actions, each with 4 subjects: 12 lines in 2 s at most

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def request(self) -> bool:
        """Run the command; return False, and log why, if the request is refused."""
        if not self.control.command:
            if not self._warned:
                self._warned = True
                log.warning("%s refused: services.mqtt_bridge has no command for it", self.name)
            return False
        if self.running:
            self._log.warning("refused", "%s refused: it is still running", self.name)
            return False
        now = self._clock()
        if self._ran_at is not None and now - self._ran_at < self._cooldown_s:
            self._log.warning("refused", "%s refused: it ran %.0f s ago", self.name, now - self._ran_at)
            return False
        self._ran_at = now
        return self._start()

    def _start(self) -> bool:
        import subprocess  # 0.4 MB of every robot's memory, for a command that few robots run

        self._log.log("running", logging.WARNING, "%s: running its command", self.name)
        output, locked, where = None, None, f"is in {self._output}"  # where: what the log says of the output
        try:
            self._output.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            output = os.open(self._output, _NEW_FILE, 0o600)
            locked = _locked(self._output)
        except OSError as error:
            where = f"is lost: {error.strerror}: {self._output}"
        try:
            self._process = subprocess.Popen(
                self.control.command,
                cwd=self.control.cwd,
                env=child_environment(self.control.env),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL if locked is None else locked,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # a command that restarts this process must survive its end
            )
        except OSError as error:
            self._log.log("failed", logging.ERROR, "%s failed: its command or cwd: %s", self.name, error.strerror)
            if output is not None:
                os.close(output)
            return False
        finally:
            if locked is not None:  # its programs have it
                os.close(locked)
        arguments, name = (self._process, output, where), f"action {self.name}"
        threading.Thread(target=self._follow, args=arguments, name=name, daemon=True).start()
        return True

    def _follow(self, process: "subprocess.Popen[bytes]", output: int | None, where: str) -> None:
        """Log the command's exit code; limit its output's file until it runs again."""
        while (code := process.poll()) is None:
            time.sleep(LOOK_S)
            if output is not None:
                shorten(output)
        level = logging.INFO if code == 0 else logging.ERROR
        self._log.log("ended", level, "%s ended with exit code %d, its output %s", self.name, code, where)
        if output is None:
            return
        in_use = True
        while in_use and self._process is process:  # programs that it has left behind may write for ever
            time.sleep(LOOK_S)
            in_use = _is_locked(output)
            shorten(output)
        os.close(output)


def _locked(path: Path) -> int:
    """Open the file of output for a command: it is locked until all programs that have it from there have ended."""
    file = os.open(path, _NEW_FILE)
    with suppress(OSError):  # no file system for locks
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    return file


def _is_locked(file: int) -> bool:
    """True if a program may still write to the file."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    return False


def shorten(file: int) -> None:
    """Delete all but the end of the open file ``file`` if it is long; a program may append to it meanwhile."""
    size = os.fstat(file).st_size
    if size > _MOST:
        with suppress(OSError):  # a full disk
            end = os.pread(file, _KEPT, size - _KEPT)
            os.ftruncate(file, 0)
            os.write(file, b"(%d bytes are left out)\n%b" % (size - _KEPT, end))


def system_actions(section: MqttBridge, folder: Path, clock: Callable[[], float]) -> dict[Channel, Action]:
    """Return all actions of a robot."""
    return {row.channel: Action(row, getattr(section, row.section), folder=folder, clock=clock) for row in ACTIONS}


class SystemActions(Requests):
    """The actions of a robot, each requested by true on its channel."""

    channels: ClassVar[tuple[Channel, ...]] = tuple(row.channel for row in ACTIONS)

    def __init__(self, service: Service) -> None:
        super().__init__(service)
        config = service.config
        self.actions = system_actions(config.services.mqtt_bridge, config.state_dir(), service.clock)

    def take(self, channel: Channel, value: Any) -> None:
        if value:
            self.service.counters.add("actions" if self.actions[channel].request() else "actions_refused")
