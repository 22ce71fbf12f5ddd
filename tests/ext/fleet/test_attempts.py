"""The topics that each account gets through at a real mosquitto, at both levels, with and without TLS, by hand."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from pebble.config.security import SecurityLevel
from pebble.contract import CHANNELS, INCOMING
from pebble.extensions.fleet.folder import Fleet, Server
from pebble.extensions.fleet.roles import ROLES, WRITES, Account
from pebble.extensions.thin.expander import is_stream
from pebble.transports.base import Message, QoS
from pebble.transports.topics import matches
from tests.ext.fleet.brokers import HOST, BrokerClient, FleetBroker, Place, RefusedError
from tests.support import ROOT, free_port, until

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
ACCOUNTS = {name: Account(roles=roles) for name, roles in PEOPLE.items()} | {
    "goob": Account(roles=("robot",), bases=(GOOB,)),
    "fred": Account(roles=("robot",), bases=(FRED,)),
    "lamp": Account(roles=("robot",), bases=(LAMP,), plain=True),
    "gate": Account(roles=("gateway",), bases=("pebble/robots/+",)),
    "near": Account(roles=("boards",), bases=(FRED, LAMP)),
    "lan": Account(roles=("neighbour",), bases=(FRED,)),
    "hub": Account(roles=("hub",)),
    "exp": Account(roles=("expander",)),
    "page-2": Account(roles=("page", "expander")),
}
LOOK = {"estop", "front-camera"}
DRIVE = LOOK | {
    *("drive-values", "control", "lights-solid", "lights-flash", "audio", "audio-stream", "soundboard-command"),
    *("autonomy-command", "mcu/u1/led", "outlets/a/power", "mip-raw", "flags/mqtt-video", "flags/mqtt-audio", "group"),
}
SYSTEM = {"flags/reboot", "flags/service-restart", "flags/git-pull", "flags/remote-mirror"}
#: Outgoing topics that an expander publishes, and others.
STREAMS = {"touch-sensors", "wheel-odometry", "sensors/imu", "apriltag-data", "mcu/u1/imu"}
NO_STREAMS = {
    "online",
    "control/serial",
    "estop/serial",
    "capabilities",
    "group",
    "wire",
    "front-camera",
    "link",
    "x/y",
}
MAY = {
    "vera": LOOK,
    "otto": DRIVE,
    "mia": DRIVE | SYSTEM | {"control/take"},
    "sam": DRIVE | {"control/take", "estop-reset"},
    "dora": DRIVE | {"control/take", "estop-reset"},
    "max": DRIVE | SYSTEM | {"control/take", "estop-reset"},
    "admin": DRIVE | SYSTEM | {"control/take", "estop-reset"},
    "page-1": DRIVE | SYSTEM | {"control/take", "estop-reset"},
    "page-2": DRIVE | SYSTEM | {"control/take", "estop-reset", "expander"},
    "exp": {"expander"},
}
METRICS = sorted(
    DRIVE
    | SYSTEM
    | {"control/take", "estop-reset", "expander", "junk", "flags/junk", "estop/x", "outlets/power"}
    | {"by/otto/by/otto/estop"}
)
TOPICS = [
    *(f"{base}/incoming/{metric}" for base in (GOOB, LAMP) for metric in METRICS),
    *(f"{GOOB}/incoming/by/{name}/{metric}" for name in ("otto", "sam", "goob", "exp", "nobody") for metric in METRICS),
    *(f"{GOOB}/outgoing/{metric}" for metric in sorted(STREAMS | NO_STREAMS)),
    *(f"{FRED}/{metric}" for metric in ("outgoing/online", "incoming/drive-values", "incoming/flags/reboot")),
    "pebble/servers/x1/outgoing/bridge-probe",
    "pebble/servers/x1/outgoing/online",
    "pebble/gateways/gate/outgoing/online",
    "pebble/gateways/other/outgoing/online",
    "pebble/robots/new/outgoing/online",
]


EXPANDERS = ("exp", "page-2")


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
        if name in EXPANDERS and topic.partition("/outgoing/")[2] in STREAMS:
            return True
        return topic == "pebble/servers/x1/outgoing/bridge-probe" and name not in ("vera", "exp")
    if rest == "estop":
        return name != "exp"
    if level == "login":
        return rest in MAY[name] or (rest == "estop-reset" and name not in ("vera", "exp"))
    if base == LAMP and rest in MAY[name]:
        return True
    by, _, named = rest.partition("/")
    sender, _, metric = named.partition("/")
    return by == "by" and sender == name and metric in MAY[name]


def is_shown(name: str, topic: str) -> bool:
    """By hand."""
    if name in EXPANDERS and topic.endswith(("/outgoing/wire", "/outgoing/group", "/expander")):
        return True
    if name in PEOPLE or name == "page-2":
        return "/outgoing/" in topic or "/incoming/flags/" in topic
    bases = {"goob": (GOOB,), "fred": (FRED,), "lamp": (LAMP,), "near": (FRED, LAMP), "gate": ("pebble/robots",)}
    gateway = name == "gate" and re.fullmatch("pebble/gateways/[^/]*/outgoing/online", topic)
    return bool(gateway) or any(topic.startswith(f"{base}/") for base in bases.get(name, ()))


LEVELS: tuple[SecurityLevel, ...] = ("login", "named")
EYE = Account(roles=("gateway",), bases=("+/+/+",))  # reads everything below any base


@pytest.fixture(scope="module", params=LEVELS)
def broker(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetBroker]:
    folder = tmp_path_factory.mktemp("fleet") / "hall"
    with FleetBroker(folder, ACCOUNTS | {"eye": EYE}, level=request.param, unencrypted=free_port()) as broker:
        yield broker


@pytest.fixture(params=["TLS", "without TLS"])
def place(request: pytest.FixtureRequest, broker: FleetBroker) -> Place:
    return {"TLS": broker.place, "without TLS": Place(HOST, broker.unencrypted or 0, None)}[request.param]


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


def test_each_account_writes_what_it_may_and_nothing_else(broker: FleetBroker, place: Place, eye: BrokerClient) -> None:
    wrong = []
    for name in ACCOUNTS:
        with BrokerClient(place, name, broker.passwords[name]) as client:
            for topic in TOPICS:
                client.publish(topic, name.encode())
            client.flush()
        passed = {topic for topic, payload in seen(eye) if payload == name.encode()}
        expected = {topic for topic in TOPICS if lets_through(name, topic, broker.fleet.level)}
        wrong += [(name, topic) for topic in sorted(passed ^ expected)]
    assert wrong == []
    assert len(ACCOUNTS) * len(TOPICS) > 2_500  # for each of two brokers, both of their ports, and written and read


def test_each_account_reads_what_it_may_and_nothing_else(broker: FleetBroker, place: Place) -> None:
    """Also what is retained, and whatever it subscribes to."""
    bases = {"goob": GOOB, "fred": FRED, "lamp": LAMP}
    senders = {name: broker.login(name) for name in (*bases, "eye")}
    sent = {topic: next((name for name in bases if topic.startswith(bases[name])), "eye") for topic in TOPICS}
    retained = [f"{GOOB}/outgoing/online", f"{GOOB}/incoming/flags/mqtt-video", f"{GOOB}/incoming/drive-values"]
    for topic in retained:
        senders["goob"].publish(topic, b"before", retain=True)
    senders["goob"].flush()
    wrong = []
    for name in ACCOUNTS:
        with BrokerClient(place, name, broker.passwords[name]) as client:
            client.subscribe(["#", "$SYS/#", "+/+/+/#", *sent], qos=0)
            for topic, sender in sent.items():
                senders[sender].publish(topic, name.encode())
            for sender in senders.values():
                sender.flush()
            client.subscribe(["pebble/end"])  # answered after what was delivered before
        kept, passed = ({topic for topic, got in client.received if got == one} for one in (b"before", name.encode()))
        wrong += [(name, topic) for topic in sorted(passed ^ {topic for topic in sent if is_shown(name, topic)})]
        wrong += [(name, topic) for topic in sorted(kept ^ {topic for topic in retained if is_shown(name, topic)})]
    for topic in retained:
        senders["goob"].publish(topic, b"", retain=True)
    senders["goob"].flush()
    for client in senders.values():
        client.__exit__()
    assert wrong == []


def test_a_robot_has_the_short_name_of_its_account_and_expanders_read_it(broker: FleetBroker, place: Place) -> None:
    with ExitStack() as opened:
        clients = {name: opened.enter_context(BrokerClient(place, name, broker.passwords[name])) for name in ACCOUNTS}
        for client in clients.values():
            client.subscribe(["~/+"])
        for name, client in clients.items():
            for short in ("~/goob", "~/3f"):
                client.publish(short, name.encode())
            client.flush()
        for client in clients.values():
            client.subscribe(["pebble/end"])  # answered after what was delivered before
        seen = {name: client.received for name, client in clients.items() if client.received}
    assert seen == {name: [("~/goob", b"goob")] for name in EXPANDERS}


def test_an_account_may_publish_the_streams_that_an_expander_publishes() -> None:
    streams = {channel for channel in CHANNELS if is_stream(channel)}
    fleet = Fleet(level="login", brokers=(Server(host="hall"),), accounts=ACCOUNTS)
    rules = {rule.filter for rule in fleet.rules_of("exp")}
    assert {channel.filter("+/+/+") for channel in streams} == {one for one in rules if "/outgoing/" in one} - {
        "+/+/+/outgoing/wire",
        "+/+/+/outgoing/group",
    }


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


@pytest.mark.parametrize(
    ("name", "password"), [(None, None), ("otto", None), ("otto", "wrong"), ("nobody", "x"), ("OTTO", "x"), ("", "")]
)
def test_strangers_do_not_get_in(place: Place, name: str | None, password: str | None) -> None:
    with pytest.raises(RefusedError):
        BrokerClient(place, name, password)


def test_every_role_and_every_command_of_the_contract_is_tried() -> None:
    given = {channel for channels in WRITES.values() for channel in channels if not isinstance(channel, str)}
    assert {channel for channel in CHANNELS if channel.direction == INCOMING and channel.remote} == given
    assert {role for account in ACCOUNTS.values() for role in account.roles} == set(ROLES)
    tried = {
        matched for matched in given for metric in METRICS if matches(matched.filter(GOOB), f"{GOOB}/incoming/{metric}")
    }
    assert tried == given


#: The rows of docs/ext/fleet.md: what is sent, below the robot or the system; ``{by}`` is the sender at level `named`.
ROWS = {
    "emergency stop, with or without a name": ["incoming/{by}estop", "incoming/estop"],
    "drive, also by a will or a retained command": ["incoming/{by}drive-values", "incoming/{by}control"],
    "drive, without a name": ["incoming/drive-values", "incoming/control"],
    "scripts, lights, sounds, outlets, devices, voice; allow pictures and sound": [
        f"incoming/{{by}}{one}"
        for one in (
            *("autonomy-command", "lights-solid", "lights-flash", "soundboard-command", "outlets/a/power"),
            *("mcu/u1/led", "mip-raw", "audio", "audio-stream", "flags/mqtt-video", "flags/mqtt-audio"),
        )
    ],
    "take control over": ["incoming/{by}control/take"],
    "reset an emergency stop": ["incoming/{by}estop-reset"],
    "ask for pictures": ["incoming/{by}front-camera"],
    "reboot, restart, update, mirror": [
        f"incoming/{{by}}flags/{one}" for one in ("reboot", "service-restart", "git-pull", "remote-mirror")
    ],
    "pose as this robot, or as others who command it; commands that the contract does not know": [
        *(f"incoming/by/nobody/{one}" for one in ("drive-values", "control", "estop-reset")),
        *("outgoing/online", "outgoing/control/serial", "outgoing/junk"),
        *("incoming/{by}junk", "incoming/{by}flags/junk"),
    ],
    "pose as another or a new robot, or as a page server": [
        *("pebble/robots/new/outgoing/online", "pebble/robots/new/incoming/junk"),
        "pebble/servers/x1/outgoing/online",
    ],
    "probe a broker as a page server": ["pebble/servers/x1/outgoing/bridge-probe"],
}
SHOWN = {
    "see what the robot publishes, and its flags": ["outgoing/online", "incoming/flags/x"],
    "see commands of others": ["incoming/drive-values", "incoming/audio-stream", "incoming/by/otto/drive-values"],
}
COLUMNS = {
    "viewer": "vera",
    "driver": "otto",
    "maintainer": "mia",
    "safety": "sam",
    "admin, page": "admin",
    "the robot": "goob",
}


def test_the_table_of_the_documentation_is_what_the_brokers_do() -> None:
    lines = (ROOT / "docs/ext/fleet.md").read_text().partition("| to a robot |")[2].partition("\n\n")[0].splitlines()
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert head == list(COLUMNS)
    table = {what: dict(zip(COLUMNS, cells, strict=True)) for what, *cells in rows}
    assert table == {what: {one: _cell(what, name) for one, name in COLUMNS.items()} for what in (*ROWS, *SHOWN)}
    assert {what: _cell(what, "page-1") for what in table} == {what: row["admin, page"] for what, row in table.items()}
    assert {_cell(what, "fred") for what in table} == {"–"}


def _cell(what: str, name: str) -> str:
    """Return the word that is true for each topic of the row."""
    answers = []
    for level in LEVELS:
        by = f"by/{name}/" if level == "named" else ""
        topics = [one.format(by=by) for one in ROWS.get(what, SHOWN.get(what, ()))]
        topics = [one if one.startswith("pebble/") else f"{GOOB}/{one}" for one in topics]
        may = {lets_through(name, one, level) if what in ROWS else is_shown(name, one) for one in topics}
        assert len(may) == 1, (what, name, level)
        answers.append(may.pop())
    return {(True, True): "yes", (True, False): "login", (False, True): "named", (False, False): "–"}[tuple(answers)]
