"""System actions: reboot, service-restart and git-pull each run one command of the operating system."""

from __future__ import annotations

import logging
import os
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from pebble.config import MqttBridge, SystemControl
from pebble.contract import GIT_PULL, REBOOT, SERVICE_RESTART, Channel

log = logging.getLogger(__name__)

_LINE_CHARS = 2048  # of a command's output, per log record


@dataclass(frozen=True, slots=True)
class Row:
    """One action: its channel, and the section of services.mqtt_bridge with its command."""

    channel: Channel
    section: str


ACTIONS: Final = (
    Row(REBOOT, "reboot_control"),
    Row(SERVICE_RESTART, "service_restart_control"),
    Row(GIT_PULL, "git_pull_control"),
)


class Action:
    """Runs one command at a time, no more often than its cooldown allows. Not thread-safe."""

    def __init__(self, name: str, control: SystemControl, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.name, self.control = name, control
        self._clock = clock
        self._ran_at: float | None = None
        self._process: subprocess.Popen[str] | None = None
        self._warned = False

    def request(self) -> bool:
        """Run the command; False, with a log line, if that is refused."""
        if not self.control.command:
            self._warn_of_missing_command()
            return False
        if self._process is not None and self._process.poll() is None:
            log.warning("%s refused: it is still running", self.name)
            return False
        now = self._clock()
        if self._ran_at is not None and now - self._ran_at < self.control.cooldown_seconds:
            log.warning("%s refused: it ran %.0f s ago", self.name, now - self._ran_at)
            return False
        self._ran_at = now
        return self._start()

    def _start(self) -> bool:
        log.warning("%s: running %s", self.name, " ".join(self.control.command))
        try:
            self._process = subprocess.Popen(
                self.control.command,
                cwd=self.control.cwd,
                env={**os.environ, **self.control.env},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                start_new_session=True,  # a command that restarts this process must survive its end
            )
        except OSError as error:
            log.error("%s failed: %s", self.name, error)
            return False
        threading.Thread(
            target=_follow, args=(self.name, self._process), name=f"action {self.name}", daemon=True
        ).start()
        return True

    def _warn_of_missing_command(self) -> None:
        if not self._warned:
            self._warned = True
            log.warning("%s refused: services.mqtt_bridge has no command for it", self.name)


class SystemActions:
    """The whole table, for one robot's config."""

    def __init__(self, section: MqttBridge, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._actions = {
            row.channel: Action(row.channel.metric, getattr(section, row.section), clock=clock) for row in ACTIONS
        }

    def accepts_retained(self, channel: Channel) -> bool:
        """Whether ``channel`` is an action whose retained requests run, too (``ignore_retained: false``)."""
        action = self._actions.get(channel)
        return action is not None and not action.control.ignore_retained

    def request(self, channel: Channel) -> bool:
        """Run the command of ``channel``; False if it is refused."""
        return self._actions[channel].request()


def _follow(name: str, process: subprocess.Popen[str]) -> None:
    """Log the command's output and its exit code."""
    assert process.stdout is not None  # noqa: S101  (PIPE above)
    with process.stdout as output:
        while line := output.readline(_LINE_CHARS):
            log.info("%s: %s", name, line.rstrip())
    code = process.wait()
    log.log(logging.INFO if code == 0 else logging.ERROR, "%s ended with exit code %d", name, code)
