"""Two channels under one topic: every message would be taken for both."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.errors import ConfigError


def problems(**services: Any) -> list[str]:
    try:
        parse({"robot": {"id": "goob"}, "services": services}, folder=Path("/nowhere"), env={})
    except ConfigError as error:
        return error.problems
    return []


def serial(**topics: str) -> dict[str, Any]:
    return {"topics": topics}


@pytest.mark.parametrize(
    ("services", "expected"),
    [
        (
            {"serial_mcu_bridge": serial(drive_values="a/b", lights_solid="a/b")},
            "serial_mcu_bridge.topics.lights_solid: is also the topic of incoming/drive-values, choose another",
        ),
        (
            {"serial_mcu_bridge": serial(charging_level="pebble/robots/goob/incoming/drive-values")},
            "serial_mcu_bridge.topics.charging_level: is also the topic of incoming/drive-values, choose another",
        ),
        (
            {"mqtt_bridge": {"heartbeat": {"topic": "pebble/robots/goob/outgoing/status"}}},
            "mqtt_bridge.heartbeat.topic: is also the topic of outgoing/status, choose another",
        ),
        (
            {"serial_mcu_bridge": {"instances": {"rear": serial(lights_flash="pebble/robots/goob/incoming/audio")}}},
            "serial_mcu_bridge.instances.rear.topics.lights_flash: is also the topic of incoming/audio, choose another",
        ),
    ],
)
def test_two_channels_with_one_topic(services: dict[str, Any], expected: str) -> None:
    assert problems(**services) == [f"services.{expected}"]


def test_lines_may_share_a_channel_and_channels_may_change_places() -> None:
    swapped = {
        "drive_values": "pebble/robots/goob/incoming/lights-solid",
        "lights_solid": "pebble/robots/goob/incoming/drive-values",
    }
    assert problems(serial_mcu_bridge=serial(**swapped)) == []
    assert problems(serial_mcu_bridge={"topics": {"drive_values": "a/b"}, "instances": {"one": {}, "two": {}}}) == []
