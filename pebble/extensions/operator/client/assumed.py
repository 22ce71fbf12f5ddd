"""The capabilities of a robot that publishes none: by the subscriptions in its heartbeat or status, else assumed. Pure.

Such are boards in other languages, and the original Pebble's.
"""

from collections.abc import Collection
from typing import Any, Final, Literal

import msgspec

from pebble import contract as c
from pebble.contract.capabilities import (
    AudioOffer,
    CapabilitiesValue,
    DriveOffer,
    FilesOffer,
    FlagOffer,
    LightsOffer,
    SystemOffer,
    VideoOffer,
)
from pebble.contract.payloads import Drive

Axis = Literal["x", "z", "y"]
#: Of a board that lists no subscriptions either, and that people let be driven.
AXES: Final[tuple[Axis, ...]] = ("x", "z")  # unless more are known
HEARD_S = 5.0  # so long it has sent heartbeats: a robot that starts has said by then what it can do
#: After the zero at the end of a gesture: while such a board connects anew, nothing but a later zero stops it.
REPEATS_S = (0.15, 0.45)
#: What people have to know who let it be driven.
RISK = "A stop cannot latch it, and it may roll on while its Wi-Fi is away."
PARKED = "A drive command is retained on its topic, and moves it whenever it connects: clear it first"

_LARGEST = 4096  # bytes of a heartbeat or status that are looked at
_KNOWN = (
    c.DRIVE, c.VIDEO_CONTROL, c.AUDIO_CONTROL, c.SOUNDBOARD_COMMAND, c.AUTONOMY_COMMAND,
    c.LIGHTS_SOLID, c.LIGHTS_FLASH, c.REBOOT, c.SERVICE_RESTART, c.GIT_PULL,
)  # fmt: skip


def announced(base: str, payload: bytes) -> dict[str, Any]:
    """Return the capabilities that follow from ``"subscribes": ["incoming/drive-values", …]``; empty without a list.

    Their ``announced`` is true: so a page tells the robot's maker to publish capabilities. Whole topics in the list
    are ignored, also the robot's own.
    """
    if len(payload) > _LARGEST or b'"subscribes"' not in payload:
        return {}
    decoded = json_object(payload) or {}
    subscribes, value = decoded.get("subscribes"), decoded.get("value")
    if subscribes is None and isinstance(value, dict):  # a status has it inside its value
        subscribes = value.get("subscribes")
    if not isinstance(subscribes, list):
        return {}
    has = {channel for channel in _KNOWN if channel.suffix in subscribes}
    capabilities: dict[str, Any] = msgspec.to_builtins(_value(base, has)) if has else {}
    return capabilities


def json_object(raw: bytes) -> dict[str, Any] | None:
    """Return the JSON object in ``raw``; None if there is none."""
    try:
        value = msgspec.json.decode(raw)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        return None
    return value if isinstance(value, dict) else None


def assumed(base: str, axes: Collection[str], name: str = "") -> dict[str, Any]:
    """Return the assumed capabilities: a name, and driving if there are any ``axes``.

    They have ``assumed`` and ``announced``. Because of ``announced`` a page tells the board's maker to publish
    capabilities, and subscriptions that the board lists later replace what is assumed.
    """
    value: dict[str, Any] = msgspec.to_builtins(_value(base, {c.DRIVE})) if axes else {}
    if axes:
        value["drive"]["axes"] = list(axes)
    if name:
        value["identity"] = {"name": name}
    return value | {"announced": True, "assumed": True} if value else {}


def encode(drive: Drive, axes: Collection[str]) -> bytes:
    """Return a drive command with these axes only; the board's MQTT client drops messages above 256 bytes."""
    return msgspec.json.encode({axis: round(getattr(drive, axis), 3) for axis in axes})


def _value(base: str, has: set[c.Channel]) -> CapabilitiesValue:
    """Return the capabilities of a robot that has subscribed to these channels."""

    def offer(kind: Any, channel: c.Channel) -> Any:
        return kind(available=channel in has, controls=channel in has)

    return CapabilitiesValue(
        video=offer(VideoOffer, c.VIDEO_CONTROL),
        audio=offer(AudioOffer, c.AUDIO_CONTROL),
        soundboard=offer(FilesOffer, c.SOUNDBOARD_COMMAND),
        autonomy=offer(FilesOffer, c.AUTONOMY_COMMAND),
        system=SystemOffer(
            reboot=offer(FlagOffer, c.REBOOT),
            service_restart=offer(FlagOffer, c.SERVICE_RESTART),
            git_pull=offer(FlagOffer, c.GIT_PULL),
        ),
        drive=DriveOffer(available=c.DRIVE in has, controls=c.DRIVE in has, topic=c.DRIVE.topic(base)),
        lights=LightsOffer(solid=c.LIGHTS_SOLID in has, flash=c.LIGHTS_FLASH in has),
        announced=True,
    )
