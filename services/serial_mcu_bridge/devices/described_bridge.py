"""The bridge of a self-describing MCU (``pebble_serial_v1``), whose manifest defines its topics."""

import logging
import secrets
import time
from functools import partial
from typing import Any

from pebble.contract import (
    GROUP,
    MCU_COMMAND,
    MCU_DESCRIBE,
    MCU_LOCAL_ONLY,
    Channel,
    Kind,
    codec,
    groups,
)
from pebble.contract.payloads import McuManifest, McuSample
from pebble.errors import DeviceError, PayloadError
from pebble.runtime.parent import Notifier, Reported
from pebble.runtime.service import every, on
from pebble.runtime.timers import Timer
from pebble.services.serial_mcu_bridge.devices.alias_use import AliasUse
from pebble.services.serial_mcu_bridge.devices.aliases import claims, outlet_feature
from pebble.services.serial_mcu_bridge.devices.device import Alias, Device, Route
from pebble.services.serial_mcu_bridge.devices.peers import PeerDevices
from pebble.services.serial_mcu_bridge.imu.reports import FAMILY, MOTION, ImuReports, ImuWatchdog, measured
from pebble.services.serial_mcu_bridge.line.serial_line import LineState
from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import END
from pebble.services.serial_mcu_bridge.pebble_serial_v1.host import (
    Answer,
    Described,
    Event,
    Gone,
    Reading,
    RefusedInput,
    Send,
    Session,
)
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import (
    PROTOCOL,
    RESERVED,
    Direction,
    Interface,
    InterfaceKind,
    Manifest,
)
from pebble.services.serial_mcu_bridge.serial_service import SerialService
from pebble.services.serial_mcu_bridge.text.device_log import DeviceLogLine
from pebble.transports import Message, QoS, Subscription

CLAIM_S = 0.25  # between publishing claims and using them: another device has objected by then
_WATCH_S = 0.5

#: Asks which process has the device of this uid, to check a retained manifest: that process publishes it again. With a
#: token, the sender has such a device itself, and another process that also has one logs a warning.
_UID_QUERY = Channel(
    metric=MCU_COMMAND.metric.replace("{name}", RESERVED),
    kind=Kind.COMMAND,
    payload=dict[str, Any],
    doc="Which process has the device of this uid?",
)


class DescribedBridge(SerialService):
    """The service of one MCU. It publishes the MCU's topics while it is connected, and clears them afterwards."""

    end = END
    boot_s = 0.0  # bytes that are no frame are skipped
    retry_s = 0.25  # the topics exist within 2 s of plugging in

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._takes_groups = self.config.services.mqtt_bridge.link.groups
        self._session = Session(self.config.base)
        self.watchdog = ImuWatchdog(self.options, self.instance)
        self._peers = PeerDevices()
        self._token = secrets.token_hex(8)  # of our question about our uid: another token is from a second device
        self._conflict_logged = False  # another device has the same uid
        self.device: Device | None = None
        self._published_states: dict[int, tuple[Reading, int]] = {}  # newest of each state interface, its epoch ms
        #: To the generic topics, mcu/…, of the device that was described last, connected or not.
        self._generic: list[Subscription] = []
        self.aliases = AliasUse(self.log, self._peers, self._begin_alias, self._end_alias, self.options.aliases)
        self._provided: set[str] = set()  # features, such as outlets, for the robot's capabilities
        self._notifier = Notifier()
        self._features: dict[str, Reported] = {}  # that were provided, by name, as the launcher knows them
        self._timer: Timer | None = None  # for the next event of the session, or of the peers

    def start(self) -> None:
        self.post(self._subscribe)
        super().start()

    def stop(self) -> None:
        self._device_gone("the bridge ends")

    def on_line_state(self, state: LineState) -> None:
        """Begin the dialogue with the MCU once it has booted, and end it when the device has gone."""
        now = self.clock()
        if state is LineState.READY:
            self._session.opened(now)
            self.watchdog.begin(now)
        elif state is LineState.ABSENT:
            self.watchdog.end()
            self._handle_events(self._session.closed())
        self._arm()

    def on_input(self, chunk: bytes) -> None:
        before = self._session.frames
        self._handle_events(self._session.feed(chunk, self.clock()))
        self.note_report(self._session.frames != before)
        if self._session.frames != before and self._session.mcu_ms is not None:
            self.note_clock(self._session.mcu_ms)
        self._arm()

    @every(_WATCH_S)
    def watch(self) -> None:
        for name, feature in self._features.items():
            feature.report(name, name in self._provided)
        if self.watchdog.expired(self.clock()):
            raise DeviceError(f"no sample for {self.watchdog.timeout_s:g} s")

    def _tick(self) -> None:
        self._timer = None
        self._handle_events(self._session.tick(self.clock(), _now_ms()))
        for uid in self._peers.left_over(self.clock()):
            self.log.info("%s: its retained manifest is stale; cleared", uid)
            self.clear(MCU_DESCRIBE, uid=uid)
            self.clear(MCU_LOCAL_ONLY, uid=uid)
            self.aliases.update()
        self._arm()

    def _arm(self) -> None:
        """Set the timer, unless it is set for the next event or earlier: a timer that is too early does no harm."""
        times = [due for due in (self._session.due, self._peers.due) if due is not None]
        due = min(times, default=None)
        if due is None or (self._timer is not None and self._timer.due <= due):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.call_at(due, self._tick)

    # -- events of the MCU

    def _handle_events(self, events: list[Event]) -> None:
        for event in events:
            match event:
                case Reading():
                    self._report(event)
                case Send(kind, data):
                    self.line.send(kind, data)
                case Described(manifest):
                    self._publish_device(manifest)
                case Gone(why):
                    self._device_gone(why)
                case Answer():
                    self._log_answer(event)
                case DeviceLogLine(level, text):
                    self.device_log.log("log", level, "MCU: %s", text)
                case RefusedInput(subject, reason, level):
                    self.counters.add(subject)
                    if level > logging.DEBUG:
                        self.device_log.log(subject, level, "%s", reason)

    def _report(self, reading: Reading) -> None:
        """Publish a reading of the MCU, and note it for the checks of its sensors."""
        device, now_ms = self.device, _now_ms()
        is_motion = reading.interface.profile == MOTION
        has_motion = device is not None and device.has_motion
        if is_motion or not has_motion:  # of a board with motion, other readings do not show that the sensor works
            self.watchdog.sample(self.clock())
        if is_motion:
            self.sensors.take(measured(reading.values), self.clock())
        if reading.interface.kind is InterfaceKind.STATE:
            self._published_states[reading.interface.id] = reading, now_ms
        if device is not None:
            route = device.routes[reading.interface.id]
            sample = device.sample(reading, now_ms)
            self.publish(route.generic, sample)
            if route.alias is not None:
                self._publish_alias(device, route, sample, route.alias)

    def _publish_alias(self, device: Device, route: Route, sample: McuSample, alias: Alias) -> None:
        body = device.alias_body(route, sample)  # also while unused, as a summary needs the newest motion
        if alias in self.aliases and body is not None:
            self.publish(alias.channel, body)

    def _log_answer(self, answer: Answer) -> None:
        if answer.accepted:
            self.log.debug("%s: command %d accepted", answer.command, answer.sequence)
        elif answer.accepted is None:
            self.counters.add("unanswered")
            self.log_limited.warning("unanswered", "%s: no answer to command %d", answer.command, answer.sequence)
        else:
            self.counters.add("nack")
            reason = answer.reason or "no reason given"
            text = "%s: the MCU refuses command %d: %s"
            self.device_log.log("nack", logging.WARNING, text, answer.command, answer.sequence, reason)

    # -- the device appears and leaves

    @on(_UID_QUERY)
    def on_question(self, question: dict[str, Any], uid: str) -> None:
        """Publish the manifest again for a process that asks; warn if that process has a device of this uid, too."""
        if self.device is None or uid != self.device.uid:
            return
        token = question.get("from")
        if not token:
            self.publish(MCU_DESCRIBE, self.device.payload, uid=uid)
        elif token != self._token and not self._conflict_logged:
            self._conflict_logged = True
            text = "%s: another device has this uid, too: both obey its commands; append the chip's own number"
            self.log.warning(text, uid)

    def _publish_device(self, manifest: Manifest) -> None:
        """Subscribe to the commands for a device that has described itself, and publish what it is."""
        device = self.device = Device(manifest, self.addresses, ImuReports(self.options, self.instance))
        hello = device.hello
        self.log.info("%s: %r, firmware %r, %d interfaces", device.uid, hello.model, hello.firmware_version,
                      len(device.routes))  # fmt: skip
        for name, reason in device.claims.refused.items():
            self.log.warning("%s: no alias for %s: %s", device.uid, name, reason)
        if any(route.interface.profile.startswith(FAMILY) for route in device.routes.values()):
            self.watchdog.found_imu()
        self._peers.forget(device.uid)
        for subscription in self._generic:
            subscription.close()
        self._generic = [self.follow_driving()] if device.has_motion else []
        self._listen_generic(device, private=False)  # first: a reader of the manifest may send some at once
        self.publish(MCU_LOCAL_ONLY, device.local_only, uid=device.uid)
        self.publish(MCU_DESCRIBE, device.payload, uid=device.uid)
        self.publish(MCU_COMMAND, {"from": self._token}, uid=device.uid, name=RESERVED)  # bridges of the same uid warn
        self._listen_generic(device, private=True)  # last: by MCU_LOCAL_ONLY bridges keep these topics on the robot
        self.aliases.announce(device)
        self.call_at(self.clock() + CLAIM_S, partial(self.aliases.permit, device))

    def _device_gone(self, why: str) -> None:
        """Remove the device's retained messages. Its commands are still received, counted and dropped."""
        self._conflict_logged = False
        self._published_states.clear()
        device, self.device = self.device, None
        if device is None:
            return
        self.log.info("%s: %s", device.uid, why)
        self.aliases.withdraw()
        for route in device.routes.values():
            if route.generic.kind is Kind.STATE:
                self.retract(route.generic)
        self.retract(MCU_DESCRIBE, uid=device.uid)
        self.retract(MCU_LOCAL_ONLY, uid=device.uid)

    def _listen_generic(self, device: Device, *, private: bool) -> None:
        """Subscribe to the device's commands: to those that it marks ``local_only`` (``private``), or to the others."""
        self._generic += [
            self.listen(route.generic, partial(self._command, device, route))
            for route in device.routes.values()
            if route.interface.direction is Direction.IN and route.interface.local_only is private
        ]

    def _receive_group(self, message: Message, _value: Any, _names: dict[str, str]) -> None:
        """Decode a group of commands, on the transport's thread."""
        try:
            members = groups.decode(message.payload)
        except PayloadError as error:
            self.refusals.malformed(GROUP, error)
            return
        self.post_message(GROUP, partial(self._command_group, members))

    def _command_group(self, members: tuple[groups.Member, ...]) -> None:
        """Write the members of a group that are for this device: all at once, or none."""
        if self.device is None:
            self._drop_command("a group of commands")
            return
        routes = [route for route in self.device.routes.values() if route.interface.direction is Direction.IN]
        interfaces = {route.generic.metric: route.interface for route in routes}
        for_device = [member for member in members if member.metric.startswith(f"mcu/{self.device.uid}/")]
        if unknown := [member.metric for member in for_device if member.metric not in interfaces]:
            self._refuse_command(f"{unknown[0]} is not there")
        elif for_device:
            commands = [(interfaces[member.metric], codec.plain(MCU_COMMAND, member.payload)) for member in for_device]
            self._send_commands(commands)

    def _command(self, device: Device, route: Route, values: dict[str, Any]) -> None:
        """Send a command to the MCU, if that is still ``device``, for which its topic was subscribed to."""
        name = route.interface.name
        if self._takes_groups and values.get(groups.MARK) is True:
            return  # a copy for programs that take no groups: here the group itself arrives
        if device is not self.device:
            self._drop_command(name)
            return
        self._send_commands([(route.interface, values)])

    def _drop_command(self, name: str) -> None:
        self.counters.add("no_device")
        self.log_limited.warning("no device", "%s: dropped a command, the device is not there", name)

    def _send_commands(self, wanted: list[tuple[Interface, dict[str, Any]]]) -> None:
        try:
            send = self._session.commands(wanted, self.clock(), _now_ms())
        except PayloadError as error:
            self._refuse_command(str(error))
            return
        if not self.line.send(send.kind, send.data):
            self.counters.add("no_device")
        self._arm()

    def _refuse_command(self, why: str) -> None:
        self.counters.add("refused")
        self.log_limited.warning("command", "refused a command: %s", why)

    def _begin_alias(self, device: Device, route: Route, alias: Alias) -> Subscription | None:
        """Return the subscription to an alias for commands; on any other alias publish the newest state."""
        names = outlet_feature(alias.claim)
        self._provided |= names
        for name in names:
            self._features.setdefault(name, Reported(self._notifier.feature, name, False))
        if route.interface.direction is Direction.IN:
            return self.listen(alias.channel, partial(self._command, device, route))
        newest = self._published_states.get(route.interface.id)
        if newest is not None:
            self._publish_alias(device, route, device.sample(*newest), alias)
        return None

    def _end_alias(self, alias: Alias) -> None:
        self._provided -= outlet_feature(alias.claim)
        if alias.channel.kind is Kind.STATE:
            self.retract(alias.channel)
        elif self.addresses[alias.channel].retain:  # the config retains a stream
            self.clear(alias.channel)

    # -- the other devices of this robot

    def _subscribe(self) -> None:
        self.transport.subscribe(self.addresses[MCU_DESCRIBE].topic, self._on_manifest, echo=False, direct=True)
        if self._takes_groups:
            receive = self.refusals.reader(GROUP, self._receive_group)
            self.transport.subscribe(self.addresses[GROUP].topic, receive, qos=QoS.DELIVERED, direct=True)

    def _on_manifest(self, message: Message) -> None:
        """Handle the manifest of any device, on the transport's thread. A wrong one is left out."""
        uid = MCU_DESCRIBE.names(message.topic).get("uid")
        if uid is None:  # the filter's + also matches an empty level
            self.counters.add("refused")
            return
        manifest = None  # of an empty message: the manifest was removed
        if message.payload:
            try:
                manifest = codec.decode(MCU_DESCRIBE, message.payload)
            except PayloadError:
                return
            if manifest.protocol != PROTOCOL or manifest.device_uid != uid:
                return
        self.post_message(MCU_DESCRIBE, partial(self._receive_manifest, uid, manifest, message.retain))

    def _receive_manifest(self, uid: str, manifest: McuManifest | None, retained: bool) -> None:
        """Follow the manifests of other devices, whose claims decide about our aliases; restore our own if removed."""
        if self.device is not None and uid == self.device.uid:
            if manifest is None:
                self.republish()  # another process removed it, for example that of a device with the same uid
            return
        if manifest is None:
            self._peers.forget(uid)
        else:
            self._peers.add(uid, frozenset(claims(manifest).granted), self.clock(), retained=retained)
            if retained:  # let the device's bridge publish it again: if none does so in time, _tick clears it
                self.publish(MCU_COMMAND, {}, uid=uid, name=RESERVED)
        self.aliases.update()
        self._arm()


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
