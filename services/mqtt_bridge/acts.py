"""What people do to the robot, and what is refused, recognised in the messages that pass the bridge. No I/O.

Commands tell who asked; who has control and what is stopped is in the states of the motor owners. Of stops both
count, because a stop may come from within the robot. Names are the broker's where ``by`` is given; others stand with
``?``: they are claims.
"""

import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
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
from pebble.contract.names import NO_ACCOUNT
from pebble.contract.payloads import ControlRequest, ControlState, EstopState
from pebble.errors import PayloadError
from pebble.forwarding.routing import Drop
from pebble.motion.lease import shown
from pebble.services.mqtt_bridge.audit_rows import ROBOT, AuditRows, Row

#: Quotas: of one account 200 acts of a kind at once, then 12 an hour: in all kinds a week's flood in 4 MB.
_ACTS, _ACTS_S = 200, 300.0
_REFUSED, _REFUSED_S = 1, 60.0
_UNKNOWN = "?"  # in place of an account: the name was not checked
_MOST, _WHY, _NAME = 64, 40, 40  # characters of a file, a reason, a sender
_REMEMBERED = 256  # stops, and requests for control
_STATES = 64  # that wait, of each owner: they come ten times a second at most
_AFTER_S = 0.2  # a state may arrive before the command that brought it about has been noted
_RECENT_S = 5.0  # so long a request explains a change of control, or a reset
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


class _Holder:
    """Who has control, as far as the states tell."""

    def __init__(self, state: ControlState, since: float, commands: int) -> None:
        self.state, self.since, self.commands = state, since, commands


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
        self._holder: _Holder | None = None
        self._stops: OrderedDict[str, tuple[Row, bool]] = OrderedDict()  # by name; whether the sender's was checked
        self._estops: dict[str, EstopState] = {}
        self._requests: OrderedDict[tuple[str, tuple[str, str]], float] = OrderedDict()  # by what, and which client
        self._reset: tuple[str, str, float] = ("", "", float("-inf"))
        self._nameless_stop_at = float("-inf")
        self._keys: frozenset[bytes] | None = None  # of control; None: there is no owner that gives any
        self._commands = 0
        self._handlers: dict[str, Callable[[Channel, str | None, bytes], None]] = {
            ESTOP.suffix: self._on_stop,
            ESTOP_RESET.suffix: self._on_reset,
            CONTROL.suffix: self._on_request,
            CONTROL_TAKE.suffix: self._on_request,
            AUTONOMY_COMMAND.suffix: self._on_script,
        }

    # -- the transports' threads

    def passed(self, channel: Channel, by: str | None, payload: bytes) -> None:
        """A command or a changed flag. ``by`` is the checked sender, ROBOT, or None. Hot for drive commands."""
        if channel is DRIVE:
            self._commands += 1
            keys = self._keys
            if keys is not None and b'"key"' in payload and not any(key in payload for key in keys):
                self._check_key(by, payload)
            return
        handler = self._handlers.get(channel.suffix)
        if handler is not None:
            with self.lock:
                handler(channel, by, payload)
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

    # -- what commands tell

    def _on_stop(self, _channel: Channel, by: str | None, payload: bytes) -> None:
        try:
            stop = codec.decode(ESTOP, payload)
        except PayloadError:
            return
        who, account = self._sender(by, stop.by)
        self._stopped(stop.stop or "", who, account, stop.why or "")

    def _on_reset(self, channel: Channel, by: str | None, payload: bytes) -> None:
        try:
            reset = codec.decode(channel, payload)
        except PayloadError:
            return
        if any(one.boot == reset.boot and one.count == reset.count for one in self._estops.values()):
            self._reset = (*self._sender(by, reset.by), self._clock())

    def _on_request(self, channel: Channel, by: str | None, payload: bytes) -> None:
        """What explains a change of control; a request that is only repeated is not remembered again.

        Ids are public: where names are checked, only the account's own request explains what becomes of its control.
        """
        try:
            request: ControlRequest = codec.decode(channel, payload)
        except PayloadError:
            return
        state = None if self._holder is None else self._holder.state
        sender = request.by if by is None or by == ROBOT else by
        client = (sender.partition("/")[0] if state is not None and state.named else "", request.id)
        holds = state is not None and client == _client(state)
        if request.want == "release":
            if not holds:
                return
            name = "release", client
        elif channel is CONTROL_TAKE and not holds:
            name = "take", client
        else:
            return
        _remember(self._requests, name, self._clock())

    def _on_script(self, channel: Channel, by: str | None, payload: bytes) -> None:
        try:
            command = codec.decode(channel, payload)
        except PayloadError:
            return
        who, account = self._sender(by, getattr(command, "by", None))
        if command.ends() or command.file:
            what = "script-stop" if command.ends() else "script-start"
            self._act(what, who, account, {"file": command.file[:_MOST]} if command.file else {})

    def _on_switch(self, channel: Channel, by: str | None, payload: bytes) -> None:
        try:
            on = bool(payload) and codec.decode(channel, payload)
        except PayloadError:
            return
        name, action = channel.metric.removeprefix("flags/"), channel.kind is Kind.ACTION
        if on or not action:
            with self.lock:
                who, account = self._sender(by, None)
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
        try:
            if topic == self._control_topic:
                self._follow_control(codec.decode(CONTROL_STATE, payload) if payload else None, at)
            elif payload:
                self._follow_stop(topic, codec.decode(ESTOP_STATE, payload))
        except PayloadError:
            return

    def _follow_control(self, state: ControlState | None, at: float) -> None:
        if state is None:
            return
        before = self._holder
        if before is None:  # the bridge has just started: what was before it does not know
            self._holder = _Holder(state, at, self._commands)
            return
        asked_before, passes = before.state.asks_id, state.key != before.state.key or state.boot != before.state.boot
        if passes:
            if before.state.key:
                self._lost(before, state, at)
            if state.key:
                self._named("control-taken" if self._lately("take", state, at) else "control-given", state, state.by)
            self._holder = _Holder(state, at, self._commands)
        else:
            before.state = state
        if state.asks_id and state.asks_id != asked_before:
            self._named("control-asked", state, state.asks)

    def _lost(self, before: _Holder, state: ControlState, at: float) -> None:
        if state.boot != before.state.boot:
            what, why = "control-ended", {"why": "restart"}
        elif self._lately("release", before.state, at):
            what, why = "control-released", {}
        else:
            what, why = "control-ended", {"why": "another" if state.key else "silent"}
        used = {"seconds": round(at - before.since, 1), "commands": self._commands - before.commands}
        self._named(what, before.state, before.state.by, {**used, **why})

    def _named(self, what: str, state: ControlState, by: str, more: Row | None = None) -> None:
        who, account = self._sender(by if state.named and by else None, by)
        device = {"device": state.device} if state.device and by == state.by else {}
        self._act(what, who, account, {**device, **(more or {})})

    def _lately(self, want: str, holder: ControlState, at: float) -> bool:
        return at - self._requests.get((want, _client(holder)), float("-inf")) < _RECENT_S

    def _follow_stop(self, topic: str, state: EstopState) -> None:
        before = self._estops.get(topic)
        self._estops[topic] = state
        if before is None:
            return
        new = state.count - before.count if state.boot == before.boot else state.count
        for name in state.recent[: max(new, 0)] or [""] * (new > 0):
            self._stopped(name, *self._sender(None, state.by), state.why, seen_by_owner=True)
        if before.latched and not state.latched and state.boot == before.boot:
            who, account, at = self._reset
            recent = self._clock() - at < _RECENT_S
            self._act("reset", *((who, account) if recent else (_UNKNOWN, _UNKNOWN)), {})

    def _stopped(self, name: str, who: str, account: str, why: str, *, seen_by_owner: bool = False) -> None:
        """One row for each stop, whichever way it is heard of first, and how often it is repeated."""
        checked = account != _UNKNOWN
        row, was_checked = self._stops.get(name, (None, False)) if name else (None, False)
        if row is not None:
            if was_checked or not checked:
                return
            if self.acts.waits(row):
                row["who"] = who
                self._stops[name] = row, True
                return
        if not name:
            now, before = self._clock(), self._nameless_stop_at
            if seen_by_owner and now - before < _RECENT_S:
                return  # its command has passed here
            self._nameless_stop_at = now
        row = self._act("stop", who, account, {"why": why[:_WHY]} if why else {})
        if name:
            _remember(self._stops, name, (row, checked))

    # -- rows

    def _sender(self, by: str | None, claim: object) -> tuple[str, str]:
        """Who to show, and whose quota it is."""
        name = shown(claim.rstrip(_UNKNOWN), _NAME) if isinstance(claim, str) else ""  # a motor owner shows it marked
        if by == ROBOT:
            return f"{ROBOT}/{name}" if name else ROBOT, ROBOT
        if by is None or by == NO_ACCOUNT:
            return f"{name}{_UNKNOWN}", _UNKNOWN
        return by, by.partition("/")[0]

    def _act(self, what: str, who: str, account: str, more: Row) -> Row:
        row = {"t": round(self._wall(), 3), "what": what, "who": who, **more}
        self.acts.add(row, account, self._clock())
        return row

    def _refuse(self, reason: str, by: str | None) -> None:
        who, account = self._sender(by, None)
        with self.lock:
            self.refused.add({"t": round(self._wall(), 3), "what": reason, "who": who}, account, self._clock())


def _client(state: ControlState) -> tuple[str, str]:
    """The account, "" where names are not checked, and the id of who has control."""
    return state.by.partition("/")[0] if state.named else "", state.id


def _remember(table: OrderedDict[Any, Any], name: object, value: object) -> None:
    table[name] = value
    table.move_to_end(name)
    if len(table) > _REMEMBERED:
        table.popitem(last=False)
