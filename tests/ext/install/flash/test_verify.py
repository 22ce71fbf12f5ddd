"""The last step of flashing accepts a live heartbeat, and ignores a retained one."""

from __future__ import annotations

import os
import subprocess
import threading
import tty
from binascii import crc_hqx
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.config import Config, parse
from pebble.errors import DeviceError
from pebble.extensions.install.flash import verify
from pebble.extensions.install.flash.boards import FIRMWARE
from pebble.extensions.install.flash.verify import at_broker, on_serial_port
from tests.commands.conftest import broker as broker
from tests.support import WAIT_S, Broker, beside, free_port

TOPIC = "pebble/robots/lamp/outgoing/online"


def config(port: int) -> Config:
    raw = {"robot": {"id": "lamp"}, "local_mqtt": {"host": "127.0.0.1", "port": port}}
    return parse(raw, folder=Path("/"), env={})


def publish(broker: Broker, payload: str, *options: str) -> None:
    command = ["mosquitto_pub", "-p", str(broker.port), "-t", TOPIC, "-m", payload, *options]
    subprocess.run(command, check=True, timeout=WAIT_S)


def test_a_retained_heartbeat_and_a_will_are_ignored(broker: Broker) -> None:
    publish(broker, '{"t": 1700000000000, "online": true}', "-r")
    dead = threading.Timer(0.2, publish, (broker, '{"t": 0, "online": false}'))
    dead.start()
    with pytest.raises(DeviceError, match=r"no heartbeat from pebble/robots/lamp within 0\.6 s"):
        at_broker(config(broker.port), timeout_s=0.6)
    dead.join()


def test_a_live_heartbeat_counts_even_without_the_time_of_day(broker: Broker) -> None:
    done = threading.Event()

    def send_heartbeats() -> None:
        while not done.wait(0.2):
            publish(broker, '{"t": 3250, "online": true}', "-r")

    with beside(send_heartbeats, done):
        assert at_broker(config(broker.port), timeout_s=WAIT_S) == "the robot is online"


def test_an_unreachable_broker_is_reported_as_this_machines_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify, "BROKER_S", 0.3)
    with pytest.raises(DeviceError, match="this machine cannot connect"):
        at_broker(config(free_port()), timeout_s=1)


@pytest.fixture
def line() -> Iterator[tuple[str, int]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    yield os.ttyname(slave), master
    os.close(master)
    os.close(slave)


def frame() -> bytes:
    """A HELLO without content, as pebble_serial_v1 puts it on the wire."""
    body = bytes((1, 1, 0, 0, 0, 0, 0, 0, 0, 7, 0, 0, 0))
    body += crc_hqx(body, 0xFFFF).to_bytes(2, "little")
    return b"".join(bytes((len(run) + 1,)) + run for run in body.split(b"\0")) + b"\0"


@pytest.mark.parametrize(
    ("robot", "sent", "is_report"),
    [
        ("goob", b"1 a2=3\r\nT a0=1 a1=2 a2=3\r\n", True),
        ("fred", b"Done!\r\nT t0=1 t1=2 t2=3 chg=0\r\n", True),
        ("goob_imu", b"garbage\0" + frame(), True),
        ("goob", b"\r\n>>> \r\n", False),
        ("goob_imu", b"x\0" + frame()[:-3] + b"\1\0", False),
    ],
)
def test_a_report_on_the_line_counts_and_other_bytes_are_shown(
    robot: str, sent: bytes, is_report: bool, line: tuple[str, int]
) -> None:
    timer = threading.Timer(0.3, os.write, (line[1], sent))
    timer.start()
    if is_report:
        assert on_serial_port(line[0], FIRMWARE[robot], timeout_s=WAIT_S) == "the robot sends reports"
    else:
        with pytest.raises(DeviceError, match=f"no report from {robot} within 0.6 s; received b'"):
            on_serial_port(line[0], FIRMWARE[robot], timeout_s=0.6)
    timer.join()
