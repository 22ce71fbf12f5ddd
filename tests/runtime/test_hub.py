"""What a robot's hub takes as a will: nothing that happens once, under whatever name, from whomever."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.config import parse
from pebble.runtime.connections import hub_settings
from pebble.runtime.hub import WILLS
from pebble.transports import QoS, ZenohSettings, create
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.hub.admission import Admission
from pebble.transports.zenoh.hub.intake import ASKED_BYTES, QUEUE_BYTES, SENDERS, Intake
from pebble.transports.zenoh.hub.journal import Journal
from pebble.transports.zenoh.hub.records import StoredWill
from pebble.transports.zenoh.wire import Will
from tests.support import ROOT, WAIT_S, Child, until
from tests.transports.zenoh_net import HubProcess

BASE = "pebble/robots/goob"
REFUSED = (
    *(f"{BASE}/incoming/{metric}" for metric in ("drive-values", "estop", "mcu/arm-1/move", "flags/reboot")),
    *(f"{BASE}/incoming/{metric}" for metric in ("by/otto/drive-values", "drive-values/", "/drive-values", "%2A")),
    *("arm/drive", "site/reboot", "site/@stop ?*", f"{BASE}/incoming", "a/b/c/incoming/drive-values"),
)
RAW = (f"{BASE}/incoming/+", f"{BASE}/incoming/#", "+/+/+/incoming/drive-values")  # of clients that are not ours
TAKEN = (
    *(f"{BASE}/outgoing/{metric}" for metric in ("online", "incoming/drive-values")),
    *(f"{BASE}/incoming/flags/{flag}" for flag in ("mqtt-video", "night", "reboot/now")),
    *("site/video", "will", f"a/{BASE}/incoming/drive-values"),
)
VICTIM = """
import json, sys, time; from pathlib import Path
from pebble.transports import Message, QoS, ZenohSettings, create
run_dir, *topics = json.loads(sys.argv[1])
clients = [
    create("zenoh", topic, ZenohSettings(run_dir=Path(run_dir), client=True), will=Message(topic, b'{"z":0.6}', QoS(1)))
    for topic in topics
]
print([client.open(10).state.name for client in clients], flush=True)
time.sleep(600)
"""


@pytest.fixture
def settings(tmp_path: Path) -> ZenohSettings:
    line = {"enabled": True, "serial": {"port": "/dev/ttyACM0"}, "topics": {"drive_values": "else/where"}}
    arm = {"serial": {"port": "/dev/ttyACM1"}, "topics": {"drive_values": "arm/drive", "lights_solid": "site/@stop ?*"}}
    services = {
        "serial_mcu_bridge": {**line, "instances": {"arm": arm}},
        "mqtt_bridge": {"topics": {"reboot": "site/reboot", "mqtt_video": "site/video"}},
    }
    transport = {"kind": "zenoh", "run_dir": str(tmp_path / "run"), "journal": str(tmp_path / "journal")}
    config = parse({"robot": {"id": "goob"}, "transport": transport, "services": services}, folder=tmp_path, env={})
    return hub_settings(config)


def die(settings: ZenohSettings, *topics: str) -> None:
    """Be killed as clients that have left a will on each of ``topics``."""
    arguments = [sys.executable, "-c", VICTIM, json.dumps([str(settings.run_dir), *topics])]
    victim = Child(arguments, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert victim.stdout is not None
    assert victim.stdout.readline().count("CONNECTED") == len(topics), "a hello succeeds, whatever the will"
    victim.kill()
    victim.wait(WAIT_S)
    victim.stdout.close()


def test_by_topic(settings: ZenohSettings) -> None:
    admission = Admission((*WILLS, *settings.wills))
    assert [topic for topic in (*REFUSED, *RAW, *TAKEN) if admission.takes(topic)] == list(TAKEN)
    assert [topic for topic in TAKEN if not Admission(WILLS).takes(topic)] == [], "as a hub without a config"


def test_those_of_clients_that_are_killed_and_of_a_journal(settings: ZenohSettings) -> None:
    """An earlier hub of another version may have stored one that is refused now."""
    assert settings.journal is not None
    settings.run_dir.mkdir(mode=0o700)
    journal = Journal(settings.journal)
    journal.load()
    wills = {
        "a": Will("arm/drive", b'{"z":0.6}', QoS.DELIVERED, False, "a"),
        "b": Will("status", b"gone", QoS.DELIVERED, True),
    }
    journal.rewrite((name, msgspec.msgpack.encode(StoredWill(name, will))) for name, will in wills.items())
    journal.close()
    hub = HubProcess(settings.run_dir)
    hub.settings = settings
    hub.start()
    received: list[str] = []
    with create("zenoh", "watcher", ZenohSettings(run_dir=settings.run_dir, client=True)) as watcher:
        watcher.subscribe("#", lambda message: received.append(message.topic))
        assert until(lambda: received)
        die(settings, *REFUSED[:4], *TAKEN[:4])
        assert until(lambda: len(received) > 4)
        die(settings, "the/last")
        assert until(lambda: received[-1] == "the/last")
    assert sorted(received) == sorted((*TAKEN[:4], "status", "the/last"))
    _, printed = hub.end()
    assert printed.count("refused the will of") == 5
    assert b"arm/drive" not in b"".join(Journal(settings.journal).load())


class Asked:
    """A query; ``dropped``: it is answered with nothing."""

    def __init__(self, key: str, size: int) -> None:
        self.key_expr, self.payload, self.dropped = key, bytes(size), False

    def drop(self) -> None:
        self.dropped = True


def test_a_query_follows_each_task_and_too_large_a_hello_is_not_answered() -> None:
    intake, done = Intake(), list[str]()
    for number in range(3):
        asked: Any = Asked("@retain/**", 1)
        intake.ask(lambda _query, number=number: done.append(f"query {number}"), asked)  # type: ignore[misc]
        intake.put(partial(done.append, f"task {number}"))
    large: Any = Asked("@hub/hello/vera", ASKED_BYTES + 1)
    intake.greet(lambda _query: done.append("hello"), large)
    assert large.dropped
    intake.end()
    while (task := intake.take(0)) is not None:
        task()
    assert done == ["task 0", "query 0", "task 1", "query 1", "task 2", "query 2"]


@pytest.mark.parametrize(("waits_s", "works"), [(3.0, True), (0.0, False)])
def test_a_query_that_no_one_waits_for_any_more_is_not_answered(
    monkeypatch: pytest.MonkeyPatch, waits_s: float, works: bool
) -> None:
    monkeypatch.setattr(wire, "RETAINED_ANSWER_S", waits_s)
    intake = Intake()
    worked: list[Any] = []
    asked: Any = Asked("@retain/**", 1)
    intake.ask(worked.append, asked)
    task = intake.take(0)
    assert task is not None
    task()
    assert (asked.dropped, worked == [asked]) == (not works, works)


def test_beyond_the_room_eight_senders_wait_and_what_others_send_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    intake, done = Intake(), list[int]()
    intake.receive(partial(done.append, 0), QUEUE_BYTES + 1)
    senders = [
        threading.Thread(target=intake.receive, args=(partial(done.append, number), 1), daemon=True)
        for number in range(1, SENDERS + 3)
    ]
    for sender in senders:
        sender.start()
    assert until(lambda: intake.dropped == 2)
    assert "the hub receives more than it can store" in caplog.text
    for _ in range(SENDERS + 1):
        task = intake.take(5)
        assert task is not None
        task()
    assert len(done) == SENDERS + 1
    assert done[0] == 0


def test_each_client_is_logged_once_and_a_flood_of_them_not_without_end(caplog: pytest.LogCaptureFixture) -> None:
    admission = Admission(WILLS)
    will = Will(f"{BASE}/incoming/drive-values", b"{}", QoS.DELIVERED, False)
    for number in range(1000):
        admission.admitted(StoredWill("session", msgspec.structs.replace(will, client=f"evil-{number // 2}")))
    assert (admission.refused, len(caplog.records)) == (1000, 100)
    assert "evil-0" in caplog.messages[0]
    assert caplog.messages[-1].endswith("those of further clients are only counted")
