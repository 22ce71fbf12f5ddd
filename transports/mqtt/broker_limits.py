"""Limits of a broker that lacks retained messages, QoS 1 or wills: MQTT 5 tells them, or a CONNECT shows them. Pure."""

from __future__ import annotations

from enum import Enum
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from pebble.transports.base import Message, QoS
from pebble.transports.mqtt.bridge_mode import Result

_NEVER_ACKED: Final = 2  # hang-ups in a row after messages of QoS 1, without a single acknowledgement
_VALID_S: Final = 600.0  # after which the next connection is made with everything again


class Limits(Struct, frozen=True):
    """The functions of MQTT that may be used with a broker."""

    retain: bool = True
    qos: int = 1
    will: bool = True

    def fit(self, message: Message) -> Message:
        """Return ``message`` with a QoS and retain flag that this broker accepts."""
        return Message(message.topic, message.payload, QoS(min(message.qos, self.qos)), message.retain and self.retain)

    def fit_will(self, will: Message | None) -> Message | None:
        return self.fit(will) if will is not None and self.will else None

    def both(self, other: Limits) -> Limits:
        """Return the functions that both of these limits allow."""
        return Limits(self.retain and other.retain, min(self.qos, other.qos), self.will and other.will)

    @property
    def losses(self) -> str:
        """The functions that this broker lacks, in words; empty if there are none."""
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
#: With these a CONNECT is tried, one after the other, while the broker hangs up; after the last one no more.
_STEPS: Final = (EVERYTHING, Limits(qos=0), Limits(retain=False), Limits(retain=False, qos=0), Limits(will=False))


class Asking(Enum):
    """The kind of CONNECT that is tried at once, before the next regular attempt."""

    NOTHING = "none"
    WITHOUT_WILL = "a CONNECT without a will"
    AGAIN = "a CONNECT with a will, as the limits have it: the broker takes one without, or has said what it lacks"


class BrokerLimits:
    """The limits of the broker at one address, learned from how its CONNECTs end.

    On 3.1.1 a broker hangs up on a will that is retained or has QoS 1, as mosquitto does, and so does a proxy whose
    broker is away: a hang-up counts only after the same broker has accepted a CONNECT without a will. A client without
    a will learns only that QoS 1 is lacking, by `note_loss`; it withholds topics on which the broker hangs up
    (refused_topics.py).
    """

    def __init__(self) -> None:
        self.limits = EVERYTHING  # of the next connection
        self._asking = Asking.NOTHING
        self._never_acked = 0  # connections in a row that were lost so
        self._since = float("-inf")  # when the limits were last reduced

    @property
    def wants_probe(self) -> bool:
        """True if a CONNECT without a will is to be tried first."""
        return self._asking is Asking.WITHOUT_WILL

    @property
    def asks_again(self) -> bool:
        """True if another CONNECT is to be sent to the same broker at once."""
        return self._asking is not Asking.NOTHING

    def begin(self, now: float) -> None:
        """Note that a connection is about to be made."""
        if self._asking is not Asking.AGAIN and now - self._since > _VALID_S:
            self.limits = EVERYTHING

    def note_probe(self, result: Result) -> None:
        """Note how a CONNECT without a will has ended: if it was accepted, try the one with a will again."""
        self._asking = Asking.AGAIN if result is Result.ACCEPTED else Asking.NOTHING

    def note_connect(self, result: Result, now: float) -> None:
        """Note how a CONNECT has ended whose will was fitted to `limits`. The first line that fits counts.

        *Again*: it was sent at once, after an accepted probe or with less than the one before (`Asking.AGAIN`).
        *First*: any other. The result of a probe is for `note_probe`; after it the next CONNECT is noted here again.

        | result                             | tried | the next CONNECT is                                |
        |------------------------------------|-------|----------------------------------------------------|
        | retained messages or QoS 1 refused | any   | at once, without these                             |
        | hung up                            | first | at once, without a will (a probe)                  |
        | hung up                            | again | at once, with less, as long as there is less       |
        | accepted                           | any   | the same                                           |
        | any other                          | again | with everything: the limits were not the reason    |
        | any other                          | first | the same                                           |
        """
        again, self._asking = self._asking is Asking.AGAIN, Asking.NOTHING
        if result is Result.RETAIN_REFUSED and self.limits.retain:
            self._reduce(replace(self.limits, retain=False), now)
        elif result is Result.QOS_REFUSED and self.limits.qos:
            self._reduce(replace(self.limits, qos=0), now)
        elif result is Result.HUNG_UP and not again:
            self._asking = Asking.WITHOUT_WILL
        elif result is Result.HUNG_UP and self.limits in _STEPS[:-1]:  # not the last: there is less
            self._reduce(_STEPS[_STEPS.index(self.limits) + 1], now)
        elif again and result is not Result.ACCEPTED:
            self.limits = EVERYTHING

    def note_loss(self, *, never_acked: bool, now: float) -> None:
        """Note the loss of a connection of a client without a will; the second hang-up on QoS 1 in a row ends its use.

        ``never_acked``: the broker has hung up, and acknowledged none of the messages of QoS 1 before.
        """
        self._never_acked = self._never_acked + 1 if never_acked else 0
        if self._never_acked >= _NEVER_ACKED and self.limits.qos:
            self.limits, self._since = replace(self.limits, qos=0), now

    def _reduce(self, limits: Limits, now: float) -> None:
        """Connect again at once, with these limits."""
        self.limits, self._since, self._asking = limits, now, Asking.AGAIN
