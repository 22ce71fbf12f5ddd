"""docs/ext/boards.md and serial-protocol.md: the example is a valid manifest, and the numbers agree with the code."""

from __future__ import annotations

import re
from typing import Any

from pebble.services.serial_mcu_bridge.devices import described_bridge, peers
from pebble.services.serial_mcu_bridge.devices.aliases import claims
from pebble.services.serial_mcu_bridge.pebble_serial_v1 import frame, host, manifest
from tests.support import ROOT

DOCUMENT = "".join((ROOT / "docs/ext" / name).read_text() for name in ("boards.md", "serial-protocol.md"))


def test_the_examples_are_a_valid_manifest_and_valid_frames() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", DOCUMENT, re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    assert manifest.parse_hello(names["HELLO"]).device_uid == "lamp-1"
    described = manifest.parse_describe(names["DESCRIBE"])
    assert set(claims(described.payload()).granted) == {"incoming/lights/lamp", "outgoing/lights/lamp"}
    request, command = (bytes.fromhex(found) for found in re.findall(r"`((?:[0-9a-f]{2} ){9,}00)`", DOCUMENT))
    assert frame.decode(request[:-1]).type is frame.Type.DESCRIBE_REQ
    assert frame.decode(command[:-1]) == frame.Frame(frame.Type.CMD, b"\x01", 3, 1)


def test_the_numbers_agree_with_the_code() -> None:
    sentences = " ".join(DOCUMENT.split())
    for number, sentence in (
        (frame.FRAME_LIMIT, "{} bytes between two zeros"),
        (host.PING_S, "After {:g} s of silence the host sends a PING"),
        (host.SILENCE_S, "after {:g} s the device counts as gone"),
        (host.ASK_AFTER_OPENING_S, "{:g} s after opening the port"),
        (host.ASK_AFTER_HELLO_S, "{:g} s after a HELLO"),
        (host.ANSWER_S, "no answer within {:g} s"),
        (host.WAITING, "Up to {} commands per interface"),
        (peers.CONFIRM_S, "counts as a claim for {:g} s"),
        (described_bridge.CLAIM_S, "only {:g} s after it has published"),
        (manifest.MOST_INTERFACES, "fields of an interface; levels of a channel | {}; 64; 8"),
    ):
        assert sentence.format(number) in sentences, sentence
    assert described_bridge.CLAIM_S + described_bridge.DescribedBridge.retry_s < 1, "topics exist within two seconds"
