"""``pebble impair --robot``: a robot behind a real broker is recorded, its media requested, and nothing else sent."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.transports import Message, MqttSettings, Transport, create
from tests.commands.command_line import Run, program
from tests.support import Broker, until
from tests.web.picture_robot import CAMERA, FLAG, REF, REQUEST, PictureRobot
from tests.web.served import RecordingRobot


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    monkeypatch.chdir(tmp_path)
    return Run(monkeypatch, capsys)


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(tmp_path_factory.mktemp("broker"))
    yield broker
    broker.kill()


@pytest.fixture
def url(broker: Broker) -> str:
    return f"mqtt://127.0.0.1:{broker.port}"


@pytest.fixture
def robot(broker: Broker) -> Iterator[PictureRobot]:
    """A robot with heartbeats and a camera."""
    with RecordingRobot(broker.port, REF, capabilities={}), closing(_camera(broker)) as robot:
        yield robot


def _camera(broker: Broker) -> PictureRobot:
    return PictureRobot(transport=_client(broker, "camera"))


def _client(broker: Broker, name: str) -> Transport:
    return create("mqtt", name, MqttSettings(host="127.0.0.1", port=broker.port)).open()


@contextmanager
def _everything(broker: Broker) -> Iterator[list[Message]]:
    """All messages of the broker but the retained ones of before."""
    messages: list[Message] = []

    def receive(message: Message) -> None:
        messages.extend([message] * (not message.retain))

    with closing(_client(broker, "everything")) as transport:
        transport.subscribe("#", receive, direct=True)
        yield messages


def _incoming(messages: list[Message]) -> list[tuple[str, Any]]:
    return [(one.topic, json.loads(one.payload)) for one in list(messages) if "/incoming/" in one.topic]


def _rows(text: str) -> dict[str, list[str]]:
    """The cells of each row of a printed table, by its name."""
    lines = (line.strip().split("  ") for line in text.splitlines())
    return {cells[0].strip(): [cell.strip() for cell in cells[1:] if cell.strip()] for cells in lines if cells[0]}


def test_only_media_are_requested_and_withdrawn_again(run: Run, broker: Broker, robot: PictureRobot, url: str) -> None:
    with _everything(broker) as messages:
        assert run("impair", "--robot", "goob", "--url", url, "--label", "512k", "--seconds", "2", "--no-media") == 0
        assert _incoming(messages) == []
        assert run("impair", "--robot", "goob", "--url", url, "--label", "1M", "--seconds", "2") == 0
        assert until(lambda: len(_incoming(messages)) == 4)
        assert {message.topic.split("/")[0] for message in messages} == {"pebble"}
    assert _incoming(messages) == [
        (FLAG, {"value": True}),
        (REQUEST, {"enabled": True}),
        (REQUEST, {"enabled": False}),
        (FLAG, {"value": False}),
    ]


def test_the_table_has_a_column_for_each_label(run: Run, robot: PictureRobot, url: str) -> None:
    for label in ("unlimited", "50%"):
        assert run("impair", "--robot", "goob", "--url", url, "--label", label, "--seconds", "3") == 0
    table = run.out
    rows = _rows(table)
    assert "unlimited" in table.splitlines()[1]
    assert table.index("unlimited") < table.index("50%")  # in the order of measuring
    assert rows["robot"] == ["goob", "goob"]
    assert rows["measured, s"] == ["3", "3"]
    assert all(8 <= float(cell) <= 18 for cell in rows["pictures a second"])  # the camera's rate is 15
    assert rows["pictures lost, %"] == ["0.0", "0.0"]
    assert all(float(cell) < 1000 for cell in rows["heartbeat latency p95, ms"])
    assert all(float(cell) > 10 for cell in rows["video, kbit/s"])
    assert "sound lost, %" not in rows
    assert run("impair", "--compare") == 0
    assert run.out == table
    assert run("analyse", "impair/unlimited") == 0


def test_only_this_robot_is_recorded(run: Run, broker: Broker, robot: PictureRobot, url: str) -> None:
    with RecordingRobot(broker.port, "pebble/robots/benjr"):
        assert run("impair", "--robot", "goob", "--url", url, "--label", "512k", "--seconds", "2", "--into", "x") == 0
    assert run("recordings", "info", "x/512k") == 0
    assert "goob" in run.out
    assert "benjr" not in run.out


def test_a_label_is_replaced_only_if_asked_to(run: Run, robot: PictureRobot, url: str) -> None:
    arguments = ("impair", "--robot", "goob", "--url", url, "--label", "512k", "--seconds", "1", "--no-media")
    assert run(*arguments) == 0
    old = {path.name for path in Path("impair/512k").rglob("*.mcap")}
    assert run(*arguments) == 1
    assert run.err.startswith("pebble: impair/512k exists: add --replace")
    assert {path.name for path in Path("impair/512k").rglob("*.mcap")} == old
    assert run(*arguments, "--replace") == 0
    assert not old & {path.name for path in Path("impair/512k").rglob("*.mcap")}


def test_a_folder_that_is_no_measurement_is_never_deleted(run: Run, url: str) -> None:
    Path("mine/512k").mkdir(parents=True)
    assert run("impair", "--robot", "goob", "--url", url, "--label", "512k", "--into", "mine", "--replace") == 1
    assert run.err.startswith("pebble: mine/512k is no measurement")
    assert Path("mine/512k").is_dir()


def test_interrupted_it_withdraws_and_prints_what_was_measured(
    broker: Broker, robot: PictureRobot, url: str, tmp_path: Path
) -> None:
    with _everything(broker) as messages:
        process = program("impair", "--robot", "goob", "--url", url, "--label", "512k", "--into", tmp_path / "impair")
        with process:
            assert until(lambda: sum(one.topic == CAMERA for one in list(messages)) > 30, 30)
            process.send_signal(signal.SIGINT)
            out, _ = process.communicate(timeout=30)
        assert until(lambda: _incoming(messages)[-1] == (FLAG, {"value": False}))
    assert (REQUEST, {"enabled": False}) in _incoming(messages)
    assert process.returncode == 0
    assert float(_rows(out)["measured, s"][0]) < 100


def test_a_robot_without_heartbeats(run: Run, robot: PictureRobot, url: str) -> None:
    assert run("impair", "--robot", "gobo", "--url", url, "--label", "512k") == 1
    assert run.err == "pebble: no heartbeat of gobo came within 5 s: is this its broker?\n"
    assert not Path("impair").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robot", "goob", "--label", "512k"], "--url is missing"),
        (["--robot", "goob", "--url", "mqtt://127.0.0.1"], "--label is missing"),
        (["--robot", "goob", "--url", "mqtt://127.0.0.1", "--label", "../x"], '--label "../x" cannot name a folder'),
        (["--robot", "goob", "--url", "mqtt://127.0.0.1", "--label", "2026"], '--label "2026" cannot name a folder'),
        (["--robot", "goob", "--url", "mqtt://127.0.0.1:1", "--label", "x"], "cannot connect to mqtt://127.0.0.1:1"),
        (["--robot", "goob", "--quick"], "--quick is for simulated robots"),
        (["--label", "512k"], "--label is for a real robot: add --robot ID"),
        (["--compare"], "impair: there is no measurement of a real robot"),
        (["--compare", "--label", "512k"], "--label does not go with --compare"),
    ],
)
def test_what_is_wrong_is_one_line(run: Run, arguments: list[str], message: str) -> None:
    assert run("impair", *arguments) == 1
    assert message in run.err
    assert len(run.err.splitlines()) == 1


def test_a_package_that_is_missing_is_named(run: Run, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.recordings.traffic.duck.find_spec", lambda _name: None)
    assert run("impair", "--robot", "goob", "--url", url, "--label", "512k") == 1
    assert run.err == 'pebble: duckdb and zstandard missing: pip install "pebble-robot[archive]"\n'
