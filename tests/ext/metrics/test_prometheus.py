"""Each alert is fired by its cause, with the real Prometheus: `make long PART=metrics` installs it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

import pytest
import yaml

from pebble.extensions.metrics import robots as r
from pebble.transports import MqttSettings, create
from tests.ext.metrics.test_metrics import FOLDER, exporter, media, status
from tests.kit.played_robot import RecordingRobot
from tests.support import WAIT_S, Broker, Child, free_port, until

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.timeout(300),
    pytest.mark.skipif(shutil.which("promtool") is None, reason="no Prometheus: make long PART=metrics installs it"),
]
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


class Prometheus:
    """A server that scrapes each second, with the rules and without their patience."""

    def __init__(self, folder: Path, *addresses: str) -> None:
        rules = re.sub(r"for: \w+", "for: 0s", (FOLDER / "alerts.yml").read_text())
        (folder / "alerts.yml").write_text(rules)
        targets = [address.split("/")[2] for address in addresses]
        config = {
            "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
            "rule_files": ["alerts.yml"],
            "scrape_configs": [{"job_name": "pebble", "static_configs": [{"targets": targets}]}],
        }
        (folder / "prometheus.yml").write_text(yaml.safe_dump(config))
        self._port = free_port()
        self._process = Child(
            ["prometheus", "--config.file=prometheus.yml", "--storage.tsdb.path=data", "--log.level=error",
             f"--web.listen-address=127.0.0.1:{self._port}"],
            cwd=folder,
        )  # fmt: skip

    def firing(self) -> set[str]:
        """Return the alerts that fire now."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._port}/api/v1/alerts", timeout=WAIT_S) as answer:
                alerts = json.load(answer)["data"]["alerts"]
        except OSError:  # it starts
            return set()
        return {alert["labels"]["alertname"] for alert in alerts if alert["state"] == "firing"}

    def end(self) -> None:
        self._process.kill()
        self._process.wait()


def test_each_alert_is_fired_by_its_cause(tmp_path: Path, brokers: tuple[Broker, Broker]) -> None:
    fleet, away = brokers
    other_robots = create("mqtt", "others", MqttSettings(host="127.0.0.1", port=fleet.port)).open(WAIT_S)

    def beat(name: str) -> bool:
        """Publish heartbeats that take 0.8 s, of this robot and of one that is listed."""
        payload = json.dumps({"t": int(1000 * (time.time() - 0.8))}).encode()
        for robot in ("slow", name):
            other_robots.publish(f"pebble/robots/{robot}/outgoing/online", payload)
        time.sleep(0.01)
        return True

    with exporter(fleet) as address, exporter(away) as other, RecordingRobot(fleet.port, "pebble/robots/goob") as goob:
        dead = f"http://127.0.0.1:{free_port()}/metrics"
        goob.publish_states()
        goob.publish("charging-level", {"value": 60, "unit": "%"}, retain=True)
        goob.publish("status", status({"recorder": "ready"}, "yes"), retain=True)
        goob.publish("media-status", media(1000, 0), retain=True)
        prometheus = Prometheus(tmp_path, address, other, dead)
        try:
            assert until(lambda: prometheus.firing() == {"PebbleExporterAway"}, 60)
            time.sleep(3)
            assert prometheus.firing() == {"PebbleExporterAway"}
            goob.stop()
            goob.publish("charging-level", {"value": 12, "unit": "%"}, retain=True)
            failed = status({"recorder": "failed"}, "no")
            failed["value"]["services"]["recorder"]["restarts"] = 9
            goob.publish("status", failed, retain=True)
            goob.publish("media-status", media(2000, 3), retain=True)
            away.kill()
            causes = {"PebbleRobotStopped", "PebbleBatteryLow", "PebbleServiceDown", "PebbleRobotNotDriveable"}
            causes |= {"PebbleServiceRestarts", "PebbleMediaLoss", "PebbleBrokerAway", "PebbleExporterAway"}
            assert until(lambda: prometheus.firing() == causes, 60), prometheus.firing()
            goob.silent()
            assert until(lambda: "PebbleRobotSilent" in prometheus.firing(), 60)
            for number in range(r.MOST_ROBOTS):
                beat(f"r{number}")
            assert until(lambda: beat("late") and {"PebbleLinkSlow", "PebbleRobotsUnlisted"} <= prometheus.firing(), 60)
        finally:
            prometheus.end()
