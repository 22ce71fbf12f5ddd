"""Messages to publish, as the contract completes and refuses them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pebble.errors import PebbleError
from pebble.extensions.operator.client.names import Names
from pebble.extensions.operator.commands.draft import draft
from tests.commands.command_line import GOOB


def test_the_contract_fills_in_how_to_publish(tmp_path: Path) -> None:
    def made(name: str, text: str, **options: Any) -> tuple[str, bytes, int, bool]:
        message = draft(Names(GOOB), name, text, **{"retain": None, "qos": None, "force": False, **options})
        assert message.warnings == ()
        return message.topic, message.payload, message.qos, message.retain

    (tmp_path / "drive.json").write_bytes(b'{"x": 1}')
    assert made("drive-values", f"@{tmp_path}/drive.json") == (f"{GOOB}/incoming/drive-values", b'{"x": 1}', 1, False)
    assert made("flags/mqtt-video", "true") == (f"{GOOB}/incoming/flags/mqtt-video", b"true", 1, True)
    assert made("flags/mqtt-video", "true", retain=False, qos=0)[2:] == (0, False)
    assert made("drive-values", "", retain=True)[3] is True  # removes the retained message
    assert made("drive-values", '{"x": 0}', retain=True, force=True)[3] is True


@pytest.mark.parametrize("name", ["drive-values", "flags/reboot", "audio-stream", "front-camera"])
def test_a_retained_command_is_refused(name: str) -> None:
    with pytest.raises(PebbleError, match="--force"):
        draft(Names(GOOB), name, "true", retain=True, qos=None, force=False)


@pytest.mark.parametrize(
    ("name", "text", "doubt"),
    [
        ("drive-values", '{"x": NaN}', "will refuse"),
        ("flags/reboot", "1", "will refuse"),
        ("outgoing/online", '{"t": 1}', "published by robots"),
        ("heartbeat", '{"t": 1}', "older name of online"),
        ("drive-values", '{"speed": 0.5}', "none of x, z and y is in it, but 'speed': so it is a stop"),
        ("drive-values", '{"value": {"speed": 0.5}}', "'speed'"),
        ("house/lamp", "on", "not in the contract"),
    ],
)
def test_doubtful_messages_are_sent_with_a_warning(name: str, text: str, doubt: str) -> None:
    message = draft(Names(GOOB), name, text, retain=None, qos=None, force=False)
    assert any(doubt in one for one in message.warnings)


@pytest.mark.parametrize("text", ['{"x": 0}', '{"z": 0.5, "speed": 1}', '{"z": "0.5"}'])
def test_a_stop_and_a_command_with_an_axis_are_sent_without_a_warning(text: str) -> None:
    assert draft(Names(GOOB), "drive-values", text, retain=None, qos=None, force=False).warnings == ()
