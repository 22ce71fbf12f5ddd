"""Reports to systemd: sd_notify(3) in pure Python. Nothing is sent if systemd does not listen."""

import logging
import os
import socket
from collections.abc import Mapping

log = logging.getLogger(__name__)


class SystemdNotifier:
    """A sender of state datagrams to ``$NOTIFY_SOCKET``; the unit must say ``Type=notify``."""

    #: Only for the process that systemd started, not for its children.
    VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = _address(environment)
        #: Seconds between two signs of life, half of what the unit's WatchdogSec allows; None without a watchdog.
        self.watchdog_period_s = _watchdog_period_s(environment)

    def ready(self) -> None:
        self._send("READY=1")

    def status(self, text: str) -> None:
        """Set the line that ``systemctl status`` shows."""
        self._send(f"STATUS={text}")

    def watchdog(self) -> None:
        self._send("WATCHDOG=1")

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def _send(self, text: str) -> None:
        if self._address is None:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.setblocking(False)
                sender.sendto(text.encode(), self._address)
        except OSError as error:
            log.debug("systemd did not take %s: %s", text, error)


def _address(environment: Mapping[str, str]) -> str | None:
    path = environment.get("NOTIFY_SOCKET", "")
    if path.startswith("@"):  # the abstract namespace
        return "\0" + path[1:]
    return path if path.startswith("/") else None


def _watchdog_period_s(environment: Mapping[str, str]) -> float | None:
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    microseconds = environment.get("WATCHDOG_USEC", "")
    return int(microseconds) / 2e6 if microseconds.isdigit() and int(microseconds) > 0 else None
