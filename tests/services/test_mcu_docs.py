"""docs/mcu.md: its example is a manifest, and its numbers are the code's."""

from __future__ import annotations

import re
from typing import Any

from pebble.services.serial_mcu_bridge import described_bridge, frame, manifest, neighbours, pebble_serial, uid_claim
from pebble.services.serial_mcu_bridge.aliases import claims
from tests.support import ROOT

DOCUMENT = (ROOT / "docs" / "mcu.md").read_text()


def test_the_example_is_a_manifest() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", DOCUMENT, re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    assert manifest.parse_hello(names["HELLO"]).device_uid == "lamp-1"
    described = manifest.parse_describe(names["DESCRIBE"])
    assert set(claims(described.payload()).granted) == {"incoming/lights/lamp", "outgoing/lights/lamp"}


def test_the_frames_are_frames() -> None:
    request, command = (bytes.fromhex(found) for found in re.findall(r"`((?:[0-9a-f]{2} ){9,}00)`", DOCUMENT))
    assert frame.decode(request[:-1]).type is frame.Type.DESCRIBE_REQ
    assert frame.decode(command[:-1]) == frame.Frame(frame.Type.CMD, b"\x01", 3, 1)


def test_the_numbers_are_the_codes() -> None:
    for number, words in (
        (frame.FRAME_LIMIT, "{} bytes between two zeros"),
        (pebble_serial.PING_S, "After {:g} s of silence the host sends a PING"),
        (pebble_serial.SILENCE_S, "after {:g} s the device counts as gone"),
        (pebble_serial.ASK_AFTER_OPENING_S, "{:g} s after opening the port"),
        (pebble_serial.ASK_AFTER_HELLO_S, "{:g} s after a HELLO"),
        (pebble_serial.ANSWER_S, "no answer within {:g} s"),
        (pebble_serial._WAITING, "Up to {} commands per interface"),
        (neighbours.CONFIRM_S, "counts as a claim for {:g} s"),
        (described_bridge._CLAIM_S, "only {:g} s after it has published"),
        (manifest._MOST_INTERFACES, "fields of one; levels of a channel | {}; 64; 8"),
    ):
        assert words.format(number) in DOCUMENT, words
    assert uid_claim.ASK_S + described_bridge._CLAIM_S + described_bridge._RETRY_S < 1, "found within two seconds"
