"""What each account gets through at a real mosquitto, in both forms of rules and at both levels. Expected by hand."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from pebble.config.security import SecurityLevel
from pebble.contract import CHANNELS, INCOMING
from pebble.fleet.attempts import ROWS, document, topics
from pebble.fleet.broker_client import BrokerClient, RefusedError
from pebble.fleet.broker_files import acl_text, hashed, security_text
from pebble.fleet.folder import Fleet, Server
from pebble.fleet.roles import CONTROL_ANSWERS, CONTROL_TOPIC, ROLES, WRITES, Account
from pebble.transports.base import Message, QoS
from pebble.transports.topics import matches
from tests.fleet.brokers import FleetBroker
from tests.support import ROOT, until

GOOB, FRED, LAMP = "pebble/robots/goob", "pebble/robots/fred", "pebble/lamps/lamp"
MARK = "pebble/gateways/eye/outgoing/online"
PEOPLE = {
    "vera": ("viewer",),
    "otto": ("driver",),
    "mia": ("maintainer",),
    "sam": ("safety",),
    "dora": ("driver", "safety"),
    "max": ("maintainer", "safety"),
    "admin": ("admin",),
    "page-1": ("page",),
}
ACCOUNTS = {name: Account(roles=roles) for name, roles in PEOPLE.items() if name != "admin"} | {
    "goob": Account(roles=("robot",), bases=(GOOB,)),
    "fred": Account(roles=("robot",), bases=(FRED,)),
    "lamp": Account(roles=("robot",), bases=(LAMP,), plain=True),
    "gate": Account(roles=("gateway",), bases=("pebble/robots/+",)),
    "near": Account(roles=("boards",), bases=(FRED, LAMP)),
    "lan": Account(roles=("neighbour",), bases=(FRED,)),
    "hub": Account(roles=("hub",)),
}
LOOK = {"estop", "front-camera"}
DRIVE = LOOK | {
    *("drive-values", "control", "lights-solid", "lights-flash", "audio", "audio-stream", "soundboard-command"),
    *("autonomy-command", "mcu/u1/led", "outlets/a/power", "mip-raw", "flags/mqtt-video", "flags/mqtt-audio"),
}
SYSTEM = {"flags/reboot", "flags/service-restart", "flags/git-pull", "flags/remote-mirror"}
MAY = {
    "vera": LOOK,
    "otto": DRIVE,
    "mia": DRIVE | SYSTEM | {"control/take"},
    "sam": DRIVE | {"control/take", "estop-reset"},
    "dora": DRIVE | {"control/take", "estop-reset"},
    "max": DRIVE | SYSTEM | {"control/take", "estop-reset"},
    "admin": DRIVE | SYSTEM | {"control/take", "estop-reset"},
    "page-1": DRIVE | SYSTEM | {"control/take", "estop-reset"},
}
METRICS = sorted(
    DRIVE
    | SYSTEM
    | {"control/take", "estop-reset", "junk", "flags/junk", "estop/x", "outlets/power", "by/otto/by/otto/estop"}
)
TOPICS = [
    *(f"{base}/incoming/{metric}" for base in (GOOB, LAMP) for metric in METRICS),
    *(f"{GOOB}/incoming/by/{name}/{metric}" for name in ("otto", "sam", "goob", "nobody") for metric in METRICS),
    *(f"{GOOB}/outgoing/{metric}" for metric in ("online", "control/serial", "estop/serial", "capabilities")),
    *(f"{FRED}/{metric}" for metric in ("outgoing/online", "incoming/drive-values", "incoming/flags/reboot")),
    "pebble/servers/x1/outgoing/bridge-probe",
    "pebble/servers/x1/outgoing/online",
    "pebble/gateways/gate/outgoing/online",
    "pebble/gateways/other/outgoing/online",
    "pebble/robots/new/outgoing/online",
]


def lets_through(name: str, topic: str, level: str) -> bool:
    """By hand."""
    base, _, rest = topic.partition("/incoming/")
    if name in ("goob", "fred", "lamp"):
        own = {"goob": GOOB, "fred": FRED, "lamp": LAMP}[name]
        return topic.startswith(f"{own}/")
    if name == "gate":
        return (
            topic.startswith("pebble/robots/")
            and ("/outgoing/" in topic or rest in ("flags/remote-mirror", "flags/mqtt-audio", "flags/mqtt-video"))
        ) or topic == "pebble/gateways/gate/outgoing/online"
    if name == "near":
        return topic.startswith((f"{FRED}/", f"{LAMP}/"))
    if name in ("hub", "lan"):
        return False  # test_zenoh has what they are at a hub
    if not rest:
        return topic == "pebble/servers/x1/outgoing/bridge-probe" and name != "vera"
    if rest == "estop":
        return True
    if level == "login":
        return rest in MAY[name] or (rest == "estop-reset" and name != "vera")
    if base == LAMP and rest in MAY[name]:
        return True
    by, _, named = rest.partition("/")
    sender, _, metric = named.partition("/")
    return by == "by" and sender == name and metric in MAY[name]


LEVELS: tuple[SecurityLevel, ...] = ("login", "named")
EYE = Account(roles=("gateway",), bases=("+/+/+",))  # reads everything below any base


@pytest.fixture(
    scope="module", params=[(rules, level) for rules in ("plugin", "files") for level in LEVELS], ids="-".join
)
def broker(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetBroker]:
    rules, level = request.param
    folder = tmp_path_factory.mktemp("fleet") / "hall"
    with FleetBroker(folder, ACCOUNTS | {"eye": EYE}, level=level, rules=rules) as broker:
        yield broker


@pytest.fixture
def eye(broker: FleetBroker) -> Iterator[BrokerClient]:
    with broker.login("eye") as eye:
        eye.subscribe(["+/+/+/incoming/#", "+/+/+/outgoing/#"])
        yield eye


def seen(eye: BrokerClient) -> list[tuple[str, bytes]]:
    """All that was let through before; forgets it."""
    eye.publish(MARK, b"mark")
    eye.wait(lambda: any(topic == MARK for topic, _ in eye.received), "deliver")
    found = [one for one in eye.received if one[0] != MARK]
    eye.received.clear()
    return found


def test_each_account_writes_what_it_may_and_nothing_else(broker: FleetBroker, eye: BrokerClient) -> None:
    wrong, attempts = [], 0
    for name in (*ACCOUNTS, "admin"):
        with broker.login(name) as client:
            for topic in TOPICS:
                client.publish(topic, name.encode())
            client.flush()
        passed = {topic for topic, payload in seen(eye) if payload == name.encode()}
        expected = {topic for topic in TOPICS if lets_through(name, topic, broker.fleet.level)}
        wrong += [(name, topic) for topic in sorted(passed ^ expected)]
        attempts += len(TOPICS)
    assert wrong == []
    assert attempts > 1_700  # for each of four brokers


def test_each_account_reads_what_it_may_and_nothing_else(broker: FleetBroker) -> None:
    """Also what is retained, and whatever it subscribes to."""
    published = [
        (f"{GOOB}/outgoing/online", True),
        (f"{GOOB}/incoming/flags/mqtt-video", True),
        (f"{GOOB}/outgoing/logs", False),
        (f"{GOOB}/incoming/drive-values", False),
        (f"{GOOB}/incoming/by/otto/audio-stream", False),
    ]
    everything = {topic for topic, _ in published}
    public = {f"{GOOB}/outgoing/online", f"{GOOB}/outgoing/logs", f"{GOOB}/incoming/flags/mqtt-video"}
    expected = dict.fromkeys(PEOPLE, public) | {"goob": everything, "gate": everything, "fred": set(), "lamp": set()}
    found = {}
    with broker.login("goob") as robot:
        for topic, retained in published:
            robot.publish(topic, b"before", retain=retained)
        robot.flush()
        for name in expected:
            with broker.login(name) as client:
                client.subscribe(["#", "$SYS/#", "+/+/+/#", *everything])
                for topic, _ in published:
                    robot.publish(topic, name.encode())
                robot.flush()
                client.subscribe(["pebble/end"])  # answered after what was delivered before
                found[name] = {topic for topic, _ in client.received}
        for topic, retained in published:
            robot.publish(topic, b"", retain=retained)
        robot.flush()
    assert found == expected


@pytest.mark.parametrize("name", ["vera", "otto", "fred"])
def test_a_will_is_judged_as_what_its_account_sends(broker: FleetBroker, eye: BrokerClient, name: str) -> None:
    own = f"by/{name}/" if broker.fleet.level == "named" else ""
    topics = {one: f"{GOOB}/incoming/{one}" for one in (f"{own}drive-values", "by/sam/drive-values", "estop")}
    for topic in topics.values():
        will = Message(topic, name.encode(), qos=QoS.DELIVERED)
        BrokerClient(broker.place, name, broker.passwords[name], will=will).cut()
    expected = {topic for topic in topics.values() if lets_through(name, topic, broker.fleet.level)}
    assert until(lambda: expected <= {topic for topic, _ in (eye.listen(0.01), *eye.received)[1:]})
    eye.listen(0.1)
    assert {topic for topic, _ in seen(eye)} == expected


def test_only_an_admin_changes_accounts(broker: FleetBroker) -> None:
    answered = set()
    for name in (*ACCOUNTS, "admin"):
        with broker.login(name) as client:
            client.subscribe(["$CONTROL/#", CONTROL_ANSWERS])
            client.publish(CONTROL_TOPIC, b'{"commands": [{"command": "listClients"}]}')
            client.flush()
            client.subscribe(["pebble/end"])
            answered |= {name} if client.received else set()
    assert answered == ({"admin"} if broker.fleet.rules == "plugin" else set())


@pytest.mark.parametrize(
    ("name", "password"), [(None, None), ("otto", None), ("otto", "wrong"), ("nobody", "x"), ("OTTO", "x"), ("", "")]
)
def test_strangers_do_not_get_in(broker: FleetBroker, name: str | None, password: str | None) -> None:
    with pytest.raises(RefusedError):
        BrokerClient(broker.place, name, password)


def test_every_role_and_every_command_of_the_contract_is_tried() -> None:
    given = {channel for channels in WRITES.values() for channel in channels if not isinstance(channel, str)}
    assert {channel for channel in CHANNELS if channel.direction == INCOMING and channel.remote} == given
    assert {role for account in ACCOUNTS.values() for role in account.roles} | {"admin"} == set(ROLES)
    tried = {
        matched for matched in given for metric in METRICS if matches(matched.filter(GOOB), f"{GOOB}/incoming/{metric}")
    }
    assert tried == given


def test_an_account_may_do_all_of_an_attempt_or_nothing() -> None:
    """So that one word in the table is true for each of its topics."""
    for row in ROWS:
        for level in LEVELS:
            for name in PEOPLE:
                answers = {
                    lets_through(name, one, level) for one in topics(row, GOOB, name, level, "nobody") if one[0] != "$"
                }
                assert len(answers) <= 1, (row.what, name, level)


def test_the_table_in_the_documentation_is_that_of_the_roles() -> None:
    assert (ROOT / "docs" / "fleet.md").read_text() == document()


@pytest.mark.parametrize("rules", ["plugin", "files"])
def test_the_files_of_a_large_fleet_stay_small(rules: Any) -> None:
    people = {f"p{number}": Account(roles=("driver",)) for number in range(50)}
    robots = {f"r{number}": Account(roles=("robot",), bases=(f"pebble/robots/r{number}",)) for number in range(200)}
    fleet = Fleet(level="named", rules=rules, brokers=(Server(host="hall"),), accounts=people | robots)
    passwords = dict.fromkeys(fleet.accounts, hashed("x"))
    assert len(acl_text(fleet)) < 100_000
    assert len(security_text(fleet, passwords)) < 260_000
