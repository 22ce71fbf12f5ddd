"""What setup makes works: its broker lets in whom it should, names change, backups become robots again."""

from __future__ import annotations

import json
import os
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from pebble.checks.broker.login_attempt import attempt
from pebble.commands.web import people as web_people
from pebble.config import load
from pebble.contract.identity import Identity
from pebble.fleet import certificates
from pebble.fleet.certificates import CA_CERT
from pebble.fleet.people import People
from pebble.fleet.roles import Account, Role
from pebble.rig.processes import mosquitto_path
from pebble.runtime.connections import mqtt_settings
from pebble.setup import retained
from pebble.setup.backup import make
from pebble.setup.places import Places
from pebble.transports import MqttSettings, QoS
from pebble.transports.mqtt.transport import MqttTransport
from pebble.transports.settings import TlsSettings
from tests.commands.command_line import Run
from tests.fleet.brokers import HOST, FleetBroker
from tests.setup.rig import ANSWERS, BROKER_PASSWORD, PASSWORD, backup_of, machine_root, set_up, tar_of, tree
from tests.support import Broker, Child, free_port, listening, needs_root, until

HEAD = ("backup.json", b'{"format": 1, "version": "0", "id": "a"}')
GOOB, FRED = Identity("pebble", "robots", "goob"), Identity("pebble", "robots", "fred")


def settings_of(root: Path) -> MqttSettings:
    return mqtt_settings(load(Places(root).config).services.mqtt_bridge.remote_mqtt, reconnect_max_s=1)


# -- the robot's own broker


@contextmanager
def mosquitto(root: Path) -> Iterator[tuple[int, int]]:
    """A real one with the configuration that setup wrote, at other ports; yields those."""
    plain, encrypted = free_port(), free_port()
    text = Places(root).broker.read_text().replace("/etc/", f"{root}/etc/")
    text = text.replace("listener 1883 ", f"listener {plain} ").replace("listener 8883", f"listener {encrypted} {HOST}")
    (root / "mosquitto-of-test.conf").write_text(f"{text}user root\n")
    with Child([str(mosquitto_path()), "-c", str(root / "mosquitto-of-test.conf")]) as process:
        assert until(lambda: listening(plain) and listening(encrypted))
        yield plain, encrypted
        process.terminate()


def test_its_own_broker_lets_in_the_robot_and_its_page_and_no_stranger(root: Path) -> None:
    set_up(root)
    places = Places(root)
    logins = {
        name: (places.etc / f"{file}.password").read_text().strip()
        for name, file in (("goob", "broker"), ("page", "page"))
    }
    tls = TlsSettings(ca_cert=places.broker_folder / CA_CERT)

    def code(port: int, tls: TlsSettings | None, user: str | None = None, password: str | None = None) -> int | None:
        settings = MqttSettings(host=HOST, port=port, username=user, password=password, tls=tls)
        return attempt(settings, login=user is not None).code

    with mosquitto(root) as (plain, encrypted):
        found = [
            code(port, with_tls, name, one)
            for name, one in logins.items()
            for port, with_tls in ((plain, None), (encrypted, tls))
        ]
        assert found == [0] * 4
        assert [code(plain, None), code(encrypted, tls), code(plain, None, "goob", "wrong")] == [5, 5, 5]
        assert code(encrypted, None, "goob", logins["goob"]) is None, "beyond this machine it is encrypted"


def test_another_name_gets_the_account_and_the_stop_and_the_earlier_one_loses_them(root: Path) -> None:
    set_up(root)
    stop = Places(root).state / "estop-serial-pebble+robots+goob.json"
    stop.write_text('{"stopped": true}')
    password = settings_of(root).password
    found = {result.step.what: str(result.state) for result in set_up(root, id="fred")}
    assert found["what goob saved, its stop too, is fred's"] == "new"
    assert not stop.exists()
    assert stop.with_name("estop-serial-pebble+robots+fred.json").read_text() == '{"stopped": true}'
    accounts = json.loads((Places(root).broker_folder / "fleet.json").read_text())["accounts"]
    assert accounts.keys() == {"admin", "fred", "page"}
    assert (settings_of(root).username, settings_of(root).password) == ("fred", password)


def test_a_config_that_was_changed_by_hand_keeps_its_name_until_it_is_changed_there(root: Path) -> None:
    set_up(root)
    config = Places(root).config
    config.write_text(config.read_text().replace("synthetic", "libcamera"))
    found = {result.step.what: result.why for result in set_up(root, id="fred")}
    assert "set robot.id there" in found["what goob saved, its stop too, is fred's"]
    accounts = json.loads((Places(root).broker_folder / "fleet.json").read_text())["accounts"]
    assert accounts.keys() == {"admin", "goob", "fred", "page"}, "the robot logs in still"


# -- a broker elsewhere


@contextmanager
def retaining(broker: Broker, topics: list[str]) -> Iterator[MqttTransport]:
    """A client that leaves something retained at each of the topics."""
    client = MqttTransport("test", MqttSettings(host=HOST, port=broker.port))
    with closing(client):
        client.open(5)
        for topic in topics:
            assert client.publish(topic, b'{"value": 1}', qos=QoS.DELIVERED, retain=True)
        yield client


def left(client: MqttTransport) -> list[str]:
    found: list[str] = []
    client.subscribe("#", lambda message: found.append(message.topic) if message.retain and message.payload else None)
    end = time.monotonic() + 0.5
    until(lambda: time.monotonic() > end)
    return sorted(found)


def test_another_name_leaves_nothing_retained_under_the_earlier_one(tmp_path: Path, root: Path) -> None:
    broker = Broker(tmp_path)
    own = [GOOB.outgoing(name) for name in ("capabilities", "status", "estop/serial", "mcu/u1/describe")]
    own.append(GOOB.incoming("flags/mqtt-video"))
    others = [GOOB.outgoing("of-another-program"), FRED.outgoing("status"), "pebble/robots/goober/outgoing/status"]
    try:
        with retaining(broker, own + others):
            set_up(root, broker=f"{HOST}:{broker.port}")
            set_up(root, id="fred")
        fresh = MqttTransport("fresh", MqttSettings(host=HOST, port=broker.port))
        with closing(fresh):
            fresh.open(5)
            assert left(fresh) == sorted(others)
    finally:
        broker.stop()


def test_what_is_removed_is_a_list_of_the_robots_own_topics(root: Path) -> None:
    set_up(root)
    topics = list(retained.topics(load(Places(root).config)))
    assert GOOB.outgoing("capabilities") in topics
    assert [topic for topic in topics if "#" in topic or not topic.startswith(f"{GOOB.base}/")] == []


@pytest.mark.parametrize(
    ("user", "password", "code", "shown"),
    [
        ("goob", None, 0, "lets the robot in"),
        ("goob", "wrong-password", 1, "it does not: not authorised"),
        ("eve", None, 1, "it does not: not authorised"),
    ],
    ids=("right", "wrong password", "no account"),
)
def test_a_broker_elsewhere_is_asked_whether_it_lets_the_robot_in(
    user: str, password: str | None, code: int, shown: str, root: Path, tmp_path: Path, run: Run
) -> None:
    robot = {"goob": Account(roles=("robot",), bases=(GOOB.base,))}
    with FleetBroker(tmp_path / "hall", robot, unencrypted=free_port()) as broker:
        file, answers = tmp_path / "password", tmp_path / "answers.json"
        file.write_text(password or broker.passwords["goob"])
        given = ANSWERS | {"broker": f"{HOST}:{broker.unencrypted}", "broker_user": user, "page": False}
        answers.write_text(json.dumps(given | {"broker_password_file": str(file)}))
        assert run("setup", "--root", root, "--answers", answers, "--yes") == code
        assert shown in run.out
        assert file.read_text() not in run.out + run.err
        assert settings_of(root).password == file.read_text()


def test_a_broker_on_another_machine_is_reached_encrypted_and_with_a_login(root: Path, tmp_path: Path) -> None:
    certificates.init(tmp_path / "hall", ["broker.invalid"])
    far = {"broker": "broker.invalid", "broker_user": "goob", "broker_ca": str(tmp_path / "hall" / CA_CERT)}
    found = {result.step.what: result for result in set_up(root, **far)}
    refused = found["broker broker.invalid:8883 lets the robot in"]
    assert (str(refused.state), refused.why.startswith("it does not: ")) == ("cannot", True)
    config = load(Places(root).config)
    remote = config.services.mqtt_bridge.remote_mqtt
    assert config.security.level == "login"
    assert (remote.port, remote.username, remote.password, remote.tls.enabled) == (8883, "goob", BROKER_PASSWORD, True)
    (tmp_path / "hall" / CA_CERT).unlink()
    again = {result.step.what: str(result.state) for result in set_up(root)}
    assert again["authority of the broker"] == "same", "the file that was named may be gone"


# -- backups


def test_a_backup_on_a_blank_machine_is_the_same_robot(root: Path, tmp_path: Path, run: Run) -> None:
    set_up(root)
    places = Places(root)
    places.config.write_text(places.config.read_text().replace("synthetic", "libcamera"))
    (places.state / "estop-serial-pebble+robots+goob.json").write_text('{"stopped": true}')
    other = machine_root(tmp_path / "other")
    before = tree(root)
    backup = backup_of(root, tmp_path / "goob.tar")
    assert run("setup", "--root", other, "--from", backup, "--dry-run") == 0
    assert not Places(other).etc.exists()
    assert run("setup", "--root", other, "--from", backup, "--yes") == 0
    assert tree(other) == before
    assert settings_of(other).password == settings_of(root).password
    with closing(People(Places(other).people)) as people:
        assert people.check("ann", PASSWORD, "")
    assert run("setup", "--root", other, "--from", backup, "--yes") == 1
    assert "this machine is set up as goob" in run.err


@needs_root
def test_a_backup_by_root_of_a_database_that_is_written_to_is_whole_and_leaves_it_to_its_owner(root: Path) -> None:
    """SQLite makes files beside a database, and gives them to the owner of that, where it may."""
    set_up(root)
    file, owner = Places(root).people, 65534
    os.chown(file, owner, owner)
    ending = threading.Event()

    def write() -> None:
        with closing(People(file)) as people:
            (ann,) = people.list()
            while not ending.is_set():
                people.start_session(ann)

    page = threading.Thread(target=write)
    page.start()
    try:
        saved = [make(Places(root)).files["var/lib/pebble/people.sqlite"].content for _ in range(10)]
    finally:
        ending.set()
        page.join()
    assert len(set(saved)) > 1, "it was written to meanwhile"
    make(Places(root))
    assert {path.stat().st_uid for path in file.parent.glob("people.sqlite*")} == {owner}
    (root / "saved.sqlite").write_bytes(saved[-1])
    with closing(People(root / "saved.sqlite")) as people:
        assert people.check("ann", PASSWORD, "")


def test_a_second_robot_has_a_name_passwords_and_certificates_of_its_own(root: Path, tmp_path: Path, run: Run) -> None:
    set_up(root)
    places, other = Places(root), machine_root(tmp_path / "other")
    (places.state / "estop-serial-pebble+robots+goob.json").write_text('{"stopped": true}')
    (places.state / "camera_calibration.yaml").write_text("f: 1")
    with closing(People(places.people)) as people:
        people.start_session(people.list()[0])
    backup = backup_of(root, tmp_path / "goob.tar")
    assert run("setup", "--root", other, "--from", backup, "--as", "fred", "--yes") == 0
    second = Places(other)
    assert load(second.config).base == FRED.base
    assert (settings_of(other).username, settings_of(root).username) == ("fred", "goob")
    same = {
        path for path, (_, content) in tree(other).items() if content and tree(root).get(path, ("", b""))[1] == content
    }
    keys = ("broker.password", "page.password", "tls/ca.key", "tls/server.key", "tls/ca.pem")
    assert [name for name in keys if (second.etc / name).read_bytes() == (places.etc / name).read_bytes()] == []
    assert "var/lib/pebble/camera_calibration.yaml" in same
    assert not list(second.state.glob("estop-*"))
    with closing(sqlite3.connect(second.people)) as database:
        assert database.execute("SELECT count(*) FROM sessions").fetchone() == (0,)
    with closing(People(second.people)) as people:
        assert [user.name for user in people.list()] == ["ann"]


@pytest.mark.parametrize(
    ("members", "why"),
    [
        ([("etc/pebble/robot.json", b"")], "is no backup of Pebble"),
        ([("backup.json", b"{}")], "Object missing required field"),
        ([("backup.json", b'{"format": 2, "version": "9", "id": "a"}')], "has format 2"),
        ([HEAD, ("etc/shadow", b"")], "is no file of a robot"),
        ([HEAD, ("etc/pebble/../shadow", b"")], "is not what a backup has"),
        ([HEAD, ("/etc/pebble/a", b"")], "is not what a backup has"),
        ([HEAD], "the backup has no answers"),
    ],
)
def test_what_is_no_backup_is_refused(
    members: list[tuple[str, bytes]], why: str, root: Path, tmp_path: Path, run: Run
) -> None:
    before = tree(root)
    assert run("setup", "--root", root, "--from", tar_of(tmp_path / "a.tar", members), "--yes") == 1
    assert why in run.err
    assert tree(root) == before


# -- people


def test_a_user_without_a_config_is_added_where_the_robots_page_reads(
    root: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up(root)
    monkeypatch.setattr(web_people, "PLACES", Places(root))
    assert run("web", "user", "list") == 0
    assert run.out.split() == ["ann", Role.ADMIN]
