"""What `pebble exporter` serves of robots, to whom, and what never is."""

from __future__ import annotations

import json
import re
import select
import shutil
import socket
import subprocess
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from pebble.extensions.metrics import robots as r
from pebble.transports import Message
from tests.commands.command_line import Run, running
from tests.ext.operator.client.estop_robot import Robot as Stops
from tests.kit.played_robot import RecordingRobot
from tests.support import ROOT, WAIT_S, Broker, until

TYPE = re.compile(r"# TYPE (pebble_[a-z_]+) (gauge|counter)")
SAMPLE = re.compile(r'(pebble_[a-z_]+)\{((?:[a-z]+="(?:[^"\\\n]|\\[\\"n])*"(?:,(?!})|(?=})))*)\} (-?[0-9.e+-]+)')
Samples = dict[str, float]


def parse(text: str) -> Samples:
    """Return samples by metric and labels, as they are written."""
    samples: Samples = {}
    types: dict[str, str] = {}
    assert text.endswith("\n")
    for line in text[:-1].split("\n"):
        if (kind := TYPE.fullmatch(line)) is not None:
            assert kind[1] not in types
            assert (kind[2] == "counter") is kind[1].endswith("_total")
            types[kind[1]] = kind[2]
            continue
        sample = SAMPLE.fullmatch(line)
        assert sample is not None, line
        assert sample[1] == list(types)[-1]  # the samples of a metric stand together
        assert len({*re.findall(r'([a-z]+)="', sample[2])} - {"robot"}) <= 1
        name = f"{sample[1]}{{{sample[2]}}}"
        assert name not in samples
        samples[name] = float(sample[3])
    return samples


@contextmanager
def exporter(broker: Broker, *options: str) -> Iterator[str]:
    """Give the address of an exporter."""
    with running("exporter", "--url", f"mqtt://127.0.0.1:{broker.port}", "--port", "0", *options) as process:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], 30)[0], "nothing was printed"
        line = process.stdout.readline()
        assert "; Ctrl-C ends it" in line
        yield line.split(" at ")[1].split(";")[0]


def get(address: str, token: str = "") -> str:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=WAIT_S) as answer:
        text: str = answer.read().decode()
        return text


def shows(address: str, **expected: float | None) -> Callable[[], bool]:
    """Return a condition: the metrics of goob have these values; None: they are absent."""

    def is_so() -> bool:
        samples = {name.partition("{")[0]: value for name, value in parse(get(address)).items()}
        return all(samples.get(f"pebble_{name}") == value for name, value in expected.items())

    return is_so


GOOB = "pebble/robots/goob"
FOLDER = ROOT / "pebble" / "extensions" / "metrics"
NAMES = {*re.findall(r'"(pebble_[a-z_]+)"', "".join(path.read_text() for path in FOLDER.glob("*.py")))}
PAGE = (ROOT / "docs" / "ext" / "metrics.md").read_text()
SERVICES = {"recorder": "ready", "av_daemon": "failed", "camera_publisher": "stopped", "audio_publisher": "held"}
STATE = json.loads(Stops(GOOB, "serial").owners[0].state().payload)


class Played:
    """Robots whose messages a test makes, at times that it chooses."""

    def __init__(self) -> None:
        self.robots, self.now = r.Robots(), 1000.0

    def take(self, metric: str, payload: Any, base: str = GOOB, *, retain: bool = False) -> None:
        message = Message(f"{base}/outgoing/{metric}", json.dumps(payload).encode(), retain=retain)
        self.robots.receive(message, self.now, self.now)

    def beat(self, count: int = 3, base: str = GOOB) -> None:
        for _ in range(count):
            self.now += 0.25
            self.take("online", {"t": int(1000 * self.now) - 40}, base)

    def samples(self) -> dict[str, float]:
        samples = r.Samples()
        self.robots.add_to(samples, self.now)
        return {
            re.sub(r'robot="goob",?|\{\}|pebble_', "", name): value for name, value in parse(samples.text()).items()
        }


def status(states: dict[str, str], driveable: str) -> dict[str, Any]:
    services = {name: {"state": state, "restarts": 2, "pid": 7} for name, state in states.items()}
    return {"t": 1, "value": {"services": services, "driveable": {"state": driveable, "why": "a secret"}}}


def media(t: int, dropped: int, **more: Any) -> dict[str, Any]:
    return {"t": t, "value": {"camera": {"running": True, "rate": 9, "bitrate": 80_000, "dropped": dropped} | more}}


RESTARTS = {f'service_restarts_total{{service="{name}"}}': 2 for name in SERVICES}


@pytest.mark.parametrize(
    ("messages", "samples"),
    [
        ([("charging-level", {"value": 7.4, "unit": "v"})], {"battery_volts{}": 7.4}),
        ([("charging-level", {"value": 81, "unit": "%"})], {"battery_percent{}": 81}),
        ([("charging-level", {"value": 81})], {}),
        ([("charging-level", {"value": 7.4, "unit": "v"}), ("charging-level", {"value": 81})], {}),
        ([("charging-status", {"value": True})], {"robot_charging{}": 1}),
        ([("charging-status", {"value": None})], {}),
        ([("status", status({}, "yes"))], {"robot_driveable{}": 1}),
        ([("status", status({}, "no"))], {"robot_driveable{}": 0}),
        (
            [("status", status(SERVICES, "unknown"))],
            RESTARTS
            | {'service_up{service="recorder"}': 1, 'service_up{service="av_daemon"}': 0, "robot_driveable{}": -1},
        ),
        ([("status", status({'"} 1\nx{': "ready"}, "yes"))], {"robot_driveable{}": 1, 'up{service="\\"} 1"}': None}),
        ([("status", {"value": {"services": ["recorder"]}}), ("media-status", {"t": 1, "value": 7})], {}),
        ([("media-status", media(1000, 0))], {'media_fps{stream="camera"}': 9}),
        (
            [("media-status", media(1000, 5)), ("media-status", media(2000, 6))],
            {'media_fps{stream="camera"}': 9, 'media_loss_ratio{stream="camera"}': 0.1},
        ),
        (
            [("media-status", media(1000, 5)), ("media-status", media(2000, 0))],  # it was started again
            {'media_fps{stream="camera"}': 9},
        ),
        ([("media-status", media(1000, 0, running=False))], {}),
        ([("estop/serial", STATE)], {'robot_stopped{owner="serial"}': 0}),
    ],
)  # fmt: skip
def test_each_message_feeds_its_metrics_and_no_others(messages: list[Any], samples: dict[str, float | None]) -> None:
    played = Played()
    for metric, payload in messages:
        played.take(metric, payload)
    played.beat()
    got = played.samples()
    assert got.pop("link_bytes_per_second{}") > 0
    known = {name: value for name, value in samples.items() if value is not None}
    always = {"robot_online{}": 1, "heartbeat_age_seconds{}": 0, "exporter_robots": 1, "exporter_unlisted": 0}
    assert got.pop("heartbeat_latency_seconds{}") == pytest.approx(0.04, abs=0.002)
    assert got == pytest.approx(known | always)


def test_a_silent_robot_stays_for_an_hour_and_comes_back() -> None:
    played = Played()
    played.take("capabilities", {"t": 1, "value": {"drive": {"available": True}}}, "lab/arms/a\\1", retain=True)
    played.take("charging-level", {"value": 7.4, "unit": "v"})
    played.beat()
    heard_at = played.now
    for seconds, online in ((0.5, 1), (5, 0), (3595, 0), (3601, None)):
        played.now = heard_at + seconds
        samples = played.samples()
        assert samples.get("robot_online{}") == online
        assert ("battery_volts{}" in samples) == (online == 1)
        assert samples.get('robot_online{robot="lab/arms/a\\\\1"}') == (None if online is None else 0)
    played.beat()
    assert played.samples()["robot_online{}"] == 1


def test_robots_that_find_no_place_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(r, "MOST_ROBOTS", 2)
    played = Played()
    for name in ("goob", "a", "b", "c", "d", "b"):
        played.beat(1, f"pebble/robots/{name}")
    played.take("online", {"t": 1}, "pebble/servers/web")
    samples = played.samples()
    assert (samples["exporter_robots"], samples["exporter_unlisted"]) == (2, 2)
    assert 'robot_online{robot="b"}' not in samples


def test_a_robot_at_a_broker_is_followed_and_nothing_private_is_shown(broker: Broker) -> None:
    with RecordingRobot(broker.port, GOOB, keeps=True) as robot, exporter(broker) as address:
        robot.publish("charging-level", {"value": 7.4, "unit": "v"}, retain=True)
        robot.publish_states()
        robot.command("control", {"by": "ann", "id": "01234567", "device": "desk"})
        assert until(shows(address, robot_online=1, robot_stopped=0, battery_volts=7.4, exporter_broker_connected=1))
        robot.stop(by="ann@desk", why="dog")
        assert until(shows(address, robot_stopped=1))
        assert [word for word in ("ann", "desk", "dog", "01234567", "127.0.0.1") if word in get(address)] == []
        robot.silent()
        assert until(shows(address, robot_online=0, robot_stopped=1, battery_volts=None))
        broker.stop()
        assert until(shows(address, robot_online=None, exporter_robots=None, exporter_broker_connected=0))
        broker.start()
        assert until(shows(address, robot_online=0, exporter_broker_connected=1))


def test_beyond_loopback_a_token_is_needed(run: Run, tmp_path: Path, broker: Broker) -> None:
    token, empty = tmp_path / "token", tmp_path / "empty"
    token.write_text("a long word\n")
    empty.write_text("\n")
    for options in (("--host", "0.0.0.0"), ("--host", "0.0.0.0", "--token-file", empty), ("--token-file", empty)):
        assert run("exporter", "--url", "mqtt://127.0.0.1", *options) == 1
        assert run.err.rstrip().endswith("add --token-file FILE, with a token in it")
    with exporter(broker, "--host", "0.0.0.0", "--token-file", str(token)) as address:
        address = address.replace("0.0.0.0", "127.0.0.1")
        for wrong in ("", "a long", "a long word "):
            with pytest.raises(urllib.error.HTTPError, match="401"):
                get(address, f"{wrong}x" if wrong else "")
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get(address.replace("metrics", "robots"), "a long word")
        port = int(address.split(":")[2].split("/")[0])
        for bad in (b"GET /metrics HTTP/1.1\r\nX: " + bytes(10_000), b"\r\n\r\n", b"\xff\r\n\r\n"):
            with socket.create_connection(("127.0.0.1", port)) as client:
                client.sendall(bad)
        assert parse(get(address, "a long word"))["pebble_exporter_broker_connected{}"] == 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), "where to connect is missing"),
        (("--url", f"zenoh:{ROOT}"), "metrics are those of a broker"),
        (("--url", "mqtt://127.0.0.1", "--host", "127.0.0.1:1"), "--host"),
    ],
)
def test_a_wrong_command_line_is_one_line(run: Run, options: tuple[str, ...], said: str) -> None:
    assert run("exporter", *options) == 1
    assert said in run.err
    assert run.err.count("\n") == 1


def test_page_rules_and_dashboard_name_metrics_that_exist() -> None:
    table = set(re.findall(r"^\| `.*", PAGE, re.MULTILINE))
    assert {name for row in table for name in re.findall(r"pebble_[a-z_]+", row)} == NAMES
    (config,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    assert yaml.safe_load(config)["rule_files"] == ["alerts.yml"]
    yaml.safe_load((FOLDER / "alerts.yml").read_text())
    json.loads((FOLDER / "dashboard.json").read_text())
    for name in ("alerts.yml", "dashboard.json"):
        assert set(re.findall(r"pebble_[a-z_]+", (FOLDER / name).read_text())) - NAMES == set()


# -- Prometheus' own tool fires each alert, and reads what is served


promtool = pytest.mark.skipif(shutil.which("promtool") is None, reason="make long PART=metrics installs it")
#: The series by which each alert fires after ten minutes.
SERIES = {
    "PebbleRobotSilent": 'pebble_robot_online{robot="goob"} 0',
    "PebbleRobotStopped": 'pebble_robot_stopped{robot="goob",owner="serial"} 1',
    "PebbleRobotNotDriveable": 'pebble_robot_driveable{robot="goob"} 0',
    "PebbleBatteryLow": 'pebble_battery_percent{robot="goob"} 19',
    "PebbleServiceDown": 'pebble_service_up{robot="goob",service="recorder"} 0',
    "PebbleServiceRestarts": 'pebble_service_restarts_total{robot="goob",service="recorder"} 0+1',
    "PebbleLinkSlow": 'pebble_heartbeat_latency_seconds{robot="goob"} 0.7',
    "PebbleMediaLoss": 'pebble_media_loss_ratio{robot="goob",stream="camera"} 0.2',
    "PebbleBrokerAway": "pebble_exporter_broker_connected{} 0",
    "PebbleExporterAway": 'up{job="pebble"} 0',
    "PebbleRobotsUnlisted": "pebble_exporter_unlisted{} 1",
}
WELL = (
    ("robot_online", 1), ("robot_stopped", 0), ("robot_driveable", -1), ("battery_percent", 20), ("service_up", 1),
    ("heartbeat_latency_seconds", 0.1), ("media_loss_ratio", 0.05), ("exporter_broker_connected", 1),
)  # fmt: skip


@promtool
@pytest.mark.thorough
def test_the_rules_fire_by_their_series_alone(tmp_path: Path) -> None:
    charging = [("pebble_robot_charging{robot='goob'}", "1x20"), ("pebble_battery_percent{robot='goob'}", "9x20")]
    well = [(f"pebble_{name}{{robot='goob'}}", f"{value}x20") for name, value in WELL]
    cases = [((alert,), [tuple(series.rsplit(" ", 1))]) for alert, series in SERIES.items()]
    cases = [(alerts, [(name, f"{value}x20") for name, value in series]) for alerts, series in cases]
    tests = [
        {
            "interval": "1m",
            "input_series": [{"series": name, "values": values} for name, values in series],
            "promql_expr_test": [
                {
                    "expr": 'count by (alertname) (ALERTS{alertstate="firing"})',
                    "eval_time": "15m",
                    "exp_samples": [{"labels": f'{{alertname="{alert}"}}', "value": 1} for alert in alerts],
                }
            ],
        }
        for alerts, series in (*cases, ((), charging), ((), well))
    ]
    rules = {"rule_files": [str(FOLDER / "alerts.yml")], "evaluation_interval": "1m", "tests": tests}
    (tmp_path / "test.yml").write_text(yaml.safe_dump(rules))
    done = subprocess.run(
        ["promtool", "test", "rules", "test.yml"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@promtool
@pytest.mark.thorough
def test_prometheus_reads_what_is_served(broker: Broker) -> None:
    with exporter(broker) as address, RecordingRobot(broker.port, GOOB) as goob:
        goob.publish_states()
        goob.publish("charging-level", {"value": 60, "unit": "%"}, retain=True)
        goob.publish("status", status({"recorder": "ready"}, "yes"), retain=True)
        goob.publish("media-status", media(1000, 0), retain=True)
        assert until(shows(address, battery_percent=60, service_up=1, media_fps=9, robot_stopped=0))
        done = subprocess.run(
            ["promtool", "check", "metrics"], input=get(address), capture_output=True, text=True, check=False
        )
    remarks = [line for line in done.stderr.splitlines() if not line.endswith("no help text")]
    assert (done.returncode, remarks) == (3, []), "it has no other remark"
