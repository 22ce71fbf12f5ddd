"""Owns the serial line to a self-describing MCU (``pebble_serial_v1``): what it can do is learnt from itself."""

from __future__ import annotations

import logging
import secrets
import time
from functools import partial
from typing import Any

from pebble import codec
from pebble.contract import IMU, IMU_FAST, MCU_COMMAND, MCU_DESCRIBE, MCU_VALUE, Channel, Kind
from pebble.errors import LinkError, PayloadError
from pebble.payloads import McuManifest, McuSample
from pebble.service import every, on
from pebble.services.serial_mcu_bridge.alias_use import AliasUse
from pebble.services.serial_mcu_bridge.aliases import claims
from pebble.services.serial_mcu_bridge.device import Alias, Device, Route
from pebble.services.serial_mcu_bridge.frame import END
from pebble.services.serial_mcu_bridge.imu import FAMILY, MOTION, ImuReports
from pebble.services.serial_mcu_bridge.imu_watchdog import ImuWatchdog
from pebble.services.serial_mcu_bridge.line import LineState
from pebble.services.serial_mcu_bridge.manifest import PROTOCOL, RESERVED, Direction, Manifest
from pebble.services.serial_mcu_bridge.manifest import Kind as InterfaceKind
from pebble.services.serial_mcu_bridge.neighbours import Neighbours
from pebble.services.serial_mcu_bridge.pebble_serial import (
    Answer,
    Described,
    Event,
    Gone,
    Reading,
    Refused,
    Said,
    Send,
    Session,
)
from pebble.services.serial_mcu_bridge.serial_service import SerialService
from pebble.services.serial_mcu_bridge.uid_claim import Move, UidClaim
from pebble.timers import Timer
from pebble.transports import Message, Subscription

_RETRY_S = 0.25  # looking for a device that is not there: it is to be known within 2 s of being plugged in
_CLAIM_S = 0.25  # from telling others what we claim to using it: a rival has objected by then
_WATCH_S = 0.5

#: Asked by those who want a uid, or doubt a kept manifest; whoever has the device says its manifest again.
_QUESTION = Channel(
    metric=MCU_COMMAND.metric.replace("{name}", RESERVED),
    kind=Kind.COMMAND,
    payload=dict[str, Any],
    doc="Whose device is this?",
)


class DescribedBridge(SerialService):
    """One MCU, its topics while it is there, and nothing of it once it has gone."""

    publishes = (MCU_DESCRIBE, MCU_VALUE, IMU_FAST, IMU)
    end = END

    def start(self) -> None:
        self._session = Session()
        self._watchdog = ImuWatchdog(self.options, self.instance)
        self._neighbours = Neighbours()
        self._uid = UidClaim(secrets.token_hex(8))
        self._candidate: Manifest | None = None  # described, perhaps under somebody else's uid
        self._uid_is_taken = False  # and we have said so
        self._device: Device | None = None
        self._states_said: dict[int, tuple[Reading, int]] = {}  # the newest of each state interface, and when, epoch ms
        self._generic: list[Subscription] = []  # of the device that was described last, there or not
        self._aliases = AliasUse(self.log, self._neighbours, self._begin_alias, self._end_alias)
        self._timer: Timer | None = None
        self.post(self._meet_neighbours)
        self.open_line(settle_s=0.0, retry_s=_RETRY_S)  # frames need no settling: what is none is skipped

    def stop(self) -> None:
        if hasattr(self, "line"):
            self._leave("the bridge ends")
        super().stop()

    # -- the line

    def on_line(self, state: LineState) -> None:
        now = time.monotonic()
        if state is LineState.READY:
            self._session.opened(now)
            self._watchdog.begin(now)
        elif state is LineState.ABSENT:
            self._watchdog.end()
            self._act(self._session.closed())
            self.exit_if_asked()
        self._arm()

    def on_input(self, chunk: bytes) -> None:
        self._act(self._session.feed(chunk, time.monotonic()))
        self._arm()

    @every(_WATCH_S)
    def watch(self) -> None:
        if self._watchdog.expired(time.monotonic()):
            raise LinkError(f"no sample for {self._watchdog.timeout_s:g} s")

    def _tick(self) -> None:
        self._timer = None
        self._act(self._session.tick(time.monotonic(), _now_ms()))
        for uid in self._neighbours.left_over(time.monotonic()):
            self.log.info("%s: nobody stands for its kept manifest any more; taken back", uid)
            self._send(MCU_DESCRIBE, MCU_DESCRIBE.topic(self.config.base, uid=uid), b"")
            self._aliases.settle()
        self._do(self._uid.tick(time.monotonic()))
        self._arm()

    def _arm(self) -> None:
        """Have a timer that is early enough; one that is too early only looks again."""
        times = (self._session.due, self._neighbours.due, self._uid.due)
        due = min((due for due in times if due is not None), default=None)
        if due is None or (self._timer is not None and self._timer.due <= due):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.call_at(due, self._tick)

    # -- what the MCU says

    def _act(self, events: list[Event]) -> None:
        for event in events:
            match event:
                case Reading():
                    self._report(event)
                case Send(kind, data):
                    self.line.send(kind, data)
                case Described(manifest):
                    self._candidate = manifest
                    self._do(self._uid.want(manifest.uid, time.monotonic()))
                case Gone(why):
                    self._leave(why)
                case Answer():
                    self._log_answer(event)
                case Said(text):
                    self.chatter_log.say("log", logging.INFO, "MCU: %s", text)
                case Refused(subject, reason, level):
                    self.counters.add(subject)
                    if level > logging.DEBUG:
                        self.chatter_log.say(subject, level, "%s", reason)

    def _report(self, reading: Reading) -> None:
        device, now_ms = self._device, _now_ms()
        if device is None or not device.has_motion or reading.interface.profile == MOTION:
            self._watchdog.sample(time.monotonic())
        if reading.interface.kind is InterfaceKind.STATE:
            self._states_said[reading.interface.id] = reading, now_ms
        if device is not None:
            route = device.routes[reading.interface.id]
            sample = device.sample(reading, now_ms)
            self.publish(route.generic, sample)
            if route.alias is not None:
                self._say_alias(device, route, sample, route.alias)

    def _say_alias(self, device: Device, route: Route, sample: McuSample, alias: Alias) -> None:
        body = device.alias_body(route, sample)  # also while it is not in use: a summary needs the newest motion
        if alias in self._aliases and body is not None:
            self.publish(alias.channel, body)

    def _log_answer(self, answer: Answer) -> None:
        if answer.accepted:
            self.log.debug("%s: command %d accepted", answer.command, answer.sequence)
        elif answer.accepted is None:
            self.counters.add("unanswered")
            self._quiet_log.warning("unanswered", "%s: no answer to command %d", answer.command, answer.sequence)
        else:
            self.counters.add("nack")
            reason = answer.reason or "no reason given"
            text = "%s: the MCU refuses command %d: %s"
            self.chatter_log.say("nack", logging.WARNING, text, answer.command, answer.sequence, reason)

    # -- coming and going

    def _do(self, move: Move) -> None:
        candidate, device = self._candidate, self._device
        match move:
            case Move.ASK if candidate is not None:
                self._ask(candidate.uid, self._uid.token)
            case Move.INSIST if candidate is not None:
                self._ask(candidate.uid, self._uid.token, has=True)
            case Move.ANSWER if device is not None:
                self.publish(MCU_DESCRIBE, device.payload, uid=device.uid)
            case Move.HOLD if candidate is not None:
                self._introduce(candidate)
            case Move.YIELD if candidate is not None:
                self._yield(candidate.uid)

    def _yield(self, uid: str) -> None:
        self._withdraw("is given up")  # while the fabric was away both may have had it
        if not self._uid_is_taken:
            self._uid_is_taken = True
            text = "%s: another device has this uid already; this one is not used until that one leaves"
            self.log.warning(text, uid)

    def _ask(self, uid: str, token: str = "", *, has: bool = False) -> None:
        """Who has this uid? Without a ``token`` only out of curiosity: nobody yields to that."""
        self.publish(MCU_COMMAND, {"from": token, "has": has}, uid=uid, name=RESERVED)

    @on(_QUESTION)
    def hear_question(self, question: dict[str, Any], uid: str) -> None:
        token, has = str(question.get("from", "")), question.get("has") is True
        self._do(self._uid.hear_question(uid, token, time.monotonic(), has=has))
        self._arm()

    def _introduce(self, manifest: Manifest) -> None:
        port = str(self.options.serial.port)
        reports = ImuReports(device=port, protocol=self.options.protocol, instance=self.instance)
        device = self._device = Device(manifest, self.addresses, reports)
        hello = device.hello
        self.log.info("%s: %r, firmware %r, %d interfaces", device.uid, hello.model, hello.firmware_version,
                      len(device.routes))  # fmt: skip
        for name, reason in device.claims.refused.items():
            self.log.warning("%s: no alias for %s: %s", device.uid, name, reason)
        if any(route.interface.profile.startswith(FAMILY) for route in device.routes.values()):
            self._watchdog.found_imu()
        self._neighbours.forget(device.uid)
        self._close_generic()
        self._listen_generic(device, private=False)  # whoever reads the manifest may command at once
        self.publish(MCU_DESCRIBE, device.payload, uid=device.uid)  # then whoever forwards knows what is private
        self._listen_generic(device, private=True)
        for reading, said_ms in self._states_said.values():  # while we asked: states may be said only once
            self.publish(device.routes[reading.interface.id].generic, device.sample(reading, said_ms))
        self._aliases.introduce(device)
        self.call_at(time.monotonic() + _CLAIM_S, partial(self._aliases.permit, device))

    def _leave(self, why: str) -> None:
        """Nothing that is kept speaks for a device that is not there. Commands are still heard, and counted."""
        self._candidate, self._uid_is_taken = None, False
        self._states_said.clear()
        self._uid.release()
        self._withdraw(why)

    def _withdraw(self, why: str) -> None:
        device, self._device = self._device, None
        if device is None:
            return
        self.log.info("%s: %s", device.uid, why)
        self._aliases.leave()
        for route in device.routes.values():
            if route.generic.kind is Kind.STATE:
                self.retract(route.generic)
        self.retract(MCU_DESCRIBE, uid=device.uid)

    def _listen_generic(self, device: Device, *, private: bool) -> None:
        self._generic += [
            self.listen(route.generic, partial(self._command, device, route))
            for route in device.routes.values()
            if route.interface.direction is Direction.IN and route.interface.local_only is private
        ]

    def _close_generic(self) -> None:
        subscriptions, self._generic = self._generic, []
        for subscription in subscriptions:
            subscription.close()

    # -- commands

    def _command(self, device: Device, route: Route, values: dict[str, Any]) -> None:
        name = route.interface.name
        if device is not self._device:
            self.counters.add("no_device")
            self._quiet_log.warning("no device", "%s: dropped a command, the device is not there", name)
            return
        try:
            send = self._session.command(route.interface, values, time.monotonic(), _now_ms())
        except PayloadError as error:
            self.counters.add("refused")
            self._quiet_log.warning("command", "refused a command: %s", error)
            return
        if not self.line.send(send.kind, send.data):
            self.counters.add("no_device")
        self._arm()

    # -- aliases

    def _begin_alias(self, device: Device, route: Route, alias: Alias) -> Subscription | None:
        if route.interface.direction is Direction.IN:
            return self.listen(alias.channel, partial(self._command, device, route))
        newest = self._states_said.get(route.interface.id)
        if newest is not None:
            self._say_alias(device, route, device.sample(*newest), alias)
        return None

    def _end_alias(self, alias: Alias) -> None:
        address = self.addresses[alias.channel]
        if alias.channel.kind is Kind.STATE:
            self.retract(alias.channel)
        elif address.retain:  # the config wants a stream kept
            self._send(alias.channel, address.topic, b"")

    # -- the other devices of this robot

    def _meet_neighbours(self) -> None:
        self.transport.subscribe(self.addresses[MCU_DESCRIBE].topic, self._on_manifest, echo=False, direct=True)

    def _on_manifest(self, message: Message) -> None:
        """On the transport's thread."""
        uid = MCU_DESCRIBE.names(message.topic)["uid"]
        manifest = None
        if message.payload:
            try:
                manifest = codec.decode(MCU_DESCRIBE, message.payload)
            except PayloadError:
                return
            if manifest.protocol != PROTOCOL or manifest.device_uid != uid:
                return
        self.post(partial(self._hear_of, uid, manifest, message.retain))

    def _hear_of(self, uid: str, manifest: McuManifest | None, kept: bool) -> None:
        now = time.monotonic()
        if self._device is not None and uid == self._device.uid:
            if manifest is None:
                self._republish()  # somebody gave it up: what was taken back is ours
            else:
                self._do(self._uid.hear_manifest(uid, now))
            return
        if manifest is None:
            self._neighbours.forget(uid)
            self._do(self._uid.hear_leaving(uid, now))
        else:
            self._neighbours.hear(uid, frozenset(claims(manifest).granted), now, kept=kept)
            if kept:
                self._ask(uid)  # is anybody there?
            else:
                self._do(self._uid.hear_manifest(uid, now))
        self._aliases.settle()
        self._arm()


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
