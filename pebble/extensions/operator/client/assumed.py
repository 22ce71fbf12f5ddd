"""The capabilities assumed for a board that publishes none, such as the original Pebble's boards. Pure."""

from collections.abc import Collection
from typing import Any, Final, Literal

import msgspec

from pebble.contract import DRIVE
from pebble.contract.payloads import Drive
from pebble.extensions.operator.client.announced import announced

Axis = Literal["x", "z", "y"]
AXES: Final[tuple[Axis, ...]] = ("x", "z")  # unless more are known
HEARD_S = 5.0  # so long it has sent heartbeats: a robot that starts has said by then what it can do
#: After the zero at the end of a gesture: while such a board connects anew, nothing but a later zero stops it.
REPEATS_S = (0.15, 0.45)
#: What people have to know who let it be driven.
RISK = "A stop cannot latch it, and it may roll on while its Wi-Fi is away."
PARKED = "A drive command is retained on its topic, and moves it whenever it connects: clear it first"

#: The heartbeat of a robot that says that it reads drive commands, and nothing else.
_DRIVES = msgspec.json.encode({"subscribes": [DRIVE.suffix]})


def assumed(base: str, axes: Collection[str], name: str = "") -> dict[str, Any]:
    """Return the assumed capabilities: a name, and driving if there are any ``axes``.

    They have ``assumed`` and ``announced``. Because of ``announced`` a page tells the board's maker to publish
    capabilities, and subscriptions that the board lists later replace what is assumed.
    """
    value = announced(base, _DRIVES) if axes else {}
    if axes:
        value["drive"]["axes"] = list(axes)
    if name:
        value["identity"] = {"name": name}
    return value | {"announced": True, "assumed": True} if value else {}


def encode(drive: Drive, axes: Collection[str]) -> bytes:
    """Return a drive command with these axes only; the board's MQTT client drops messages above 256 bytes."""
    return msgspec.json.encode({axis: round(getattr(drive, axis), 3) for axis in axes})
