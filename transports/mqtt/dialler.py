"""Makes connections to a broker, at the present address of its host and in a way that the broker accepts."""

import threading
import time
from dataclasses import replace

from pebble.transports.base import Message
from pebble.transports.counters import Counters
from pebble.transports.credentials import Credentials
from pebble.transports.hosts import SMALL_SEGMENT, Address, AddressRound, HostPort
from pebble.transports.mqtt import client_ids
from pebble.transports.mqtt.bridge_mode import Attempt, BridgeMode, Result
from pebble.transports.mqtt.broker_limits import EVERYTHING, BrokerLimits
from pebble.transports.mqtt.client import Client, Opening
from pebble.transports.mqtt.connection import Connection
from pebble.transports.mqtt.ending import Absent, Lost, Refused, Silent, TlsLate
from pebble.transports.mqtt.incoming import Owner
from pebble.transports.settings import MqttSettings

_ENDING_S = 1.0  # so long a broker that ends may still accept connections, and hang up on them
_LARGE = 1000  # bytes from which a message fills a packet, which some ways lose without a word
_LARGE_LOST = 3  # connections in a row that seem to have lost large packets, and the next ones have small segments
_SOON_S = 3.0  # what a broker retains, and what we do, is sent so soon
_HESITATION_S = 0.5  # a CONNACK that takes longer comes over a very slow connection, or from a suspended broker


class Dialler:
    """A maker of connections. It remembers how attempts at a broker have ended, and chooses the next way by that."""

    def __init__(
        self, client_id: str, settings: MqttSettings, will: Message | None, client_class: type[Client]
    ) -> None:
        # The same at each reconnect: the broker then closes our own half-dead connection at once.
        self._client_id = client_ids.unique(client_id) if settings.client_id is None else settings.client_id
        self._settings, self._will, self._client_class = settings, will, client_class
        self.addresses = AddressRound(HostPort(settings.host, settings.port))
        self.attempt: Connection | None = None  # the newest connection, in any state
        self.stalled = False  # the broker may have been suspended: it forwards old messages first
        self._credentials: Credentials | None = None
        self._address: Address | None = None
        self._bridge_mode, self.limits = BridgeMode(), BrokerLimits()  # of the broker at this address
        self.reported = EVERYTHING  # the limits that were logged
        self._large_lost = 0  # connections in a row that went silent on something large
        self._gone_at = float("-inf")  # when the broker was last known to be gone

    def open(self) -> None:
        """Read the credentials. Raises TransportError."""
        self._credentials = Credentials(self._settings)

    # -- one attempt

    def begin(self) -> None:
        """Begin an attempt. Raises Lost if the name of the broker has no address."""
        self.attempt = None  # none while a name is resolved, which nothing can interrupt
        try:
            address = self.addresses.address()
        except (OSError, ValueError) as error:
            raise Lost(f"{self.addresses.where} cannot be reached: {error}") from None
        if address != self._address:
            self._bridge_mode, self.limits = BridgeMode(), BrokerLimits()
        self._address = address
        self.limits.begin(time.monotonic())

    def connect(self, owner: Owner, counters: Counters, stopping: threading.Event) -> Connection:
        """Return a connection that the broker has accepted. Raises Lost."""
        if self.limits.wants_probe or (self._asks_for_bridge_mode and self._bridge_mode.next_attempt is Attempt.PROBE):
            self._probe(owner, counters, stopping)
        plain = self._asks_for_bridge_mode and self._bridge_mode.next_attempt is Attempt.PLAIN
        as_published = self._settings.as_published and not plain
        connection = self._make(self.limits.limits.fit_will(self._will), owner, counters, as_published=as_published)
        try:
            if connection.connect(stopping) > _HESITATION_S:
                self.stalled = True
        except Lost as lost:
            self._note_result(lost.result if isinstance(lost, Refused) else Result.FAILED)
            raise
        finally:
            if connection.incoming.accepted is None:
                connection.discard()
        self._note_result(Result.ACCEPTED)
        self.addresses.opened(connection.opened_s)
        return connection

    def _make(self, will: Message | None, owner: Owner, counters: Counters, *, as_published: bool) -> Connection:
        assert self._address is not None  # noqa: S101 - `begin` has set it
        assert self._credentials is not None  # noqa: S101 - `open` has set it
        segment = SMALL_SEGMENT if self.loses_large else self._settings.max_segment
        settings = replace(self._settings, password=self._credentials.password(), max_segment=segment)
        self.attempt = Connection(
            Opening(
                self._client_id, settings, self._credentials.context(), will, self._address, self.addresses.patience_s
            ),
            counters,
            owner,
            where=self.addresses.where,
            as_published=as_published,
            limits=self.limits.limits,
            client_class=self._client_class,
        )
        return self.attempt

    @property
    def _asks_for_bridge_mode(self) -> bool:
        """True if bridge mode is to be tried. With MQTT 5 it is not needed."""
        return self._settings.as_published and self._settings.protocol == "3.1.1"

    def _probe(self, owner: Owner, counters: Counters, stopping: threading.Event) -> None:
        """Test whether the broker accepts us without bridge mode; leave our will out, as a failure would publish it."""
        probe = self._make(None, owner, counters, as_published=False)  # None: no will; False: no bridge mode
        try:
            probe.connect(stopping)
            probe.disconnect()
        except Lost:
            self._note_probe(Result.FAILED)
            raise
        finally:
            probe.discard()
        self._note_probe(Result.ACCEPTED)

    # -- how it ended

    @property
    def _is_last_attempt(self) -> bool:
        """True if no further attempt at this broker is needed to learn whether it has bridge mode."""
        return not self._asks_for_bridge_mode or self._bridge_mode.next_attempt is Attempt.BRIDGE

    def _note_result(self, result: Result) -> None:
        """Note how a CONNECT has ended. While bridge mode is undecided, hanging up tells nothing about limits."""
        self._bridge_mode.note(result)
        if self._will is not None and (self._is_last_attempt or result is not Result.HUNG_UP):
            self.limits.note_connect(result, time.monotonic())

    def _note_probe(self, result: Result) -> None:
        """Note how a CONNECT without bridge mode and without a will has ended."""
        if self._bridge_mode.next_attempt is Attempt.PROBE:
            self._bridge_mode.note(result)
        if self._will is not None:  # without one nothing was left out
            self.limits.note_probe(result)

    @property
    def loses_large(self) -> bool:
        """True if the way to the broker seems to lose large packets; connections then use small segments."""
        return self._large_lost >= _LARGE_LOST and not self._settings.max_segment

    def _may_have_lost_large(self, lost: Lost) -> bool:
        """True if the connection may have ended because large packets are lost on the way, in either direction.

        Signs of that are a late TLS, as certificates are large; silence after a large message of ours; and silence soon
        after the broker has accepted us, as its retained messages may be large.
        """
        attempt = self.attempt
        if attempt is None or not isinstance(lost, Silent):  # without silence only the first sign is possible
            return isinstance(lost, TlsLate)
        answered_s = attempt.incoming.answered_s
        return attempt.in_flight.lost_bytes > _LARGE or (answered_s is not None and answered_s < _SOON_S)

    def note_end(self, lost: Lost) -> bool:
        """Note how a connection, or an attempt, has ended; return True if TCP's segments are made small from now on."""
        silent, late = isinstance(lost, Silent), isinstance(lost, TlsLate)
        if silent:
            self.stalled = True
        if late:
            self.addresses.was_slow()
        if self.loses_large or not (silent or late):
            return False  # segments are small already, or this end tells nothing of large packets
        self._large_lost = self._large_lost + 1 if self._may_have_lost_large(lost) else 0
        return self.loses_large

    def is_gone(self, lost: Lost, *, connected: bool, was_ended: bool) -> bool:
        """True if the broker's process seems to have ended. ``was_ended``: the result of the call before this.

        1. A connection was lost (``connected``): True, unless the broker was silent. Then we may have stood still.
        2. Nothing listens there: this decides nothing, so ``was_ended``.
        3. An attempt failed otherwise: False after silence, or if 1 and 2 are `_ENDING_S` ago; else ``was_ended``.
        """
        now, was_silent = time.monotonic(), isinstance(lost, Silent)
        if connected:
            self._gone_at = now
            return not was_silent
        if isinstance(lost, Absent):
            self._gone_at = now
            return was_ended
        return was_ended and not was_silent and now - self._gone_at <= _ENDING_S

    def failed(self, problem: str, held_s: float) -> tuple[str, bool]:
        """Go on to the host's next address, unless this broker is to be asked once more (bridge mode, other limits).

        ``held_s``: how long a connection lasted, or 0. Return the problem in words ("": none yet), and True to log it.
        """
        addresses, asks_again = self.addresses, self.limits.asks_again
        if self._is_last_attempt and not asks_again:  # no other way to ask it is left: this address has failed
            why = problem.removeprefix(f"{addresses.where} ")  # the list of failures names the addresses
            failures = addresses.failed(why, held_s)
            if addresses.several:
                problem = f"broker {addresses.host_port}: {failures}"
        if asks_again and held_s <= 0:  # not logged: it is asked once more, and that shows the problem
            return "", False
        # Of a round through several addresses, only the end is worth a line.
        return problem, held_s > 0 or addresses.is_over or not addresses.several
