"""Topics that a robot retains, by its heartbeats and capabilities."""

from __future__ import annotations

import pytest

from pebble.runtime.retained_names import retained_names
from pebble.transports import Message

BASE = "pebble/robots/größe"
OWN = f"{BASE}/outgoing"


@pytest.mark.parametrize(
    ("suffix", "payload", "retain", "names"),
    [
        ("outgoing/online", "{}", False, ["capabilities", "status", "charging-level", "autonomy-status"]),
        ("outgoing/heartbeat", "", False, ["capabilities", "online"]),
        ("outgoing/online", "{}", True, []),  # no sign of life
        ("outgoing/status", f'"{OWN}/estop/serial"', False, []),
        ("incoming/online", "{}", False, []),
        ("outgoing/capabilities", f'{{"a": ["{OWN}/estop/serial", "{OWN}/x"]}}', True, ["estop/serial", "x"]),
        (
            "outgoing/capabilities",
            f'["{OWN}/a/+", "{OWN}/#", "{OWN}/a b", "{OWN}/a>", "{OWN}/\\n", "{OWN}/"]',
            True,
            [],
        ),
        ("outgoing/capabilities", '["pebble/robots/other/outgoing/estop/serial"]', True, []),
        ("outgoing/capabilities", f'["{OWN}/{"x" * 201}"]', True, []),
    ],
)
def test_names(suffix: str, payload: str, retain: bool, names: list[str]) -> None:
    found = list(retained_names(Message(f"{BASE}/{suffix}", payload.encode(), retain=retain)))
    assert {f"{OWN}/{name}" for name in names} <= {*found}
    assert bool(names) is bool(found)


def test_they_are_bounded() -> None:
    many = "".join(f'"{OWN}/{number}"' for number in range(1000)).encode()
    assert len(retained_names(Message(f"{OWN}/capabilities", many, retain=True))) == 100
    assert not retained_names(Message(f"pebble/robots/{'x' * 500}/outgoing/online", b""))
