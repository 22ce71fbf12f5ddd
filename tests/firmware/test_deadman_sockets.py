"""Motors are off within a second after the last command, with real sockets, a real broker and real faults.

All faults run at the same time, each on a pair of robots of its own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.client import MQTTMessageInfo

from pebble.extensions.lab.simulation.wireless import KINDS
from tests.firmware.wireless_rig import Operator, Robots
from tests.support import Broker, until
from tests.tcp_proxy import TcpProxy

LIMIT_S = 1.0
BACK_S = 20.0
FAULTS = ("wifi lost", "broker killed", "black hole", "dns failing", "ntp silent", "only keepalives", "flood")
_PERIOD_S = 0.05


@dataclass
class Result:
    """Per kind: how long the motors ran after the last command that arrived, and how long it took to obey again."""

    ran_on_s: dict[str, float]
    back_s: float


class Case:
    """One fault: two robots, a broker, perhaps a link between them, and an operator."""

    def __init__(self, fault: str, folder: Path, stack: ExitStack) -> None:
        self.fault = fault
        self.broker = Broker(folder)
        stack.callback(self.broker.kill)
        self.link = stack.enter_context(TcpProxy(self.broker.port))
        self.robots = Robots("localhost" if fault == "dns failing" else "127.0.0.1", self.link.port)
        self.robots.fleet.servers.clock = fault != "ntp silent"
        stack.enter_context(self.robots)
        self.operator = stack.enter_context(Operator(self.broker.port))

    def play(self) -> Result:
        self.robots.wait_online()
        last = self._drive(1.0)
        with _FAULTS[self.fault](self) as after:
            last = after or last
            assert until(lambda: not any(map(self.robots.moving, KINDS)), 3.0), f"{self.fault}: a robot runs on"
            time.sleep(2.0)  # and stays where it is, though the fault goes on and connections are given up
            ran_on = {kind: self.robots.stopped_at(kind) - last for kind in KINDS}
        began = time.monotonic()
        assert until(self._obeys, BACK_S, step=_PERIOD_S), f"{self.fault}: {self._troubles()}"
        assert self.robots.alive
        return Result(ran_on, time.monotonic() - began)

    def _drive(self, seconds: float) -> float:
        """Both robots move at the end; returns when the broker had the last command."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            last = [self.operator.drive(kind, 0.1, 0.8) for kind in KINDS]
            time.sleep(_PERIOD_S)
        assert all(map(self.robots.moving, KINDS)), f"{self.fault}: {self._troubles()}"
        return self.acknowledged(last)

    def acknowledged(self, sent: list[MQTTMessageInfo | None]) -> float:
        for info in sent:
            assert info is not None
            info.wait_for_publish(5)
        return time.monotonic()

    def _obeys(self) -> bool:
        """Are both robots driven again?"""
        for kind in KINDS:
            self.operator.drive(kind, 0.0, 0.7)
        return all(map(self.robots.moving, KINDS))

    def _troubles(self) -> Any:
        return {kind: (robot.online, robot.problem) for kind, robot in self.robots.robots.items()}

    def keep_driving(self, rate_hz: float, stop: threading.Event) -> None:
        """The operator notices nothing."""
        while not stop.wait(1 / rate_hz):
            for kind in KINDS:
                self.operator.drive(kind, 0.1, 0.8)


@contextmanager
def _driven_through(case: Case) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=case.keep_driving, args=(20.0, stop), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(5)


@contextmanager
def _wifi(case: Case) -> Iterator[None]:
    for robot in case.robots.robots.values():
        robot.network.radio.lose()
    with _driven_through(case):
        yield
    for robot in case.robots.robots.values():
        robot.network.radio.restore()


@contextmanager
def _killed(case: Case) -> Iterator[None]:
    case.broker.kill()
    with _driven_through(case):
        yield
    case.broker.start()


@contextmanager
def _hole(case: Case) -> Iterator[None]:
    case.link.blackhole()
    with _driven_through(case):
        yield
    case.link.resume()


@contextmanager
def _dns(case: Case) -> Iterator[None]:
    case.robots.fleet.servers.names = False
    case.link.drop()
    with _driven_through(case):
        yield
    case.robots.fleet.servers.names = True


@contextmanager
def _ntp(case: Case) -> Iterator[None]:
    yield
    case.robots.fleet.servers.clock = True


@contextmanager
def _keepalives(case: Case) -> Iterator[None]:
    time.sleep(3.0)  # longer than the silence that makes a robot give up its connection
    assert all(robot.online for robot in case.robots.robots.values())
    yield


@contextmanager
def _flood(case: Case) -> Iterator[float]:
    began = time.monotonic()
    for number in range(1000):
        last = [case.operator.drive(kind, 0.1 * (number % 3), 0.8, qos=number % 2) for kind in KINDS]
        time.sleep(max(0.0, began + number / 500 - time.monotonic()))
    assert all(map(case.robots.moving, KINDS))
    yield case.acknowledged(last)


_FAULTS: dict[str, Callable[[Case], Any]] = dict(
    zip(FAULTS, (_wifi, _killed, _hole, _dns, _ntp, _keepalives, _flood), strict=True)
)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Future[Result]]]:
    """All faults, started at the same time."""
    with ExitStack() as stack:
        cases = [Case(fault, tmp_path_factory.mktemp("fault"), stack) for fault in FAULTS]
        pool = stack.enter_context(ThreadPoolExecutor(len(cases)))
        yield {case.fault: pool.submit(case.play) for case in cases}


@pytest.mark.parametrize("fault", FAULTS)
def test_motors_are_off_within_a_second(results: dict[str, Future[Result]], fault: str) -> None:
    result = results[fault].result(60)
    for kind in KINDS:
        assert result.ran_on_s[kind] <= LIMIT_S, f"{kind} ran on for {result.ran_on_s[kind]:.3f} s"
