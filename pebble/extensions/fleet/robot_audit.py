"""The robot's audit: a log of JSON lines about who did what, which the bridge writes when commands pass.

Forwarding never waits for it. It holds no driving commands, and no parameters or keys of other commands.
"""

import errno
import math
import os
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from pebble.config import Config
from pebble.contract import (
    AUTONOMY_COMMAND,
    CONTROL,
    CONTROL_TAKE,
    ESTOP,
    ESTOP_RESET,
    GROUP,
    LIGHTS_FLASH,
    LIGHTS_SOLID,
    OUTLET_COMMAND,
    SOUNDBOARD_COMMAND,
    Channel,
    Kind,
    codec,
)
from pebble.contract.names import NO_ACCOUNT
from pebble.contract.payloads import ControlState, EstopCommand, EstopState, LightsSolid, Switch
from pebble.errors import PayloadError
from pebble.extensions.fleet.row_writer import DIFFERENT, OF_STRANGERS, WINDOW_S, Row, RowWriter
from pebble.forwarding.observer import ROBOT, Observer
from pebble.forwarding.routing import Drop
from pebble.motion.lease import shown
from pebble.runtime.whole_file import sync_file
from pebble.version import __version__

_UNCHECKED = "?"  # behind a name that the broker has not checked
_MOST_BYTES = 8_000_000  # of each of two files
_NAME, _FILE = 40, 64  # characters
_REMEMBERED = 256  # names of stops, as a stop is repeated until it is confirmed; and as many senders of lights
_REFUSED = {
    *(Drop.UNNAMED, Drop.MISNAMED, Drop.UNREADABLE, Drop.SIGNED, Drop.LATE),
    *(Drop.STALE, Drop.TOO_LARGE, Drop.TOO_MANY, Drop.TOO_OFTEN),
}
#: What is noted of a command; empty: nothing.
_COMMANDS: dict[str, Callable[[Any], Row]] = {
    ESTOP.suffix: lambda stop: {"what": "stop", "stop": stop.stop or "", "why": stop.why or ""},
    ESTOP_RESET.suffix: lambda _: {"what": "reset"},
    CONTROL.suffix: lambda request: {"what": "control-released", "id": request.id} if request.ends() else {},
    CONTROL_TAKE.suffix: lambda request: {"what": "control-demanded", "id": request.id},
    AUTONOMY_COMMAND.suffix: lambda request: _file_row("script", request),
    SOUNDBOARD_COMMAND.suffix: lambda request: _file_row("sound", request),
    LIGHTS_SOLID.suffix: lambda colour: _lights_row(colour),
    LIGHTS_FLASH.suffix: lambda colour: _lights_row(colour),
    OUTLET_COMMAND.suffix: lambda request: {"what": "outlet", "on": request.on},
}
#: Harmless commands: after OF_STRANGERS different rows in a minute theirs are only counted, so that others have room.
_MILD = (SOUNDBOARD_COMMAND, LIGHTS_SOLID, LIGHTS_FLASH)


def files(config: Config) -> list[Path]:
    """Return the files of a robot's audit, the newer one first."""
    path = config.state_file("audit").with_suffix(".jsonl")
    return [path, path.with_suffix(".old.jsonl")]


class Audit(Observer):
    """A writer of commands, refusals and changes of control. Thread-safe, except for :meth:`control`."""

    def __init__(self, config: Config, clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._older = files(config)
        self._level = config.security.level
        self._writer, self._clock = RowWriter(self._append, clock), clock
        self._holder: ControlState | None = None  # None: not known yet
        self._owners, self._awaited = config.motor_owners, set[str]()  # awaited: their answer to the newest reset
        self._refusals = dict[str, str | None]()  # by owner: why it has refused its last reset, if it has
        self._stops = deque[tuple[str, str]](maxlen=_REMEMBERED)  # those that have a row: name and sender
        self._lights = dict[tuple[str, bool], float]()  # when each sender last sent lights, on or off

    def start(self) -> None:
        self._writer.start()
        self.note("start", level=self._level, version=__version__)

    def close(self) -> None:
        self._writer.close()

    def note(self, what: str, who: str = ROBOT, *, most: int = DIFFERENT, **more: str | float | bool) -> None:
        """Add a row; ``what`` is one of a fixed set. ``most``: see :meth:`RowWriter.add`."""
        self._writer.add({"t": round(time.time(), 3), "what": what, "who": who, **more}, most=most)

    def passed(self, channel: Channel, by: str | None, payload: bytes) -> None:
        """Add a row for a message that passed, without parameters and keys; for a whole group, of each member."""
        if channel is GROUP:
            from pebble.contract import groups  # few robots get one

            with suppress(PayloadError):
                for member in groups.decode(payload):
                    self.passed(member.channel, by, member.payload)
            return  # the group itself has no row
        row_of = _COMMANDS.get(channel.suffix)
        if row_of is None and channel.kind not in (Kind.FLAG, Kind.ACTION):
            return
        with suppress(PayloadError):
            if row_of is not None:
                command = codec.decode(channel, payload)
                row, who = row_of(command), _sender(by, command)
                most_different = OF_STRANGERS if channel in _MILD else DIFFERENT  # in a minute, see RowWriter.add
                if row and not self._noted_before(row, who):
                    self.note(who=who, most=most_different, **_place(by), **row)
                if channel is ESTOP_RESET:
                    self._awaited.update(self._owners)
            else:
                on = bool(payload) and bool(codec.decode(channel, payload))
                if on or channel.kind is Kind.FLAG:  # an action that is not "on" does nothing
                    name = channel.metric.removeprefix("flags/")
                    self.note(channel.kind.name.lower(), _sender(by), **_place(by), name=name, on=on)

    def refused(self, drop: Drop, channel: Channel | None, by: str | None) -> None:
        """Add a row for a refused message; after OF_STRANGERS different ones in a minute, more are only counted."""
        if drop in _REFUSED:
            name, who = "" if channel is None else channel.metric, _sender(by)
            row = {"t": round(time.time(), 3), "what": "refused", "who": who, **_place(by), "name": name}
            self._writer.add({**row, "why": drop.value}, most=OF_STRANGERS)

    def control(self, state: ControlState) -> None:
        """Add rows for the gain and the loss of control, as the motor owner reports them."""
        before, self._holder = self._holder, state
        if before is None or (before.key, before.boot) == (state.key, state.boot):
            return
        for what, holder in (("control-ended", before), ("control-given", state)):
            if holder.key:
                who = holder.by if holder.named and holder.by else f"{holder.by}{_UNCHECKED}"  # "?": no name
                self.note(what, who, id=holder.id, device=holder.device)

    def estop(self, owner: str, state: EstopState) -> None:
        """Add a row if the owner has refused a reset. All its states say why it has refused the last one, if it has."""
        why = state.reset_refused
        if owner not in self._refusals:
            self._refusals[owner] = why  # the first state that is seen may tell of an old refusal: it is no news
        is_news = why != self._refusals[owner]
        is_answer = owner in self._awaited  # to the newest reset that passed here
        is_of_another = why == "boot" and len(self._owners) > 1  # a reset is for one owner's boot: all others refuse it
        self._refusals[owner] = why
        self._awaited.discard(owner)
        if why and (is_answer or is_news) and not is_of_another:
            self.note("reset-refused", owner=owner, why=why)

    def unconfirmed(self, owner: str, stop: EstopCommand) -> None:
        self.note("stop-not-confirmed", owner=owner, stop=str(stop.stop))

    def _noted_before(self, row: Row, who: str) -> bool:
        """True if the sender has a row for the same stop, or has switched lights so (on or off) in the last minute.

        Remembers the row. A stop may arrive with its sender's account, and once more without: then it has two rows.
        Lights that blink have one row for on and one for off, and new ones only after they have rested for a minute.
        """
        if row["what"] == "lights":
            key, now = (who, row["on"]), self._clock()
            last_at = self._lights.pop(key, -math.inf)
            if len(self._lights) >= _REMEMBERED:
                self._lights.pop(next(iter(self._lights)))  # the one that rests longest
            self._lights[key] = now
            return now - last_at < WINDOW_S
        stop = row.get("stop", "")
        repeated = (stop, who) in self._stops
        if stop and not repeated:
            self._stops.append((stop, who))
        return repeated

    def _append(self, rows: list[Row]) -> None:
        """Write all rows. If that raises OSError, the file is as before."""
        lines = b"".join(msgspec.json.encode(row) + b"\n" for row in rows)
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if self._path.exists() and self._path.stat().st_size >= _MOST_BYTES:
            self._path.replace(self._older)
        file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
        size = os.fstat(file).st_size
        try:
            if size and os.pread(file, 1, size - 1) != b"\n":  # a power cut has left a part of a line
                lines = b"\n" + lines
            if os.write(file, lines) != len(lines):
                raise OSError(errno.ENOSPC, "No space left on device")
            sync_file(file, data=True)
        except OSError:
            os.ftruncate(file, size)
            raise
        finally:
            os.close(file)


def _file_row(what: str, request: Switch) -> Row:
    if not request.ends() and not request.file:
        return {}
    return {"what": f"{what}-stop" if request.ends() else f"{what}-start", "file": (request.file or "")[:_FILE]}


def _lights_row(colour: LightsSolid) -> Row:
    return {"what": "lights", "on": colour.r + colour.g + colour.b > 0}


def _sender(by: str | None, command: Any = None) -> str:
    """Return the account, or else the payload's claimed sender, marked as unchecked."""
    claim = getattr(command, "by", None)
    name = shown(claim.rstrip(_UNCHECKED), _NAME) if isinstance(claim, str) else ""
    if by == ROBOT:
        return f"{ROBOT}/{name}" if name else ROBOT
    return f"{name}{_UNCHECKED}" if by is None or by == NO_ACCOUNT else by


def _place(by: str | None) -> Row:
    """Return the field of a row that names the side from which a command came."""
    return {"from": "robot" if by == ROBOT else "operators"}
