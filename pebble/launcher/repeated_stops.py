"""Repeats stops to the motor owners of a robot without a bridge: otherwise the bridge does that."""

import logging
import time
from contextlib import suppress
from functools import partial

from pebble.config import Config
from pebble.contract import ESTOP, ESTOP_STATE, codec
from pebble.errors import PayloadError, TransportError
from pebble.launcher.reactor import Reactor
from pebble.services.mqtt_bridge.passed_stops import REPEAT_S, PassedStops, is_named, named
from pebble.transports import Message, QoS, Transport

log = logging.getLogger(__name__)


def repeat_stops(config: Config, transport: Transport, reactor: Reactor) -> None:
    """From now on, repeat each stop to every motor owner until that owner has confirmed it."""
    passed, topic = PassedStops(config.motor_owners, time.monotonic), ESTOP.topic(config.base)

    def receive(message: Message) -> None:
        if not message.retain:  # the owners have it unless one restarts now
            passed.accept(named(message.payload), nameless=not is_named(message.payload))

    def follow(owner: str, message: Message) -> None:
        with suppress(PayloadError):
            passed.follow(owner, codec.decode(ESTOP_STATE, message.payload) if message.payload else None)

    def repeat() -> None:
        for owner, _stop in passed.give_up():
            log.error("an emergency stop is not confirmed by %s, which has withdrawn its own", owner)
        for payload in passed.repeat():
            with suppress(TransportError):
                transport.publish(topic, payload, qos=QoS.DELIVERED, urgent=True)

    transport.policy.is_stop = topic.__eq__
    transport.subscribe(topic, receive, echo=False, direct=True)
    for owner in config.motor_owners:
        transport.subscribe(ESTOP_STATE.topic(config.base, owner=owner), partial(follow, owner), direct=True)
    reactor.every(REPEAT_S, repeat)
