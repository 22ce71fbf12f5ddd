"""The six commands and files of docs/many.md and docs/ext/neighbours.md as printed; only hosts and ports are others."""

from __future__ import annotations

import json
import re
import shutil
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from pebble.config.raw import deep_merge
from pebble.contract import CAPABILITIES, ONLINE
from pebble.extensions.fleet import certificates
from pebble.transports import QoS, TlsSettings, ZenohSettings, create
from tests.ext.fleet.broker_client import BrokerClient, Place
from tests.ext.fleet.commands.test_fleet import PASSWORD, mosquitto, pebble, run, typed
from tests.support import ROOT, free_port, listening, until

pytestmark = pytest.mark.thorough

GOOB = "pebble/robots/goob"
RECEIVES = "pebble topic echo neighbours -c goob.json --raw -n 1 -s 5"


class Section:
    """The lines and the files below a heading; ``here`` replaces names and ports."""

    def __init__(self, page: str, heading: str, here: dict[str, str]) -> None:
        text = (ROOT / "docs" / page).read_text().partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
        for there, mine in here.items():
            text = text.replace(there, mine)
        (block,) = re.findall(r"^    (?:pebble|mosquitto) .*(?:\n    pebble .*)*", text, re.MULTILINE)[:1]
        self.lines = [line.partition("#")[0].strip() for line in block.splitlines()]
        (pieces,) = re.findall(r"```jsonc\n(.*?)```", text, re.DOTALL)[:1]
        found = re.findall(r"^// (\S+\.(?:json|conf))[^\n]*\n(.*?)(?=^//|\Z)", pieces, re.DOTALL | re.MULTILINE)
        self.files = {name: re.sub(r"\s+//.*$", "", body, flags=re.MULTILINE) for name, body in found}
        assert len(self.lines) == 6


def start(line: str, folder: Path, port: int, stack: ExitStack) -> None:
    """What runs until the end; first of all the hub, which listens at ``port`` before others look for it."""
    stack.enter_context(typed(line, folder))
    assert until(lambda: listening(port), 60), (folder / "simulation.log").read_text()


def test_a_gateway_in_six_commands(tmp_path: Path) -> None:
    port, hub = free_port(), free_port()
    here = {f"{host}:7447": f"127.0.0.1:{hub}" for host in ("broker.lab", "0.0.0.0")}
    section = Section("many.md", "Gateways", {**here, "broker.lab": "127.0.0.1", "8883": str(port)})
    *accounts, start_hub, start_gateway = section.lines
    run(f"pebble fleet init hall --host 127.0.0.1 --port {port}", tmp_path)
    with ExitStack() as stack:
        stack.enter_context(mosquitto(tmp_path / "hall" / "mosquitto.conf", port))
        (password,) = PASSWORD.findall(run("pebble fleet add ann --role driver", tmp_path))
        run("pebble fleet add goob --role robot", tmp_path)
        (printed,) = PASSWORD.findall("".join(run(line, tmp_path) for line in accounts))
        for name, body in {"gate-1-password": printed, **section.files}.items():
            (tmp_path / name).write_text(body)
            (tmp_path / name).chmod(0o600)
        for line in (start_hub, start_gateway):
            start(line, tmp_path, hub, stack)
        ca, own = tmp_path / "hall" / certificates.CA_CERT, tmp_path / "hall" / certificates.ACCOUNTS / "goob.pem"
        tls = TlsSettings(ca_cert=ca, client_cert=own, client_key=own.with_suffix(".key"))
        at_hub = {"connect": (f"tls/127.0.0.1:{hub}",), "tls": tls, "client": True, "account": "goob"}
        robot = stack.enter_context(create("zenoh", "goob-x", ZenohSettings(run_dir=tmp_path / "run", **at_hub)))
        operator = stack.enter_context(BrokerClient(Place("127.0.0.1", port, ca), "ann", password))
        operator.subscribe([ONLINE.topic(GOOB)])
        robot.publish(CAPABILITIES.topic(GOOB), b"{}", qos=QoS.DELIVERED, retain=True)

        def carried() -> bool:
            now = json.dumps({"t": int(time.time() * 1000)}).encode()
            robot.publish(ONLINE.topic(GOOB), now, qos=QoS.DELIVERED, retain=True)
            operator.listen(0.2)
            return bool(operator.received)

        assert until(carried, 60), (robot.problem, (tmp_path / "simulation.log").read_text())


def test_two_robots_of_a_lan_receive_each_other_in_six_commands(tmp_path: Path) -> None:
    hub = free_port()
    section = Section(
        "ext/neighbours.md", "goob drives fred", {"0.0.0.0:7447": f"127.0.0.1:{hub}", "hub.lab": "127.0.0.1"}
    )
    init, *accounts, start_hub, up_goob, up_fred = section.lines
    run(init, tmp_path)
    for line, name in zip(accounts, ("goob.json", "fred.json"), strict=True):
        config = deep_merge(piece_in(run(line, tmp_path), hub), json.loads(section.files[name]))
        (tmp_path / name).write_text(json.dumps(config))
    (tmp_path / "hub.json").write_text(section.files["hub.json"])
    for file in (tmp_path / "lan" / certificates.CA_CERT, *(tmp_path / "lan" / certificates.ACCOUNTS).iterdir()):
        shutil.copy(file, tmp_path)
    with ExitStack() as stack:
        for line in (start_hub, up_goob, up_fred):
            start(line, tmp_path, hub, stack)
        assert until(lambda: received(tmp_path) == {"fred": True}, 60), (tmp_path / "simulation.log").read_text()


def test_two_robots_of_a_lan_and_a_board_receive_each_other_in_six_commands(tmp_path: Path) -> None:
    hub, port = free_port(), free_port()
    section = Section("many.md", "A LAN with boards", {"hub.lab": "127.0.0.1"})
    make, *starts, _ = section.lines
    run(f"{make} --port {port}", tmp_path)
    lan = tmp_path / "lan"
    (grants,) = section.files.values()
    gateway = lan / "gateway.json"
    gateway.write_text(json.dumps(deep_merge(json.loads(gateway.read_text()), json.loads(grants))))
    for file in lan.glob("**/*.json"):
        if file.name not in ("fleet.json", "zenoh.json"):
            file.write_text(file.read_text().replace("0.0.0.0:7447", "127.0.0.1:7447").replace("7447", str(hub)))
    for file in lan.glob("robots/*/*"):
        shutil.copy(file, tmp_path)
    with ExitStack() as stack:
        began = time.monotonic()
        for line in starts:
            start(line, tmp_path, hub, stack)
        both = {"fred": True, "minilamp": True}
        assert until(lambda: received(tmp_path) == both, 60), (tmp_path / "simulation.log").read_text()
        sys.stdout.write(f"\ngoob receives fred and the board after {time.monotonic() - began:.1f} s\n")


def received(folder: Path) -> dict[str, bool]:
    """Whom goob receives now."""
    shown = pebble(RECEIVES, folder).stdout
    return dict(json.loads(shown)["receives"]) if shown else {}


def piece_in(shown: str, hub: int) -> dict[str, Any]:
    """The piece of a config that a command has printed, with the port of this test's hub."""
    (piece,) = re.findall(r"^\{.*^\}", shown.replace("7447", str(hub)), re.DOTALL | re.MULTILINE)
    found: dict[str, Any] = json.loads(piece)
    return found
