from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from pebble.launcher.sd_notify import SystemdNotifier


@pytest.fixture(params=["path", "abstract"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return {"path": str(tmp_path / "notify"), "abstract": f"@pebble-test-{os.getpid()}"}[request.param]


def test_notifications_arrive(address: str) -> None:
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


@pytest.mark.parametrize("environment", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "/nowhere/at/all"}])
def test_without_systemd_nothing_happens(environment: dict[str, str]) -> None:
    SystemdNotifier(environment).ready()


@pytest.mark.parametrize(
    ("environment", "period_s"),
    [
        ({"WATCHDOG_USEC": "20000000"}, 10.0),
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "own"}, 10.0),
        ({"WATCHDOG_USEC": "20000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_the_watchdog_is_served_at_half_its_time(environment: dict[str, str], period_s: float | None) -> None:
    own = {name: text.replace("own", str(os.getpid())) for name, text in environment.items()}
    assert SystemdNotifier(own).watchdog_period_s == period_s
