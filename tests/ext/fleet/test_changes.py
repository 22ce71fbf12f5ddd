"""Accounts that change, at a mosquitto that runs and in files, what a check finds, and certificates."""

from __future__ import annotations

import datetime
import errno
import json
import os
import re
import shutil
import signal
import socket
import ssl
import stat
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from getpass import getuser
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.hashes import SHA256
from msgspec.structs import replace

from pebble.extensions.fleet import applying, authority, broker_files
from pebble.extensions.fleet.certificates import CertificateError, init, renew, show
from pebble.extensions.fleet.folder import ACL, CONF, FLEET, PASSWORDS, ZENOH, Extra, FleetError, load, locked, refused
from pebble.extensions.fleet.hub_access import read_access
from pebble.extensions.fleet.roles import Account
from tests.commands.command_line import Run
from tests.ext.fleet.brokers import BrokerClient, FleetBroker, RefusedError
from tests.support import ROOT, quickly, until

DRIVER, VIEWER = Account(roles=("driver",)), Account(roles=("viewer",))
GOOB = Account(roles=("robot",), bases=("pebble/robots/goob",))
DATA = ROOT / "tests" / "data" / "plugin_fleet"
PLUGIN = next(Path("/usr/lib").glob("*/mosquitto_dynamic_security.so"), None)
DRIVE, STOP = "pebble/robots/goob/incoming/drive-values", "pebble/robots/goob/incoming/estop"


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[FleetBroker]:
    with FleetBroker(tmp_path / "hall", {"otto": DRIVER, "goob": GOOB}) as broker:
        yield broker


def passes(broker: FleetBroker, client: BrokerClient, topic: str) -> bool:
    """Whether the robot gets what this client sends."""
    with broker.login("goob") as robot:
        robot.subscribe(["pebble/robots/goob/#"])
        client.publish(topic, b"tried")
        client.flush()
        robot.publish("pebble/robots/goob/outgoing/end", b"end")
        robot.wait(lambda: any(payload == b"end" for _, payload in robot.received), "deliver")
        return (topic, b"tried") in robot.received


def test_a_change_counts_at_once_and_costs_no_other_connection(broker: FleetBroker) -> None:
    with broker.login("goob") as robot, broker.login("otto") as otto:
        with quickly():
            assert broker.add("zoe", DRIVER) == "at once"
            assert broker.change(broker.fleet.with_account("zoe", VIEWER)) == "at once"
            assert broker.remove("zoe") == "at once"
        for one in (robot, otto):
            one.listen(0.05)
            one.publish("pebble/robots/goob/outgoing/end", b"")
            one.flush()
            assert not one.closed


def test_a_role_counts_for_connections_that_are_there(broker: FleetBroker) -> None:
    broker.add("zoe", DRIVER)
    assert until(lambda: _gets_in(broker, "zoe"))
    with broker.login("zoe") as zoe:
        assert passes(broker, zoe, DRIVE)
        broker.change(broker.fleet.with_account("zoe", VIEWER))
        with quickly():
            assert until(lambda: not passes(broker, zoe, DRIVE))
        assert passes(broker, zoe, STOP)
        broker.change(broker.fleet.with_account("zoe", DRIVER))
        assert until(lambda: passes(broker, zoe, DRIVE))


@pytest.mark.parametrize("how", ["remove", "password"])
def test_who_is_removed_or_gets_another_password_is_disconnected(broker: FleetBroker, how: str) -> None:
    change = {"remove": lambda broker: broker.remove("otto"), "password": lambda broker: broker.renew("otto")}
    with broker.login("otto") as otto:
        old = broker.passwords["otto"]
        change[how](broker)
        with quickly():
            assert until(lambda: otto.listen(0.05) or otto.closed)
    with pytest.raises(RefusedError):
        BrokerClient(broker.place, "otto", old)
    assert _gets_in(broker, "otto") == (how == "password")


def _gets_in(broker: FleetBroker, name: str) -> bool:
    try:
        broker.login(name).__exit__()
    except RefusedError:
        return False
    return True


def test_who_takes_all_connections_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broker_files, "MAX_CONNECTIONS", 10)
    with FleetBroker(tmp_path / "hall", {"otto": DRIVER, "zoe": DRIVER}) as broker, ExitStack() as all_of_them:
        clients = [all_of_them.enter_context(broker.login("otto")) for _ in range(10)]
        assert broker.remove("otto") == "at once"
        assert until(lambda: all(client.listen(0.01) or client.closed for client in clients))
        assert _gets_in(broker, "zoe")


def test_a_change_while_mosquitto_is_down_counts_when_it_runs(broker: FleetBroker) -> None:
    broker.stop()
    assert "mosquitto does not run" in broker.add("zoe", DRIVER)
    broker.remove("otto")
    broker.start()
    assert applying.of_rules(broker.folder, broker.fleet) == []
    assert [_gets_in(broker, name) for name in ("zoe", "otto", "goob")] == [True, False, True]


def test_hubs_keep_out_who_is_removed_whatever_the_broker_does(
    broker: FleetBroker, monkeypatch: pytest.MonkeyPatch
) -> None:
    broker.change(replace(broker.fleet, hubs="here"))

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(signal, "pidfd_send_signal", refuse)
    with pytest.raises(FleetError, match="Operation not permitted; send it SIGHUP"):
        broker.remove("otto")
    assert set(read_access(broker.folder / ZENOH).accounts) == {"goob"}


def test_a_password_survives_a_change_of_level(broker: FleetBroker) -> None:
    broker.change(replace(broker.fleet, level="named"))
    with broker.login("otto") as otto:
        named = until(lambda: passes(broker, otto, "pebble/robots/goob/incoming/by/otto/drive-values"))
        assert (named, passes(broker, otto, DRIVE), passes(broker, otto, STOP)) == (True, False, True)
    broker.change(replace(broker.fleet, plain=True))
    with broker.login("otto") as otto:
        assert until(lambda: passes(broker, otto, DRIVE))


# -- what a check finds


def test_it_finds_changes_of_the_table(tmp_path: Path) -> None:
    broker = FleetBroker(tmp_path / "hall", {"otto": DRIVER, "goob": GOOB})
    assert applying.of_rules(broker.folder, broker.fleet) == []
    fleet = replace(broker.fleet, extra=Extra(look=("arm/+",)))
    found = applying.of_rules(broker.folder, fleet.without("goob").with_account("new", VIEWER))
    assert "one rule too few: otto: write +/+/+/incoming/arm/+" in found
    assert "goob: an account too many: the broker lets it in" in found
    assert "new: has no password: `pebble fleet password new`" in found


@pytest.mark.parametrize(
    ("file", "old", "new", "found"),
    [
        (CONF, "allow_anonymous false", "allow_anonymous true", "has a line of its own: allow_anonymous true"),
        (CONF, "max_connections", "listener 1883\nmax_connections", "has a line of its own: listener 1883"),
        (ACL, "user otto\n", "topic readwrite #\nuser otto\n", "one rule too many: everybody: readwrite #"),
        (ACL, "topic write +/+/+/incoming/audio\n", "", "one rule too few: otto: write +/+/+/incoming/audio"),
        (PASSWORDS, "goob:", "bob:", "goob: has no password"),
    ],
)
def test_it_finds_changes_of_files(tmp_path: Path, file: str, old: str, new: str, found: str) -> None:
    broker = FleetBroker(tmp_path / "hall", {"otto": DRIVER, "goob": GOOB})
    changed = (broker.folder / file).read_text().replace(old, new)
    (broker.folder / file).write_text(changed)
    by_hand, rules = applying.by_hand(broker.folder, broker.fleet), applying.of_rules(broker.folder, broker.fleet)
    assert any(found in line for line in (*by_hand, *rules))
    assert bool(by_hand) == (file == CONF), "`pebble fleet apply` is advised for what it mends"
    assert all(line.endswith("then restart mosquitto") for line in by_hand)


@pytest.mark.parametrize("file", [CONF, ACL, PASSWORDS])
def test_a_file_that_is_no_text_is_named(tmp_path: Path, file: str) -> None:
    broker = FleetBroker(tmp_path / "hall", {"otto": DRIVER, "goob": GOOB})
    for damage in (lambda path: path.write_bytes(b"\xff"), lambda path: (path.unlink(), os.mkfifo(path))):
        damage(broker.folder / file)
        with pytest.raises(FleetError, match=f"{file}:? is n"):
            (applying.apply if file == CONF else applying.of_rules)(broker.folder, broker.fleet)


# -- a fleet of the last version


def test_a_fleet_of_the_plugin_becomes_one_of_files(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the last version made it, and the plugin has it: vera is disabled, mia without rights, ghost in no table."""
    broker = FleetBroker(tmp_path / "hall", {})
    monkeypatch.chdir(tmp_path)

    def fleet(*words: str) -> int:
        return run("fleet", *words, "--folder", "hall")

    with_plugin = (
        (DATA / CONF).read_text().format(folder=broker.folder, port=broker.port, user=getuser(), plugin=PLUGIN)
    )
    (broker.folder / CONF).write_text(with_plugin)
    for name in (FLEET, "dynamic-security.json"):
        (broker.folder / name).write_text((DATA / name).read_text().replace("18883", str(broker.port)))
    (broker.folder / ACL).unlink()
    (broker.folder / PASSWORDS).unlink()
    broker.passwords = {"otto": "ne64-pksd-a7vu-j2p8", "goob": "bbe2-qvse-j4bs-2ch3", "ghost": "boo"}
    broker.passwords |= {"vera": "4cvf-pjhv-bg6v-tjyb", "mia": "4kds-nsmp-zbbu-wha4", "admin": "3aht-huvw-xgnj-exxp"}
    with broker:
        before = [name for name in broker.passwords if _gets_in(broker, name)]
        assert fleet("remove", "otto") == 1
        assert "`pebble fleet apply --folder hall` makes it files" in run.err
        assert fleet("apply") == 1  # until the lines are changed
        lines = re.findall(r"(?:has a line of its own|is without the line): (.*): (remove|add) it", run.err)
        named = [name for name in ("ghost", "vera", "mia") if f"pebble: {name}: " in run.err]
        assert fleet("remove", "otto") == 1
        assert "mosquitto still obeys its dynamic-security plugin" in run.err
    gone = [line for line, what in lines if what == "remove"]
    wanted = [line for line in with_plugin.splitlines() if line not in gone]
    (broker.folder / CONF).write_text("\n".join(wanted + [line for line, what in lines if what == "add"]))
    with broker:
        after = [name for name in broker.passwords if _gets_in(broker, name)]
        with broker.login("otto") as otto:
            by_otto = "pebble/robots/goob/incoming/by/otto/drive-values"
            assert [passes(broker, otto, topic) for topic in (by_otto, DRIVE, STOP)] == [True, False, True]
            assert fleet("apply") == 0
            fleet("check")
            assert run.err.count("pebble: ") == 3  # vera and mia have no password
            assert fleet("remove", "otto") == 0
            assert until(lambda: otto.listen(0.05) or otto.closed)
    assert before == ["otto", "goob", "ghost", "mia", "admin"]
    assert after == ["otto", "goob", "admin"]
    assert named == ["ghost", "vera", "mia"]


# -- names, folders


@pytest.mark.parametrize(
    ("name", "account", "why"),
    [
        ("Ann", DRIVER, "is no name"),
        ("otto", DRIVER, "exists already, as driver"),
        ("x", Account(roles=()), "is no role"),
        (
            "x",
            Account(roles=("boss",)),
            "'boss' is no role: use viewer, driver, maintainer, safety, admin, or for programs page",
        ),
        ("x", Account(roles=("robot", "driver"), bases=("a/b/c",)), "robot goes with no other role"),
        ("x", Account(roles=("page", "driver")), "page goes with no other role"),
        ("x", Account(roles=("robot",)), "has one base"),
        ("x", Account(roles=("driver",), bases=("a/b/c",)), "no other account has any"),
        ("x", Account(roles=("driver",), plain=True), "only a robot can be plain"),
        ("x", Account(roles=("robot",), bases=("pebble/robots/goob",)), "belongs to goob"),
        ("x", Account(roles=("robot",), bases=("pebble/+/goob",)), "is no base"),
        ("x", Account(roles=("robot",), bases=("goob",)), "is no base"),
        ("x", Account(roles=("robot",), bases=("pebble/servers/x",)), "servers are no robots"),
        ("x", Account(roles=("gateway",), bases=("pebble/robots",)), "is no base"),
        ("x", Account(roles=("neighbour",), bases=("pebble/robots/goob",)), "belongs to goob-lan"),
        ("x", Account(roles=("neighbour",), bases=("pebble/robots/fred",)), ""),
        ("x", Account(roles=("driver", "safety")), ""),
        ("x", Account(roles=("gateway",), bases=("pebble/robots/+",)), ""),
        ("x", Account(roles=("boards",), bases=("pebble/robots/minilamp", "pebble/robots/benjr")), ""),
        ("x_-1", Account(roles=("robot",), bases=("pebble/lamps/x",), plain=True), ""),
    ],
    ids=str,
)
def test_who_may_be_added(tmp_path: Path, name: str, account: Account, why: str) -> None:
    lan = Account(roles=("neighbour",), bases=GOOB.bases)
    broker = FleetBroker(tmp_path / "hall", {"otto": DRIVER, "goob": GOOB, "goob-lan": lan})
    assert why in refused(broker.fleet, name, account)
    assert bool(why) == bool(refused(broker.fleet, name, account))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"level": "open"}, "Invalid enum value 'open'"),
        ({"brokers": []}, "brokers"),
        ({"brokers": [{"host": "hall\nuser root"}]}, "brokers: a host holds U+000A"),
        ({"accounts": {"Ann": {"roles": ["driver"]}}}, "accounts.Ann: 'Ann' is no name"),
        ({"extra": {"drive": ["#"]}}, "'#' is no metric"),
        ({"extra": {"drive": ["by/otto/x"]}}, "is no metric"),
        ({"extra": {"look": ["+/ann/drive-values"]}}, "'+/ann/drive-values' covers drive-values as well"),
        ({"extra": {"drive": ["flags/+"]}}, "'flags/+' covers flags/remote-mirror as well"),
        ({"accounts": {"ann": {"roles": ["robot"], "bases": ["pebble/robots/%u"]}}}, "has a blank or %"),
    ],
    ids=str,
)
def test_a_mistake_in_the_file_is_named(tmp_path: Path, change: dict[str, Any], why: str) -> None:
    broker = FleetBroker(tmp_path / "hall", {})
    file = broker.folder / FLEET
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(FleetError, match=r"fleet\.json") as error:
        load(broker.folder)
    assert why in str(error.value)


def test_no_secret_is_in_the_fleet_and_no_other_user_reads_one(tmp_path: Path) -> None:
    broker = FleetBroker(tmp_path / "hall", {"otto": DRIVER})
    text = (broker.folder / FLEET).read_text()
    assert not any(password in text for password in broker.passwords.values())
    assert broker.folder.stat().st_mode & 0o077 == 0


def test_commands_change_a_folder_one_after_the_other(tmp_path: Path) -> None:
    broker = FleetBroker(tmp_path / "hall", {})
    child = os.fork()
    if child == 0:  # pragma: no cover
        for number in range(10):
            with locked(broker.folder):
                broker.add(f"a{number}", DRIVER)
        os._exit(0)
    for number in range(10):
        with locked(broker.folder):
            broker.add(f"b{number}", DRIVER)
    assert os.waitpid(child, 0)[1] == 0
    assert len(broker.fleet.accounts) == 20
    assert applying.of_rules(broker.folder, broker.fleet) == []


def test_a_command_that_waits_for_another_one_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def change() -> None:
        with locked(tmp_path):
            pass

    other = threading.Thread(target=change)
    with locked(tmp_path):
        other.start()
        assert until(lambda: f"another command changes {tmp_path}, and is waited for" in caplog.text)
        assert {record.levelname for record in caplog.records} == {"ERROR"}, "commands show only errors"
    other.join()


# -- certificates


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    init(tmp_path / "tls", ["Lab.local", "192.168.1.20", "127.0.0.1", "::1", "pebble.example.org"])
    return tmp_path / "tls"


def handshake(folder: Path, name: str) -> str:
    """A TLS handshake as a browser does it; "" or why it failed."""
    server = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    server.load_cert_chain(folder / "server.pem", folder / "server.key")
    client = ssl.create_default_context(cafile=folder / "ca.pem")
    client.verify_flags |= ssl.VERIFY_X509_STRICT
    ours, theirs = socket.socketpair()

    def serve() -> None:
        try:
            server.wrap_socket(theirs, server_side=True).close()
        except OSError:
            theirs.close()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        client.wrap_socket(ours, server_hostname=name).close()
    except ssl.SSLCertVerificationError as error:
        return error.verify_message
    finally:
        ours.close()
        thread.join()
    return ""


@pytest.mark.parametrize("name", ["lab.local", "192.168.1.20", "::1", "pebble.example.org"])
def test_clients_that_trust_the_authority_accept_each_name_and_one_is_enough(
    folder: Path, tmp_path: Path, name: str
) -> None:
    assert handshake(folder, name) == ""
    init(tmp_path, [name])
    assert handshake(tmp_path, name) == ""


def test_keys_are_for_their_owner_and_certificates_for_all(folder: Path) -> None:
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}
    assert modes == {"ca.pem": 0o644, "ca.key": 0o600, "server.pem": 0o644, "server.key": 0o600}


def test_nothing_is_overwritten(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(CertificateError, match=r"ca\.pem exists: `pebble cert renew --folder"):
        init(folder, ["lab.local"])
    (folder / "ca.pem").unlink()
    with pytest.raises(CertificateError, match=r"ca\.key exists"):
        init(folder, ["lab.local"])
    assert all(path.read_bytes() == content for path, content in before.items() if path.name != "ca.pem")


def test_what_is_shown(folder: Path) -> None:
    server = show(folder / "server.pem")
    assert server.names == ("lab.local", "192.168.1.20", "127.0.0.1", "::1", "pebble.example.org")
    left = server.until - datetime.datetime.now(datetime.UTC)
    assert datetime.timedelta(days=396) < left < datetime.timedelta(days=397)
    authority = show(folder / "ca.pem")
    assert authority.until > server.until + datetime.timedelta(days=3000)
    content = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
    assert authority.sha256.replace(":", "").lower() == content.fingerprint(SHA256()).hex()


def test_renewal_has_a_new_key_the_same_names_and_the_same_authority(folder: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    renew(folder)
    after = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {name for name in before if before[name] != after[name]} == {"server.pem", "server.key"}
    assert show(folder / "server.pem").names[0] == "lab.local"
    assert handshake(folder, "lab.local") == ""


@pytest.mark.parametrize("name", ["bank.example.com", "8.8.8.8", "2001:db8::1", "notlocal"])
def test_an_authority_does_not_sign_for_foreign_names(folder: Path, name: str) -> None:
    before = (folder / "server.pem").read_bytes()
    with pytest.raises(CertificateError, match=f"may not sign for {name}, only for"):
        renew(folder, [name])
    assert (folder / "server.pem").read_bytes() == before


def test_clients_refuse_what_a_stolen_authority_signs_for_foreign_names(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(authority, "_check_permitted", lambda *_: None)
    renew(folder, ["bank.example.com", "8.8.8.8"])
    assert handshake(folder, "bank.example.com") == "permitted subtree violation"
    assert handshake(folder, "8.8.8.8") == "permitted subtree violation"


@pytest.mark.parametrize(
    "names",
    [[], *([one] for one in ("", "https://a.local", "a.local:8080", "-x.local", "*.local", "1.2.3", "fe80::1%e"))],
)
def test_no_name_and_odd_names_are_refused(tmp_path: Path, names: list[str]) -> None:
    with pytest.raises(CertificateError, match="a certificate" if names else "name the addresses"):
        init(tmp_path, names)
    assert list(tmp_path.iterdir()) == []


def test_missing_and_broken_files(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CertificateError, match=r"ca\.pem: No such file or directory; `pebble cert init`"):
        renew(tmp_path)
    shutil.copy(folder / "server.key", folder / "ca.key")
    with pytest.raises(CertificateError, match=r"ca\.key is not the key of .*ca\.pem"):
        renew(folder)
    (folder / "ca.key").write_text("nothing")
    with pytest.raises(CertificateError, match=r"ca\.key: "):
        renew(folder)
    (folder / "ca.pem").write_text("nothing")
    with pytest.raises(CertificateError, match=r"ca\.pem holds no certificate"):
        show(folder / "ca.pem")
