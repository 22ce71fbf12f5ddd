"""What an MQTT client concludes about bridge mode from how its attempts to connect end."""

from __future__ import annotations

import pytest

from pebble.transports.mqtt.bridge_mode import BridgeMode, Result

ACCEPTED, PROTOCOL, HUNG_UP, OTHER = Result.ACCEPTED, Result.PROTOCOL_REFUSED, Result.HUNG_UP, Result.FAILED


@pytest.mark.parametrize(
    ("results", "attempts"),
    [
        ([ACCEPTED], "bridge bridge"),
        ([PROTOCOL], "bridge plain"),
        ([PROTOCOL, ACCEPTED], "bridge plain bridge"),  # it is tried again with each connection
        ([PROTOCOL, OTHER], "bridge plain bridge"),
        ([OTHER] * 4, "bridge bridge bridge bridge bridge"),  # a wrong password, say
        ([HUNG_UP] * 6, "bridge probe bridge probe bridge probe bridge"),  # a proxy whose broker is away
        ([HUNG_UP, OTHER, HUNG_UP], "bridge probe bridge probe"),
        ([HUNG_UP, ACCEPTED, ACCEPTED], "bridge probe bridge bridge"),  # the broker was just starting
        ([HUNG_UP, ACCEPTED, OTHER, HUNG_UP], "bridge probe bridge bridge probe"),
        ([HUNG_UP, ACCEPTED, HUNG_UP], "bridge probe bridge plain"),
        ([HUNG_UP, ACCEPTED, HUNG_UP, ACCEPTED, HUNG_UP], "bridge probe bridge plain bridge plain"),  # remembered
        ([PROTOCOL, ACCEPTED, HUNG_UP], "bridge plain bridge plain"),
        ([PROTOCOL, ACCEPTED, ACCEPTED, HUNG_UP], "bridge plain bridge bridge probe"),  # another broker
    ],
)
def test_attempts(results: list[Result], attempts: str) -> None:
    """Those that end with ``results``, and the one after them."""
    mode = BridgeMode()
    made = []
    for result in results:
        made.append(mode.next_attempt.value)
        mode.note(result)
    assert [*made, mode.next_attempt.value] == attempts.split()
