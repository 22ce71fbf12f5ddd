"""docs/fleet.md by a newcomer: two brokers, two hubs, two robots and a board, and one of each is killed.

``pytest -s`` prints how long it took and when the others were right again. All machines are this one: a port, an
address and the path of the second broker's folder are changed, nothing else.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.config.raw import deep_merge
from pebble.fleet.certificates import ACCOUNTS, CA_CERT
from pebble.fleet.folder import CONF, FLEET, ZENOH
from pebble.rig.processes import mosquitto_path, python
from pebble.runtime.every_host import EveryHost
from pebble.transports import Message, MqttSettings, TlsSettings, ZenohSettings, create
from tests.commands.test_fleet import PASSWORD, run
from tests.support import ROOT, Child, free_port, until

pytestmark = [pytest.mark.alone, pytest.mark.thorough]
FIRST, SECOND = "127.0.0.2", "127.0.0.3"
LIMIT_S = 5.0  # until a robot is received elsewhere, or is known to be gone


class Walk:
    """The folders of all machines, and what runs on them, by name."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder, self.port, self.hubs = folder, free_port(), {name: free_port() for name in ("hub1", "hub2")}
        self.received: dict[str, float] = {}  # when the newest heartbeat came, and the newest will
        self.gone: dict[str, float] = {}
        self._running: dict[str, Child] = {}
        self._lines: dict[str, list[str]] = {}
        stack.callback(lambda: [self.kill(name) for name in list(self._running)])
        self._brokers()
        password = self._accounts()
        tls = TlsSettings(ca_cert=folder / "hall" / CA_CERT)
        places = tuple((host, self.port) for host in (FIRST, SECOND))
        settings = MqttSettings(host=FIRST, port=self.port, hosts=places, username="ann", password=password, tls=tls)
        self.operator = EveryHost("operator", settings)
        here = tuple(f"tls/127.0.0.1:{port}" for port in self.hubs.values())
        certificate, key = (folder / "hall" / ACCOUNTS / f"ann.{ending}" for ending in ("pem", "key"))
        tls = TlsSettings(ca_cert=folder / "hall" / CA_CERT, client_cert=certificate, client_key=key)
        at_hubs = ZenohSettings(run_dir=folder / "eye", connect=here, tls=tls, client=True, account="ann")
        for client in (self.operator, create("zenoh", "eye", at_hubs)):
            stack.enter_context(client).subscribe("pebble/robots/+/outgoing/online", self._take)

    def _take(self, message: Message) -> None:
        if not message.retain:
            online = json.loads(message.payload).get("online", True)  # a heartbeat is without it
            (self.received if online else self.gone)[message.topic.split("/")[2]] = time.monotonic()

    def _brokers(self) -> None:
        hall, spare = self.folder / "hall", self.folder / "spare"
        run(f"pebble fleet init hall --host {FIRST},{SECOND} --port {self.port} --level named", self.folder)
        shutil.copytree(hall, spare)
        text = (spare / CONF).read_text().replace(str(hall), str(spare)).replace(FIRST, SECOND)
        (spare / CONF).write_text(text)
        fleet = json.loads((hall / FLEET).read_text())
        fleet["brokers"].append({"host": SECOND, "port": self.port})
        (hall / FLEET).write_text(json.dumps(fleet))
        for name in ("hall", "spare"):
            self._lines[name] = [str(mosquitto_path()), "-c", str(self.folder / name / CONF)]
            self.start(name)

    def _accounts(self) -> str:
        """Returns Ann's password."""

        def fleet(line: str) -> tuple[str, dict[str, Any]]:
            shown = until_done(f"pebble fleet {line} --folder hall", self.folder)
            found = re.search(r"^\{.*^\}", shown, re.DOTALL | re.MULTILINE)
            return shown, json.loads(found[0]) if found else {}

        (ann, _), (_, goob), (_, lamp) = map(
            fleet, ("add ann --role driver", "add goob --role robot", "add minilamp --role robot --board")
        )
        for line in ("add fred --role robot", *(f"add {name} --role hub" for name in self.hubs), "zenoh"):
            fleet(line)
        connect = [f"tls/127.0.0.1:{port}" for port in self.hubs.values()]
        for name, port in self.hubs.items():
            _, file = fleet(f"certificate {name} 127.0.0.1")
            other = [one for one in connect if not one.endswith(str(port))] if name == "hub1" else []
            file |= {"listen": [f"tls/127.0.0.1:{port}"], "connect": other}
            self._machine(name, file, "fleet hub {}")
        _, fred = fleet("certificate fred")
        fred["services"]["mqtt_bridge"]["remote"]["connect"] = connect
        fleet("certificate ann")
        self._machine("goob", deep_merge(_config("minimal"), goob), "up {}")
        self._machine("fred", deep_merge(_config("minimal"), fred), "up {}")
        self._machine("minilamp", deep_merge(_config("minilamp"), lamp), "sim minilamp --broker {}")
        return str(PASSWORD.findall(ann)[0])

    def _machine(self, name: str, config: dict[str, Any], line: str) -> None:
        """A folder with a config and what it names beside it; the program starts."""
        place, hall = self.folder / name, self.folder / "hall"
        place.mkdir()
        file = place / f"{name}.json"
        for one in (hall / CA_CERT, hall / ZENOH, *(hall / ACCOUNTS).glob(f"{name}.*")):
            shutil.copy(one, place)
        file.write_text(json.dumps(config))
        file.chmod(0o600)
        self._lines[name] = python("pebble.cli", *line.format(file).split())
        self.start(name)

    def start(self, name: str) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self._running[name] = Child(self._lines[name], cwd=self.folder, stdout=log, stderr=log)

    def kill(self, name: str) -> float:
        process, at = self._running.pop(name), time.monotonic()
        process.kill()
        process.wait(10)
        return at

    def receives(self, *names: str, since: float) -> float:
        """Seconds after ``since`` when all of them were received again."""
        assert until(lambda: all(self.received.get(name, 0.0) > since for name in names), 60), (self.received, names)
        return max(self.received[name] for name in names) - since

    def misses(self, name: str, since: float) -> float:
        assert until(lambda: self.gone.get(name, 0.0) > since, LIMIT_S), (name, self.gone)
        return self.gone[name] - since


def until_done(line: str, folder: Path) -> str:
    """Brokers that begin are asked again."""
    shown = [""]

    def done() -> bool:
        try:
            shown[0] = run(line, folder)
        except AssertionError:
            return False
        return True

    assert until(done, 20), line
    return shown[0]


def _config(kind: str) -> dict[str, Any]:
    """Return the file without the name of its broker: `pebble up` wants it left out where there are several."""
    found: dict[str, Any] = json.loads((ROOT / "configs" / f"{kind}.json").read_text())
    for section in (
        found.get("local_mqtt", {}),
        found.get("services", {}).get("mqtt_bridge", {}).get("remote_mqtt", {}),
    ):
        section.pop("host", None)
    return found


@contextmanager
def walk(folder: Path) -> Iterator[Walk]:
    with ExitStack() as stack:
        yield Walk(folder, stack)


def test_one_of_each_is_killed_and_the_rest_is_right_again(tmp_path: Path) -> None:
    began = time.monotonic()
    took: dict[str, float] = {}
    with walk(tmp_path) as walked:
        walked.receives("goob", "fred", "minilamp", since=began)
        took["begin"] = time.monotonic() - began
        killed = walked.kill("hall")
        second = f"{SECOND}:{walked.port}"
        at = {f"pebble/robots/{name}" for name in ("goob", "minilamp")}
        assert until(lambda: {walked.operator.host_of(base) for base in at} == {second}, 30)
        took["broker"] = time.monotonic() - killed
        walked.start("hall")
        killed = walked.kill("hub1") + 0.3  # what it had passed on is not new
        took["hub"] = walked.receives("fred", since=killed)
        walked.start("hub1")
        for name in ("goob", "fred", "minilamp"):
            took[f"{name} is gone"] = walked.misses(name, walked.kill(name))
            walked.start(name)
            took[f"{name} is back"] = walked.receives(name, since=time.monotonic())
    sys.stdout.write(f"\nafter s: { {what: round(seconds, 2) for what, seconds in took.items()} }\n")
    assert max(took["broker"], took["hub"]) <= LIMIT_S
