"""The offers of a component: sections of the ``value`` of its Capabilities (paper A.8.6).

A section that is absent or malformed offers nothing; some have a *card*, a box of the operator page. Topics are whole,
and below the component's own identity; readers use no others. An absent topic is that of the contract.
"""

from typing import Any, Literal

from msgspec import UNSET, UnsetType
from msgspec.structs import replace

from pebble.contract.looks import Body, Colour
from pebble.contract.payloads import Payload


class RobotIdentity(Payload, frozen=True, kw_only=True):
    """The identity of the robot, and its looks. Each program has defaults for absent fields."""

    system: str  # the first three levels of its topics
    type: str
    id: str
    name: str | UnsetType = UNSET  # what people call it, 32 characters at most; without it, its id
    description: str | UnsetType = UNSET  # what it is, 60 characters at most
    colour: Colour | UnsetType = UNSET
    picture: Body | UnsetType = UNSET  # the drawing that stands for it
    battery_cells: int | UnsetType = UNSET  # lithium cells in series; without them volts are shown, and no per cent


class TransportOffer(Payload, frozen=True, kw_only=True):
    """The transport inside the robot; for people only."""

    kind: str  # mqtt or zenoh


class Offer(Payload, frozen=True, kw_only=True):
    """A section of capabilities. ``available``: it exists. ``controls``: it obeys commands."""

    available: bool = False
    controls: bool = False


class VideoOffer(Offer, frozen=True, kw_only=True):
    """A camera. Without it there is no picture to request; a robot without any capabilities may have one."""

    topic: str | UnsetType = UNSET  # of the pictures
    command_topic: str | UnsetType = UNSET  # of requests
    flag_topic: str | UnsetType = UNSET  # of the flag that lets it send
    overlays_topic: str | UnsetType = UNSET  # of drawings over the picture
    width: float | UnsetType | None = UNSET  # pixels
    height: float | UnsetType | None = UNSET
    fps: float | UnsetType | None = UNSET
    encoding: str | UnsetType = UNSET  # that it sends unless a request names another
    encodings: list[str] | UnsetType = UNSET  # that a request may name; without them it names none


class AudioOffer(Offer, frozen=True, kw_only=True):
    """A microphone, and a loudspeaker if there is an ``uplink_topic``. Without this section there is no sound."""

    topic: str | UnsetType = UNSET  # of its sound
    uplink_topic: str | UnsetType = UNSET  # of voices to it
    command_topic: str | UnsetType = UNSET
    flag_topic: str | UnsetType = UNSET
    rate: float | UnsetType | None = UNSET  # samples a second
    channels: float | UnsetType | None = UNSET
    encoding: str | UnsetType = UNSET
    encodings: list[str] | UnsetType = UNSET


class FilesOffer(Offer, frozen=True, kw_only=True):
    """Sounds or scripts of a robot. Without this section their card is shown once the robot publishes a list."""

    command_topic: str | UnsetType = UNSET
    files_topic: str | UnsetType = UNSET
    status_topic: str | UnsetType = UNSET


class FlagOffer(Offer, frozen=True, kw_only=True):
    """An action that a flag starts."""

    flag_topic: str | UnsetType = UNSET


class SystemOffer(Payload, frozen=True, kw_only=True):
    """Actions of the robot's computer. An absent action has no button."""

    reboot: FlagOffer | UnsetType = UNSET
    service_restart: FlagOffer | UnsetType = UNSET
    git_pull: FlagOffer | UnsetType = UNSET


class DriveOffer(Offer, frozen=True, kw_only=True):
    """Wheels, or anything else that moves the robot. Without this section there is no card to drive."""

    topic: str | UnsetType = UNSET  # of drive commands
    axes: list[Literal["x", "y", "z"]] | UnsetType = UNSET  # that move anything; without it all of them
    arbitrates: bool | UnsetType = UNSET  # people go before scripts; without it stop the script, then drive
    control: bool | UnsetType = UNSET  # it publishes who drives (docs/control.md); without it servers agree on that


class EstopOffer(Payload, frozen=True, kw_only=True):
    """A latching emergency stop. Without it, a stop is only a zero drive command, and pages say so."""

    available: bool = False
    topic: str | UnsetType = UNSET
    reset_topic: str | UnsetType = UNSET
    owners: list[str] | UnsetType = UNSET  # the names of all motor owners: a stop is confirmed when each reports it
    status_topics: list[str] | UnsetType = UNSET  # of their states, in the order of `owners`
    zeros: list[str] | UnsetType = UNSET  # drive topics of motors that no stop can hold: zeros go there during a stop


class LightsOffer(Payload, frozen=True, kw_only=True):
    """Lights. Without this section there is no card for lights."""

    solid: bool = False  # a steady colour
    flash: bool = False  # one that fades in and out
    solid_topic: str | UnsetType = UNSET
    flash_topic: str | UnsetType = UNSET


class TelemetryOffer(Payload, frozen=True, kw_only=True):
    """Measurements. A measurement that is not listed is shown from its first message on."""

    touch_sensors: bool = False
    charging_status: bool = False
    touch_topic: str | UnsetType = UNSET
    charging_topic: str | UnsetType = UNSET
    charging_level_topic: str | UnsetType = UNSET
    wheel_odometry: bool = False  # scripts can measure it
    wheel_odometry_topic: str | UnsetType = UNSET
    imu: bool = False
    imu_topic: str | UnsetType = UNSET


class OutletOffer(Payload, frozen=True, kw_only=True):
    """One outlet of a board that is connected."""

    name: str
    controls: bool = False
    status_topic: str | UnsetType = UNSET
    command_topic: str | UnsetType = UNSET


class OutletsOffer(Offer, frozen=True, kw_only=True):
    """Switched outlets. Without this section an outlet is shown from its first status on."""

    outlets: list[OutletOffer] | UnsetType = UNSET


class CapabilitiesValue(Payload, frozen=True, kw_only=True):
    """The ``value`` of Capabilities. A robot in another language lists what it has, and leaves out the rest."""

    identity: RobotIdentity | UnsetType = UNSET
    transport: TransportOffer | UnsetType = UNSET
    video: VideoOffer | UnsetType = UNSET
    audio: AudioOffer | UnsetType = UNSET
    soundboard: FilesOffer | UnsetType = UNSET
    autonomy: FilesOffer | UnsetType = UNSET
    system: SystemOffer | UnsetType = UNSET
    drive: DriveOffer | UnsetType = UNSET
    estop: EstopOffer | UnsetType = UNSET
    lights: LightsOffer | UnsetType = UNSET
    telemetry: TelemetryOffer | UnsetType = UNSET
    outlets: OutletsOffer | UnsetType = UNSET
    groups: list[str] | UnsetType = UNSET  # metrics of the commands that it takes in a group; clients group no others
    named: bool | UnsetType = UNSET  # it takes commands only with an account's name in the topic (docs/ext/fleet.md)
    announced: bool | UnsetType = UNSET  # set by readers that derive this from a heartbeat's `subscribes`; never sent


def offered(offer: Any, enabled: bool) -> Any:
    """Return ``offer`` with ``enabled`` as its ``available`` and its ``controls``."""
    return replace(offer, available=enabled, controls=enabled)
