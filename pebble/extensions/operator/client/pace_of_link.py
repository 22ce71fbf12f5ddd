"""The rate of commands to a robot, by the link that it reports as ``outgoing/link``. Pure.

Commands that bring something to rest have no limit: they are sent at once, with QoS 1, at every level.
"""

from typing import NamedTuple

from msgspec.structs import replace

from pebble.contract import DRIVE
from pebble.contract.levels import LEVELS
from pebble.contract.payloads import Drive, LinkState
from pebble.transports import QoS

_LEAST_S = 0.015  # between two commands on a wide link: what comes together counts once
_EARLY_S = 0.025  # half of what lies between two commands of a page: a slot is met, not missed by a moment
_LEAST_VALID = 2  # commands within the time that one is valid: a robot may report any rate, and must not halt by it

#: Behind a queue that stays and is so long a command comes too late to move anything: the fewer are sent, the sooner it
#: has drained.
_USELESS_MS, _LONGEST_S = 500, 2.0


class Pace(NamedTuple):
    """The rate of messages to one robot.

    ``stamped``: moving commands carry a time ``t`` and a ``key``, and requests for control a time ``t``.
    """

    step_s: float = _LEAST_S  # at least, between two commands of one gesture
    qos: QoS = QoS(DRIVE.default_qos)  # of those that move anything
    valid_ms: int = LEVELS["wide"].valid_ms
    stamped: bool = False
    control_s: float = 1.0  # between two requests of control
    control_for_ms: float = 3000  # so long each holds it
    answer_s: float = LEVELS["wide"].answer_s  # a robot that has not answered by then will not

    def dated(self, drive: Drive, now: float, key: str) -> Drive:
        """Return a moving command with its time, its validity for this link, and ``key`` if it has no other."""
        if not self.stamped:
            return drive
        return replace(drive, t=ms(now), key=drive.key or key, valid_ms=self.valid_ms)


WIDE = Pace()


def pace_of(link: LinkState | None) -> Pace:
    """Return the pace for a robot's link state; without a state, everything is sent."""
    if link is None or link.level == "wide":
        return WIDE
    level = LEVELS[link.level]
    least_hz = 1000 * _LEAST_VALID / level.valid_ms  # at a lower rate the robot may halt between two commands
    hz = min(max(link.drive_hz, least_hz), LEVELS["wide"].drive_hz)
    step_s = 1 / hz - _EARLY_S  # else a command that comes a moment before its slot would be left out
    # The robot asks for less than its level's rate: more is on its way than drains. Send few until the queue is gone.
    if link.drive_hz < level.drive_hz and link.queue_ms > _USELESS_MS:
        step_s = min(link.queue_ms / 1000, _LONGEST_S)
    return Pace(
        step_s=step_s,
        qos=WIDE.qos if level.drive_qos is None else QoS(level.drive_qos),
        valid_ms=level.valid_ms,
        stamped=level.stamped,
        control_s=5.0,  # commands renew it, too
        control_for_ms=10_000,
        answer_s=level.answer_s,
    )


def way_s(link: LinkState) -> float:
    """Return roughly how long a command takes to reach the robot: half a round trip plus the queue."""
    return (link.rtt_ms / 2 + link.queue_ms) / 1000


def ms(now: float) -> int:
    """Return the sender's time for ``t``: milliseconds of a clock that also counts while the machine is suspended."""
    return round(1000 * now)
