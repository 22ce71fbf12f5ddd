"""Robots that setup made: their broker lets in whom it should; backups become robots again, or are refused."""

from __future__ import annotations

import errno
import io
import json
import os
import stat
import subprocess
import tarfile
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from pebble.config import load
from pebble.contract.identity import Identity
from pebble.extensions.checks.broker.login_attempt import attempt
from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.certificates import CA_CERT
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Account
from pebble.extensions.install.setup import backup as backups
from pebble.extensions.install.setup.backup import ABOUT, BackupError, Saved, make, packed, read, unpacked
from pebble.extensions.operator.places import Places, mosquitto_path
from pebble.runtime.connections import mqtt_settings
from pebble.transports import MqttSettings
from pebble.transports.settings import TlsSettings
from tests.commands.command_line import Run
from tests.ext.checks.installed import MQTT, PAGE, PEOPLE, ROBOT, installed
from tests.ext.fleet.brokers import HOST, FleetBroker
from tests.ext.install.setup.conftest import (
    BROKER_PASSWORD,
    PASSWORD,
    answers_in,
    at,
    machine_root,
    set_up,
    tar_of,
    tree,
)
from tests.support import Child, beside, free_port, listening, needs_root, refused, until

HEAD = (ABOUT, b'{"format": 1, "version": "0", "id": "a"}')
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


def test_a_name_that_was_changed_in_the_config_keeps_its_account(root: Path) -> None:
    set_up(root)
    config = Places(root).config
    config.write_text(config.read_text().replace('"id": "goob"', '"id": "fred"'))
    assert set_up(root) == ["accounts, rules and certificate of the robot's own broker"]
    accounts = json.loads((Places(root).broker_folder / "fleet.json").read_text())["accounts"]
    assert {name: account["bases"] for name, account in accounts.items() if "bases" in account} == {"goob": [FRED.base]}
    assert set_up(root) == []


# -- a broker elsewhere


@pytest.mark.parametrize("password", ["", "wrong-password"])
def test_a_broker_elsewhere_is_asked_whether_it_lets_the_robot_in(
    password: str, root: Path, tmp_path: Path, run: Run
) -> None:
    robot = {"goob": Account(roles=("robot",), bases=(GOOB.base,))}
    with FleetBroker(tmp_path / "hall", robot, unencrypted=free_port()) as broker:
        file, place = tmp_path / "password", f"{HOST}:{broker.unencrypted}"
        file.write_text(password or broker.passwords["goob"])
        answers = answers_in(tmp_path, broker=place, broker_user="goob", page=False, broker_password_file=str(file))
        run("setup", "--answers", answers)
        refused = f"Failed: the broker {place} does not let the robot in: not authorized"
        assert (refused in run.out.replace("\n  ", " ")) == bool(password)
        assert file.read_text() not in run.out + run.err
        assert settings_of(root).password == file.read_text()


def test_a_broker_on_another_machine_is_reached_encrypted_and_with_a_login(
    root: Path, tmp_path: Path, run: Run
) -> None:
    certificates.init(tmp_path / "hall", ["broker.invalid"])
    file, ca = tmp_path / "password", tmp_path / "hall" / CA_CERT
    file.write_text(BROKER_PASSWORD)
    far = {"broker": "broker.invalid", "broker_user": "goob", "broker_ca": str(ca), "broker_password_file": str(file)}
    run("setup", "--answers", answers_in(tmp_path, **far))
    assert "Failed: the broker broker.invalid does not let the robot in" in run.out
    config = load(Places(root).config)
    remote = config.services.mqtt_bridge.remote_mqtt
    assert config.security.level == "login"
    assert (remote.port, remote.username, remote.password, remote.tls.enabled) == (8883, "goob", BROKER_PASSWORD, True)
    assert (Places(root).etc / "broker-ca.pem").read_bytes() == ca.read_bytes()
    ca.unlink()
    assert set_up(root, camera="none") == ["config /etc/pebble/robot.json"], "the file that was named may be gone"


# -- backups


def test_a_backup_on_a_blank_machine_is_the_same_robot(
    root: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up(root)
    places = Places(root)
    places.config.write_text(places.config.read_text().replace("synthetic", "libcamera"))
    (places.state / "estop-serial-pebble+robots+goob.json").write_text('{"stopped": true}')
    wanted = tree(root)
    backup = tmp_path / "goob.tar"
    with monkeypatch.context() as share:  # on one that lacks this call
        share.setattr("os.fsync", refused(errno.EINVAL))
        assert run("setup", "--backup", backup) == 0
    other = machine_root(tmp_path / "other")
    at(other, monkeypatch)
    assert run("setup", "--from", backup) == 1, "systemd does not run there"
    assert "The files of goob are in their places." in run.out
    assert tree(other) == wanted
    assert settings_of(other).password == settings_of(root).password
    with closing(People(Places(other).people)) as people:
        assert people.check("ann", PASSWORD, "")
    before = tree(other)
    run("setup", "--from", backup)
    assert "All is so already." in run.out
    assert tree(other) == before


@pytest.mark.parametrize("name", ["etc/pebble/robot.json", "var/lib/pebble/estop-serial-pebble+robots+goob.json"])
def test_a_machine_with_other_files_takes_no_backup(
    name: str, root: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up(root)
    (Places(root).state / "estop-serial-pebble+robots+goob.json").write_text('{"stopped": true}')
    assert run("setup", "--backup", tmp_path / "goob.tar") == 0
    other = machine_root(tmp_path / "other")
    at(other, monkeypatch)
    (other / name).write_text("{}")
    before = tree(other)
    assert run("setup", "--from", tmp_path / "goob.tar") == 1
    assert f"{other / name} is there already, with other content" in run.err
    assert tree(other) == before


def changed(files: dict[str, Saved], more: dict[str, bytes], keys: dict[str, Any]) -> bytes:
    """Return a backup as an attacker may have it: with other files, and other keys of its config."""
    config = json.loads(files["etc/pebble/robot.json"].content)
    config["services"]["mqtt_bridge"] |= keys
    members = {name: saved.content for name, saved in files.items()} | more
    members["etc/pebble/robot.json"] = json.dumps(config).encode()
    return tar_of(HEAD, *members.items())


@pytest.mark.parametrize(
    ("keys", "shown"),
    [
        ({"git_pull_control": {"command": ["sh", "-c", "evil"]}}, "mqtt_bridge.git_pull_control.command: sh -c evil"),
        ({"remote_mqtt": {"password_file": "../shadow"}}, "remote_mqtt.password_file: ../shadow"),
        ({}, "/etc/pebble/autonomy/walk/run.py"),
    ],
)
def test_what_a_restored_config_runs_and_names_is_asked_for_first(
    keys: dict[str, Any], shown: str, root: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up(root)
    script = {"etc/pebble/autonomy/walk/run.py": b"evil"}
    (tmp_path / "evil.tar").write_bytes(changed(make(Places(root)).files, script if not keys else {}, keys))
    other = machine_root(tmp_path / "other")
    at(other, monkeypatch)
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    before = tree(other)
    assert run("setup", "--from", tmp_path / "evil.tar") == 130
    assert shown in run.out
    assert tree(other) == before


def test_a_restored_broker_lets_in_whom_its_table_names_and_has_no_other_listener(
    root: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_up(root)
    wanted, other = tree(root), machine_root(tmp_path / "other")
    folder, rules = "etc/mosquitto", b"user eve\ntopic readwrite #\n"
    evil = {"conf.d/a.conf": b"listener 1999", "conf.d/pebble.conf": b"allow_anonymous true", "mosquitto.conf": b"x"}
    evil |= {"pebble/acl": rules, "pebble/mosquitto.conf": b"x", "pebble/mosquitto.pid": b"1"}
    more = {f"{folder}/{name}": content for name, content in evil.items()}
    (tmp_path / "evil.tar").write_bytes(changed(make(Places(root)).files, more, {}))
    at(other, monkeypatch)
    run("setup", "--from", tmp_path / "evil.tar")
    there = tree(other)
    assert there.keys() == wanted.keys()
    assert [name for name in wanted if name.startswith(folder) and there[name][1] != wanted[name][1]] == []


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

    with beside(write, ending):
        saved = [make(Places(root)).files["var/lib/pebble/people.sqlite"].content for _ in range(10)]
    assert len(set(saved)) > 1, "it was written to meanwhile"
    make(Places(root))
    assert {path.stat().st_uid for path in file.parent.glob("people.sqlite*")} == {owner}
    (root / "saved.sqlite").write_bytes(saved[-1])
    with closing(People(root / "saved.sqlite")) as people:
        assert people.check("ann", PASSWORD, "")


@pytest.mark.parametrize(
    ("members", "why"),
    [
        ([HEAD, ("etc/pebble/robot.json", b""), ("etc/shadow", b"")], "is no file of a robot"),
        ([HEAD], "has no etc/pebble/robot.json"),
    ],
)
def test_what_is_no_backup_is_refused(
    members: list[tuple[str, bytes]], why: str, root: Path, tmp_path: Path, run: Run
) -> None:
    before = tree(root)
    backup = tmp_path / "a.tar"
    backup.write_bytes(tar_of(*members))
    assert run("setup", "--from", backup) == 1
    assert why in run.err
    assert tree(root) == before


# -- files of backups


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Places]:
    with installed(tmp_path_factory.mktemp("root")) as one:
        yield one


def test_all_files_but_recordings_are_in_it_as_they_are(places: Places, tmp_path: Path) -> None:
    """Config, passwords, keys, certificates, accounts at the broker, people, the stop, calibrations."""
    made = make(places)
    files = unpacked(packed(made), "goob.tar").files
    there = {str(path.relative_to(places.root)): path for path in places.root.rglob("*") if path.is_file()}
    left_out = {name for name in there if name.endswith((".mcap", "-wal", "-shm"))}
    assert made.left_out == {str(places.state / "recordings"): "recordings"}
    assert files.keys() == there.keys() - left_out
    database = tmp_path / "people.sqlite"
    database.write_bytes(files.pop(str(PEOPLE)).content)
    with closing(People(database)) as people:
        assert people.check("ann", PAGE, "10.0.0.1"), "though it is open, with changes in its journal"
    for name, saved in files.items():
        assert (saved.content, saved.mode) == (there[name].read_bytes(), stat.S_IMODE(there[name].stat().st_mode)), name


def test_one_that_is_too_large_is_given_up_before_the_machine_has_no_memory(
    places: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = list[Path]()
    monkeypatch.setattr(backups, "_MOST", 100)
    monkeypatch.setattr(backups, "read_plain", lambda file: read.append(file) or bytes(60))
    with pytest.raises(BackupError, match="would have more than"):
        make(places)
    assert len(read) == 2


def test_the_command(places: Places, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    at(places.root, monkeypatch)
    file = tmp_path / "goob.tar"
    before = os.umask(0)
    try:
        assert run("setup", "--backup", file) == 0
    finally:
        os.umask(before)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert not [one for one in (PAGE, MQTT, ROBOT) if one in run.out + run.err]
    assert read(file).about.id == "goob"
    first = file.read_bytes()
    assert run("setup", "--backup", file) == 2
    assert "exists: name another file" in run.err
    assert file.read_bytes() == first
    (link := tmp_path / "link.tar").symlink_to(tmp_path / "of-another")
    assert run("setup", "--backup", link) == 1
    assert not link.exists(), "what another put there leads nowhere"
    listed = subprocess.run(["tar", "tf", file], capture_output=True, text=True, check=True).stdout.splitlines()
    assert (listed[0], "etc/pebble/robot.json" in listed) == (ABOUT, True)


def test_nothing_is_left_of_one_that_cannot_be_made(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "goob.tar"
    with installed(tmp_path / "other") as broken:
        pass  # its database is closed
    (broken.root / PEOPLE).write_bytes(b"SQLite format 3\0" + bytes(4000))
    at(broken.root, monkeypatch)
    assert run("setup", "--backup", file) == 1
    assert "people.sqlite: is" in run.err
    at(tmp_path / "elsewhere", monkeypatch)
    assert run("setup", "--backup", file) == 1
    assert "no robot is installed there" in run.err
    assert not file.exists()


FOREIGN: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "is no backup of Pebble"),
    "a picture": (b"\xff\xd8\xff" * 5000, "is no backup of Pebble"),
    "another tar": (tar_of(("etc/passwd", b"x")), "does not begin with backup.json"),
    "no id": (tar_of((ABOUT, b'{"format": 1, "version": "0.1"}')), "is not of a backup"),
    "a later format": (tar_of((ABOUT, b'{"format": 2, "version": "0.9", "id": "x"}')), "of Pebble 0.9: update Pebble"),
    "absolute": (tar_of(HEAD, ("/etc/shadow", b"x")), "'/etc/shadow' is not what a backup has"),
    "beyond the root": (tar_of(HEAD, ("etc/../../x", b"x")), "is not what a backup has"),
    "a link": (tar_of(HEAD, ("etc/x", b""), kind=tarfile.SYMTYPE), "is not what a backup has"),
    "a hole": (tar_of(HEAD, ("etc/x", b""), kind=tarfile.GNUTYPE_SPARSE), "is not what a backup has"),
    "a device": (tar_of(HEAD, ("etc/x", b""), kind=tarfile.CHRTYPE), "is not what a backup has"),
    "a long name": (tar_of(HEAD, (f"etc/{'x' * 256}", b"x")), "is not what a backup has"),
    "a broken name": (tar_of(HEAD, ("etc/./x", b"x")), "is not what a backup has"),
    "twice": (tar_of(HEAD, ("etc/x", b"1"), ("etc/x", b"2")), "is in it twice"),
}


@pytest.mark.parametrize("what", FOREIGN)
def test_what_is_no_backup_is_refused_in_one_line(what: str) -> None:
    raw, why = FOREIGN[what]
    with pytest.raises(BackupError, match=r"\Ax\.tar: [^\n]+\Z") as refused:
        unpacked(raw, "x.tar")
    assert why in str(refused.value)


def test_a_torn_or_damaged_one_is_never_taken_for_whole(places: Places) -> None:
    """Cut at any block, or with a byte changed in any header or file."""
    whole = packed(make(places))
    wanted = unpacked(whole, "x.tar").files
    end = len(whole.rstrip(b"\0"))
    for cut in range(0, end + 512, 509):
        with pytest.raises(BackupError):
            unpacked(whole[:cut], "x.tar")
    for place in range(600, end, 401):
        damaged = whole[:place] + bytes([whole[place] ^ 0x5A]) + whole[place + 1 :]
        with suppress(BackupError):  # a header has fields that mean nothing here
            assert unpacked(damaged, "x.tar").files == wanted, place
