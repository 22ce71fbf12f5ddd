"""Accounts that change: at a mosquitto that runs, in the files of one that does not, and what a check finds."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from pebble.fleet import applying, broker_files, check
from pebble.fleet.broker_client import BrokerClient, RefusedError
from pebble.fleet.dynsec import Control
from pebble.fleet.folder import ACL, CONF, FLEET, PASSWORDS, SECURITY, Extra, FleetError, Server, load, locked, refused
from pebble.fleet.roles import Account
from pebble.rig.processes import Processes
from pebble.rig.robot import Robot
from tests.fleet.brokers import HOST, FleetBroker
from tests.support import until

DRIVER, VIEWER = Account(roles=("driver",)), Account(roles=("viewer",))
GOOB = Account(roles=("robot",), bases=("pebble/robots/goob",))
DRIVE, STOP = "pebble/robots/goob/incoming/drive-values", "pebble/robots/goob/incoming/estop"


@pytest.fixture(params=["plugin", "files"])
def broker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[FleetBroker]:
    with FleetBroker(tmp_path / "hall", {"otto": DRIVER, "goob": GOOB}, rules=request.param) as broker:
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
        took = {}
        for what, change in (
            ("add", lambda: broker.add("zoe", DRIVER)),
            ("role", lambda: broker.change(broker.fleet.with_account("zoe", VIEWER))),
            ("remove", lambda: broker.remove("zoe")),
        ):
            began = time.monotonic()
            assert change() == "at once"
            took[what] = time.monotonic() - began
        for one in (robot, otto):
            one.listen(0.05)
            one.publish("pebble/robots/goob/outgoing/end", b"")
            one.flush()
            assert not one.closed
    assert max(took.values()) < 0.5, took


def test_a_role_counts_for_connections_that_are_there(broker: FleetBroker) -> None:
    broker.add("zoe", DRIVER)
    assert until(lambda: _gets_in(broker, "zoe"))
    with broker.login("zoe") as zoe:
        assert passes(broker, zoe, DRIVE)
        broker.change(broker.fleet.with_account("zoe", VIEWER))
        assert until(lambda: not passes(broker, zoe, DRIVE), 3)
        assert passes(broker, zoe, STOP)
        broker.change(broker.fleet.with_account("zoe", DRIVER))
        assert until(lambda: passes(broker, zoe, DRIVE), 3)


@pytest.mark.parametrize("how", ["remove", "password"])
def test_who_is_removed_or_gets_another_password_is_disconnected(broker: FleetBroker, how: str) -> None:
    change = {"remove": lambda broker: broker.remove("otto"), "password": lambda broker: broker.renew("otto")}
    with broker.login("otto") as otto:
        old = broker.passwords["otto"]
        change[how](broker)
        assert until(lambda: otto.listen(0.05) or otto.closed, 3)
    with pytest.raises(RefusedError):
        BrokerClient(broker.place, "otto", old)
    assert _gets_in(broker, "otto") == (how == "password")


def _gets_in(broker: FleetBroker, name: str) -> bool:
    try:
        broker.login(name).__exit__()
    except RefusedError:
        return False
    return True


def test_who_takes_all_connections_is_removed_while_mosquitto_is_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command says what to do, and not that it is another broker."""
    monkeypatch.setattr(broker_files, "MAX_CONNECTIONS", 10)
    with FleetBroker(tmp_path / "hall", {"otto": DRIVER}) as broker, ExitStack() as all_of_them:
        for _ in range(10):
            all_of_them.enter_context(broker.login("otto"))
        with pytest.raises(FleetError, match=f"mosquitto runs there .process {broker.pid}.: end it"):
            broker.remove("otto")
        assert "otto" in broker.fleet.accounts
        broker.stop()
        assert "does not run" in broker.remove("otto")
        broker.start()
        with pytest.raises(RefusedError):
            broker.login("otto")


def test_a_change_while_mosquitto_is_down_counts_when_it_runs(broker: FleetBroker) -> None:
    broker.stop()
    assert "mosquitto does not run" in broker.add("zoe", DRIVER)
    broker.remove("otto")
    broker.start()
    assert check.compare(broker.folder, broker.fleet) == []
    assert [_gets_in(broker, name) for name in ("zoe", "otto", "goob")] == [True, False, True]


def test_a_password_survives_a_change_of_level(broker: FleetBroker) -> None:
    broker.change(replace(broker.fleet, level="named"))
    with broker.login("otto") as otto:
        named = until(lambda: passes(broker, otto, "pebble/robots/goob/incoming/by/otto/drive-values"), 3)
        assert (named, passes(broker, otto, DRIVE), passes(broker, otto, STOP)) == (True, False, True)
    broker.change(replace(broker.fleet, plain=True))
    with broker.login("otto") as otto:
        assert until(lambda: passes(broker, otto, DRIVE), 3)


def test_metrics_beyond_the_contract(broker: FleetBroker) -> None:
    broker.change(replace(broker.fleet, extra=Extra(drive=("arm/+",))))
    with broker.login("otto") as otto:
        assert until(lambda: passes(broker, otto, "pebble/robots/goob/incoming/arm/left"), 3)
        assert not passes(broker, otto, "pebble/robots/goob/incoming/arm")


def test_the_file_of_the_plugin_is_never_written_while_mosquitto_runs(tmp_path: Path) -> None:
    with FleetBroker(tmp_path / "hall", {"otto": DRIVER}) as broker:
        os.kill(broker.pid, 19)  # it keeps its port and answers nothing
        before = (broker.folder / SECURITY).read_bytes()
        with pytest.raises(FleetError, match="mosquitto runs there"):
            broker.add("zoe", DRIVER)
        os.kill(broker.pid, 18)
        assert (broker.folder / SECURITY).read_bytes() == before
        assert "zoe" not in broker.fleet.accounts
        assert "at once" in broker.add("zoe", DRIVER)


def test_a_second_broker_that_is_away_is_named_and_nothing_is_written(tmp_path: Path) -> None:
    with FleetBroker(tmp_path / "hall", {"otto": DRIVER}) as broker:
        away = Server(host=HOST, port=1)
        fleet = replace(broker.fleet, brokers=(*broker.fleet.brokers, away))
        with pytest.raises(FleetError, match="Connection refused: it was not changed"):
            applying.apply(broker.folder, fleet, fleet.without("otto"))
        assert "otto" in broker.fleet.accounts  # so that the command can be given again
        assert not _gets_in(broker, "otto")


# -- what a check finds


def test_it_finds_one_rule_too_many_and_one_too_few(broker: FleetBroker) -> None:
    assert check.compare(broker.folder, broker.fleet) == []
    without = Account(roles=("viewer",))
    fleet = broker.fleet
    if_driver_were_viewer = replace(fleet, accounts=fleet.accounts | {"otto": without, "new": VIEWER})
    found = check.compare(broker.folder, if_driver_were_viewer)
    assert "otto: one rule too many: write +/+/+/incoming/drive-values" in found
    assert "new: an account too few: the broker does not have it: `pebble fleet password new`" in found
    more = replace(fleet, extra=Extra(look=("arm/+",))).without("goob")
    found = check.compare(broker.folder, more)
    assert "otto: one rule too few: write +/+/+/incoming/arm/+" in found
    assert "goob: an account too many: the broker lets it in, and fleet.json does not have it" in found


def test_attempts_find_one_rule_too_many_and_one_too_few(broker: FleetBroker, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check.attempt(broker.folder, broker.fleet).wrong == []
    real = check.may

    def table(rules: Any, access: str, topic: str) -> bool:
        """The broker's rules are right, and what is expected is not: another robot's reboot, and no lights."""
        return topic.endswith("flags/reboot") or (real(rules, access, topic) and not topic.endswith("lights-solid"))

    monkeypatch.setattr(check, "may", table)
    wrong = check.attempt(broker.folder, broker.fleet).wrong
    assert any("viewer: one rule too few: reboot" in line for line in wrong)
    assert any("driver: one rule too many: lights" in line for line in wrong)
    assert not any(name.startswith("check-") for name in broker.fleet.accounts)
    assert check.compare(broker.folder, broker.fleet) == []  # the accounts of the attempts are gone


@pytest.mark.parametrize(
    ("file", "old", "new", "found"),
    [
        (CONF, "allow_anonymous false", "allow_anonymous true", "has a line of its own: allow_anonymous true"),
        (CONF, "max_connections", "listener 1883\nmax_connections", "has a line of its own: listener 1883"),
        (ACL, "user admin\n", "topic readwrite #\nuser admin\n", "everybody: one rule too many: topic readwrite #"),
        (ACL, "topic write +/+/+/incoming/audio\n", "", "otto: one rule too few: write +/+/+/incoming/audio"),
        (PASSWORDS, "goob:", "bob:", "goob: an account too few"),
    ],
)
def test_it_finds_changes_of_files(tmp_path: Path, file: str, old: str, new: str, found: str) -> None:
    broker = FleetBroker(tmp_path / "hall", {"otto": DRIVER, "goob": GOOB}, rules="files")
    changed = (broker.folder / file).read_text().replace(old, new)
    (broker.folder / file).write_text(changed)
    by_hand, rules = check.by_hand(broker.folder, broker.fleet), check.of_rules(broker.folder, broker.fleet)
    assert any(found in line for line in (*by_hand, *rules))
    assert bool(by_hand) == (file == CONF), "`pebble fleet init` is advised for what it mends"
    assert all(line.endswith("then restart mosquitto") for line in by_hand)


def test_it_finds_changes_of_the_plugin(tmp_path: Path) -> None:
    with FleetBroker(tmp_path / "hall", {"otto": DRIVER}) as broker:
        with Control(broker.place, "admin", broker.passwords["admin"]) as control:
            acls = [{"acltype": "publishClientReceive", "allow": True}]
            rule = {"acltype": "publishClientSend", "topic": "#", "allow": True}
            control.send(
                [
                    {"command": "setDefaultACLAccess", "acls": acls},
                    {"command": "addRoleACL", "rolename": "account-otto", **rule},
                    {"command": "createGroup", "groupname": "guests"},
                    {"command": "setAnonymousGroup", "groupname": "guests"},
                    {"command": "disableClient", "username": "otto"},
                ]
            )
        assert check.compare(broker.folder, broker.fleet) == [
            "otto: is disabled at the broker",
            "everybody: one rule too many: publishClientReceive is allowed for all",
            "clients without a name: have the rights of group guests: stop mosquitto before the next line",
            "otto: one rule too many: write #",
        ]
        applying.repair(broker.folder, broker.fleet)
        (left,) = check.compare(broker.folder, broker.fleet)
        assert left.startswith("clients without a name")
        broker.stop()
        applying.repair(broker.folder, broker.fleet)
        broker.start()
        assert check.compare(broker.folder, broker.fleet) == []


@pytest.mark.parametrize(
    ("without", "instead", "found"),
    [
        ((), (), []),
        (
            ("plugin", "allow_anonymous"),
            ("allow_anonymous true",),
            ["lets in clients without a name", "lets in clients with a wrong password", "has no rules"],
        ),
        (("plugin",), ("password_file {passwords}",), ["has no rules, each account may do all"]),
    ],
    ids=["of this fleet", "open", "without rules"],
)
def test_it_finds_a_second_broker_that_lets_everybody_write(
    tmp_path: Path, without: tuple[str, ...], instead: tuple[str, ...], found: list[str]
) -> None:
    broker = FleetBroker(tmp_path / "hall", {"otto": DRIVER})
    second = broker.spare(tmp_path / "spare")
    conf, passwords = second.folder / CONF, second.folder / PASSWORDS
    hashed = {name: broker_files.hashed(one) for name, one in broker.passwords.items()}
    passwords.write_text(broker_files.passwords_text(hashed))
    lines = [line for line in conf.read_text().splitlines() if not line.startswith(without)]
    conf.write_text("\n".join([*lines, *(more.format(passwords=passwords) for more in instead)]))
    with broker, second:
        ((server, lines),) = check.of_others(broker.folder, broker.fleet)
        assert server.port == second.port
        assert [any(one in line for line in lines) for one in found] == [True] * len(lines)
        assert all(f":{second.port} " in line for line in lines)


# -- a person who drives


@pytest.mark.alone
def test_the_wheels_stop_within_a_second_when_the_driver_is_removed(tmp_path: Path) -> None:
    with FleetBroker(tmp_path / "hall", {"otto": DRIVER, "goob": GOOB}) as broker, Processes() as running:
        login = {"username": "goob", "password": broker.passwords["goob"]}
        tls = {"enabled": True, "ca_cert": str(broker.folder / "ca.pem")}
        bridge = {"mqtt_bridge": {"remote_mqtt": login | {"tls": tls}}, "serial_mcu_bridge": {}}
        robot = Robot(running, "zenoh", (HOST, broker.port), name="goob", services=bridge)
        robot._own |= {"security": {"level": "login"}}
        robot.prepare()
        robot.launch()
        with broker.login("otto") as otto:

            def driven() -> bool:
                if not otto.closed:
                    otto.publish(DRIVE, b'{"x": 0, "z": 0.5}')
                    otto.listen(0.05)
                return any(entry.motors not in (None, (0.0, 0.0)) for entry in robot.entries()[-3:])

            assert until(driven, 20), robot.log()
            removed = time.monotonic()
            broker.remove("otto")
            assert until(lambda: otto.listen(0.02) or otto.closed, 2)
            stopped = until(lambda: [e.motors for e in robot.entries() if e.motors is not None][-1] == (0.0, 0.0), 3)
            last = [entry.ns / 1e9 for entry in robot.entries() if entry.motors is not None][-1]
        assert stopped
        assert last - removed < 1.0


# -- names, folders


@pytest.mark.parametrize(
    ("name", "account", "why"),
    [
        ("Ann", DRIVER, "is no name"),
        ("a/b", DRIVER, "is no name"),
        ("", DRIVER, "is no name"),
        ("a" * 33, DRIVER, "is no name"),
        ("otto", DRIVER, "exists already, as driver"),
        ("x", Account(roles=()), "is no role"),
        ("x", Account(roles=("boss",)), "'boss' is no role: use viewer"),
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
        ("x", Account(roles=("driver", "safety")), ""),
        ("x", Account(roles=("gateway",), bases=("pebble/robots/+",)), ""),
        ("x", Account(roles=("boards",), bases=("pebble/robots/minilamp", "pebble/robots/benjr")), ""),
        ("x_-1", Account(roles=("robot",), bases=("pebble/lamps/x",), plain=True), ""),
    ],
    ids=str,
)
def test_who_may_be_added(tmp_path: Path, name: str, account: Account, why: str) -> None:
    broker = FleetBroker(tmp_path / "hall", {"otto": DRIVER, "goob": GOOB})
    assert why in refused(broker.fleet, name, account)
    assert bool(why) == bool(refused(broker.fleet, name, account))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"level": "open"}, "Invalid enum value 'open'"),
        ({"brokers": []}, "brokers"),
        ({"accounts": {"Ann": {"roles": ["driver"]}}}, "accounts.Ann: 'Ann' is no name"),
        ({"accounts": {"ann": {"roles": ["boss"]}}}, "'boss' is no role"),
        ({"extra": {"drive": ["#"]}}, "'#' is no metric"),
        ({"extra": {"drive": ["by/otto/x"]}}, "is no metric"),
        ({"secret": 1}, "unknown field `secret`"),
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
    assert len(broker.fleet.accounts) == 21
    assert check.compare(broker.folder, broker.fleet) == []
