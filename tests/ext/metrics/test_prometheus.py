"""Prometheus' own tool fires each alert, and reads what is served: `make long PART=metrics` installs it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from tests.ext.metrics.test_metrics import FOLDER, GOOB, exporter, get, media, shows, status
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

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
