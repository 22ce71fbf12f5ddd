"""A robot as its script uses it: pictures, messages and wheels."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from pebble.config import Config
from pebble.contract import (
    AUTONOMY_COMMAND,
    DRIVE,
    ESTOP_RESET,
    ESTOP_STATE,
    NEIGHBOUR_VALUE,
    TO_NEIGHBOUR,
    Channel,
    Kind,
    codec,
)
from pebble.contract.channels import INCOMING
from pebble.contract.payloads import Drive
from pebble.errors import PebbleError
from pebble.extensions.scripts.script.neighbour import Neighbour, RobotParts
from pebble.extensions.scripts.script.pictures import Pictures
from pebble.extensions.scripts.script.wheels import Wheels
from pebble.runtime.addresses import Addresses
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.runtime.receive import Refusals
from pebble.transports import QoS, Transport
from pebble.transports.counters import Counters
from pebble.transports.topics import matches

if TYPE_CHECKING:
    from pebble.extensions.media.cameras import Picture

#: What no script publishes, and why.
_REFUSED = {
    DRIVE: "use robot.drive() to move",
    TO_NEIGHBOUR: "use robot.neighbour(…).drive()",
    ESTOP_RESET: "let people reset",
    ESTOP_STATE: "motor owners publish it",
    AUTONOMY_COMMAND: "let people start scripts, or list those it needs in run(main, needs=…)",
}
_STUCK_S = 1.0  # the last values wait no longer than this for a publish that hangs
_WAITING = 100  # messages of one channel that wait for its handler, before the oldest is dropped

EXIT_ENDED = 3  # of a script whose run was ended: by an operator, an emergency stop or a newer run


class Stopped(SystemExit):
    """An error: the script must end. Every later call on the robot raises it, and nothing moves any more."""


class _Arrived(NamedTuple):
    value: Any
    at: float  # on the monotonic clock


class _Latest:
    """The newest payload of each channel that the script has asked for."""

    def __init__(self, subscribe: Callable[[Channel, Callable[..., None]], None], clock: Callable[[], float]) -> None:
        self._subscribe, self._clock = subscribe, clock
        self._arrived: dict[Channel, _Arrived | None] = {}

    def of(self, channel: Channel, max_age: float) -> Any:
        """Return the newest payload that is not older than ``max_age`` seconds; the first call subscribes."""
        if channel not in self._arrived:
            self._arrived[channel] = None
            self._subscribe(channel, lambda value, **_: self._receive(channel, value))
        newest = self._arrived[channel]
        if newest is None or self._clock() - newest.at > max_age:
            return None
        return newest.value

    def _receive(self, channel: Channel, value: Any) -> None:
        self._arrived[channel] = _Arrived(value, self._clock())


class Robot:
    """The robot of this script. Any thread of its process may call every method, but no forked process.

    Every method raises :class:`Stopped` once the script must end.
    """

    def __init__(
        self,
        config: Config,
        transport: Transport,
        number: Callable[[int], int],
        *,
        name: str = "script",
        on_ended: Callable[[str], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
        drives: bool = True,
    ) -> None:
        """Store the arguments. ``transport`` is already open.

        ``number`` returns the run's number, above the number that it is given. ``drives``: the script may drive.
        """
        self.config = config
        self.log = logging.getLogger(f"pebble.script.{name}")
        self._refusals = Refusals(RateLimitedLog(self.log), Counters())
        self._transport, self._addresses, self._clock = transport, Addresses(config), clock
        self._latest = _Latest(self._subscribe, clock)
        self._last_values: dict[Channel, Callable[[], Any]] = {}  # by :meth:`publish_at_end`
        self._neighbours: dict[str, Neighbour] = {}
        self._pictures = Pictures(config.run_dir())
        self._publishing = threading.RLock()  # the last values are published after all others, before disconnecting
        self._stopped = threading.Event()
        self._drives = drives
        self._exit_code = 0  # with which Stopped ends the script
        self._pid = os.getpid()  # no forked process may use the robot
        self._wheels = Wheels(transport, self._addresses, number, on_ended or self._end_run, clock)

    # -- to see

    def camera(
        self, *, width: int | None = None, views: bool = False, timeout: float | None = None
    ) -> Iterator[Picture]:
        """Iterate over the camera's pictures, always the newest: arrays of (height, width, 3) bytes, blue first.

        See `pebble.camera` for the options, and for what is raised.
        """
        self._check()
        for picture in self._pictures.every(width=width, views=views, timeout=timeout):
            self._check()
            yield picture
        self._check()

    def picture(self, max_age: float = 0.5) -> Picture | None:
        """Return the newest picture captured within the last ``max_age`` seconds, or None. Does not wait."""
        self._check()
        return self._pictures.newest(max_age)

    def latest(self, channel: Channel, max_age: float = 1.0) -> Any:
        """Return the newest payload of ``channel`` that arrived within the last ``max_age`` seconds, or None.

        Does not wait. The first call subscribes, and mostly returns None.
        """
        self._check()
        return self._latest.of(channel, max_age)

    def on(self, channel: Channel, handler: Callable[..., None]) -> None:
        """Call ``handler`` with each payload of ``channel``, on a thread of its own.

        For a pattern channel, the names in the topic are arguments too. If the handler is slow, the oldest are dropped.
        """
        self._check()
        self._subscribe(channel, handler)

    # -- to act

    def drive(self, x: float = 0.0, z: float = 0.0, y: float = 0.0) -> bool:
        """Steer by ``x`` (-1..1, positive: right), throttle ``z`` (positive: forward), and ``y``, as the robot has it.

        A command moves the robot for 0.75 s at most: repeat it, 5 to 50 times a second. Return False if the command has
        no effect, because a person drives, the robot is stopped, or there is no connection. At most 50 commands a
        second are published: if there are more, only the newest is, but a stop never waits. Numbers of NumPy will do.
        Raises ValueError or TypeError for a value that is no number.
        """
        self._check_drives()
        return self._wheels.drive(Drive(x=_axis("x", x), z=_axis("z", z), y=_axis("y", y)))

    def stop(self) -> bool:
        """Stop the wheels: the same as ``drive()``."""
        return self.drive()

    @property
    def overridden(self) -> bool:
        """True if a person has driven within the last 2 s, so that :meth:`drive` has no effect."""
        return self._wheels.overridden

    @property
    def why_refused(self) -> str:
        """Reason why :meth:`drive` would have no effect now; empty if it would have one, as far as is known."""
        return self._wheels.refusal()

    def publish(self, channel: Channel, value: Any, **names: str) -> bool:
        """Publish ``value`` on ``channel``; False: it was not accepted. ``names`` fill a pattern channel's levels."""
        topic = channel.topic(self.config.base, **names) if names else self._addresses[channel].topic
        with self._publishing:
            self._check_publish(channel, topic)
            return self._publish(channel, value, topic)

    def publish_at_end(self, channel: Channel, value: Callable[[], Any]) -> None:
        """Call ``value()`` and publish its result when the script ends, however it ends; not if it is killed."""
        self._check_publish(channel, self._addresses[channel].topic)
        self._last_values[channel] = value

    def neighbour(self, name: str) -> Neighbour:
        """Return another robot of the LAN, named in ``services.neighbours.listens``. Raises PebbleError for others."""
        self._check()
        neighbour = self._neighbours.get(name)
        if neighbour is None:
            section = getattr(self.config.services, "neighbours", None)  # None: its extension is not installed
            if section is None or not section.enabled or name not in section.listens:
                raise PebbleError(f'robot.neighbour: {name!r} is not in services.neighbours.listens: add "{name}": []')
            latest = _Latest(partial(self._subscribe_to, name), self._clock)
            parts = RobotParts(self._transport, self._wheels, latest.of, self._check, self._check_drives, self._clock)
            neighbour = self._neighbours[name] = Neighbour(name, self.config.identity, parts)
        return neighbour

    def sleep(self, seconds: float) -> None:
        """Wait; the wheels stop after 0.75 s without a command."""
        self._check()
        self._stopped.wait(max(0.0, seconds))
        self._check()

    # -- its end

    def end(self, why: str, exit_code: int = 0) -> None:
        """Publish the final zero and close the cameras; every later call raises Stopped. From any thread."""
        if os.getpid() != self._pid:  # a forked copy of the script's process
            return
        if not self._stopped.is_set():  # the first end decides
            self._exit_code = exit_code
        self._stopped.set()
        self._wheels.end(why)
        for neighbour in list(self._neighbours.values()):
            neighbour.end()
        locked = self._publishing.acquire(timeout=_STUCK_S)  # False: a publish hangs, and the end does without
        try:
            values, self._last_values = self._last_values, {}
            for channel, value in values.items():
                self._publish_last(channel, value)
        finally:
            if locked:
                self._publishing.release()
        self._pictures.close()

    def close(self) -> None:
        if os.getpid() == self._pid:
            self.end("the script has finished")
            self._transport.close()

    def _publish(self, channel: Channel, value: Any, topic: str) -> bool:
        address = self._addresses[channel]
        payload, flag = codec.encode(channel, value), channel.kind is Kind.FLAG
        return self._transport.publish(topic, payload, qos=QoS(address.qos), retain=address.retain, shared=flag)

    def _publish_last(self, channel: Channel, value: Callable[[], Any]) -> None:
        try:
            self._publish(channel, value(), self._addresses[channel].topic)
        except Exception:  # the boundary to the script's own function: the rest of the end goes on
            self.log.exception("publish_at_end: no last %s", channel.metric)

    def _end_run(self, why: str) -> None:
        self.log.warning("%s", why)
        self.end(why, EXIT_ENDED)

    def _check(self) -> None:
        if os.getpid() != self._pid:
            raise PebbleError("a fork of a script has no robot: use a thread, or start a program with subprocess")
        if self._stopped.is_set():
            raise Stopped(self._exit_code)

    def _check_drives(self) -> None:
        self._check()
        if not self._drives:
            raise PebbleError("this script only measures, as its run(…, drives=False) says: it commands nothing")

    def _check_publish(self, channel: Channel, topic: str) -> None:
        self._check()
        if channel.direction == INCOMING:  # a command, perhaps to another robot
            self._check_drives()
        check_publish(topic, self._addresses)

    def _subscribe(self, channel: Channel, handler: Callable[..., None]) -> None:
        self._receive(self._addresses[channel].topic, channel, handler)

    def _subscribe_to(self, robot: str, channel: Channel, handler: Callable[..., None]) -> None:
        self._receive(NEIGHBOUR_VALUE.topic(self.config.base, robot=robot, metric=channel.metric), channel, handler)

    def _receive(self, topic: str, channel: Channel, handler: Callable[..., None]) -> None:
        receive = self._refusals.reader(channel, lambda _message, value, names: handler(value, **names))
        self._transport.subscribe(topic, receive, qos=QoS(channel.default_qos), limit=_WAITING)


def _axis(name: str, value: Any) -> float:
    """Return a number as a float. Raises ValueError or TypeError that names the axis."""
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise type(error)(f"robot.drive: {name} is a number from -1 to 1, not {value!r:.40}") from None


def check_publish(topic: str, addresses: Addresses) -> None:
    """Raise PebbleError for a topic that a script must not publish on."""
    for channel, instead in _REFUSED.items():
        if matches(addresses[channel].topic, topic) or matches(channel.filter(addresses.base), topic):
            raise PebbleError(f"a script does not publish {channel.metric}: {instead}")
