"""A described MCU on this robot: the channel and the payloads of each of its interfaces."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from pebble import contract as c
from pebble.contract.payloads import McuLocalOnly, McuManifest, McuSample, Payload
from pebble.runtime.addresses import Addresses
from pebble.services.serial_mcu_bridge.devices.aliases import Claims, claims
from pebble.services.serial_mcu_bridge.imu import reports as imu
from pebble.services.serial_mcu_bridge.pebble_serial_v1.host import Reading
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import Direction, Interface, InterfaceKind, Manifest

_Object = dict[str, Any]

#: How an interface of each kind travels: sensor readings may be lost, states may not.
_KINDS = {
    InterfaceKind.SAMPLE: (c.Kind.STREAM, 0),
    InterfaceKind.STATE: (c.Kind.STREAM, 1),
    InterfaceKind.EVENT: (c.Kind.EVENT, 1),
    InterfaceKind.COMMAND: (c.Kind.COMMAND, 1),
}

Body = Callable[[McuSample], Payload | None]


@dataclass(frozen=True, slots=True)
class Alias:
    """An extra channel for one interface. While two devices have the same ``claim``, neither uses it."""

    claim: str
    channel: c.Channel
    body: str  # the profile whose body it carries; empty: the generic one


@dataclass(frozen=True, slots=True)
class Route:
    """The channels of an interface: its generic one, and an alias if the robot lets it have one."""

    interface: Interface
    generic: c.Channel
    alias: Alias | None


class Device:
    """A described MCU. ``payload`` is its manifest as published, with channels renamed as in the robot's config."""

    def __init__(self, manifest: Manifest, addresses: Addresses, reports: imu.ImuReports) -> None:
        self._addresses, self._reports = addresses, reports
        self.uid = manifest.uid
        self.hello = manifest.hello
        interfaces = tuple(map(self._renamed, manifest.interfaces))
        self.payload: McuManifest = Manifest(manifest.hello, interfaces).payload()
        self.claims: Claims = claims(self.payload, self._robots_channel)
        self.routes = {interface.id: self._route(interface) for interface in interfaces}

    @property
    def has_motion(self) -> bool:
        """True if the MCU has an inertial sensor, which sends all the time."""
        return any(route.interface.profile == imu.MOTION for route in self.routes.values())

    @property
    def local_only(self) -> McuLocalOnly:
        """The topics of this MCU's interfaces that stay on the robot."""
        routes = [route for route in self.routes.values() if route.interface.local_only]
        aliases = [route.alias.claim for route in routes if route.alias is not None]
        return McuLocalOnly(topics=[*(route.generic.suffix for route in routes), *aliases])

    def sample(self, reading: Reading, t: int) -> McuSample:
        """Return a reading as the payload of its interface's generic topic."""
        interface = reading.interface
        return McuSample(
            t=t,
            seq=reading.sequence,
            mcu_ms=reading.mcu_ms,
            device_uid=self.uid,
            interface=interface.name,
            profile=interface.profile,
            value=reading.values,
        )

    def alias_body(self, route: Route, sample: McuSample) -> Payload | None:
        """Return ``sample`` as the payload of its interface's :class:`Alias`; None if there is none yet.

        An inertial sensor may have two interfaces: for samples of its motion, and for summaries, whose payloads repeat
        the newest of these. So a sample of motion is stored as well, and a summary before the first one gives None.
        """
        has_imu_body = route.alias is not None and route.alias.body != ""  # "": the generic payload
        if route.interface.profile == imu.MOTION and imu.fits(imu.MOTION, sample.value):
            motion = self._reports.motion(sample.t, sample.seq, sample.mcu_ms, sample.value)
            return motion if has_imu_body else sample
        if has_imu_body:
            return self._reports.summary(sample.t, sample.seq, sample.mcu_ms, sample.value)
        return sample

    def _route(self, interface: Interface) -> Route:
        incoming = interface.direction is Direction.IN
        pattern = c.MCU_COMMAND if incoming else c.MCU_VALUE
        metric = pattern.metric.format(uid=self.uid, name=interface.name)
        payload = _Object if incoming else McuSample
        generic = _channel(metric, interface.kind, payload, retain=interface.retain)
        return Route(interface, generic, self._alias(interface, payload))

    def _alias(self, interface: Interface, payload: Any) -> Alias | None:
        """Return the alias of an interface; None if the channel it names is another interface's or the robot's own.

        ``payload``: the type of the payloads on the interface's generic channel, the one below ``mcu/``.
        """
        claim = f"{c.INCOMING if interface.direction is Direction.IN else c.OUTGOING}/{interface.channel}"
        if self.claims.granted.get(claim) != interface.name:
            return None
        channel = self._robots_channel(claim)
        if channel in (c.IMU_FAST, c.IMU):  # the contract has these, with the body of their profile
            return Alias(claim, channel, interface.profile)
        new_channel = _channel(interface.channel, interface.kind, payload, retain=interface.retain)
        # What must stay on the robot keeps the generic body: the MQTT bridge recognises it by the device named in it.
        may_have_imu_body = interface.profile in (imu.MOTION, imu.SUMMARY) and not interface.local_only
        has_imu_body = may_have_imu_body and imu.fits(interface.profile, {field.name for field in interface.fields})
        return Alias(claim, new_channel, interface.profile if has_imu_body else "")

    def _renamed(self, interface: Interface) -> Interface:
        """Return ``interface`` with the channel name that the config sets, if it sets a valid one."""
        if interface.direction is Direction.IN:
            return interface
        channel = c.channel_of(f"{c.OUTGOING}/{interface.channel}")
        outgoing = f"{self._addresses.base}/{c.OUTGOING}/"
        # Of the robot's channels that an MCU may use, only these have a key in the config.
        if channel not in (c.IMU_FAST, c.IMU) or not self._addresses[channel].topic.startswith(outgoing):
            return interface
        return replace(interface, channel=self._addresses[channel].topic.removeprefix(outgoing))

    def _robots_channel(self, suffix: str) -> c.Channel | None:
        """Return the channel of a topic below the robot's base, by the config or else by the contract, or None."""
        return self._addresses.channel(f"{self._addresses.base}/{suffix}") or c.channel_of(suffix)


def _channel(metric: str, kind: InterfaceKind, payload: Any, *, retain: bool = False) -> c.Channel:
    """Return a channel made at run time. Only a state is retained: a retained sample would be stale."""
    channel_kind, qos = _KINDS[kind]
    if kind is InterfaceKind.STATE and retain:
        channel_kind = c.Kind.STATE
    return c.Channel(metric=metric, kind=channel_kind, payload=payload, doc="", qos=qos)
