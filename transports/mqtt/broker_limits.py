"""Finds out what a broker lacks: retained messages, QoS 1 or wills. Pure.

MQTT 5 has words for it. On 3.1.1 a broker hangs up, as mosquitto does: on a CONNECT whose will is retained or has
QoS 1, or on such a PUBLISH. So does a link that breaks, a proxy whose broker is away, and a broker that refuses one
topic. So hang-ups on CONNECT count only if the same broker accepts a CONNECT without a will in between, and losses only
if they come in a row and none of these messages was ever confirmed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from pebble.transports.base import Message, QoS
from pebble.transports.mqtt.bridge_mode import Result

_HANG_UPS: Final = 3  # on CONNECT, one of them after a CONNECT without a will was accepted
_LOSSES: Final = 6  # in a row, with nothing confirmed: twice as many as prove that one topic is refused,
_PROVEN_LOSSES: Final = 12  # and so many if this broker has confirmed such messages before: it may have a new config
_VALID_S: Final = 600.0  # after which the next connection is made with everything again


@dataclass(frozen=True, slots=True)
class Limits:
    """What a broker is used with."""

    retain: bool = True
    qos: int = 1
    will: bool = True

    def fit(self, message: Message) -> Message:
        """``message`` as this broker takes it."""
        return Message(message.topic, message.payload, QoS(min(message.qos, self.qos)), message.retain and self.retain)

    def fit_will(self, will: Message | None) -> Message | None:
        return self.fit(will) if will is not None and self.will else None

    def both(self, other: Limits) -> Limits:
        return Limits(self.retain and other.retain, min(self.qos, other.qos), self.will and other.will)

    @property
    def losses(self) -> str:
        """What does not work with this broker, in words."""
        lost = []
        if not self.retain:
            lost.append(
                "keeps no retained messages: states are shown only when they change, and a flag that is changed while "
                "the robot or an operator is away is lost"
            )
        if not self.qos:
            lost.append("has no QoS 1: what is lost on the way is not sent again, except stops, by their senders")
        if not self.will:
            lost.append("takes no will: only the age of the heartbeat shows that this program has gone")
        return "; it ".join(lost)


EVERYTHING: Final = Limits()
#: In the order in which they are tried.
_STEPS: Final = (
    EVERYTHING,
    Limits(retain=False),
    Limits(qos=0),
    Limits(retain=False, qos=0),
    Limits(will=False),
    Limits(will=False, retain=False),
    Limits(will=False, qos=0),
    Limits(will=False, retain=False, qos=0),
)


class BrokerLimits:
    """What the broker at one address is used with next, by how connections to it were refused and lost."""

    def __init__(self) -> None:
        self.limits = EVERYTHING  # of the next connection
        self.wants_probe = False  # whether a CONNECT without a will is to be tried first
        self._searching = False  # `limits` were not accepted yet
        self._hang_ups = 0
        self._probed = False  # since the first hang-up
        self._losses = 0
        self._proven = False  # such messages were confirmed
        self._tries_less = False  # after losses, and no connection has held since
        self._cleared = False  # losses have another reason: less did not help
        self._since = float("-inf")  # when the limits were last reduced

    @property
    def asks_again(self) -> bool:
        """Whether the same broker is to be asked once more, in another way."""
        return self.wants_probe or self._probed or self._searching

    @property
    def undecided(self) -> bool:
        """Whether connections are being lost because the broker may lack something, which only more of them show."""
        return self._losses > 0 and not (self._proven or self._cleared)

    def begin(self, now: float) -> None:
        """A connection is about to be made."""
        if not self._searching and now - self._since > _VALID_S:
            self.limits, self._cleared = EVERYTHING, False

    def note_probe(self, result: Result) -> None:
        """A CONNECT without a will has ended."""
        self.wants_probe, self._probed = False, result is Result.ACCEPTED
        if not self._probed:
            self._restart()

    def note_connect(self, result: Result, now: float, *, last: bool) -> None:
        """A CONNECT with a will, as `limits` have it, has ended; ``last``: there is no other way to ask in."""
        lacks = {Result.RETAIN_REFUSED: self.limits.retain, Result.QOS_REFUSED: self.limits.qos > 0}
        if result is Result.ACCEPTED:
            self._searching = self._probed = self.wants_probe = False
            self._hang_ups = 0
        elif lacks.get(result, False):
            retain = result is not Result.RETAIN_REFUSED and self.limits.retain
            qos = 0 if result is Result.QOS_REFUSED else self.limits.qos
            self._reduce(replace(self.limits, retain=retain, qos=qos), now)
        elif result is Result.HUNG_UP:
            self._note_hang_up(now, last=last)
        elif last:
            self._restart()

    def _note_hang_up(self, now: float, *, last: bool) -> None:
        self._hang_ups += 1
        if not (self._probed or self._searching):
            self.wants_probe = True
        elif last and (self._searching or self._hang_ups >= _HANG_UPS):
            if self.limits.will:
                self._reduce(_STEPS[_STEPS.index(self.limits) + 1], now)
            else:
                self.limits = EVERYTHING  # the will was not the reason
                self._restart()

    def note_loss(self, in_flight: Limits, confirmed: Limits, now: float, *, held: bool) -> bool:
        """The broker has closed a connection, which it ``held`` for a while; returns whether to try with less.

        Fields of ``in_flight`` are set if such messages were unconfirmed, and of ``confirmed`` if such were confirmed.
        """
        self._proven |= confirmed.retain or confirmed.qos > 0
        suspects = (in_flight.retain and not confirmed.retain) or in_flight.qos > confirmed.qos
        if held or not (suspects or self._tries_less):
            self._losses, self._tries_less = 0, False
            return False
        self._losses += 1
        wanted = _PROVEN_LOSSES if self._proven else _LOSSES
        if self._cleared or not (self._tries_less or self._losses >= wanted):
            return False
        after = _STEPS.index(self.limits) + 1
        if after < len(_STEPS) and _STEPS[after].will is self.limits.will:
            self._reduce(_STEPS[after], now)
            self._tries_less = True
        else:
            self.limits, self._since = replace(EVERYTHING, will=self.limits.will), now
            self._cleared, self._tries_less, self._losses = True, False, 0
        return True

    def _reduce(self, limits: Limits, now: float) -> None:
        self.limits, self._since, self._searching = limits, now, True

    def _restart(self) -> None:
        if self._searching:
            self.limits = EVERYTHING
        self._searching = self._probed = self.wants_probe = False
        self._hang_ups = 0
