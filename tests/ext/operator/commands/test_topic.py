"""``pebble topic`` with real brokers and hubs."""

from __future__ import annotations

import itertools
import json
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import CHANNELS
from pebble.errors import PebbleError
from pebble.extensions.operator.client.names import Names
from pebble.extensions.operator.commands import show
from pebble.extensions.operator.commands.draft import Draft, draft
from pebble.extensions.operator.contract.schemas import schemas
from tests.commands.command_line import GOOB, Run, running
from tests.kit.played_robot import RecordingRobot
from tests.support import WAIT_S, Broker, until
from tests.transports.zenoh_net import HubProcess

_numbers = itertools.count(1)


@pytest.fixture(scope="module")
def local_transports(broker: Broker, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """A broker and a hub, by kind of transport, as URLs."""
    run_dir = tmp_path_factory.mktemp("z")
    hub = HubProcess(run_dir).start()
    yield {"mqtt": f"mqtt://127.0.0.1:{broker.port}", "zenoh": f"zenoh:{run_dir}"}
    hub.end()


@pytest.fixture(params=["mqtt", "zenoh"])
def at(request: pytest.FixtureRequest, local_transports: dict[str, str]) -> tuple[str, str, str]:
    """Options that lead there, with a robot of the test's own."""
    return "--url", local_transports[request.param], f"--robot=r{next(_numbers)}"


def test_what_is_published_is_echoed_and_its_rate_measured_on_either_transport(
    at: tuple[str, str, str], run: Run
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    assert run("topic", "pub", "charging-level", '{"value": 7.4}', *at) == 0
    with running("topic", "pub", "drive-values", '{"x": 0.5}', "--rate", "40", *at) as pub:
        assert run("topic", "echo", "drive-values", "--count", "3", "--seconds", "60", *at) == 0, run.err
        assert run.out.splitlines()[1::2] == ['{"x": 0.5}'] * 3
        assert "incoming/drive-values  10 B  qos 1" in run.out
        assert run("topic", "hz", "drive-values", "--seconds", "1", *at) == 0
        assert " kbit/s  min " in run.out
        assert signal.getsignal(signal.SIGTERM) is before
        assert run("topic", "hz", "charging-level", "--seconds", "0.5", *at) == 1, "what is retained does not count"
        assert set(run.out.splitlines()) == {"no new messages"}
        pub.send_signal(signal.SIGINT)
        assert (pub.communicate(timeout=WAIT_S), pub.returncode) == (("", ""), 130)


def test_retained_topics_are_listed_with_their_synonym_and_echoed_raw(at: tuple[str, str, str], run: Run) -> None:
    assert run("topic", "pub", "flags/mqtt-video", "true", *at) == 0
    assert run("topic", "pub", "heartbeat", '{"t": 1710969600123}', *at) == 0
    assert (run("topic", "list", "--seconds", "1", *at), run.err) == (0, "")
    rows = {line.split()[0]: line.split()[1:] for line in run.out.splitlines()}
    assert rows["incoming/flags/mqtt-video"] == ["yes", "4", "B", "?", "flag"]
    assert rows["outgoing/heartbeat"][0] == "yes"
    assert rows["outgoing/heartbeat"][-3:] == ["state", "(like", "online)"]
    assert run("topic", "echo", "online", "--raw", "--count", "1", "--seconds", "30", *at) == 0
    assert run.out == '{"t": 1710969600123}\n'


@pytest.mark.parametrize("words", [("topic", "echo", "capabilities", "-s", "5", "-n", "1", "-r"), ("estop", "status")])
def test_a_robot_is_found_however_its_accents_are_spelled(run: Run, broker: Broker, words: tuple[str, ...]) -> None:
    robot = RecordingRobot(broker.port, "pebble/robots/ba\u0308r", "serial", heartbeats=False)
    try:
        assert run(*words, "b\u00e4r", f"--url=mqtt://127.0.0.1:{broker.port}") == 0, run.err
        assert run.out
    finally:
        robot.silent()
        for metric in ("capabilities", "estop/serial"):
            robot.remove(metric)
        robot.close()


# -- the contract


def test_the_contract_for_programs(run: Run) -> None:
    assert run("topic", "contract", "--json", "--base", "goob") == 0
    listed = {entry["topic"]: entry for entry in json.loads(run.out)}
    assert listed.keys() == {f"{GOOB}/{channel.suffix}" for channel in CHANNELS}
    assert listed[f"{GOOB}/outgoing/heartbeat"]["synonym_of"] == "online"
    assert listed[f"{GOOB}/incoming/drive-values"]["retain"] is False
    assert run("topic", "contract", "--json-schema") == 0
    assert json.loads(run.out) == schemas()


# -- messages to publish, as the contract completes and refuses them


def drafted(name: str, text: str, **options: Any) -> Draft:
    return draft(Names(GOOB), name, text, **{"retain": None, "qos": None, "force": False, **options})


def test_the_contract_fills_in_how_to_publish(tmp_path: Path) -> None:
    def made(name: str, text: str, **options: Any) -> tuple[str, bytes, int, bool]:
        message = drafted(name, text, **options)
        assert message.warnings == ()
        return message.topic, message.payload, message.qos, message.retain

    (tmp_path / "drive.json").write_bytes(b'{"x": 1}')
    assert made("drive-values", f"@{tmp_path}/drive.json") == (f"{GOOB}/incoming/drive-values", b'{"x": 1}', 1, False)
    assert made("flags/mqtt-video", "true") == (f"{GOOB}/incoming/flags/mqtt-video", b"true", 1, True)
    assert made("flags/mqtt-video", "true", retain=False, qos=0)[2:] == (0, False)
    assert made("drive-values", "", retain=True)[3] is True  # removes the retained message
    assert made("drive-values", '{"x": 0}', retain=True, force=True)[3] is True
    assert made("drive-values", '{"z": 0.5, "speed": 1}')[2:] == (1, False)


@pytest.mark.parametrize("name", ["drive-values", "flags/reboot"])
def test_a_retained_command_is_refused(name: str) -> None:
    with pytest.raises(PebbleError, match="--force"):
        drafted(name, "true", retain=True)


@pytest.mark.parametrize(
    ("name", "text", "doubt"),
    [
        ("drive-values", '{"x": NaN}', "will refuse"),
        ("outgoing/online", '{"t": 1}', "published by robots"),
        ("heartbeat", '{"t": 1}', "older name of online"),
        ("drive-values", '{"speed": 0.5}', "none of x, z and y is in it, but 'speed': so it is a stop"),
        ("house/lamp", "on", "not in the contract"),
    ],
)
def test_doubtful_messages_are_sent_with_a_warning(name: str, text: str, doubt: str) -> None:
    assert any(doubt in one for one in drafted(name, text).warnings)


# -- how messages and rates are printed


def test_bodies() -> None:
    assert show.body(b'{"t":1}', 80) == '{"t": 1}'
    assert show.body(b'{"a":{"b":1}}', 8).count("\n") == 4
    assert show.body(b"true", 80) == "true"
    assert show.body(b"", 80).startswith("(empty")
    assert show.body("é".encode(), 80) == "é"
    assert show.body(b"PBAT\x01\x01" + bytes(40), 80).splitlines()[0] == "PBAT sound, 46 bytes"
    assert show.body(b"PBVD\x01\x01", 80).splitlines()[1].startswith("  0000  50 42 56 44 01 01")
    assert show.body(b"\x00\x80", 80).startswith("binary, 2 bytes")
    assert max(map(len, show.body(bytes(100), 60).splitlines())) <= 60


@pytest.mark.parametrize("payload", [b"\x1b[31mred", b'"\\u001b[31m"', '"\x9b31m"'.encode(), b'"\\ud800"', b"[" * 5000])
def test_no_payload_upsets_the_terminal(payload: bytes) -> None:
    text = show.body(payload, 80)
    text.encode()
    assert "\x1b" not in text
    assert "\x9b" not in text


def test_a_table_in_a_pipe_cuts_no_name(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    names = [f"{'goob-of-the-long-corridor-' * 3}{number}" for number in range(3)]
    show.print_table(("robot", "why"), [(name, "x" * 60) for name in names], whole=("robot",))
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]] == names


# -- robots that take commands only with the name of their sender


@pytest.fixture
def robot(broker: Broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, f"pebble/robots/named{next(_numbers)}", named=True) as one:
        yield one


def incoming(robot: RecordingRobot) -> set[str]:
    return {one.removeprefix(f"{robot.base}/incoming/") for one in robot.wire}


def test_a_message_has_the_user_name_at_the_broker_in_its_topic(
    broker: Broker, robot: RecordingRobot, run: Run
) -> None:
    name, words = robot.base.rpartition("/")[2], ("topic", "pub", "lights-solid", '{"r": 1}')
    assert run(*words, "--url", f"mqtt://ann@127.0.0.1:{broker.port}", "--robot", name) == 0, run.err
    assert until(lambda: incoming(robot) == {"by/ann/lights-solid"})
    assert run(*words, "--url", f"mqtt://127.0.0.1:{broker.port}", "--robot", name) == 1
    assert f"pebble: {name} takes commands only with a name, and there is none here: log in" in run.err


def test_a_stop_goes_both_ways_and_a_reset_by_name(broker: Broker, robot: RecordingRobot, run: Run) -> None:
    name, url = robot.base.rpartition("/")[2], f"mqtt://ann@127.0.0.1:{broker.port}"
    assert run("estop", name, "--url", url) == 0, run.err
    assert {"estop", "by/ann/estop"} <= incoming(robot)
    assert run("estop", "reset", name, "--url", f"mqtt://127.0.0.1:{broker.port}") == 1
    assert "takes commands only with a name" in run.err
    assert run("estop", "reset", name, "--url", url) == 0, run.err
    assert {one for one in incoming(robot) if one.endswith("reset")} == {"by/ann/estop-reset"}


def test_a_password_comes_from_a_file_or_the_environment(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    passwords = tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "ann", "geheim"], check=True, capture_output=True)
    passwords.chmod(0o644)
    broker = Broker(tmp_path, "allow_anonymous false", f"password_file {passwords}")
    (tmp_path / "right").write_text("geheim\n")
    url = f"mqtt://ann@127.0.0.1:{broker.port}"
    pub = ("topic", "pub", "status", "{}", "--robot", "goob", "--url", url)
    try:
        assert run(*pub, "--password-file", tmp_path / "right") == 0
        monkeypatch.setenv("PEBBLE_PASSWORD", "geheim")
        assert run(*pub) == 0
    finally:
        broker.stop()
