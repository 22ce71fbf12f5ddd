"""Follows a change of the robot's identity in the config: stops last, and what the earlier name left is removed.

Otherwise retained messages would stay under it, and operators would see a robot that is off for ever.
"""

import json
import logging
import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from pebble.config import Config
from pebble.config.config import file_name
from pebble.contract import ONLINE, Channel
from pebble.contract.identity import Identity
from pebble.contract.levels import LEVELS
from pebble.errors import ConfigError, PebbleError, TransportError
from pebble.forwarding.service import ForwardingService
from pebble.forwarding.side import Gate
from pebble.runtime.service import Service
from pebble.runtime.timers import Timer
from pebble.runtime.whole_file import make_folder, write
from pebble.services.mqtt_bridge.own_requests import Requests
from pebble.transports import Message, QoS, State, Subscription, Transport

log = logging.getLogger(__name__)

CallIn: TypeAlias = Callable[[float, Callable[[], None]], Timer]  # calls later, on the service's thread

WATCH_S = LEVELS["thin"].silent_s + 1.0  # in which another robot of that name would send a heartbeat
_ARRIVE_S = 2.0  # for what a broker retains
_OFFLINE = re.compile(rb'"online"\s*:\s*false')
_NAMES = 16  # that are remembered
_TOPICS = 1000  # that are removed of one name


def keep_stops(config: Config) -> None:
    """Remember the robot's name, and keep its stops if it or a motor owner had another name at the last start.

    The old file is removed then, or its stop would come back with its name. Raises PebbleError if one cannot be kept.
    """
    if config.path is None:
        return
    names = _names_of(config)
    before = names[-1] if names else config.base
    targets = [config.state_file(f"estop-{owner}") for owner in config.motor_owners]
    for file in _stop_files(config, before):
        # If the robot's name is unchanged, an owner that has a file keeps it: only the others take the stop.
        kept_in = [target for target in targets if before != config.base or not target.exists()]
        saved = _saved(file)
        if file in targets or not kept_in or _is_free(saved):
            continue
        for target in kept_in:
            write(target, saved, 0o600, PebbleError)
        log.warning("stopped, as it was before names in the config were changed: %s", file)
        with suppress(OSError):
            file.unlink()
    if before != config.base or not names:
        _remember(config, [*(name for name in names if name != config.base), config.base])


def _stop_files(config: Config, base: str) -> list[Path]:
    """Return the files that motor owners have saved under this name. Raises PebbleError."""
    folder, end = _folder(config, file_name(base)), f"-{file_name(base)}.json"
    try:
        files = [*folder.iterdir()]
    except FileNotFoundError:
        return []
    except OSError as error:
        if base == config.base:  # its owners read them by themselves, and start stopped if they cannot
            return []
        raise PebbleError(f"{folder}: {error.strerror}: stops of {base} may be there, let its user read it") from None
    # The names of several robots may end alike. The lock of its launcher, which each has here, tells its whole name.
    ends = {f"{lock.stem.removeprefix('launcher')}.json" for lock in files if lock.match("launcher-*.lock")}
    others = tuple(other for other in ends - {end, f"-{file_name(config.base)}.json"} if other.endswith(end))
    ours = (file for file in files if file.name.endswith(end) and not file.name.endswith(others))
    return [file for file in ours if file.name.startswith("estop-")]


def _names_of(config: Config) -> list[str]:
    """Return the base topics that the robot had with its config file, the newest last."""
    try:
        names = json.loads(_file(config).read_bytes())
        return [Identity(*name.split("/")).base for name in names][-_NAMES:]
    # No file at the first start, or one that is damaged.
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, ConfigError):
        return []


def _remember(config: Config, names: list[str]) -> None:
    try:
        make_folder(_file(config).parent)
        write(_file(config), json.dumps(names).encode(), 0o600, PebbleError)
    except (PebbleError, OSError) as error:
        log.warning("its name cannot be remembered: %s", error)


def _saved(file: Path) -> bytes:
    """Return the state that a motor owner has saved; empty if it cannot be read."""
    try:
        return file.read_bytes()
    except OSError:
        return b""


def _is_free(saved: bytes) -> bool:
    """True if no stop holds the owner whose state this is. What cannot be parsed is a stop, as for the owner itself."""
    try:
        state = json.loads(saved)
    except (ValueError, RecursionError):
        return False
    return isinstance(state, dict) and state.get("latched") is False and isinstance(state.get("recent"), list)


def _file(config: Config) -> Path:
    """Return the file of names. Several robots may share a state directory, but not a config."""
    return _folder(config, "") / f"names-{file_name(str(config.path and config.path.resolve()))}.json"


def _folder(config: Config, name: str) -> Path:
    """Return the state directory. By default each name has one of its own: then that of ``name``."""
    folder = config.state_dir()
    return folder.parent / name if folder.name == file_name(config.base) else folder


class EarlierNames:
    """A search for what is left of the names that the robot had with its config file."""

    def __init__(self, config: Config, sides: list[Transport], call_in: CallIn) -> None:
        self._config, self._sides, self._call_in = config, sides, call_in
        self._begun = config.path is None  # the search, made once; without a file, by which names are stored, never

    def begin(self) -> None:
        """Look for messages of earlier names. Call this when both sides are connected."""
        if self._begun:
            return
        self._begun = True
        for name in _names_of(self._config):
            if name != self._config.base:
                text = "its name was %s before: what a broker retains under it is removed unless a robot has it"
                log.info(text, name)
                _Removal(name, self._sides, self._call_in, partial(self._forget, name)).begin()

    def _forget(self, name: str) -> None:
        _remember(self._config, [other for other in _names_of(self._config) if other != name])


class Renaming(Requests):
    """A task that looks for earlier names once the bridge forwards. It needs no request."""

    channels = ()

    def __init__(self, service: Service) -> None:
        super().__init__(service)
        if not isinstance(service, ForwardingService):
            raise TypeError("earlier names are looked for by a bridge")
        self._forwarder = service.forwarder
        self._names = EarlierNames(
            service.config,
            [service.remote, service.transport],
            lambda seconds, job: service.call_at(service.clock() + seconds, job),
        )

    def take(self, channel: Channel, value: Any) -> None:
        """Do nothing: this task has no channels."""

    def repeat(self) -> None:
        if self._forwarder.gate is Gate.OPEN:
            self._names.begin()


class _Removal:
    """The removal of what brokers retain under an earlier name, unless a living robot has that name now."""

    def __init__(self, name: str, sides: list[Transport], call_in: CallIn, done: Callable[[], None]) -> None:
        self._name, self._sides, self._call_in, self._done = name, sides, call_in, done
        self._subscriptions: list[Subscription] = []
        self._answers: list[set[str]] = []  # of each side: its heartbeats, and later the topics that it retains
        self._removed = 0

    def begin(self) -> None:
        self._ask(ONLINE.topic(self._name), _note_heartbeat, WATCH_S, self._look)

    def _look(self) -> None:
        if any(len(heartbeats) > 1 for heartbeats in self._answers):  # only one of them can be retained
            log.info("%s is another robot now: what is retained under this name is its own", self._name)
            self._end()
            self._done()  # the name is forgotten
        elif all(transport.state is State.CONNECTED for transport in self._sides):
            self._ask(f"{self._name}/#", _note_retained, _ARRIVE_S, self._remove)
        else:
            self._end()  # the name is kept: the next start looks again

    def _remove(self) -> None:
        self._removed = sum(map(len, self._answers))
        for transport, topics in zip(self._sides, self._answers, strict=True):
            for topic in sorted(topics):
                transport.publish(topic, b"", qos=QoS.DELIVERED, retain=True)
        again = partial(self._ask, f"{self._name}/#", _note_retained, _ARRIVE_S, self._note_remaining)
        self._call_in(_ARRIVE_S, again)

    def _note_remaining(self) -> None:
        remaining = [topic for topics in self._answers for topic in topics]
        remaining += [subscription.filter for subscription in self._subscriptions if subscription.refused]
        self._end()
        if remaining:
            text = "%s, its earlier name, stays at a broker: this account may not remove %s and %d more topics"
            log.warning(text, self._name, min(remaining), len(remaining) - 1)
        elif self._removed:  # the next start looks again: a broker may publish a will later
            log.info("removed %d retained messages of its earlier name %s", self._removed, self._name)
        else:
            self._done()

    def _ask(
        self, filter_: str, note: Callable[[set[str], Message], None], wait_s: float, then: Callable[[], None]
    ) -> None:
        """Subscribe on all sides, and call ``then`` after ``wait_s``. No exception ends the bridge.

        ``note(answers, message)`` is called with each message and the set of answers of its side, to which it may add.
        """
        self._end()
        self._answers = [set() for _ in self._sides]
        try:
            for transport, answers in zip(self._sides, self._answers, strict=True):
                receive = partial(note, answers)
                self._subscriptions.append(transport.subscribe(filter_, receive, echo=False, direct=True))
        except TransportError as error:
            log.warning("what is left of its earlier name %s stays: %s", self._name, error)
            self._end()
            return
        self._call_in(wait_s, then)

    def _end(self) -> None:
        while self._subscriptions:
            self._subscriptions.pop().close()


def _note_heartbeat(heartbeats: set[str], message: Message) -> None:
    if len(heartbeats) < _TOPICS and _OFFLINE.search(message.payload) is None:
        heartbeats.add(message.payload.hex())


def _note_retained(topics: set[str], message: Message) -> None:
    if message.retain and message.payload and len(topics) < _TOPICS:
        topics.add(message.topic)
