"""Each promise that a broker breaks is found, and named; whole brokers are judged as docs/brokers.md says."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from pebble.check_result import CheckResult, State
from pebble.extensions.checks.broker.login_attempt import reached
from pebble.extensions.checks.broker.probes import PROBES, Probe, judge
from pebble.extensions.checks.check import run
from pebble.transports import MqttSettings
from pebble.transports.mqtt.transport import MqttTransport
from tests.commands.command_line import Run, running
from tests.kit.mqtt_bytes import packet
from tests.sparing_broker import SparingBroker, packet_of
from tests.support import ROOT, WAIT_S, Broker, further, until
from tests.transports.brokers import MAKERS
from tests.transports.net import Received

CONNECT, PUBLISH, SUBSCRIBE, PINGREQ, PINGRESP, DISCONNECT = 0x10, 0x30, 0x80, 0xC0, 0xD0, 0xE0
RETAIN, BRIDGE = 0x01, 0x80
_LEVEL = 6  # its place in the body of a CONNECT


Change = Callable[[int, bytes], bytes]


@dataclass(frozen=True)
class Fault:
    """A fault of a broker: what goes on in place of each packet, to the broker (``up``) and to the client (``down``).

    ``answer``: what the client gets for a packet at once. ``ends``: what the broker gets when the connection is lost,
    which it notices after ``late_s``.
    """

    up: Change = packet
    down: Change = packet
    answer: Callable[[int], bytes] = lambda _: b""
    ends: bytes = b""
    late_s: float = 0.0


def kind(first: int) -> int:
    return first & 0xF0


def hidden(first: int, body: bytes) -> bytes:
    """A retained message looks live."""
    return packet(first & ~RETAIN if kind(first) == PUBLISH else first, body)


_retained: list[bytes] = []


def repeated(first: int, body: bytes) -> bytes:
    """A retained message comes a second time, after a newer one."""
    again, sent = b"".join(_retained), packet(first, body)
    _retained[:] = [sent] if kind(first) == PUBLISH and first & RETAIN else []
    return sent if _retained else sent + again


_served: set[bytes] = set()


def delayed(first: int, body: bytes) -> bytes:
    """Nothing is passed on for a while after the first subscription of each probe."""
    base = body[4:][: len("pebble/doctor/") + 16]
    if kind(first) == SUBSCRIBE and base not in _served:
        _served.add(base)
        time.sleep(1.4 * PATIENCE_S)
    return packet(first, body)


def hung_up(first: int, body: bytes) -> bytes:
    """A connection that subscribes all topics ends."""
    if kind(first) == SUBSCRIBE and b"/#" in body:
        raise OSError
    return packet(first, body)


def in_no_mode(first: int, body: bytes) -> bytes:
    """Bridge mode is taken and not kept, and MQTT 5 is not taken."""
    if first == CONNECT:
        level = body[_LEVEL] & ~BRIDGE if body[_LEVEL] != 5 else 9
        body = body[:_LEVEL] + bytes((level,)) + body[_LEVEL + 1 :]
    return packet(first, body)


def flood(data: bytes) -> Callable[[int], bytes]:
    """Thirty times this, after each subscription."""
    return lambda first: 30 * data if kind(first) == SUBSCRIBE else b""


PONG = packet(PINGRESP, b"")


class FaultyBroker(SparingBroker):
    """A proxy on a loopback port of its own, until it is closed."""

    def __init__(self, to: int, fault: Fault) -> None:
        self._fault = fault
        super().__init__(to)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        fault = self._fault
        to_reader, to_writer = await asyncio.open_connection("127.0.0.1", self._to)
        back = asyncio.ensure_future(self._changed(to_reader, writer))
        with suppress(OSError, asyncio.IncompleteReadError):
            while True:
                first, _, body = await packet_of(reader)
                to_writer.write(fault.up(first, body))
                writer.write(fault.answer(first))
        await asyncio.sleep(fault.late_s)
        with suppress(OSError):
            to_writer.write(fault.ends)
        to_writer.close()
        await back

    async def _changed(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError, asyncio.IncompleteReadError):
            while True:
                first, _, body = await packet_of(reader)
                writer.write(self._fault.down(first, body))
        writer.close()


RIGHTS, *OTHERS = PROBES
#: What needs more than a sound broker: an account, or a restart.
NEED_MORE = ("refused subscriptions", "retained, after a restart")

#: A line of mosquitto.conf, or rules of its acl_file, the probe that finds it, and words of what it tells.
SETTINGS = [
    ("set_tcp_nodelay false", "small messages", State.WARN, "holds them back"),
    ("retain_available false", "rights", State.WARN, "it retains nothing"),
    further("max_qos 0", "rights", State.WARN, "it has no QoS 1"),
    further("max_qos 0", "retained, to + and #", State.OK, "all 200"),
    further("topic write #", "rights", State.FAILED, "may not read"),
    further(
        "topic readwrite pebble/doctor/#",
        "refused subscriptions",
        State.SKIPPED,
        "may not publish there, or may not read",
    ),
    ("topic write #\ntopic readwrite pebble/doctor/#", "refused subscriptions", State.WARN, "then delivers nothing"),
]
#: A fault, the probe that finds it, and words of what it tells.
FAULTS = [
    (Fault(ends=packet(DISCONNECT, b"")), "will", "none is published"),
    further(Fault(late_s=1.2), "will", "s after the connection is reset"),
    (Fault(down=hidden), "rights", "without the retain flag"),
    (Fault(down=repeated), "newest last", "value"),
    (Fault(down=lambda *of: packet(*of) * (1 + (kind(of[0]) == PUBLISH))), "overlapping filters", "2 copies"),
    (Fault(answer=flood(packet(PUBLISH, b"\0\1x" + bytes(1_000_000)))), "rights", "without end"),
    (Fault(answer=flood(1000 * PONG)), "rights", "without end"),
    further(Fault(down=lambda *of: b"" if of[0] == PINGRESP else packet(*of)), "answers to pings", "does not answer"),
    (
        Fault(up=lambda *of: b"" if of[0] == PINGREQ else packet(*of), answer=lambda of: PONG * (of == PINGREQ)),
        "answers to pings",
        "before it has passed on what came before",
    ),
    (Fault(up=hung_up), "retained, before an answer to a ping", "0 of 200 come"),
    (Fault(up=in_no_mode), "bridge mode", "own messages come back"),
]

PATIENCE_S = 0.5  # what does not come is waited for so long


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(tmp_path_factory.mktemp("broker"), "set_tcp_nodelay true")
    yield broker
    broker.stop()


def found(port: int, name: str, restart: Callable[[], bool] | None = None) -> CheckResult:
    """The result of one probe, after the first, on which all build; nothing is left behind."""
    probes: list[Probe] = [RIGHTS, *(probe for probe in OTHERS if probe.name == name)]
    with reached(MqttSettings(host="127.0.0.1", port=port), "pebble/doctor", restart) as trial:
        trial.patience_s = PATIENCE_S
        *_, (_, last) = run(probes, trial)
    assert list(trial.left) == []
    return last


@pytest.mark.parametrize(("lines", "name", "level", "words"), SETTINGS)
def test_what_settings_and_rules_of_mosquitto_take_away(
    lines: str, name: str, level: State, words: str, tmp_path: Path
) -> None:
    (tmp_path / "acl").write_text(f"{lines}\n")
    are_rules = lines.startswith("topic ")
    broker = Broker(tmp_path, f"acl_file {tmp_path / 'acl'}" if are_rules else lines)
    finding = found(broker.port, name)
    if "nodelay" in lines and finding.state is not level:  # a busy machine can hide what it holds back for 40 ms
        finding = found(broker.port, name)
    broker.stop()
    assert (finding.state, words in finding.text) == (level, True), finding
    assert are_rules or level is State.OK or finding.fix.startswith("in mosquitto.conf: ")


@pytest.mark.parametrize(("fault", "name", "words"), FAULTS)
def test_a_fault_of_a_broker_is_found_and_named(fault: Fault, name: str, words: str, sound: Broker) -> None:
    with closing(FaultyBroker(sound.port, fault)) as broker:
        finding = found(broker.port, name)
    assert (finding.state in (State.WARN, State.FAILED), words in finding.text) == (True, True), finding


@pytest.mark.parametrize(("fault", "is_late"), [(Fault(), False), (Fault(up=delayed), True)])
def test_a_sound_broker_passes(fault: Fault, sound: Broker, *, is_late: bool) -> None:
    broker = FaultyBroker(sound.port, fault)
    with closing(broker), reached(MqttSettings(host="127.0.0.1", port=broker.port), "pebble/doctor") as trial:
        trial.patience_s = PATIENCE_S
        results = [result for probe, result in run(PROBES, trial) if probe.name not in NEED_MORE]
    assert [result for result in results if result.state is not State.OK] == []
    assert any("late" in result.text for result in results) is is_late
    assert list(trial.left) == []


@pytest.mark.parametrize(
    ("persistence", "steps", "level"),
    [
        (False, ("stop", "start"), State.WARN),
        further(True, ("stop", "start"), State.OK),
        (False, (), State.SKIPPED),  # a person pressed Enter, and did not restart it
    ],
)
def test_what_a_broker_forgets_at_a_restart_is_named(
    persistence: bool, steps: tuple[str, ...], level: State, tmp_path: Path
) -> None:
    broker = Broker(tmp_path, persistence=persistence)

    def restart() -> bool:
        for step in steps:
            getattr(broker, step)()
        return True

    finding = found(broker.port, "retained, after a restart", restart)
    broker.stop()
    assert finding.state is level, finding


# -- whole brokers


DOCUMENT = ROOT / "docs" / "brokers.md"
MARKS = {State.OK: "yes", State.WARN: "limits", State.FAILED: "**no**", State.SKIPPED: "–"}


BROKERS: dict[str, Callable[[Path], Broker]] = {
    "mosquitto": lambda folder: Broker(folder, "set_tcp_nodelay true", persistence=True),
    "mosquitto, plain": Broker,
    **{name: MAKERS[name.lower()].make for name in ("NATS", "RabbitMQ", "aedes")},
}
#: Probes whose result differs from run to run.
VARIES = {"NATS": ["newest last"], "RabbitMQ": ["newest last"]}


def is_missing(name: str) -> bool:
    return name.lower() in MAKERS and MAKERS[name.lower()].missing()


def columns(text: str) -> dict[str, dict[str, str]]:
    """Return the marks in the first table of a document: by broker without its version, then by probe."""
    lines = text[text.index("\n| ") :].strip().partition("\n\n")[0].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    names = [title.rpartition(" ")[0] for title in rows[0][1:]]
    return {name: {row[0]: row[place] for row in rows[2:]} for place, name in enumerate(names, 1)}


@pytest.mark.alone  # mosquitto's own delays are measured
@pytest.mark.thorough
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.skipif(is_missing(name), reason=f"needs {name}: make long PART=brokers"))
        for name in BROKERS
    ],
)
def test_the_document_has_what_is_found(name: str, tmp_path: Path) -> None:
    documented, broker = columns(DOCUMENT.read_text())[name], BROKERS[name](tmp_path)

    def restart() -> bool:
        broker.stop()
        broker.start()
        return True

    with reached(MqttSettings(host="127.0.0.1", port=broker.port), "pebble/doctor", restart) as trial:
        found = {probe.name: MARKS[result.state] for probe, result in judge(trial)}
    broker.stop()
    assert found == {**documented, **{probe: found[probe] for probe in VARIES.get(name, ())}}


@pytest.mark.parametrize(
    ("lines", "code", "words"),
    [
        further([], 1, "robots can use it, with limits: small messages"),
        (["acl_file RULES"], 2, "robots cannot use it with this account: rights"),
    ],
)
def test_doctor_finds_whether_robots_can_use_a_broker(
    lines: list[str], code: int, words: str, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "rules").write_text("topic read #\n")
    broker = Broker(tmp_path, *(line.replace("RULES", str(tmp_path / "rules")) for line in lines))
    assert run("doctor", "--broker", f"mqtt://127.0.0.1:{broker.port}", "--json") == code, run.out
    broker.stop()
    assert json.loads(run.out)["assessment"][0] == words


@pytest.mark.thorough
def test_what_it_retains_is_removed_when_it_is_interrupted(broker: Broker) -> None:
    settings, seen = MqttSettings(host="127.0.0.1", port=broker.port, as_published=True), Received()

    def retained() -> dict[str, bytes]:
        newest = {one.topic: one.payload for one in [*seen.messages] if one.retain_requested}
        return {topic: payload for topic, payload in newest.items() if payload}

    with MqttTransport("watcher", settings) as watcher:
        watcher.subscribe("pebble/doctor/#", seen, echo=False)
        with running("doctor", "--broker", f"mqtt://127.0.0.1:{broker.port}", stdout=subprocess.DEVNULL) as process:
            assert until(lambda: len(retained()) > 50, 60)
            process.send_signal(signal.SIGINT)
            assert process.wait(WAIT_S) == 130
        assert until(lambda: retained() == {})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["doctor", "--broker", "mqtt://127.0.0.1:1"], "cannot be reached: nothing listens there"),
        (["doctor", "--broker", "zenoh:/tmp"], "--broker must be mqtt://"),
        (["doctor", "--broker", "mqtt://ann:secret@broker.lab"], "--broker holds a password"),
        (["doctor", "--broker", "mqtt://broker.lab,spare.lab"], "--broker names one broker"),
        (["doctor", "--broker", "mqtt://127.0.0.1:PORT", "--below", "pebble/+"], "contains a wildcard"),
        (["doctor", "--broker", "mqtt://127.0.0.1:1", "robot.json"], "leave out the config file"),
    ],
)
def test_what_cannot_be_judged_is_one_clear_line(arguments: list[str], words: str, broker: Broker, run: Run) -> None:
    assert run(*(one.replace("PORT", str(broker.port)) for one in arguments), columns=200) != 0
    assert [words in line for line in (run.err or run.out).splitlines()][:1] == [True], run.out + run.err
