"""The topics that each account gets through at a Zenoh hub, which knows it by its certificate: as at a broker.

The hub and all clients are processes of their own, with TLS; expected by hand, as in test_attempts. Then what a hub
takes from an account of another machine, and what a neighbour's account may do there.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import pytest
import zenoh

from pebble.extensions.fleet import applying, certificates
from pebble.extensions.fleet.folder import ZENOH, Fleet, Server
from pebble.extensions.fleet.hub_access import Access, AccountAdmission, HubAccount, access_control, written
from pebble.extensions.fleet.roles import Account, rules
from pebble.transports import QoS, TlsSettings, ZenohSettings, create
from pebble.transports.topics import matches
from pebble.transports.zenoh import session as zenoh_session
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.hub.records import Retained
from pebble.transports.zenoh.wire import Hello, Stamp, Will, account_of, asked
from tests.ext.fleet import test_attempts
from tests.ext.fleet.test_attempts import ACCOUNTS, FRED, GOOB, TOPICS
from tests.ext.fleet.zenoh_account import Plan
from tests.support import WAIT_S, free_port, until
from tests.transports.forked import Forked
from tests.transports.zenoh_net import HubProcess
from tests.transports.zenoh_net import stranger_at as raw

NAMES = tuple(name for name in ACCOUNTS if name != "hub")  # that is no client
DRIVE, STATE, FLAG = f"{GOOB}/incoming/drive-values", f"{GOOB}/outgoing/status", f"{GOOB}/incoming/flags/mqtt-video"
NAMED = f"{GOOB}/incoming/by/otto/drive-values"


def lets_through(name: str, topic: str, level: str) -> bool:
    """By hand: as at a broker, but for a gateway, whose robots are at the hub, and for a neighbour."""
    if name == "gate":
        return topic.startswith("pebble/robots/") and "/incoming/" in topic
    if name == "near":
        return False  # its robots are at a broker
    if name == "lan":
        return topic.startswith(f"{FRED}/outgoing/")
    return test_attempts.lets_through(name, topic, level)


class Hall:
    """A hub that knows clients by their certificates, and what passes it.

    ``received``: what a local program received, by who sent it.
    """

    def __init__(self, folder: Path, level: Literal["login", "named"]) -> None:
        certificates.init(folder, ["127.0.0.1", "localhost"])
        self.folder, self.endpoint = folder, f"tls/127.0.0.1:{free_port()}"
        self.fleet = Fleet(level=level, brokers=(Server(host="127.0.0.1"),), hubs="here", accounts=ACCOUNTS)
        for name in NAMES:
            certificates.of_account(folder, name)
        applying.write_zenoh(folder, self.fleet)
        tls = self._tls(folder / certificates.SERVER_CERT, folder / certificates.SERVER_KEY)
        self.hub = HubProcess(folder / "run", folder / "journal")
        self.hub.settings = replace(
            self.hub.settings, listen=(self.endpoint,), tls=tls, access=folder / ZENOH, lease_ms=2000
        )
        self.local = ZenohSettings(run_dir=folder / "run", client=True)
        self.received: list[tuple[str, str]] = []

    def settings(self, name: str) -> ZenohSettings:
        """Return the settings of a client with the certificate of this account."""
        place = self.folder / certificates.ACCOUNTS
        tls = self._tls(place / f"{name}.pem", place / f"{name}.key")
        run_dir = self.folder / f"run-{name}"
        return ZenohSettings(run_dir=run_dir, connect=(self.endpoint,), tls=tls, client=True, account=name)

    def _tls(self, certificate: Path, key: Path) -> TlsSettings:
        return TlsSettings(ca_cert=self.folder / certificates.CA_CERT, client_cert=certificate, client_key=key)

    @contextmanager
    def running(self) -> Iterator[Hall]:
        self.hub.start()
        try:
            with create("zenoh", "eye", self.local) as self.eye:
                self.eye.subscribe("#", lambda message: self.received.append((message.payload.decode(), message.topic)))
                yield self
        finally:
            self.hub.end()

    @contextmanager
    def account(self, name: str, **plan: Any) -> Iterator[Forked]:
        text = msgspec.json.encode(Plan(self.settings(name), name, **plan), enc_hook=str).decode()
        process = Forked("tests.ext.fleet.zenoh_account", text)
        try:
            assert process.stdout.readline() == "CONNECTED\n", process.printed
            yield process
        finally:
            process.kill()
            process.wait(WAIT_S)

    def of(self, name: str) -> set[str]:
        return {topic for sender, topic in self.received if sender == name}

    def retained(self) -> set[str]:
        """What a client receives that comes now."""
        received: set[str] = set()
        with create("zenoh", "late", self.local) as reader:
            reader.subscribe(f"{GOOB}/#", lambda message: received.add(message.topic), direct=True)
        return received

    def mark(self, text: str) -> None:
        """Wait until all that came before has been received: a stop of a client that only stops comes through."""
        with self.account("dora", topics=[f"a/b/{text}/incoming/estop"]) as dora:
            play(dora)
            assert until(lambda: f"a/b/{text}/incoming/estop" in self.of("dora"))


def play(process: Forked) -> list[str]:
    """Have an account publish all; returns what it has received until then."""
    process.stdin.write("\n")
    process.stdin.flush()
    found: list[str] = json.loads(process.stdout.readline())
    return found


@pytest.fixture(scope="module", params=[pytest.param("login", marks=pytest.mark.thorough), "named"])
def hall(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    with Hall(tmp_path_factory.mktemp("hall") / "hall", request.param).running() as hall:
        yield hall


def test_each_account_writes_what_it_may_and_nothing_else(hall: Hall) -> None:
    wrong, expected = [], {}

    def writes_all(name: str, client: Forked) -> bool:
        play(client)
        return until(lambda: expected[name] <= hall.of(name), 2)

    for name in NAMES:
        expected[name] = {topic for topic in TOPICS if lets_through(name, topic, hall.fleet.level)}
        with hall.account(name, topics=TOPICS) as client:
            # A drive command that a busy machine holds up is too old for the hub: that is sent again.
            arrived = until(lambda name=name, client=client: writes_all(name, client))
            assert arrived, (name, expected[name] - hall.of(name))
    hall.mark("written")
    for name in set(NAMES) - {"dora"}:
        wrong += [(name, topic) for topic in sorted(hall.of(name) ^ expected[name])]
    assert wrong == []
    assert len(NAMES) * len(TOPICS) > 1_000


def test_each_account_reads_what_it_may_and_nothing_else(hall: Hall) -> None:
    """Also what is retained, and whatever it subscribes to."""
    public = {STATE, FLAG}
    everything = {*public, DRIVE, NAMED}
    expected = dict.fromkeys(NAMES, public) | {"goob": everything, "gate": everything, "lan": {STATE}}
    expected |= {name: set() for name in ("fred", "lamp", "near", "exp")}
    found = {}
    for topic in public:
        hall.eye.publish(topic, b"before", qos=QoS.DELIVERED, retain=True)
    filters = ["#", "+/+/+/#", "+/+/+/outgoing/#", "+/+/+/incoming/flags/#", f"{GOOB}/#", *everything]
    for name in NAMES:
        wanted = {f"{topic} False" for topic in expected[name]} | {f"{topic} True" for topic in expected[name] & public}

        def reads_what_it_may(client: Forked, wanted: set[str] = wanted) -> bool:
            for topic in everything:
                hall.eye.publish(topic, b"live", qos=QoS.DELIVERED)
            return set(play(client)) == wanted

        with hall.account(name, filters=filters) as client:
            found[name] = until(lambda client=client: reads_what_it_may(client)) and reads_what_it_may(client)
    for topic in public:
        hall.eye.publish(topic, b"", qos=QoS.DELIVERED, retain=True)
    assert found == dict.fromkeys(NAMES, True)


def test_only_state_and_flags_are_retained_and_never_under_a_name(hall: Hall) -> None:
    flags = {"otto": {FLAG}, "mia": {FLAG}} if hall.fleet.level == "login" else {}
    flags["gate"] = {FLAG}
    expected = {"otto": set(), "mia": set(), "fred": set(), "goob": {DRIVE, STATE, FLAG}} | flags
    topics = [DRIVE, NAMED, NAMED.replace("otto", "mia"), STATE, FLAG, f"{GOOB}/incoming/by/otto/flags/mqtt-video"]
    for name in expected:
        with hall.account(name, topics=topics, retain=True) as client:
            play(client)
            hall.mark(f"retained-{name}")
            assert until(lambda name=name: hall.retained() == expected[name]), (name, hall.retained())
        for topic in topics:
            hall.eye.publish(topic, b"", qos=QoS.DELIVERED, retain=True)


def test_a_robot_leaves_a_will_for_itself_and_no_one_else_leaves_any(hall: Hall) -> None:
    name_of_will = {
        **dict.fromkeys(("vera", "otto"), f"{GOOB}/incoming/{'by/otto/' * (hall.fleet.level == 'named')}drive-values"),
        "mia": "pebble/servers/x1/outgoing/bridge-probe",
        "sam": f"{GOOB}/incoming/estop",
        "fred": STATE,
        "goob": DRIVE,
        "gate": FLAG,
        "lamp": "pebble/lamps/lamp/outgoing/online",
    }
    hall.received.clear()
    for name, topic in name_of_will.items():
        with hall.account(name, will=topic):
            pass  # killed
    assert until(lambda: name_of_will["lamp"] in hall.of("lamp"))
    hall.mark("wills")
    assert {topic for name in name_of_will for topic in hall.of(name)} == {name_of_will["lamp"]}


def test_a_program_with_a_certificate_poses_as_no_one_else(hall: Hall) -> None:
    """Neither as another account, nor as the hub, nor as a program of the robot."""
    received: list[str] = []
    local = zenoh_session.session_config(hall.local, "client", listen=[], connect=[hall.folder / "run" / "hub.sock"])
    seen = zenoh_session.open_session(local)
    take = zenoh.handlers.Callback(lambda sample: received.append(str(sample.key_expr)), indirect=False)
    for prefix in (wire.UP, wire.LIVE):
        seen.liveliness().declare_subscriber(f"{prefix}*", take)
    will = wire.Will(STATE, b"otto", QoS.DELIVERED, False, "robot")
    hello = partial(wire.Hello, retained_count=0, will=None, own={})
    with raw(hall.settings("otto")) as session:

        def answers(key: str, payload: object) -> int:
            return len([one for one in session.get(key, payload=wire.encode(payload), timeout=1) if one.ok])

        named, other = wire.asked(wire.HELLO, "otto"), wire.asked(wire.HELLO, "goob")
        assert answers(named, hello(name="otto~1")) == 1
        refused = {
            "another's key": answers(other, hello(name="goob~1", will=will)),
            "no account's": answers(wire.HELLO, hello(name="otto~1")),
            "all at once": answers(f"{wire.HELLO}/*", hello(name="otto~1")),
            "another's name": answers(named, hello(name="goob~1")),
            "a local name": answers(named, hello(name="0badf00d")),
            "another's will": answers(wire.asked(wire.BYE, "otto"), "goob~1"),
            "who is there": len(list(session.liveliness().get("@live/**", timeout=1))),
            "what is retained": len(list(session.get(f"{wire.RETAINED}**", timeout=1))),
        }
        assert refused == dict.fromkeys(refused, 0)
        posing = [wire.UP + "otto", wire.LIVE + "0badf00d", wire.LIVE + "goob~1"]
        tokens = [session.liveliness().declare_token(key) for key in (*posing, wire.LIVE + "otto~1")]
        asked: list[str] = []
        for key in (wire.HELLO, wire.SYNC + "*", f"{wire.RETAINED}**"):
            session.declare_queryable(key, zenoh.handlers.Callback(lambda one: asked.append(str(one)), indirect=False))
        assert until(lambda: wire.LIVE + "otto~1" in received)
        list(seen.get(wire.SYNC + "*", timeout=0.3, target=zenoh.QueryTarget.ALL))
        assert (asked, [one for one in received if one in posing]) == ([], [])
        del tokens
    zenoh_session.close_session(seen)


def test_who_claims_another_machines_clock_holds_up_nothing_of_it(hall: Hall) -> None:
    """A message is late that is older than all others of its machine; and every sender can claim any machine."""
    by = "by/{}/" if hall.fleet.level == "named" else ""
    driving, looking = (
        f"{GOOB}/incoming/{by.format(name)}{metric}"
        for name, metric in (("otto", "drive-values"), ("vera", "front-camera"))
    )
    received: list[str] = []

    def stamp(ahead_s: float) -> bytes:
        return struct.pack(">BIQ", 1, 0x1234, wire.since_boot_ns() + int(1e9 * ahead_s))

    with (
        create("zenoh", "bridge", hall.settings("goob")) as goob,
        raw(hall.settings("otto")) as otto,
        raw(hall.settings("vera")) as vera,
    ):
        goob.subscribe(f"{GOOB}/incoming/#", lambda message: received.append(message.topic), direct=True)
        for turn in range(40):
            otto.put(driving, b"{}", attachment=stamp(0.0))
            assert until(lambda n=turn: received.count(driving) > n), (turn, goob.counters["late"])
            vera.put(looking, b"{}", attachment=stamp(10.0))
            assert until(lambda n=turn: received.count(looking) > n)


def test_what_is_retained_is_one_key(hall: Hall) -> None:
    """A robot's own base has keys with wildcards: what is retained there no one could remove."""
    stamp = wire.Stamp(QoS.DELIVERED, 0, "goob~1").pack()
    with raw(hall.settings("goob")) as goob:
        goob.put(f"{wire.RETAINED}{GOOB}/**", b"goob", attachment=stamp)
        goob.put(f"{wire.RETAINED}{STATE}", b"goob", attachment=stamp)
        assert until(lambda: STATE in hall.retained())
        assert hall.retained() == {STATE}
        goob.put(f"{wire.RETAINED}{STATE}", b"", attachment=stamp)
        assert until(lambda: not hall.retained())


@pytest.mark.parametrize(("name", "what"), [("vera", "hellos"), ("vera", "queries"), ("fred", "states")])
def test_what_an_account_asks_or_retains_holds_up_no_one_who_comes(hall: Hall, name: str, what: str) -> None:
    """A hub had ten thousand hellos of a viewer wait, 2 GB of them, and a client that came heard nothing meanwhile."""
    hall.eye.publish(STATE, b"before", qos=QoS.DELIVERED, retain=True)
    before = memory(hall.hub.pid)
    with hall.account(name, flood=what) as flooding:
        assert flooding.stdout.readline() == "flows\n"
        for number in range(5):
            received: list[str] = []
            with create("zenoh", f"late-{number}", hall.settings("otto")) as late:
                late.subscribe(f"{GOOB}/outgoing/#", lambda message: received.append(message.topic))  # noqa: B023
                assert until(lambda: received), number  # noqa: B023
    assert memory(hall.hub.pid) - before < 300
    hall.eye.publish(STATE, b"", qos=QoS.DELIVERED, retain=True)


def memory(pid: int) -> int:
    """Return the MB that a process has in memory."""
    (line,) = [one for one in Path(f"/proc/{pid}/status").read_text().splitlines() if one.startswith("VmRSS")]
    return int(line.split()[1]) // 1024


@pytest.mark.parametrize("what", ["removed", "another role"])
def test_a_change_counts_for_sessions_that_are_there(hall: Hall, what: str) -> None:
    topic = f"{GOOB}/incoming/{'by/otto/' * (hall.fleet.level == 'named')}drive-values"
    account = Account(roles=("viewer",))
    after = {
        "removed": hall.fleet.without("otto"),
        "another role": hall.fleet.without("otto").with_account("otto", account),
    }
    with hall.account("otto", topics=[topic]) as otto, hall.account("vera", topics=[f"{GOOB}/incoming/estop"]) as vera:

        def still_drives() -> bool:
            """A message of the other account comes after his, so that his has passed by then, or never will."""
            hall.received.clear()
            play(otto)
            assert until(lambda: play(vera) == [] and hall.of("vera"))
            return topic in hall.of("otto")

        assert until(still_drives)
        applying.write_zenoh(hall.folder, after[what])
        assert until(lambda: not any(still_drives() for _ in range(5)))
    applying.write_zenoh(hall.folder, hall.fleet)


# -- what a hub takes from an account of another machine


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


#: Topics at the hub, and whether goob's account writes them and reads them.
OF_GOOB = {
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
    account = Account(roles=("neighbour",), bases=(GOOB,))
    held = rules("goob-lan", account, level, at_hub=True)
    found = {
        topic: tuple(
            any(matches(rule.filter, topic) for rule in held if rule.access == one) for one in ("write", "read")
        )
        for topic in OF_GOOB
    }
    assert found == OF_GOOB
    assert rules("goob-lan", account, level) == (), "at a broker it is nothing"
