"""What a robot's connections are set up with."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.config import parse
from pebble.runtime.connections import local_settings, mqtt_settings, remote_transport
from pebble.transports.topics import matches

BASE = "pebble/robots/goob"


@pytest.mark.parametrize(
    ("topic", "remote", "local"),
    [
        (f"{BASE}/outgoing/online", True, True),
        (f"{BASE}/outgoing/estop/wheels", True, True),
        (f"{BASE}/outgoing/control/by", True, True),
        (f"{BASE}/outgoing/capabilities", True, True),
        ("site/alive", True, True),
        ("site/drive", True, True),
        (f"{BASE}/incoming/estop", False, True),
        (f"{BASE}/incoming/soundboard-command", False, True),
        (f"{BASE}/outgoing/touch-sensors", False, False),
        (f"{BASE}/outgoing/status", False, False),
    ],
)
def test_vital_topics_are_never_withheld(topic: str, remote: bool, local: bool, tmp_path: Path) -> None:
    broker = {"host": "127.0.0.1"}
    services = {
        "mqtt_bridge": {"enabled": True, "remote_mqtt": broker, "heartbeat": {"topic": "site/alive"}},
        "serial_mcu_bridge": {"topics": {"drive_values": "site/drive"}},
    }
    document = {"robot": {"id": "goob"}, "transport": {"kind": "mqtt"}, "local_mqtt": broker, "services": services}
    config = parse(document, folder=tmp_path, env={})
    tool = mqtt_settings(config.services.mqtt_bridge.remote_mqtt, reconnect_max_s=1.0)
    settings = (remote_transport(config, "remote-bridge").settings, local_settings(config))  # type: ignore[attr-defined]
    assert [any(matches(one, topic) for one in each.vital) for each in settings] == [remote, local]
    assert any(matches(one, topic) for one in tool.vital) == (local and not topic.startswith("site/"))
