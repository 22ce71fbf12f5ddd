"""Which of several brokers the programs of a robot use: one of them chooses, the others follow, and it returns."""

import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path

from pebble.transports.hosts import Address, Place, addresses_of
from pebble.transports.settings import MqttSettings

log = logging.getLogger(__name__)

_LOOK_S, _IDLE_S = 1.0, 60.0  # the connection wakes up earlier, for its pings
REST_S = 60.0  # so long a robot was not driven before it changes its host without need
_PROBE_S = 20.0  # between two looks at the first host
_GOOD_S = 40.0  # so long, in three looks, it has accepted a login
_WORST_S = 3600.0
_HELD_S = 600.0  # a return that held for so long was right


class ChosenHost:
    """The file in which the program that chooses tells the others where it is connected. Any of them may be ahead."""

    def __init__(self, file: Path, places: Sequence[Place]) -> None:
        self._file, self._places = file, {str(one): one for one in places}

    def read(self) -> Place:
        """The first host until one was chosen, and if the file names none of ours."""
        try:
            text = self._file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError):
            text = ""
        return self._places.get(text) or next(iter(self._places.values()))

    def write(self, place: Place) -> None:
        part = self._file.with_name(f".{self._file.name}.{os.getpid()}")
        try:
            part.write_text(f"{place}\n", encoding="utf-8")
            part.replace(self._file)
        except OSError as error:
            log.warning("%s cannot be written, so pictures and sound may go elsewhere: %s", self._file, error.strerror)


class Return:
    """When a robot that rests at another host goes back to the first one. Pure.

    Tools that know only the first host would not find it any more. Each return that did not hold doubles the time for
    which the first host has to be good.
    """

    def __init__(self) -> None:
        self._good_s = _GOOD_S
        self._good_since: float | None = None
        self._probe_at = inf  # no probe is due at the first host
        self._returned_at: float | None = None  # and what became of it is not known yet

    def connected(self, now: float, *, first: bool) -> None:
        self._good_since = None
        self._probe_at = inf if first else now + _PROBE_S
        if not first and self._returned_at is not None:
            short = now - self._returned_at < _HELD_S
            self._good_s, self._returned_at = min(2 * self._good_s, _WORST_S) if short else _GOOD_S, None

    def wants_probe(self, now: float) -> bool:
        """Whether to look now whether the first host accepts a login; the next time is later."""
        if now < self._probe_at:
            return False
        self._probe_at = now + _PROBE_S
        return True

    def probed(self, now: float, *, good: bool) -> None:
        if not good or self._probe_at == inf:  # of a look from before the return, perhaps
            self._good_since = None
        elif self._good_since is None:
            self._good_since = now

    def is_due(self, now: float, idle_s: float) -> bool:
        """``idle_s``: for how long the robot was not driven."""
        if self._good_since is None or now - self._good_since < self._good_s or idle_s < REST_S:
            return False
        self._good_since, self._returned_at = None, now
        return True


class Probes:
    """Looks at the first host, on a thread of its own: a login may take seconds, and heartbeats must not wait."""

    def __init__(self, probe: Callable[[], bool]) -> None:
        self._probe = probe
        self._result: bool | None = None
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._run, name="pebble-mqtt first host", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        self._result = self._probe()

    def take(self) -> bool | None:
        """The newest result, once; None: none."""
        result, self._result = self._result, None
        return result


class HostChoice:
    """The hosts of one program: where it is connected, and when it leaves for another one."""

    def __init__(self, settings: MqttSettings, accepts_login: Callable[[Place, Address], bool]) -> None:
        self._places = tuple(Place(*one) for one in settings.hosts or ((settings.host, settings.port),))
        self._chosen = None if settings.chosen is None else ChosenHost(settings.chosen, self._places)
        self._follows = settings.follows
        self._accepts_login = accepts_login
        self._connected: Place | None = None  # in the newest connection
        #: By what they refuse of us, all that is subscribed to or published: such hosts, since one has not refused it.
        self._refusing: dict[str, set[Place]] = {}
        self._returning, self._probes = Return(), Probes(self._probe_first)

    @property
    def several(self) -> bool:
        return len(self._places) > 1

    @property
    def patience_s(self) -> float:
        """So long a connection may sleep before it looks for another host."""
        return _LOOK_S if self.several else _IDLE_S

    def next_round(self) -> Sequence[Place]:
        """The hosts that have their turns in the next round."""
        return [self._chosen.read()] if self._follows and self._chosen is not None else self._places

    def moves_to(self, place: Place) -> bool:
        """Whether a connection to ``place`` is to another host than the one before."""
        return self._connected not in (None, place)

    def connected(self, place: Place) -> None:
        """The connection to ``place`` can be used."""
        self._connected = place
        self._returning.connected(time.monotonic(), first=place == self._places[0])
        if self._chosen is not None and not self._follows:
            self._chosen.write(place)

    def refused(self, what: str, place: Place) -> bool:
        """That host refuses all of it; whether to try the others: once, as they may be no better."""
        known = self._refusing.setdefault(what, set())
        is_new = place not in known
        known.add(place)
        return self.several and is_new

    def accepted(self, what: str) -> None:
        self._refusing.pop(what, None)

    def why_leave(self, idle_s: Callable[[], float]) -> str:
        """Why to leave this host now, empty if it is to stay; ``idle_s``: for how long a change has disturbed nothing.

        Call it after :attr:`patience_s` at the latest.
        """
        if not self.several:
            return ""
        if self._follows and self._chosen is not None:
            place = self._chosen.read()
            return "" if place == self._connected else f"the robot is at {place} now"
        now = time.monotonic()
        if (good := self._probes.take()) is not None:
            self._returning.probed(now, good=good)
        if self._returning.wants_probe(now):
            self._probes.begin()
        return f"returns to {self._places[0]}" if self._returning.is_due(now, idle_s()) else ""

    def _probe_first(self) -> bool:
        """Whether the first host accepts a login. On a thread of its own."""
        place = self._places[0]
        try:
            return any(self._accepts_login(place, one) for one in addresses_of(*place))
        except (OSError, ValueError):
            return False
