"""The wheels of a robot for its script: commands on the local transport, and whether they have an effect."""

import logging
import threading
import time
from collections.abc import Callable

from pebble.contract import CAPABILITIES, DRIVE, ESTOP_STATE, codec
from pebble.contract.payloads import Drive
from pebble.errors import PayloadError
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.scripts.runs import newest
from pebble.extensions.scripts.script.drive_sender import ENDED, DriveSender
from pebble.runtime.addresses import Addresses
from pebble.transports import Message, QoS, Transport

_STUCK_S = 0.3  # the final zero waits no longer than this for a publish that hangs
_WAITING = 100  # drive commands of others

log = logging.getLogger(__name__)


class Wheels:
    """The wheels of a robot, for one run of a script. Any thread may call every method.

    ``number(least)`` returns the run's number, which is above ``least``. ``on_ended(why)`` is called once, from another
    thread, when this run can never drive again.
    """

    def __init__(
        self,
        transport: Transport,
        addresses: Addresses,
        number: Callable[[int], int],
        on_ended: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.estop = RobotEstop(addresses.base)
        self._transport, self._address, self._clock, self._on_ended = transport, addresses[DRIVE], clock, on_ended
        self._lock = threading.Lock()  # guards the sender
        self._changed = threading.Event()  # the thread has something to do
        self._thread: threading.Thread | None = None
        self._over = False  # the script has ended
        self._robot = addresses.base.rpartition("/")[2]
        self._reported: str | None = None  # why commands had no effect, as logged last; None: nothing was
        # First the states of motor owners: the run's number is above those that they bar (`_barred`). direct: what is
        # retained has arrived when subscribe returns.
        for channel in (ESTOP_STATE, CAPABILITIES):
            transport.subscribe(channel.filter(addresses.base), self._receive_owner, direct=True)
        self._sender = DriveSender(number(self._barred), self._publish)
        transport.subscribe(self._address.topic, self._receive_drive, limit=_WAITING)

    @property
    def run(self) -> int:
        return self._sender.run

    def drive(self, wanted: Drive) -> bool:
        """Publish a drive command; return False if it has no effect, as far as is known."""
        with self._lock:
            now = self._clock()
            self._sender.owners(self.estop.states, now)
            obeyed = self._sender.drive(wanted, now)
            self._start_thread()
            if self._sender.due is not None:
                self._changed.set()
            refusal = self._sender.refusal(now) or ("" if obeyed else "there is no connection")
        self._report(refusal)
        return obeyed

    def drive_another(self) -> str:
        """Return why no command for another robot may be sent now; empty if one may. Call this before each."""
        with self._lock:
            now = self._clock()
            self._sender.owners(self.estop.states, now)
            self._start_thread()
            return self._sender.drive_another(now)

    @property
    def overridden(self) -> bool:
        """True if a person has driven within the last 2 s."""
        return self._sender.overridden(self._clock())

    def refusal(self) -> str:
        """Return why a command has no effect now, as far as is known; empty if it has one."""
        with self._lock:
            return self._sender.refusal(self._clock())

    def end(self, why: str) -> None:
        """Publish the final zero, and nothing after it."""
        self._over = True
        locked = self._lock.acquire(timeout=_STUCK_S)  # False: a publish hangs, and the final zero does without
        try:
            self._sender.end(why, self._clock())
        finally:
            if locked:
                self._lock.release()
        self._changed.set()

    def _start_thread(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run_thread, name="pebble-drive", daemon=True)
            self._thread.start()

    def _report(self, refusal: str) -> None:
        """Log when commands begin to have an effect, and when they no longer have one."""
        before, self._reported = self._reported, refusal
        if refusal in (before, ENDED):  # no news; or the run has ended: `on_ended` gets the reason soon
            return
        if refusal:
            log.warning("%s does not obey this script: %s", self._robot, refusal)
        else:
            log.info("run %d drives %s%s", self.run, self._robot, "" if before is None else " again")

    @property
    def _barred(self) -> int:
        """Return the newest run that an owner has barred."""
        return newest(state.last_barred for state in self.estop.states.values())

    def _run_thread(self) -> None:
        """Publish the command that waits for its turn, and notice the end of the run, while the script is busy."""
        while not self._over:
            with self._lock:
                now = self._clock()
                self._sender.owners(self.estop.states, now)
                self._sender.tick(now)
                why, due = self._sender.ended(now), self._sender.due
            if why:
                if not self._over:
                    self._on_ended(why)
                return
            self._changed.wait(None if due is None else max(0.0, due - now))
            self._changed.clear()

    def _publish(self, command: Drive) -> bool:
        raw = codec.encode(DRIVE, command)
        return self._transport.publish(self._address.topic, raw, qos=QoS(self._address.qos), urgent=True)

    # -- the transport's threads

    def _receive_owner(self, message: Message) -> None:
        if self.estop.receive(message):
            self._changed.set()

    def _receive_drive(self, message: Message) -> None:
        if message.retain:
            return  # a stale one: no motor owner obeys it either
        try:
            drive = codec.decode(DRIVE, message.payload)
        except PayloadError as error:
            log.debug("%s", error)
            return
        with self._lock:
            self._sender.receive(drive, self._clock())
        self._changed.set()
