"""What must be true of the wheels, recomputed from what people did and what the owners of the motors published."""

from __future__ import annotations

from collections.abc import Iterator

from pebble.contract.payloads import EstopState
from tests.robot.stop_schedules.history import Event, History
from tests.robot.stop_schedules.schedules import ROBOTS
from tests.robot.stop_schedules.world import World

_REACTION_S = 0.4  # from a state or a zero until the wheels are still, beside other work
_DEAD_MAN_S = 1.2  # until the MCU stops wheels whose owner was killed or stands still
_HEARTBEAT_S = 0.6  # they are sent four times a second
_STAYS_S = 1.8  # at rest after a zero
_FAULT_PAST_S, _FAULT_NEXT_S = 0.5, 0.5  # so long after and before a fault nothing is expected to arrive
_START_S = 3.0  # an owner that was killed is there again
_NAMES = 4  # remembered by every owner


def violations(history: History, world: World, until: float) -> list[str]:
    """What does not hold, in words; empty if everything does. ``until`` is when people began to end everything."""
    return [f"{robot}: {problem}" for robot in ROBOTS for problem in _Rules(history, robot, world, until).problems()]


class _Rules:
    def __init__(self, history: History, robot: str, world: World, until: float) -> None:
        self._world, self._wheels = world, world.wheels[robot]
        self._until, self._began = until, history.began
        self._events = history.events(robot=robot)
        self._faults = history.events("fault")
        self._deaths = [event.at for event in self._of("owner killed")]
        self._frozen = [(e.at, e.at + e.details["seconds"]) for e in self._of("owner frozen")]
        self._states = [(e.at, e.details["state"]) for e in self._of("state") if e.details["live"]]
        self._boots = list(dict.fromkeys(state.boot for _, state in self._states))

    def _of(self, what: str) -> list[Event]:
        return [event for event in self._events if event.what == what]

    def problems(self) -> Iterator[str]:
        yield from self._latched()
        yield from self._zeros()
        yield from self._copies()
        yield from ("a state cannot be parsed" for _ in self._of("malformed state"))

    # -- no wheel turns while its owner is latched

    def _latched(self) -> Iterator[str]:
        for given in self._of("stop given"):
            name = given.details["name"]
            for boot in self._boots:
                shown = [(at, s) for at, s in self._states if s.boot == boot and s.latched and name in s.recent]
                if shown:
                    yield from self._still_while(name, given.at, shown)

    def _still_while(self, name: str, given: float, shown: list[tuple[float, EstopState]]) -> Iterator[str]:
        """``shown``: states of one boot that list the stop."""
        first, state = shown[0]
        ends = [reset.at for reset in self._of("reset") if reset.at >= given and self._may_end(reset, name, state)]
        death = next((at for at in self._deaths if at > first), float("inf"))
        saved = next((at for at, state in shown if state.persisted is not False), float("inf"))
        if saved > death:
            ends.append(death)
        last = min([*ends, self._until])
        if turned := self._wheels.turned(first + self._reaction(first), last):
            since = f"{turned[0][0] - first:.2f} s after the state that lists stop {name}"
            reset = "no reset was sent that could end it" if not ends else f"{last - turned[0][0]:.2f} s before its end"
            yield f"wheels turn ({turned[0][2]:+.2f}) {since}, at {turned[0][0] - self._began:.3f}; {reset}"

    def _may_end(self, reset: Event, name: str, latched: EstopState) -> bool:
        """Whether the sender of this reset had seen a state with that stop, or a later one."""
        shown: EstopState = reset.details["shown"]
        if shown.boot == latched.boot:
            return name in shown.recent or shown.count >= latched.count + _NAMES
        known = self._boots.index(shown.boot) if shown.boot in self._boots else -1
        return known > self._boots.index(latched.boot)

    def _reaction(self, at: float) -> float:
        """How soon wheels are still after a state: later if its owner could not stop them any more."""
        disturbed = [(death, death) for death in self._deaths] + self._frozen
        near = any(begin - _REACTION_S <= at + _REACTION_S and at - _DEAD_MAN_S <= end for begin, end in disturbed)
        return _DEAD_MAN_S if near else _REACTION_S

    # -- zeros

    def _zeros(self) -> Iterator[str]:
        """A person's zero stops the wheels until one drives again."""
        for zero in self._of("zero"):
            driving = self._driving(zero.at)
            last = min([driving, zero.at + _STAYS_S, self._until])
            if driving <= zero.at or self._lost(zero):
                continue
            if turned := self._wheels.turned(zero.at + _REACTION_S, last):
                yield f"wheels turn ({turned[0][2]:+.2f}) {turned[0][0] - zero.at:.2f} s after a zero"

    def _driving(self, at: float) -> float:
        """When a person drives next; ``at`` if one does so."""
        own = ("drives", "zero", "ends driving")
        person = [event for event in self._events if event.what in own and "sender" not in event.details]
        before = [event for event in person if event.at <= at]
        if before and before[-1].what == "drives":
            return at
        return next((event.at for event in person if event.at > at and event.what == "drives"), float("inf"))

    def _lost(self, zero: Event) -> bool:
        """Whether it may not have arrived, or its owner may have restarted before the end of the hold."""
        at = zero.at
        if not zero.details["sent"]:
            return True
        arrived = [event.at for event in self._of("online") if at - _HEARTBEAT_S < event.at < at + _HEARTBEAT_S]
        connected = bool(arrived) and arrived[0] < at < arrived[-1]
        near = any(e.at - _FAULT_NEXT_S < at < e.details["until"] + _FAULT_PAST_S for e in self._faults)
        dead = any(at - _START_S < death < at + _STAYS_S for death in self._deaths)
        return near or dead or not connected

    # -- retained copies

    def _copies(self) -> Iterator[str]:
        for at, state in self._states:
            if found := self._world.planted & set(state.recent):
                yield f"the retained copy of stop {found.pop()} was executed, at {at - self._began:.3f}"
                return
