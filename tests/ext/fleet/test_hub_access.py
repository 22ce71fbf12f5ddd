"""What a hub takes from an account of another machine, and what a neighbour's account may do there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.fleet.folder import Fleet, Server, refused
from pebble.extensions.fleet.hub_access import Access, AccountAdmission, HubAccount, access_control, written
from pebble.extensions.fleet.roles import Account, rules
from pebble.transports import QoS
from pebble.transports.topics import matches
from pebble.transports.zenoh.hub.records import Retained
from pebble.transports.zenoh.wire import Hello, Stamp, Will, account_of, asked

FRED, GOOB = "pebble/robots/fred", "pebble/robots/goob"
WILL = Will(f"{GOOB}/outgoing/online", b"0", QoS.DELIVERED, True, "goob-bridge")
OWN = {f"{GOOB}/outgoing/online": 1, "pebble/robots/fred/outgoing/online": 2, "@%24SYS/x": None}


@pytest.fixture
def admission(tmp_path: Path) -> AccountAdmission:
    accounts = {"goob": HubAccount((f"{GOOB}/outgoing/#",), (f"{GOOB}/#",)), "otto": HubAccount()}
    file = tmp_path / "access"
    file.write_bytes(written(Access(access_control([]), accounts)))
    admission = AccountAdmission(file, [], ("+/+/+/incoming/by/#",))
    admission.rules()
    return admission


def test_a_robot_leaves_its_will_and_learns_what_the_hub_lacks_of_it(admission: AccountAdmission) -> None:
    hello = admission.hello("goob", Hello("goob~1", 3, WILL, OWN))
    assert hello is not None
    assert hello.will == Will(WILL.topic, b"0", QoS.DELIVERED, True, "goob~goob-bridge"), "nobody else's predecessor"
    assert (hello.retained_count, hello.own) == (3, {f"{GOOB}/outgoing/online": 1})


def test_a_person_leaves_nothing(admission: AccountAdmission, caplog: pytest.LogCaptureFixture) -> None:
    hello = admission.hello("otto", Hello("otto~1", 0, WILL, OWN))
    assert hello == Hello("otto~1", 0, None, {})
    assert admission.refused == 1
    assert caplog.messages == [
        "refused the will of 'otto~goob-bridge': an account leaves a will for its own robot only "
        f"({GOOB}/outgoing/online)"
    ]


@pytest.mark.parametrize(
    ("account", "name"), [("otto", "goob~1"), ("otto", "otto"), ("otto", "0badf00d"), ("x", "x~1")]
)
def test_a_session_is_named_after_its_account(admission: AccountAdmission, account: str, name: str) -> None:
    assert admission.hello(account, Hello(name, 0, None, {})) is None
    assert admission.hello("", Hello(name, 0, WILL, OWN)) == Hello(name, 0, WILL, OWN), "from this machine"


def test_nothing_is_retained_under_a_name(admission: AccountAdmission) -> None:
    def taken(key: str) -> bool:
        return admission.admitted(Retained(key, b"{}", Stamp(QoS.DELIVERED, 1, "x"))) is not None

    refused = [f"{GOOB}/incoming/by/otto/flags/mqtt-video", f"{GOOB}/incoming/by", f"{GOOB}/incoming/by/a/by/b/estop"]
    allowed = [f"{GOOB}/incoming/flags/mqtt-video", f"{GOOB}/outgoing/by/otto", "by/otto"]
    assert [key for key in (*refused, *allowed) if taken(key)] == allowed


def test_the_account_stands_in_the_key() -> None:
    assert [account_of(asked("@hub/hello", name), "@hub/hello") for name in ("", "otto")] == ["", "otto"]
    for key in ("@hub/hello/*", "@hub/hello/a/b", "@hub/hello/a~b", "@hub/bye/otto"):
        with pytest.raises(ValueError, match="is no query"):
            account_of(key, "@hub/hello")


# -- neighbours


def neighbour(name: str) -> Account:
    return Account(roles=("neighbour",), bases=(f"pebble/robots/{name}",))


#: Topics at the hub, and whether goob's account writes them and reads them.
TOPICS = {
    f"{FRED}/incoming/from/goob/drive-values": (True, False),
    f"{FRED}/incoming/from/goob/lights-solid": (False, False),
    f"{FRED}/incoming/from/carl/drive-values": (False, False),
    f"{FRED}/incoming/drive-values": (False, False),
    f"{FRED}/outgoing/wheel-odometry": (False, True),
    f"{GOOB}/outgoing/wheel-odometry": (True, True),
    f"{GOOB}/incoming/from/carl/drive-values": (False, True),
    f"{GOOB}/incoming/drive-values": (False, False),
    "pebble/lamps/lamp/outgoing/online": (False, False),
}


@pytest.mark.parametrize("level", ["login", "named"])
def test_an_account_of_a_neighbour_speaks_for_its_own_base(level: Any) -> None:
    held = rules("goob-lan", neighbour("goob"), level, at_hub=True)
    found = {
        topic: tuple(
            any(matches(rule.filter, topic) for rule in held if rule.access == one) for one in ("write", "read")
        )
        for topic in TOPICS
    }
    assert found == TOPICS
    assert rules("goob-lan", neighbour("goob"), level) == (), "at a broker it is nothing"


def test_one_neighbour_has_a_base() -> None:
    accounts = {"goob": Account(roles=("robot",), bases=(GOOB,)), "goob-lan": neighbour("goob")}
    fleet = Fleet(level="login", brokers=(Server(host="127.0.0.1"),), accounts=accounts)
    assert refused(fleet, "two", neighbour("goob")) == f"{GOOB} belongs to goob-lan"
    assert refused(fleet, "two", neighbour("fred")) == ""
