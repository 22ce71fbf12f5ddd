from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from pebble.launcher.sd_notify import SystemdNotifier


@pytest.mark.parametrize("address", ["{tmp_path}/notify", "@pebble-test-{pid}"])
def test_notifications_arrive(address: str, tmp_path: Path) -> None:
    address = address.format(tmp_path=tmp_path, pid=os.getpid())
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address.replace("@", "\0"))
        systemd.settimeout(10)
        notifier = SystemdNotifier({"NOTIFY_SOCKET": address})
        notifier.ready()
        notifier.status("3 of 4 ready")
        notifier.watchdog()
        notifier.stopping()
        received = [systemd.recv(100).decode() for _ in range(4)]
    assert received == ["READY=1", "STATUS=3 of 4 ready", "WATCHDOG=1", "STOPPING=1"]
    SystemdNotifier({"NOTIFY_SOCKET": "/nowhere/at/all"}).ready()


@pytest.mark.parametrize(
    ("environment", "period_s"),
    [
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "own"}, 10.0),
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_the_watchdog_is_served_at_half_its_time(environment: dict[str, str], period_s: float | None) -> None:
    own = {name: text.replace("own", str(os.getpid())) for name, text in environment.items()}
    assert SystemdNotifier(own).watchdog_period_s == period_s
