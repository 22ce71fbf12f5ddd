"""Finds out whether a broker has bridge mode, which MQTT 3.1.1 does not define. Pure.

A broker without bridge mode answers CONNECT with return code 1, or hangs up. A proxy whose broker is away hangs up as
well, so a hang-up counts only if the same broker accepts a plain CONNECT, and then hangs up once more.
"""

from enum import Enum


class Attempt(Enum):
    BRIDGE = "bridge"  # connect in bridge mode
    PROBE = "probe"  # connect without it, only to see whether that is accepted
    PLAIN = "plain"  # connect without it


class Result(Enum):
    ACCEPTED = "accepted"
    PROTOCOL_REFUSED = "unacceptable protocol version"
    HUNG_UP = "closed without an answer"
    RETAIN_REFUSED = "retain not supported"
    QOS_REFUSED = "QoS not supported"
    FAILED = "anything else: a wrong password, no answer, no connection"


class BridgeMode:
    """The choice whether to connect in bridge mode. Each connection tries it again: the broker may be another one."""

    def __init__(self) -> None:
        self.next_attempt = Attempt.BRIDGE
        self._probed = False  # a plain CONNECT was accepted since the broker hung up
        self._lacking = False  # a broker at this address had no bridge mode: one hang-up is enough from then on

    def note(self, result: Result) -> None:
        """Note that the attempt which ``next_attempt`` named has ended with ``result``, and choose the next one."""
        attempt, self.next_attempt = self.next_attempt, Attempt.BRIDGE
        if attempt is Attempt.PROBE:
            self._probed = result is Result.ACCEPTED
        elif attempt is Attempt.BRIDGE:
            self._note_bridge(result)

    def _note_bridge(self, result: Result) -> None:
        """Note bridge mode's result. A hang-up counts after an accepted probe, or if the mode was missing before."""
        probed, self._probed = self._probed, False
        if result is Result.ACCEPTED:
            self._lacking = False
        elif result is Result.PROTOCOL_REFUSED or (result is Result.HUNG_UP and (probed or self._lacking)):
            self._lacking, self.next_attempt = True, Attempt.PLAIN
        elif result is Result.HUNG_UP:
            self.next_attempt = Attempt.PROBE
