"""An inbox for messages that are judged before they reach the motors: stops, resets, requests, drive commands."""

import threading
from itertools import chain

from msgspec import Struct

from pebble.contract import payloads as p
from pebble.contract.groups import Member
from pebble.motion.arbiter import PERSON, UNKNOWN_RUN
from pebble.motors.control import Control
from pebble.transports import State

_STOPS = 8  # as many names as a latch remembers
_RESETS = 8
_REQUESTS = 8
_SENDERS = 8  # of drive commands: the holder of control, all other persons, and runs of scripts
_HOLDER = -2  # in place of the number of a run: the holder of control


class ReceivedDrive(Struct, frozen=True):
    """A drive command, with the time at which it was received.

    ``company``: this motor owner's other commands in the same message (a group), such as lights; all count, or none.
    """

    drive: p.Drive
    at: float
    company: tuple[Member, ...] = ()


class ReceivedReset(Struct, frozen=True):
    """A reset, with the time at which it was received."""

    reset: p.EstopReset
    at: float


class ReceivedRequest(Struct, frozen=True):
    """A request for control, with the time at which it was received, and whether it takes control over."""

    request: p.ControlRequest
    over: bool
    at: float


class Batch(Struct):
    """All messages that were waiting, to be judged in the order of the fields."""

    stops: list[p.EstopCommand]
    resets: list[ReceivedReset]
    requests: list[ReceivedRequest]
    turns: list[tuple[str, p.ControlTurn]]
    lost: bool  # messages may have been lost
    drives: list[ReceivedDrive]
    vouched: p.ControlVouched | None


class MotionInbox:
    """A bounded inbox. Any thread may put, one takes. ``put`` returns True if the inbox was empty: then wake the taker.

    Of each sender the newest drive command waits. If it replaces a zero, the zero waits before it: a zero may end a
    script, or the wait after a reset. The holder of control is a sender apart, so that no other replaces its commands.
    So is each client that requests control, by account and id as in the lease: several persons may use one account.
    """

    def __init__(self, control: Control) -> None:
        self.dropped = 0
        self._control = control
        self._lock = threading.Lock()
        self._stops: list[p.EstopCommand] = []
        self._resets: list[ReceivedReset] = []
        self._requests: dict[tuple[str, str], ReceivedRequest] = {}  # by sender, the newest sender last
        self._turns: dict[str, p.ControlTurn] = {}  # by owner: a grant of the first one; which grant another follows
        self._lost = False  # messages, since the last batch
        self._vouched: p.ControlVouched | None = None  # the newest period that the bridge has vouched for
        self._drives: dict[int, list[ReceivedDrive]] = {}  # by run, PERSON or _HOLDER; the newest sender last

    def put_stop(self, stop: p.EstopCommand) -> bool:
        with self._lock:
            was_empty = self._empty
            if stop not in self._stops:
                self._stops.append(stop)
            if len(self._stops) > _STOPS:
                self._drop(self._stops)
            return was_empty

    def put_reset(self, reset: p.EstopReset, now: float) -> bool:
        with self._lock:
            was_empty = self._empty
            self._resets.append(ReceivedReset(reset, now))
            if len(self._resets) > _RESETS:
                self._drop(self._resets)
            return was_empty

    def put_request(self, request: p.ControlRequest, over: bool, now: float) -> bool:
        """Put a request for control; ``over``: it takes control without asking the holder."""
        with self._lock:
            was_empty = self._empty
            sender = self._control.sender(request)
            waiting = self._requests.pop(sender, None)
            if len(self._requests) >= _REQUESTS:
                knows = self._control.knows  # true of the holder, and of the first that asks: these requests stay
                del self._requests[next(key for key, received in self._requests.items() if not knows(received.request))]
                self.dropped += 1
            waiting_takes_over = waiting is not None and waiting.over  # which a renewal of the request must not undo
            over = not request.ends() and (over or waiting_takes_over)
            self._requests[sender] = ReceivedRequest(request, over, now)
            return was_empty

    def put_turn(self, owner: str, turn: p.ControlTurn) -> bool:
        with self._lock:
            was_empty = self._empty
            self._turns[owner] = turn
            return was_empty

    def put_vouched(self, vouched: p.ControlVouched) -> bool:
        with self._lock:
            was_empty = self._empty
            self._vouched = vouched
            return was_empty

    def note_state(self, state: State) -> None:
        """Note a state of the connection. In any but CONNECTED messages may be lost, and the next batch says so."""
        if state is not State.CONNECTED:
            with self._lock:
                self._lost = True

    def put_drive(self, drive: p.Drive, now: float, company: tuple[Member, ...] = ()) -> bool:
        """Put a drive command. ``company``: this motor owner's other commands in the same group."""
        with self._lock:
            was_empty = self._empty
            sender = run_of(drive)
            if drive.key and sender == PERSON and self._control.holds(drive):
                sender = _HOLDER
            waiting = self._drives.pop(sender, None)
            if len(self._drives) >= _SENDERS:
                # The oldest run of a script gives way: persons never do.
                del self._drives[next(key for key in self._drives if key not in (PERSON, _HOLDER))]
                self.dropped += 1
            newest = ReceivedDrive(drive, now, company)
            self._drives[sender] = [newest] if waiting is None else _replaced(waiting, newest)
            return was_empty

    def take(self) -> Batch:
        """Remove and return all waiting messages."""
        with self._lock:
            drives = list(chain.from_iterable(self._drives.values()))
            requests, turns = list(self._requests.values()), list(self._turns.items())
            batch = Batch(self._stops, self._resets, requests, turns, self._lost, drives, self._vouched)
            self._stops, self._resets, self._requests, self._turns, self._drives = [], [], {}, {}, {}
            self._lost, self._vouched = False, None
            return batch

    @property
    def _empty(self) -> bool:
        return not (
            self._drives or self._stops or self._resets or self._requests or self._turns or self._vouched is not None
        )

    def _drop(self, waiting: list[p.EstopCommand] | list[ReceivedReset]) -> None:
        del waiting[0]
        self.dropped += 1


def run_of(drive: p.Drive) -> int:
    """Return the run of a script's drive command, or UNKNOWN_RUN; PERSON for a person's command."""
    if drive.source != p.SCRIPT:
        return PERSON
    return drive.run if isinstance(drive.run, int) else UNKNOWN_RUN


def _replaced(waiting: list[ReceivedDrive], newest: ReceivedDrive) -> list[ReceivedDrive]:
    """Return the commands that wait when ``newest`` has come: at most a zero and a command after it.

    Two zeros become one zero with the later time, final if either of them is final. A final zero (``valid_ms`` 0) ends
    scripts, which another zero only lets wait.
    """
    zeros = [received for received in waiting if not received.drive.moves]
    if newest.drive.moves or not zeros:
        return [*zeros, newest]
    final = next((received for received in zeros if received.drive.valid_ms == 0), None)
    if final is None:
        return [newest]
    return [ReceivedDrive(final.drive, newest.at, newest.company)]
