"""What people do to the robot, and what is refused, recognised in the messages that pass the bridge. No I/O.

Commands tell who asked; who has control and what is stopped is in the states of the motor owners. Of stops both
count, because a stop may come from within the robot. Names are the broker's where ``by`` is given; others stand with
``?``: they are claims.
"""

import re
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from typing import Any

from pebble.contract import (
    AUTONOMY_COMMAND,
    CONTROL,
    CONTROL_STATE,
    CONTROL_TAKE,
    DRIVE,
    ESTOP,
    ESTOP_RESET,
    ESTOP_STATE,
    Channel,
    Kind,
    codec,
)
from pebble.contract.payloads import AutonomyCommand, EstopCommand
from pebble.errors import PayloadError
from pebble.forwarding.routing import Drop
from pebble.services.mqtt_bridge.audit_rows import ROBOT, AuditRows, Row, sender
from pebble.services.mqtt_bridge.histories import ControlHistory, StopHistory

#: Quotas: of one account 200 acts of a kind at once, then 12 an hour: in all kinds a week's flood in 4 MB.
_ACTS, _ACTS_S = 200, 300.0
_REFUSED, _REFUSED_S = 1, 60.0
_FILE = 64  # characters
_STATES = 64  # that wait, of each owner: they come ten times a second at most
_AFTER_S = 0.2  # a state may arrive before the command that brought it about has been noted
_REFUSALS = {
    Drop.UNNAMED: "unnamed",
    Drop.MISNAMED: "misnamed",
    Drop.UNREADABLE: "unreadable",
    Drop.SIGNED: "signed from outside",
    Drop.LATE: "late",
    Drop.STALE: "retained",
    Drop.TOO_LARGE: "too large",
    Drop.TOO_MANY: "too many",
    Drop.TOO_OFTEN: "too often",
}
_key = re.compile(rb'"key"\s*:\s*"([0-9A-Za-z ]{0,80})"').search


class Acts:
    """Fills :attr:`acts` and :attr:`refused`. Thread-safe; ``clock`` is monotonic, ``wall`` counts epoch seconds."""

    def __init__(self, base: str, owners: Iterable[str], clock: Callable[[], float], wall: Callable[[], float]) -> None:
        self.acts, self.refused = AuditRows(_ACTS, _ACTS_S), AuditRows(_REFUSED, _REFUSED_S)
        self.lock = threading.RLock()
        self._clock, self._wall = clock, wall
        names = sorted(owners)
        self._control_topic = CONTROL_STATE.topic(base, owner=names[0]) if names else ""  # the first one decides
        #: Of the states that :meth:`state` is to receive.
        self.topics = {self._control_topic} | {ESTOP_STATE.topic(base, owner=name) for name in names}
        self._states: dict[str, list[tuple[float, bytes]]] = {}
        self._newest: dict[str, bytes] = {}
        self._control = ControlHistory(clock, self._act)
        self._stops = StopHistory(clock, self._act, self.acts.waits)
        self._keys: frozenset[bytes] | None = None  # of control; None: there is no owner that gives any
        self._handlers: dict[str, Callable[[str | None, Any], None]] = {
            ESTOP.suffix: self._stops.stop,
            ESTOP_RESET.suffix: self._stops.reset,
            CONTROL.suffix: partial(self._control.request, takes=False),
            CONTROL_TAKE.suffix: partial(self._control.request, takes=True),
            AUTONOMY_COMMAND.suffix: self._on_script,
        }

    # -- the transports' threads

    def passed(self, channel: Channel, by: str | None, payload: bytes) -> None:
        """A command or a changed flag. ``by`` is the checked sender, ROBOT, or None. Hot for drive commands."""
        if channel is DRIVE:
            self._control.commands += 1
            keys = self._keys
            if keys is not None and b'"key"' in payload and not any(key in payload for key in keys):
                self._check_key(by, payload)
            return
        handler = self._handlers.get(channel.suffix)
        if handler is not None:
            with self.lock, suppress(PayloadError):
                handler(by, codec.decode(channel, payload))
        elif channel.kind in (Kind.FLAG, Kind.ACTION):
            self._on_switch(channel, by, payload)

    @property
    def keys(self) -> frozenset[bytes] | None:
        """The key of who has control, of the owner that decides; None: no owner gives any."""
        return self._keys

    def state(self, topic: str, payload: bytes) -> None:
        """A state of a motor owner; the same again is nothing new."""
        if self._newest.get(topic) != payload:
            with self.lock:
                self._newest[topic] = payload
                if topic == self._control_topic:  # at once: commands with the new key follow
                    found = _key(payload)
                    self._keys = frozenset((found[1],)) - {b""} if found is not None else None
                waiting = self._states.setdefault(topic, [])
                waiting.append((self._clock(), payload))
                del waiting[:-_STATES]

    def drop(self, drop: Drop, by: str | None) -> None:
        """A message from outside did not pass."""
        if (reason := _REFUSALS.get(drop)) is not None:
            self._refuse(reason, by)

    # -- any thread

    def note(self, what: str, **more: Any) -> None:
        """What the robot itself does."""
        with self.lock:
            self._act(what, ROBOT, ROBOT, more)

    def follow_states(self) -> None:
        """Find what has changed in the states; call it about once a second."""
        now = self._clock()
        with self.lock:
            for topic, waiting in self._states.items():
                while waiting and now - waiting[0][0] >= _AFTER_S:
                    at, payload = waiting.pop(0)
                    self._follow(topic, payload, at)

    def unconfirmed(self, owner: str, stop: EstopCommand) -> None:
        """A motor owner has no emergency stop any more, and has not confirmed this stop."""
        with self.lock:
            self._act("stop-unconfirmed", *sender(None, stop.by), {"owner": owner})

    # -- what commands tell

    def _on_script(self, by: str | None, command: AutonomyCommand) -> None:
        who, account = sender(by, getattr(command, "by", None))
        if command.ends() or command.file:
            what = "script-stop" if command.ends() else "script-start"
            self._act(what, who, account, {"file": command.file[:_FILE]} if command.file else {})

    def _on_switch(self, channel: Channel, by: str | None, payload: bytes) -> None:
        try:
            on = bool(payload) and codec.decode(channel, payload)
        except PayloadError:
            return
        name, action = channel.metric.removeprefix("flags/"), channel.kind is Kind.ACTION
        if on or not action:
            with self.lock:
                who, account = sender(by, None)
                self._act("action" if action else "flag", who, account, {"name": name} | ({} if action else {"on": on}))

    def _check_key(self, by: str | None, payload: bytes) -> None:
        """A drive command with a key that is no owner's moves nothing. Only one of these is looked at closely."""
        found = _key(payload)
        if found is None or self._keys is None or not self._keys.isdisjoint(found[1].split(b" ")):
            return
        try:
            moves = codec.decode(DRIVE, payload).moves
        except PayloadError:
            return
        if moves:
            self._refuse("wrong key", by)

    # -- what states tell

    def _follow(self, topic: str, payload: bytes, at: float) -> None:
        with suppress(PayloadError):
            if payload and topic == self._control_topic:
                self._control.follow(codec.decode(CONTROL_STATE, payload), at)
            elif payload:
                self._stops.follow(topic, codec.decode(ESTOP_STATE, payload))

    # -- rows

    def _act(self, what: str, who: str, account: str, more: Row) -> Row:
        row = {"t": round(self._wall(), 3), "what": what, "who": who, **more}
        self.acts.add(row, account, self._clock())
        return row

    def _refuse(self, reason: str, by: str | None) -> None:
        who, account = sender(by, None)
        with self.lock:
            self.refused.add({"t": round(self._wall(), 3), "what": reason, "who": who}, account, self._clock())
