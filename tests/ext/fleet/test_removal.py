"""Who is removed while driving: through a gateway, and at a second broker, which has copies of the files."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from msgspec.structs import replace

from pebble.contract import CAPABILITIES, DRIVE, ONLINE
from pebble.extensions.fleet import applying, certificates
from pebble.extensions.fleet.folder import ZENOH, save
from pebble.extensions.fleet.roles import Account
from pebble.transports import QoS, State, TlsSettings, Transport, ZenohSettings, create
from tests.ext.fleet.broker_client import BrokerError, RefusedError
from tests.ext.fleet.brokers import HOST, FleetBroker
from tests.support import free_port, until
from tests.transports.forked import Forked
from tests.transports.zenoh_net import HubProcess

pytestmark = pytest.mark.alone  # seconds are counted

DRIVER = Account(roles=("driver",))
ROBOTS = {name: Account(roles=("robot",), bases=(f"pebble/robots/{name}",)) for name in ("goob", "fred", "lamp")}
ACCOUNTS = {
    **dict.fromkeys(("ann", "otto", "mia", "zoe"), DRIVER),
    **ROBOTS,
    "gate": Account(roles=("gateway",), bases=("pebble/robots/+",)),
}
AT_BROKER_S = 1.0
AT_HUB_S = 3.0  # a hub looks once a second whether its rules have changed, and makes its connections anew
SILENT_S = 2.0


class Driver:
    """A person who drives a robot until the broker ends the connection, which other clients would make anew."""

    def __init__(self, broker: FleetBroker, name: str, robot: str) -> None:
        self._client, self._ending = broker.login(name), threading.Event()
        self._topic = DRIVE.topic(f"pebble/robots/{robot}")
        self._payload = json.dumps({"x": 0, "z": 0.5, "who": name}).encode()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with suppress(BrokerError), self._client:
            while not self._ending.wait(0.05):
                self._client.publish(self._topic, self._payload)
                self._client.listen(0.001)

    def end(self) -> None:
        self._ending.set()
        self._thread.join(10)


class Hall:
    """Two brokers, a hub, a gateway between the first broker and the hub, where goob and fred are."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        self.first = FleetBroker(folder / "hall", ACCOUNTS)
        save(self.first.folder, replace(self.first.fleet, hubs="here"))
        self.second = stack.enter_context(self.first.spare(folder / "spare"))
        stack.enter_context(self.first)
        applying.write_zenoh(self.first.folder, self.first.fleet)
        self.arrived: dict[tuple[str, str], float] = {}  # by driver and robot: when the newest command came
        self._hub()
        self.robots = [self._robot(name) for name in ("goob", "fred")]
        self.gate = self._gate("gate")
        self.log_lamp_in()
        ending = threading.Event()
        for work in (self._heartbeats, self._listen):
            thread = threading.Thread(target=self._repeat, args=(work, ending))
            thread.start()
            stack.callback(thread.join)
        stack.callback(ending.set)

    def _hub(self) -> None:
        self.endpoint, place, run_dir = f"tls/{HOST}:{free_port()}", self.first.folder, self._folder / "hub"
        hub = HubProcess(run_dir)
        own = TlsSettings(
            ca_cert=place / certificates.CA_CERT,
            client_cert=place / certificates.SERVER_CERT,
            client_key=place / certificates.SERVER_KEY,
        )
        hub.settings = ZenohSettings(
            run_dir=self._folder / "hub", listen=(self.endpoint,), tls=own, access=place / ZENOH
        )
        hub.start()
        self._stack.callback(hub.kill)

    def _robot(self, name: str) -> Transport:
        tls = TlsSettings(**self._certificate(name))
        run_dir, at = self._folder / name, (self.endpoint,)
        settings = ZenohSettings(run_dir=run_dir, connect=at, tls=tls, client=True, account=name)
        client = self._stack.enter_context(create("zenoh", name, settings))
        assert until(lambda: client.state is State.CONNECTED, 30), client.problem
        base = f"pebble/robots/{name}"
        client.publish(CAPABILITIES.topic(base), b"{}", qos=QoS.DELIVERED, retain=True)
        client.subscribe(DRIVE.topic(base), lambda one: self._note(one.topic, one.payload), direct=True)
        return client

    def _certificate(self, name: str) -> dict[str, Path]:
        certificate, key = certificates.of_account(self.first.folder, name)
        return {"ca_cert": self.first.folder / certificates.CA_CERT, "client_cert": certificate, "client_key": key}

    def _gate(self, name: str) -> Forked:
        tls = {"enabled": True, **{key: str(path) for key, path in self._certificate(name).items()}}
        login = {"username": name, "password": self.first.passwords[name]}
        broker = {"host": HOST, "port": self.first.port, "tls": {"enabled": True, "ca_cert": tls["ca_cert"]}, **login}
        file = self._folder / f"{name}.json"
        file.write_text(json.dumps({"hub": {"connect": [self.endpoint], "account": name, "tls": tls}, "mqtt": broker}))
        file.chmod(0o600)
        gate = Forked("tests.ext.fleet.gateway_process", str(file))
        self._stack.callback(gate.kill)
        return gate

    def _repeat(self, work: Callable[[], None], ending: threading.Event) -> None:
        while not ending.wait(0.02):
            work()

    def _heartbeats(self) -> None:
        for robot in self.robots:
            now = json.dumps({"t": int(time.time() * 1000)}).encode()
            robot.publish(ONLINE.topic(f"pebble/robots/{robot.client_id}"), now, qos=QoS.DELIVERED, retain=True)
        time.sleep(0.2)

    def log_lamp_in(self) -> None:
        """The robot at the second broker."""
        self._lamp = self._stack.enter_context(self.second.login("lamp"))
        self._lamp.subscribe([DRIVE.topic("pebble/robots/lamp")])

    def _listen(self) -> None:
        client = self._lamp
        client.listen(0.02)
        received, client.received = client.received, []
        for topic, payload in received:
            self._note(topic, payload)

    def _note(self, topic: str, payload: bytes) -> None:
        if payload.strip():  # else a probe for cycles
            self.arrived[json.loads(payload)["who"], topic.split("/")[2]] = time.monotonic()

    # -- what is asked of it

    def drives(self, broker: FleetBroker, name: str, robot: str) -> None:
        driver = Driver(broker, name, robot)
        self._stack.callback(driver.end)
        assert until(lambda: (name, robot) in self.arrived, 30), self.gate.printed

    def ends_after(self, act: Callable[[], object], *driven: tuple[str, str]) -> float:
        """How long after ``act`` the last of these commands came."""
        began = time.monotonic()
        act()
        assert until(lambda: time.monotonic() - max(self.arrived[one] for one in driven) > SILENT_S, 20)
        return max(0.0, max(self.arrived[one] for one in driven) - began)

    def goes_on(self, name: str, robot: str) -> bool:
        since = time.monotonic()
        return until(lambda: self.arrived[name, robot] > since, 60)


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    with ExitStack() as stack:
        yield Hall(tmp_path, stack)


def test_who_is_removed_while_driving_drives_no_more(hall: Hall) -> None:
    first, second, took = hall.first, hall.second, dict[str, float]()
    hall.drives(first, "ann", "goob")
    hall.drives(first, "otto", "goob")
    hall.drives(first, "otto", "fred")
    took["a person, through a gateway"] = hall.ends_after(lambda: first.remove("ann"), ("ann", "goob"))
    took["a robot, at the hub"] = hall.ends_after(lambda: first.remove("goob"), ("otto", "goob"))
    assert hall.goes_on("otto", "fred")
    took["a gateway"] = hall.ends_after(lambda: first.remove("gate"), ("otto", "fred"))

    hall.drives(second, "mia", "lamp")
    first.remove("mia")
    assert hall.goes_on("mia", "lamp")
    took["a person, at the second broker"] = hall.ends_after(lambda: second.copy_rules(first), ("mia", "lamp"))
    with pytest.raises(RefusedError):
        second.login("mia")

    sys.stdout.write(f"\n{json.dumps({what: round(one, 2) for what, one in took.items()})}\n")
    assert took.pop("a robot, at the hub") < AT_HUB_S
    assert max(took.values()) < AT_BROKER_S
