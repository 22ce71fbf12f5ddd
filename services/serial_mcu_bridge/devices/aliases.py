"""The channels that a self-describing MCU may use besides its own generic topics. Pure."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pebble import contract as c
from pebble.contract.payloads import McuManifest
from pebble.services.serial_mcu_bridge.imu import reports as imu

#: First levels that no MCU may use: switches and actions of the robot itself, and the devices' generic topics.
_OWN_FAMILIES = ("flags", "mcu")

#: The contract's channels that an MCU may take over, and the profile whose body they carry; empty: the generic body.
_OPEN = {
    c.IMU_FAST.suffix: imu.MOTION,
    c.IMU.suffix: imu.SUMMARY,
    c.OUTLET_STATUS.suffix: "",
    c.OUTLET_COMMAND.suffix: "",
}

Lookup = Callable[[str], c.Channel | None]


@dataclass(frozen=True, slots=True)
class Claims:
    """The claims of one manifest: interface names by claim, and the reasons of refusals by interface name.

    A claim is a channel with its direction, such as ``outgoing/outlets/o1/status``.
    """

    granted: Mapping[str, str]
    refused: Mapping[str, str]


def claims(manifest: McuManifest, lookup: Lookup = c.channel_of) -> Claims:
    """Return the claims of a manifest. Every process that reads the manifest comes to the same result.

    ``lookup`` returns the robot's channel with the topic that a claim names, renamed or not; None if there is none.
    """
    granted: dict[str, str] = {}
    refused: dict[str, str] = {}
    for interface in manifest.interfaces:
        name, channel = str(interface.get("name")), interface.get("channel")
        if not channel or not isinstance(channel, str):
            continue
        claim = f"{c.INCOMING if interface.get('dir') == 'in' else c.OUTGOING}/{channel}"
        reason = f"{granted[claim]} has it already" if claim in granted else _why_not(claim, interface, lookup)
        if reason:
            refused[name] = f"{claim}: {reason}"
        else:
            granted[claim] = name
    return Claims(granted, refused)


def outlet_feature(claim: str) -> set[str]:
    """Return the feature that a robot has while ``claim`` is in use: ``outlets/o1/status``; empty if no outlet."""
    return {claim.partition("/")[2]} if c.channel_of(claim) in (c.OUTLET_STATUS, c.OUTLET_COMMAND) else set()


def _why_not(claim: str, interface: Mapping[str, Any], lookup: Lookup) -> str:
    """Return why an MCU must not use this channel; empty if it may. It must not command or imitate the robot."""
    direction, family = claim.split("/")[:2]
    if family in _OWN_FAMILIES or c.is_reserved(family):
        return f"{direction}/{family} is the robot's own"
    channel = lookup(claim)
    if channel is None:
        return ""
    profile = _OPEN.get(channel.suffix)  # None: not for MCUs; "": the generic body, which names the device
    if profile is None:
        return "the channel is the robot's own"
    if profile and channel.remote and interface.get("local_only"):
        return "it may leave the robot, and its payload does not name the device, so it cannot be local_only"
    if profile and (interface.get("profile") != profile or not imu.fits(profile, _field_names(interface))):
        return f"it needs the profile {profile} and its fields"
    return ""


def _field_names(interface: Mapping[str, Any]) -> set[str]:
    encoding = interface.get("encoding")
    fields = encoding.get("fields") if isinstance(encoding, dict) else None
    if not isinstance(fields, list):
        return set()
    return {str(field.get("name")) for field in fields if isinstance(field, dict)}
