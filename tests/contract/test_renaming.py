"""Topics that options of scripts choose."""

from __future__ import annotations

import pytest

from pebble.contract import APRILTAG_DATA, WHEEL_ODOMETRY, codec
from pebble.contract.payloads import WheelOdometry
from pebble.contract.renaming import renamed
from pebble.errors import ConfigError

BASE = "pebble/robots/goob"


def test_no_topic_and_the_usual_one_change_nothing() -> None:
    assert renamed(WHEEL_ODOMETRY, "", BASE) is WHEEL_ODOMETRY
    assert renamed(WHEEL_ODOMETRY, f"{BASE}/outgoing/wheel-odometry", BASE) is WHEEL_ODOMETRY


def test_a_topic_of_the_robot_has_the_channels_payload_and_delivery() -> None:
    other = renamed(WHEEL_ODOMETRY, f"{BASE}/outgoing/front/odometry", BASE)
    assert other.topic(BASE) == f"{BASE}/outgoing/front/odometry"
    assert (other.kind, other.default_qos) == (WHEEL_ODOMETRY.kind, WHEEL_ODOMETRY.default_qos)
    assert codec.decode(other, codec.encode(other, WheelOdometry(value={}, timestamp=1.0))).timestamp == 1.0


@pytest.mark.parametrize(
    "topic",
    [
        *(f"{BASE}/incoming/drive-values", f"{BASE}/outgoing/", f"{BASE}/outgoing/+", f"{BASE}/outgoing/odometry/#"),
        *(f"{BASE}/outgoing/{{name}}", "pebble/robots/fred/outgoing/wheel-odometry", "odometry", "$SYS/odometry"),
    ],
)
def test_other_topics_are_refused(topic: str) -> None:
    with pytest.raises(ConfigError, match="must be below pebble/robots/goob/outgoing/"):
        renamed(WHEEL_ODOMETRY, topic, BASE)


@pytest.mark.parametrize("metric", ["capabilities", "estop/serial", "apriltag-locations", "outlets/1/status"])
def test_a_topic_with_another_meaning_is_refused(metric: str) -> None:
    with pytest.raises(ConfigError, match="has another meaning already"):
        renamed(APRILTAG_DATA, f"{BASE}/outgoing/{metric}", BASE)
