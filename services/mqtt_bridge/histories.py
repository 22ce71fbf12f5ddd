"""The histories of control and of stops: which acts are behind what commands and states tell. No I/O."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from pebble.contract.payloads import ControlRequest, ControlState, EstopCommand, EstopReset, EstopState
from pebble.services.mqtt_bridge.audit_rows import ROBOT, UNKNOWN, Row, sender

_WHY = 40  # characters of a reason
_REMEMBERED = 256  # stops, and requests for control
_RECENT_S = 5.0  # so long a request explains a change of control, or a reset

#: Makes a row: what was done, by whom, whose quota it is, and more.
Act = Callable[[str, str, str, Row], Row]


class _Holder:
    """Who has control, as far as the states tell."""

    def __init__(self, state: ControlState, since: float, commands: int) -> None:
        self.state, self.since, self.commands = state, since, commands


class ControlHistory:
    """Who gets control and loses it, and by which request."""

    def __init__(self, clock: Callable[[], float], act: Act) -> None:
        self.commands = 0  # to drive, so far
        self._clock, self._act = clock, act
        self._holder: _Holder | None = None
        self._requests: OrderedDict[tuple[str, tuple[str, str]], float] = OrderedDict()  # by what, and which client

    def request(self, by: str | None, request: ControlRequest, *, takes: bool) -> None:
        """It explains a change of control; one that is only repeated is not remembered again.

        Ids are public: where names are checked, only the account's own request explains what becomes of its control.
        """
        state = None if self._holder is None else self._holder.state
        name = request.by if by is None or by == ROBOT else by
        client = (name.partition("/")[0] if state is not None and state.named else "", request.id)
        holds = state is not None and client == _client(state)
        if request.want == "release" and holds:
            _remember(self._requests, ("release", client), self._clock())
        elif request.want != "release" and takes and not holds:
            _remember(self._requests, ("take", client), self._clock())

    def follow(self, state: ControlState, at: float) -> None:
        """The motor owner that decides has told its newest state, at this time."""
        before = self._holder
        if before is None:  # the bridge has just started: what was before it does not know
            self._holder = _Holder(state, at, self.commands)
            return
        asked_before, passes = before.state.asks_id, state.key != before.state.key or state.boot != before.state.boot
        if passes:
            if before.state.key:
                self._lost(before, state, at)
            if state.key:
                self._named("control-taken" if self._lately("take", state, at) else "control-given", state, state.by)
            self._holder = _Holder(state, at, self.commands)
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
        used = {"seconds": round(at - before.since, 1), "commands": self.commands - before.commands}
        self._named(what, before.state, before.state.by, {**used, **why})

    def _named(self, what: str, state: ControlState, by: str, more: Row | None = None) -> None:
        who, account = sender(by if state.named and by else None, by)
        device = {"device": state.device} if state.device and by == state.by else {}
        self._act(what, who, account, {**device, **(more or {})})

    def _lately(self, want: str, holder: ControlState, at: float) -> bool:
        return at - self._requests.get((want, _client(holder)), float("-inf")) < _RECENT_S


class StopHistory:
    """Who stops the robot and who resets that. ``waits``: whether a row that was made is not written yet."""

    def __init__(self, clock: Callable[[], float], act: Act, waits: Callable[[Row], bool]) -> None:
        self._clock, self._act, self._waits = clock, act, waits
        self._stops: OrderedDict[str, tuple[Row, bool]] = OrderedDict()  # by name; whether the sender's was checked
        self._states: dict[str, EstopState] = {}  # of the motor owners, by topic
        self._resets: OrderedDict[tuple[str, int], tuple[str, str, float]] = OrderedDict()  # by what they end
        self._nameless_at = float("-inf")

    def stop(self, by: str | None, stop: EstopCommand) -> None:
        who, account = sender(by, stop.by)
        self._stopped(stop.stop or "", who, account, stop.why or "")

    def reset(self, by: str | None, reset: EstopReset) -> None:
        """It may come before the state that shows the stop has been followed."""
        _remember(self._resets, (reset.boot, reset.count), (*sender(by, reset.by), self._clock()))

    def follow(self, topic: str, state: EstopState) -> None:
        """A motor owner has told its newest state."""
        before = self._states.get(topic)
        self._states[topic] = state
        if before is None:
            return
        new = state.count - before.count if state.boot == before.boot else state.count
        for name in state.recent[: max(new, 0)] or [""] * (new > 0):
            self._stopped(name, *sender(None, state.by), state.why, seen_by_owner=True)
        if before.latched and not state.latched and state.boot == before.boot:
            who, account, at = self._resets.get((before.boot, before.count), ("", "", float("-inf")))
            recent = self._clock() - at < _RECENT_S
            self._act("reset", *((who, account) if recent else (UNKNOWN, UNKNOWN)), {})

    def _stopped(self, name: str, who: str, account: str, why: str, *, seen_by_owner: bool = False) -> None:
        """One row for each stop, whichever way it is heard of first, and how often it is repeated."""
        checked = account != UNKNOWN
        row, was_checked = self._stops.get(name, (None, False)) if name else (None, False)
        if row is not None:
            if was_checked or not checked:
                return
            if self._waits(row):
                row["who"] = who
                self._stops[name] = row, True
                return
        if not name:
            now, before = self._clock(), self._nameless_at
            if seen_by_owner and now - before < _RECENT_S:
                return  # its command has passed here
            self._nameless_at = now
        row = self._act("stop", who, account, {"why": why[:_WHY]} if why else {})
        if name:
            _remember(self._stops, name, (row, checked))


def _client(state: ControlState) -> tuple[str, str]:
    """The account, "" where names are not checked, and the id of who has control."""
    return state.by.partition("/")[0] if state.named else "", state.id


def _remember(table: OrderedDict[Any, Any], name: object, value: object) -> None:
    table[name] = value
    table.move_to_end(name)
    if len(table) > _REMEMBERED:
        table.popitem(last=False)
