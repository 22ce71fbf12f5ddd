"""Capabilities derived from the list of subscriptions in a robot's heartbeat or status. Pure."""

from typing import Any

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

_LARGEST = 4096  # bytes of a heartbeat or status that are looked at


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


_KNOWN = (
    c.DRIVE, c.VIDEO_CONTROL, c.AUDIO_CONTROL, c.SOUNDBOARD_COMMAND, c.AUTONOMY_COMMAND,
    c.LIGHTS_SOLID, c.LIGHTS_FLASH, c.REBOOT, c.SERVICE_RESTART, c.GIT_PULL,
)  # fmt: skip


def _value(base: str, has: set[c.Channel]) -> CapabilitiesValue:
    """Return the capabilities of a robot that has subscribed to these channels."""

    def flag(channel: c.Channel) -> FlagOffer:
        return FlagOffer(available=channel in has, controls=channel in has)

    def offer(kind: Any, channel: c.Channel) -> Any:
        return kind(available=channel in has, controls=channel in has)

    return CapabilitiesValue(
        video=offer(VideoOffer, c.VIDEO_CONTROL),
        audio=offer(AudioOffer, c.AUDIO_CONTROL),
        soundboard=offer(FilesOffer, c.SOUNDBOARD_COMMAND),
        autonomy=offer(FilesOffer, c.AUTONOMY_COMMAND),
        system=SystemOffer(reboot=flag(c.REBOOT), service_restart=flag(c.SERVICE_RESTART), git_pull=flag(c.GIT_PULL)),
        drive=DriveOffer(available=c.DRIVE in has, controls=c.DRIVE in has, topic=c.DRIVE.topic(base)),
        lights=LightsOffer(solid=c.LIGHTS_SOLID in has, flash=c.LIGHTS_FLASH in has),
        announced=True,
    )
