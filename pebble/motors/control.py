"""Control of a Linux robot's motor owner: it answers requests for control, and publishes who has it."""

import logging
import operator
import secrets
from collections.abc import Callable

from pebble.config import Security
from pebble.contract.payloads import ControlRequest, ControlState, ControlTurn, ControlVouched, Drive
from pebble.motors.paced import Paced
from pebble.motors.shared_lease import lease_of
from pebble.runtime.rate_limit import RateLimitedLog

log = logging.getLogger(__name__)

_TICK_S = 0.25  # while a client has control, or others drive: control that is over ends so late at most
_REPEAT_S = 0.5  # of the turn, where there are several owners
_TURNS_PER_S = 20  # at most: a turn is shown at once, but not each one of a flood
_NO_CLIENT = ("", "", "", "")


class Control:
    """The lease of one motor owner, with a clock in seconds; on the service's thread.

    ``publish(state)`` is called with each new state. Nothing is saved: after a restart no client has control.
    """

    def __init__(
        self,
        security: Security,
        publish: Callable[[ControlState], object],
        now: float,
        owner: str = "",
        owners: tuple[str, ...] = (),
        show_turn: Callable[[], object] = lambda: None,
        bridged: bool = False,
    ) -> None:
        """Store the arguments; ``owners``: all motor owners of the robot.

        ``show_turn()`` must send the result of :meth:`turn` to the other owners. ``bridged``: a client's silence counts
        only in periods for which the bridge vouches (:meth:`vouch`), as it passed on all messages; or after 30 s.
        """
        self.boot = secrets.token_hex(4)  # of this life of the motor owner
        self._named = security.named
        strangers = ("drive", "free", "refuse").index(security.unnamed)  # as the lease numbers these rules
        self.lease = lease_of(owner, owners, self.boot, ms(now), operator.sub, secrets.token_hex, strangers)
        self.lease.vouched = (ms(now), ms(now)) if bridged else None  # begin and end: no time is vouched for yet
        self._turns = Paced(show_turn, _TURNS_PER_S)
        self._turn_due = now if self.peers else None  # when the grant of control, the turn, is sent again; None: never
        self._state = Paced(lambda: publish(self.state()))
        self._log = RateLimitedLog(log, burst=5)
        self._tick_due: float | None = None  # when the lease must be ticked next

    def state(self) -> ControlState:
        _, name, by, device = self.lease.holder or _NO_CLIENT
        _, asks_id, asks, _ = self.lease.asker or _NO_CLIENT
        return ControlState(
            by=by, id=name, key=self.lease.key, device=device, asks=asks, asks_id=asks_id,
            others=self.lease.others, named=self._named, boot=self.boot,
        )  # fmt: skip

    def holds(self, drive: Drive) -> bool:
        """True if the client that has control sent this command. Any thread may ask."""
        return isinstance(drive.key, str) and self.lease.holds(drive.key, self.account(drive) or "")

    def knows(self, request: ControlRequest) -> bool:
        """True if the sender of ``request`` has control, or is the first that asks for it. Any thread may ask."""
        client = self.sender(request)
        return client == self.lease.holder[:2] or client == self.lease.asker[:2]

    def sender(self, request: ControlRequest) -> tuple[str, str]:
        """Return the account and the id that identify a client to the lease. Any thread may ask."""
        return self._client(request)[:2]

    def request(self, request: ControlRequest, over: bool, now: float) -> None:
        """Handle a request for control, or its release; ``over``: take control without asking its holder."""
        client = self._client(request)
        if request.ends():
            self.lease.release(client, ms(now))
        else:
            self.lease.hold(client, int(request.for_ms), over, ms(now))

    def vouch(self, vouched: ControlVouched, now: float) -> None:
        """Note the period in which the bridge has forwarded all messages: a holder's silence counts only within it."""
        self.lease.vouch(vouched.begin, vouched.end, ms(now))

    def doubt(self, now: float) -> None:
        """Note that messages may have been lost in this process: no silence until now counts against the holder."""
        self.lease.doubt(ms(now))

    def account(self, drive: Drive) -> str | None:
        """Return the account of a command, "" where names are not checked; None for a program of the robot."""
        if not self._named:
            return ""
        return drive.by.partition("/")[0] if isinstance(drive.by, str) else None

    def _client(self, request: ControlRequest) -> tuple[str, str, str, str]:
        account = request.by.partition("/")[0] if self._named else ""
        return account, request.id, request.by, request.device

    @property
    def peers(self) -> frozenset[str]:
        """Names of the other motor owners, whose grants of control (turns) this one has to receive."""
        return self.lease.peers

    def receive_turn(self, owner: str, turn: ControlTurn, now: float) -> None:
        """Handle the grant of control that another motor owner has sent. Call :meth:`note` afterwards."""
        self.lease.receive(owner, turn, ms(now))

    def turn(self, barred: int, now: float) -> ControlTurn | None:
        """Return the grant for the other owners, or None; ``barred``: the newest script run that the arbiter bars."""
        return self.lease.shown(barred, ms(now))

    def waits(self, now: float) -> bool:
        """True if nothing may move, because the robot's motor owners may follow different holders of control."""
        return self.lease.waits(ms(now))

    def left_ms(self, now: float) -> int:
        """Return for how long the motors may move without another grant; a longer command must be cut to that."""
        return max(0, self.lease.until - ms(now))

    def note(self, now: float) -> bool:
        """Publish the state if it has changed; return True, once, if control has passed to another client or ended.

        The caller must halt the motors then.
        """
        lease = self.lease
        if lease.changed:
            lease.changed = False
            self._state.changed(now)
            self._turn_due = now if self.peers else None
        if self._tick_due is None and (lease.key or lease.others):  # `tick` ends both when their time is over
            self._tick_due = now + _TICK_S
        halts, lease.halts = lease.halts, False
        if halts:
            _, _, by, device = lease.holder or _NO_CLIENT
            holder = (by or "somebody without a name") + (f" ({device})" if device else "")
            self._log.log("control", logging.INFO, "%s has control", holder if lease.key else "nobody")
        return halts

    @property
    def due(self) -> float | None:
        """Time at which :meth:`tick` must run next; None if nothing is due."""
        return earliest(self._tick_due, self._state.due, self._turn_due, self._turns.due)

    def tick(self, now: float) -> None:
        """End control whose time is over. Call :meth:`note` and :meth:`show_turn` afterwards."""
        if self._tick_due is not None and now >= self._tick_due:
            self._tick_due = None
            self.lease.tick(ms(now))
        self._state.tick(now)
        self._turns.tick(now)

    def show_turn(self, now: float) -> None:
        """Send the grant to the other owners if it has changed (halt the motors before that) or must be repeated."""
        if self._turn_due is not None and now >= self._turn_due:
            self._turn_due = now + _REPEAT_S
            self._turns.changed(now)

    def repeat_state(self, now: float) -> None:
        self._state.changed(now)


def earliest(*times: float | None) -> float | None:
    """Return the earliest of these times; None if all are None."""
    return min((at for at in times if at is not None), default=None)


def ms(seconds: float) -> int:
    """Return a time in milliseconds, in which leases and the arbiter count."""
    return int(1000 * seconds)
