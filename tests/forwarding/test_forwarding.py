"""The small parts that bridge and mirror are made of, without any connection."""

from __future__ import annotations

import itertools
import tracemalloc
from collections.abc import Callable
from math import inf
from pathlib import Path

import pytest
from msgspec import UNSET

from pebble.config import parse
from pebble.contract import DRIVE, Kind, codec
from pebble.contract.codec import MAX_COMMAND_BYTES
from pebble.forwarding import loopback_filter as loopback_filter
from pebble.forwarding import reconciliation as reconciliation_module
from pebble.forwarding.admission import MAX_ACTIONS, MAX_UNKNOWN_COMMANDS, MAX_UNKNOWN_FLAGS, Admission
from pebble.forwarding.event_buffer import RESEND_S, EventBuffer
from pebble.forwarding.forwarder import Forwarder
from pebble.forwarding.loopback_filter import EXPIRY_S, LoopbackFilter
from pebble.forwarding.probes import Probes
from pebble.forwarding.reconciliation import Reconciliation, Resolution
from pebble.forwarding.routing import MIRROR, TABLE_A1, Drop, Forward, Rules, Side
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message, QoS, State, clock
from pebble.transports.counters import Counters
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.services.mqtt_bridge.bridge_rig import BASE, is_probe, make_config
from tests.support import Clock

LOCAL, REMOTE = Side.LOCAL, Side.REMOTE


def grows_no_more(fill: Callable[[int], None], number: int) -> bool:
    """Whether twice that number takes hardly more memory."""
    sizes = []
    tracemalloc.start()
    for half in range(2):
        for one in range(half * number, (half + 1) * number):
            fill(one)
        sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    return sizes[1] < 1.05 * sizes[0] + 10_000


class TestLoopbackFilter:
    @pytest.mark.parametrize(
        ("history", "own"),
        [
            ("t+1 t+0 t+1 t?1 t?2 t?0 t?1 t?1", "yes no yes yes no"),  # not those of others
            ("t+1 t+0 u?1 t?0 t?1", "no yes no"),  # topics do not mix, and lost ones are passed over
            ("t+1 late t?1", "no"),
            ("t+1 unsent t?1", "no"),  # what was not sent does not come back
        ],
    )
    def test_histories(self, history: str, own: str) -> None:
        """A topic and a payload: ``+`` is to be sent, ``?`` was received."""
        clock, found = Clock(), list[bool]()
        loopback = LoopbackFilter(clock)
        for word in history.split():
            match word[1], word[2:].encode():
                case "+", payload:
                    loopback.expect(word[0], payload)
                case "?", payload:
                    found.append(loopback.is_echo(word[0], payload))
                case "n", _:
                    loopback.forget("t")
                case _:
                    clock.now += EXPIRY_S + 0.1
        assert found == [word == "yes" for word in own.split()]

    def test_many_topics_take_no_memory(self) -> None:
        loopback = LoopbackFilter(Clock())
        for number in range(2 * loopback_filter.TOPICS):
            loopback.expect(f"flag{number}", b"1")
        assert len(loopback.out) == loopback_filter.TOPICS
        assert all(
            loopback.is_echo(f"flag{number}", b"1")
            for number in range(loopback_filter.TOPICS, 2 * loopback_filter.TOPICS)
        )
        loopback.expect("t", b"1")
        loopback.forget("t")
        assert not loopback.out
        for _ in range(loopback_filter.MESSAGES):  # what has come back does not count
            loopback.expect("t", b"1")
            assert loopback.is_echo("t", b"1")


def test_a_copied_probe_counts_once() -> None:
    probes = Probes()
    assert [probes.announce(b"1"), probes.see(b"1"), probes.see(b"1")] == [False, True, False]
    assert [probes.see(b"2"), probes.announce(b"2"), probes.announce(b"2")] == [False, True, False]


class TestAdmission:
    SUBJECTS = Subjects(make_config())

    def refuse(self, admission: Admission, topic: str, payload: bytes = b"1", side: Side = REMOTE) -> Drop | None:
        subject = self.SUBJECTS[f"{BASE}/{topic}"]
        assert subject is not None
        return admission.refuse(side, subject, Message(f"{BASE}/{topic}", payload, retain=True), f"{BASE}/{topic}")

    def test_unknown_flags_are_bounded_and_a_removed_one_makes_room(self) -> None:
        admission = Admission()
        first = [f"incoming/flags/f{number}" for number in range(MAX_UNKNOWN_FLAGS)]
        assert [self.refuse(admission, topic) for topic in first] == [None] * MAX_UNKNOWN_FLAGS
        assert self.refuse(admission, "incoming/flags/more") is Drop.TOO_MANY
        assert [self.refuse(admission, topic, b"2") for topic in first] == [None] * MAX_UNKNOWN_FLAGS
        assert self.refuse(admission, "incoming/flags/mqtt-video") is None  # of the contract
        assert self.refuse(admission, "incoming/flags/f7", b"") is None
        assert self.refuse(admission, "incoming/flags/more") is None
        assert self.refuse(admission, "incoming/flags/f7") is Drop.TOO_MANY

    def test_flags_of_the_robot_itself_are_always_admitted_and_count(self) -> None:
        admission = Admission()
        assert self.refuse(admission, "incoming/flags/f0", b"") is Drop.KNOWN, "it has none to be removed"
        assert self.refuse(admission, "incoming/flags/mqtt-video", b"") is None
        for number in range(MAX_UNKNOWN_FLAGS + 5):
            assert self.refuse(admission, f"incoming/flags/f{number}", side=LOCAL) is None
        assert self.refuse(admission, "incoming/flags/f1") is None
        assert self.refuse(admission, "incoming/flags/more") is Drop.TOO_MANY

    def test_one_flag_too_many_need_not_be_read(self) -> None:
        admission = Admission()
        for number in range(MAX_UNKNOWN_FLAGS):
            assert not admission.refuses_flag(f"{BASE}/incoming/flags/f{number}".encode())
            self.refuse(admission, f"incoming/flags/f{number}")
        assert not admission.refuses_flag(f"{BASE}/incoming/flags/f0".encode())
        assert admission.refuses_flag(f"{BASE}/incoming/flags/more".encode())
        assert admission.refuses_flag(f"{BASE}/incoming/flags/".encode() + b"\xff")

    @pytest.mark.parametrize(
        ("topic", "kind"),
        [
            ("incoming/unknown", Kind.COMMAND),
            ("incoming/flags/mine", Kind.FLAG),
            ("incoming/flags/mqtt-video", None),
            ("incoming/estop", None),
            ("outgoing/unknown", None),
        ],
    )
    def test_topics_that_the_contract_does_not_name_are_known_by_their_beginning(
        self, topic: str, kind: Kind | None
    ) -> None:
        assert self.SUBJECTS.invented(f"{BASE}/{topic}".encode()) is kind
        assert self.SUBJECTS.invented(f"pebble/robots/another/{topic}".encode()) is None

    @pytest.mark.parametrize(
        ("side", "topic", "refused"),
        [
            *((REMOTE, f"incoming/{metric}", Drop.TOO_LARGE) for metric in ("drive-values", "flags/mqtt-video")),
            (REMOTE, "incoming/estop", None),  # any payload is one
            (LOCAL, "outgoing/map", None),
        ],
    )
    def test_messages_to_a_robot_are_bounded_in_size(self, side: Side, topic: str, refused: Drop | None) -> None:
        admission = Admission()
        assert self.refuse(admission, topic, bytes(MAX_COMMAND_BYTES), side) is None
        assert self.refuse(admission, topic, bytes(MAX_COMMAND_BYTES + 1), side) is refused

    @pytest.mark.parametrize(
        ("topics", "most"),
        [(["flags/reboot"], MAX_ACTIONS), ([f"mine/{number}" for number in range(9)], MAX_UNKNOWN_COMMANDS)],
        ids=["actions", "unknown commands"],
    )
    def test_what_no_robot_needs_often_is_bounded_in_each_second(self, topics: list[str], most: int) -> None:
        clock = Clock()
        admission, several = Admission(clock), itertools.cycle(topics)
        for _ in range(2):
            found = [self.refuse(admission, f"incoming/{next(several)}") for _ in range(most + 5)]
            assert found == [None] * most + [Drop.TOO_OFTEN] * 5
            assert self.refuse(admission, "incoming/drive-values") is None
            assert self.refuse(admission, "incoming/flags/git-pull") is None
            assert self.refuse(admission, f"incoming/{topics[0]}", b" \t" * 16) is None  # a probe
            assert self.refuse(admission, f"incoming/{topics[0]}", side=LOCAL) is None
            clock.now += 1


class TestReconciliation:
    """Table: what each side publishes, and the resolutions. The remote side is the winner, as on the bridge."""

    @pytest.mark.parametrize(
        ("history", "resolutions"),
        [
            ("L:a", ["hold"]),
            ("R:b L:a", ["pass", "correct"]),
            ("R:a L:a", ["pass", "known"]),
            ("L:a R:b", ["hold", "pass"]),
            ("l:a R:a", ["pass", "known"]),
            ("l:a R:b", ["pass", "pass"]),
            ("sync L:a", ["pass"]),
            ("R:a x:b R:a", ["pass", "pass", "overtaken"]),
            ("R:a x:b sync R:a", ["pass", "pass", "pass"]),
            ("R:a x:b r:c R:d", ["pass", "pass", "pass", "pass"]),
            ("r:a r:b B:a", ["pass", "pass", "correct"]),
            ("l:a l:b A:a", ["pass", "pass", "correct"]),
            ("l:a l:b A:c", ["pass", "pass", "pass"]),
            ("l:a l:b L:a", ["pass", "pass", "pass"]),
            ("L:a sync R:b", ["hold", "restore"]),
            ("L:a sync l:c R:b", ["hold", "pass", "overtaken"]),
            ("L:a sync l:c r:d R:b", ["hold", "pass", "pass", "pass"]),
            ("sync l:a R:b again R:c", ["pass", "overtaken", "pass"]),
            ("L:a sync r:b R:c", ["hold", "pass", "pass"]),
            ("r:a r:b B:c", ["pass", "pass", "pass"]),
            ("r:a r:b r:a B:b", ["pass", "pass", "pass", "correct"]),
            ("r:a " + "r:b " * 9 + "B:a", [*["pass"] * 10, "correct"]),
        ],
    )
    def test_resolutions(self, history: str, resolutions: list[str]) -> None:
        """L, R: retained messages. l, r: live ones. x: a live local one while the remote side is away.

        again: the remote connection begins anew. A, B: a retained message of the local side, and of the remote one,
        which has gone back.
        """
        reconciliation = Reconciliation(REMOTE)
        given = []
        for word in history.split():
            if word in ("sync", "again"):
                (reconciliation.synchronize if word == "sync" else reconciliation.begin)(REMOTE)
                continue
            who, _, payload = word.partition(":")
            side = REMOTE if who in "RrB" else LOCAL
            resolution = reconciliation.receive(
                side, "t", payload.encode(), retained=who.isupper(), other_away=who == "x", went_back=who in "AB"
            )
            given.append(resolution)
        assert given == [Resolution[name.upper()] for name in resolutions]

    @pytest.mark.parametrize(
        ("winner", "history", "side", "sent"),
        [
            (REMOTE, "L:a", REMOTE, ["a"]),  # a held copy fills what the winner does not know
            (REMOTE, "L:a R:b to-L:b", REMOTE, []),
            (REMOTE, "L:a R:b to-L:b", LOCAL, []),
            (REMOTE, "r:new begin", REMOTE, ["new"]),  # a side that lost a value receives it
            (REMOTE, "r:new begin R:new", REMOTE, []),
            (LOCAL, "l:a to-R:a l:", REMOTE, [""]),  # and so does one that missed a removal
            (REMOTE, "l:a l: begin", REMOTE, []),  # what was removed is not brought back
        ],
    )
    def test_what_a_side_receives_when_it_is_there_again(
        self, winner: Side, history: str, side: Side, sent: list[str]
    ) -> None:
        """to-L, to-R: what was published there. begin: the remote connection begins anew."""
        reconciliation = Reconciliation(winner)
        for word in history.split():
            who, _, payload = word.partition(":")
            place = REMOTE if who[-1] in "Rr" else LOCAL
            if who == "begin":
                reconciliation.begin(REMOTE)
            elif who.startswith("to-"):
                reconciliation.note_published(place, "t", payload.encode())
            else:
                reconciliation.receive(place, "t", payload.encode(), retained=who.isupper())
        assert reconciliation.synchronize(side) == [(side, "t", payload.encode()) for payload in sent]

    @pytest.mark.parametrize(("size", "number"), [(1, 1024), (1 << 19, 40)])
    def test_its_memory_is_bounded_in_topics_and_in_bytes(
        self, monkeypatch: pytest.MonkeyPatch, size: int, number: int
    ) -> None:
        monkeypatch.setattr(reconciliation_module, "TOPICS", 512)
        reconciliation = Reconciliation(REMOTE)

        def fill(number: int) -> None:
            value = bytes(size)
            reconciliation.receive(LOCAL, f"held/{number}", value, retained=True)
            reconciliation.receive(REMOTE, f"said/{number}", value, retained=False)
            reconciliation.note_published(LOCAL, f"said/{number}", value)

        assert grows_no_more(fill, number)
        assert (reconciliation.value("said/0"), reconciliation.value(f"said/{2 * number - 1}")) == (None, bytes(size))
        assert len(reconciliation.synchronize(REMOTE)) <= min(number, 2 * 512)


class Wire(MemoryTransport):
    """Takes what it is given while it is up, and remembers it."""

    def __init__(self) -> None:
        super().__init__("wire", MemoryHub())
        self.up = True
        self.sent: list[bytes] = []

    @property
    def state(self) -> State:
        return State.CONNECTED if self.up else State.CONNECTING

    def publish(self, topic: str, payload: bytes, **_options: object) -> bool:
        self.sent += [payload] if self.up else []
        return self.up


@pytest.fixture
def local() -> Wire:
    return Wire()


@pytest.fixture
def remote() -> Wire:
    return Wire()


@pytest.fixture(name="clock")
def a_clock() -> Clock:
    return Clock()


@pytest.fixture
def waiting(local: Wire, remote: Wire, clock: Clock) -> Forwarder:
    return Forwarder(Subjects(make_config()), TABLE_A1, {LOCAL: local, REMOTE: remote}, winner=REMOTE, clock=clock)


@pytest.fixture
def forwarder(waiting: Forwarder) -> Forwarder:
    waiting.open()
    return waiting


def test_an_event_buffer_repeats_what_a_dying_link_may_have_swallowed(remote: Wire, clock: Clock) -> None:
    events = EventBuffer(remote, Counters(), clock=clock)
    first, second, third, fourth = (Message("t", b"%d" % number, QoS.DELIVERED) for number in range(1, 5))
    events.send(first)
    clock.now += RESEND_S
    events.send(second)
    clock.now += RESEND_S - 0.1
    remote.up = False
    events.watch(State.CONNECTING)
    clock.now += 60
    events.send(third)
    remote.up = True
    events.send(fourth)  # before the flush: waits its turn
    events.flush()
    assert remote.sent == [b"1", b"2", b"2", b"3", b"4"]


class TestGate:
    """An event that arrives while the gate opens or shuts: what was waiting may have been sent, or cleared, already."""

    @pytest.mark.parametrize(("change", "sent"), [(Forwarder.open, [b"1"]), (Forwarder.shut, [])])
    def test_it_is_sent_at_once_or_never(
        self,
        waiting: Forwarder,
        remote: Wire,
        monkeypatch: pytest.MonkeyPatch,
        change: Callable[[Forwarder], None],
        sent: list[bytes],
    ) -> None:
        """The gate changes just before the event waits."""
        hold = EventBuffer.hold
        monkeypatch.setattr(EventBuffer, "hold", lambda *event: (change(waiting), hold(*event)))
        waiting.receive(LOCAL, Message(f"{BASE}/outgoing/weather", b"1", QoS.DELIVERED))
        assert remote.sent == sent
        waiting.rearm()
        waiting.open()
        assert remote.sent == sent


class TestLate:
    """What has waited in a process that stood still, before it was forwarded."""

    @pytest.mark.parametrize(
        ("metric", "payload", "limit_s"),
        [
            ("drive-values", b'{"z": 1}', 0.5),
            ("drive-values", b"{", 0.5),
            ("drive-values", b'\xef\xbb\xbf{"z": "0", "x": "no"}\0', inf),  # a stop must arrive
            ("estop", b"{}", inf),
            ("estop-reset", b'{"boot": "a", "count": 1}', 0.5),
            ("unknown", b"1", 0.5),
            ("soundboard-command", b'{"action": "play", "file": "a"}', 2.0),
            ("soundboard-command", b'{"enabled": false}', inf),
            ("autonomy-command", b'{"action": "start", "enabled": false, "file": "a"}', 0.5),
            ("autonomy-command", b'{"action": "Stop", "file": "a"}', inf),
            ("outlets/lamp/power", b'{"on": true}', 0.5),
            ("outlets/lamp/power", b'{"on": false}\r\n\0', inf),
            ("front-camera", b"false\0", inf),
            ("flags/reboot", b"true", 0.5),
            ("flags/mqtt-video", b"true", inf),
        ],
    )
    def test_what_happens_once_is_dropped(
        self, forwarder: Forwarder, local: Wire, metric: str, payload: bytes, limit_s: float
    ) -> None:
        now, endless = clock.since_boot(), limit_s == inf
        for waiting_since in (now - min(limit_s, 100) - 0.1, now - min(limit_s, 100) + 0.2):
            forwarder.receive(
                REMOTE, Message(f"{BASE}/incoming/{metric}", payload, QoS.DELIVERED, waiting_since=waiting_since)
            )
        assert [one for one in local.sent if not is_probe(one)] == [payload] * (1 + endless)
        assert forwarder.counters[f"remote: {Drop.LATE.value}"] == (not endless)


class TestSignatures:
    """A script's signature counts only from programs on the robot."""

    PERSONS = (
        *(b'{"z":0.5}', b'{"z":0.5,"source":"autonomy-page","run":7}', b"{", b'{"z":0.5,"source":"p\\u0061ge"}'),
        b'{"z":0.5,"value":{"z":0.1,"source":"page"},"source":"autonomy"}',
    )
    MOVING = (
        *(b'{"z":0.5,"source":"autonomy","run":1', b'{"y":1e-9,"source":"autonomy","run":"7"}'),
        *(b'{"z":0.5,"\\u0073ource":"\\u0061utonomy","run":1}', b'{"v\\u0061lue":{"z":0.5,"source":"autonomy"}}'),
        *(b'{"z":0.5,"sour\\ce":"autonom\\y","run":1}', b'{"z":0.5,"source":"autonomy","run":1}\0'),  # boards read it
        b'\xef\xbb\xbf{"z":0.5,"source":"page","source":"autonomy","run":1}',
    )
    ZEROS = (b'"7"', b'1,"valid_ms":0', b'1,"value":{"source":"autonomy"}')

    @pytest.fixture
    def subjects(self) -> Subjects:
        line = {"enabled": True, "serial": {"port": "/dev/ttyACM0"}}
        other = {**line, "serial": {"port": "/dev/ttyACM1"}, "topics": {"drive_values": "another/{base}"}}
        services = {"serial_mcu_bridge": {**line, "instances": {"arm": other}}}
        return Subjects(parse({"robot": {"id": "rover"}, "services": services}, folder=Path.cwd(), env={}))

    @staticmethod
    def passed(subjects: Subjects, payload: bytes, rules: Rules = TABLE_A1) -> tuple[list[bytes], Forwarder]:
        """What passes to the robot on both of its drive topics, and the forwarder."""
        local = Wire()
        forwarder = Forwarder(subjects, rules, {LOCAL: local, REMOTE: Wire()}, winner=REMOTE, clock=Clock())
        forwarder.open()
        topics = subjects.topics(DRIVE)
        assert len(topics) == 2
        for topic in topics:
            forwarder.receive(REMOTE, Message(topic, payload, QoS.DELIVERED))
        return local.sent, forwarder

    @pytest.mark.parametrize("payload", PERSONS)
    def test_a_persons_command_passes_as_it_is(self, subjects: Subjects, payload: bytes) -> None:
        assert self.passed(subjects, payload)[0] == [payload, payload]

    @pytest.mark.parametrize("payload", MOVING)
    def test_what_moves_anything_does_not_pass(self, subjects: Subjects, payload: bytes) -> None:
        sent, forwarder = self.passed(subjects, payload)
        assert (sent, forwarder.dropped()["signed"]) == ([], 2)

    @pytest.mark.parametrize("run", ZEROS)
    def test_a_zero_stops_as_a_persons(self, subjects: Subjects, run: bytes) -> None:
        sent, forwarder = self.passed(subjects, b'{"x":0,"z":0,"source":"\\u0061utonomy","run":' + run + b"}")
        drives = [codec.decode(DRIVE, raw) for raw in sent]
        assert [(drive.moves, drive.source, drive.run) for drive in drives] == [(False, UNSET, UNSET)] * 2
        assert {b"valid_ms" in raw for raw in sent} == {b"valid_ms" in run}
        assert forwarder.counters["remote: zeros of a script, passed as a person's"] == 2

    def test_the_broker_of_a_mirror_is_on_the_robot(self, subjects: Subjects) -> None:
        for payload in (b'{"z":0.5,"source":"autonomy","run":1}', b'{"source":"autonomy","run":1}'):
            assert self.passed(subjects, payload, MIRROR)[0] == [payload, payload]


class TestStops:
    """Until when a stop with the retain flag counts as an old one, on a connection that marks live ones, too."""

    STOP = Message(f"{BASE}/incoming/estop", b"{}", QoS.DELIVERED, True, True)
    FLAG = Message(f"{BASE}/incoming/flags/mqtt-video", b"true", QoS.DELIVERED, True, True)

    @pytest.fixture
    def remote(self) -> Wire:
        wire = Wire()
        wire.as_published = True
        return wire

    def first_pass(self, forwarder: Forwarder, clock: Clock, *others: Message) -> float:
        """How long stops are old, if one comes every 0.125 s, after ``others``."""
        began = clock.now
        while True:
            for other in others:
                forwarder.receive(REMOTE, other)
            if isinstance(forwarder.receive(REMOTE, self.STOP).outcome, Forward):
                return clock.now - began
            clock.now += 0.125

    def test_before_the_subscription_is_complete(self, forwarder: Forwarder, clock: Clock) -> None:
        clock.now += 60
        assert forwarder.receive(REMOTE, self.STOP).outcome is Drop.STALE
        forwarder.subscribed(REMOTE)
        assert self.first_pass(forwarder, clock) == pytest.approx(0.125)
        forwarder.sides[REMOTE].subscribing()
        assert forwarder.receive(REMOTE, self.STOP).outcome is Drop.STALE
        forwarder.subscribed(REMOTE)
        assert self.first_pass(forwarder, clock) == pytest.approx(0.125)
        forwarder.sides[REMOTE].watch(State.CONNECTING)
        assert forwarder.receive(REMOTE, self.STOP).outcome is Drop.STALE

    def test_while_other_retained_messages_arrive(self, forwarder: Forwarder, clock: Clock) -> None:
        forwarder.receive(REMOTE, self.FLAG)
        clock.now += 0.25
        forwarder.subscribed(REMOTE)
        assert self.first_pass(forwarder, clock) == pytest.approx(0.25)
        forwarder.receive(REMOTE, self.FLAG)  # a live one, long after
        assert isinstance(forwarder.receive(REMOTE, self.STOP).outcome, Forward)

    def test_not_for_ever(self, forwarder: Forwarder, clock: Clock) -> None:
        forwarder.subscribed(REMOTE)
        assert self.first_pass(forwarder, clock, self.FLAG) == pytest.approx(10.0)

    def test_one_without_the_flag_always_passes(self, forwarder: Forwarder) -> None:
        live = Message(self.STOP.topic, b"{}", QoS.DELIVERED, retain_requested=False)
        assert forwarder.receive(REMOTE, live).outcome == Forward(QoS.DELIVERED, retain=False, urgent=True)

    def test_a_flag_that_a_broker_sends_late_is_older_than_what_was_seen(self, forwarder: Forwarder) -> None:
        transport = forwarder.sides[REMOTE].transport
        transport.as_published, transport.policy.delivers_late = False, True
        assert isinstance(forwarder.receive(REMOTE, Message(self.FLAG.topic, b"false", QoS.DELIVERED)).outcome, Forward)
        assert forwarder.receive(REMOTE, self.FLAG).outcome is Drop.KNOWN
