"""A small MQTT client that waits for each answer: it changes a broker's rules, and tries what they allow.

The transports publish nothing below `$`, and go on where a broker refuses; here a refusal is the result.
"""

import secrets
import socket
import ssl
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

from pebble.errors import TransportError
from pebble.fleet.folder import FleetError
from pebble.transports.base import Message
from pebble.transports.hosts import Address, addresses_of, dial
from pebble.transports.mqtt import packets
from pebble.transports.settings import TlsSettings
from pebble.transports.tls import make_context

_KEEPALIVE_S = 60
_TIMEOUT_S = 3.0
_WINDOW = 64  # messages that the broker has not acknowledged
_REFUSED = {4, 5}  # codes of CONNACK: wrong password, not authorised


class RefusedError(FleetError):
    """The broker does not let this account in."""


class UnreachableError(FleetError):
    """Nothing answers at this address."""


class Place(NamedTuple):
    """A broker to connect to. ``ca`` None: not encrypted."""

    host: str
    port: int
    ca: Path | None

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class BrokerClient(packets.Listener, packets.Quota):
    """One connection, open from its construction until its ``with`` block ends. Its methods raise FleetError.

    Without ``username`` it is anonymous.
    """

    def __init__(
        self,
        place: Place,
        username: str | None = None,
        password: str | None = None,
        *,
        will: Message | None = None,
        timeout_s: float = _TIMEOUT_S,
    ) -> None:
        self.received: list[tuple[str, bytes]] = []
        self.closed = False  # by the broker
        self._place, self._timeout_s = place, timeout_s
        self._reader = packets.Reader(self, self, modern=False)
        self._code: int | None = None
        self._answers: dict[int, bytes] = {}
        self._unacknowledged: set[int] = set()
        self._mid = 0
        self._socket = self._connected()
        hello = packets.connect(
            f"pebble-fleet-{secrets.token_hex(8)}",
            modern=False,
            bridge=False,
            keepalive_s=_KEEPALIVE_S,
            will=will,
            username=username,
            password=password,
        )
        try:
            self._send(hello)
            self.wait(lambda: self._code is not None, "accept a login")
            if self._code:
                raise RefusedError(
                    f"broker {place} refuses {username or 'a client without a name'}"
                    + ("" if self._code in _REFUSED else f" (code {self._code})")
                )
        except BaseException:
            self._socket.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._socket.sendall(packets.DISCONNECT)
        self._socket.close()

    def cut(self) -> None:
        """End without a word, so that the broker publishes the will."""
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def subscribe(self, filters: Iterable[str]) -> bytes:
        """The broker's code for each filter; from 128 on it refuses."""
        mid = self._next()
        self._send(packets.subscribe(mid, [packets.Filter(one, 1) for one in filters], modern=False))
        self.wait(lambda: mid in self._answers, "answer a subscription")
        return self._answers.pop(mid)

    def publish(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        """With QoS 1; :meth:`flush` waits until the broker has it."""
        self.wait(lambda: len(self._unacknowledged) < _WINDOW, "acknowledge messages")
        mid = self._next()
        self._unacknowledged.add(mid)
        self._send(packets.publish(topic, payload, 1, mid, retain=retain, modern=False, expires_s=None))

    def flush(self) -> None:
        self.wait(lambda: not self._unacknowledged, "acknowledge messages")

    def wait(self, condition: Callable[[], bool], what: str, timeout_s: float | None = None) -> None:
        """Read until ``condition``. Raises FleetError in time, and when the broker closes the connection."""
        deadline = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        while not condition():
            left = deadline - time.monotonic()
            if left <= 0:
                raise FleetError(f"broker {self._place} did not {what} in time")
            if not self._read(left):
                raise FleetError(f"broker {self._place} closed the connection and did not {what}")

    def listen(self, seconds: float) -> None:
        """Read for so long, or until the broker closes the connection."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0 and self._read(left):
            pass

    # -- inside

    def _connected(self) -> socket.socket:
        place = self._place
        try:
            addresses = addresses_of(place.host, place.port)
        except (OSError, UnicodeError) as error:
            raise UnreachableError(f"broker {place}: {getattr(error, 'strerror', None) or error}") from None
        why: Exception | None = None
        for address in addresses:
            try:
                return self._dialled(address)
            except (ssl.SSLEOFError, ssl.SSLZeroReturnError):
                why = ConnectionError("closes new connections: perhaps it has as many as it takes")
            except ssl.SSLError as error:
                raise FleetError(f"broker {place} is another one: {error.reason or error}") from None
            except OSError as error:
                why = error
        raise UnreachableError(f"broker {place}: {getattr(why, 'strerror', None) or why}")

    def _dialled(self, address: Address) -> socket.socket:
        plain = dial(address, self._timeout_s)
        if self._place.ca is None:
            return plain
        try:
            context = make_context(TlsSettings(ca_cert=self._place.ca))
            return context.wrap_socket(plain, server_hostname=self._place.host)
        except TransportError as error:
            plain.close()
            raise FleetError(str(error)) from None
        except BaseException:
            plain.close()
            raise

    def _next(self) -> int:
        self._mid = self._mid % 0xFFFF + 1
        return self._mid

    def _send(self, data: bytes) -> None:
        try:
            self._socket.settimeout(self._timeout_s)
            self._socket.sendall(data)
        except OSError as error:
            raise FleetError(f"broker {self._place}: {error.strerror or error}") from None

    def _read(self, seconds: float) -> bool:
        """False: the connection is closed."""
        try:
            self._socket.settimeout(max(0.001, seconds))
            data = self._socket.recv(1 << 16)
        except TimeoutError:
            return True
        except OSError:
            data = b""
        if not data:
            self.closed = True
            return False
        self._reader.feed(data)
        try:
            while self._reader.read(1000):
                pass
        except packets.MalformedError as error:
            raise FleetError(f"broker {self._place}: {error}") from None
        if self._reader.acks:
            self._send(bytes(self._reader.acks))
            self._reader.acks.clear()
        return True

    # -- what the reader found

    def on_accepted(self, accepted: packets.Accepted) -> None:  # noqa: ARG002
        self._code = 0

    def on_refused(self, code: int) -> None:
        self._code = code

    def on_publication(self, topic: bytes, payload: bytes, first: int) -> None:  # noqa: ARG002
        self.received.append((topic.decode(errors="replace"), payload))

    def on_puback(self, mid: int, code: int) -> None:  # noqa: ARG002
        self._unacknowledged.discard(mid)

    def on_answer(self, mid: int, codes: bytes) -> None:
        self._answers[mid] = codes

    def on_pong(self) -> None:
        pass

    def on_disconnect(self, code: int) -> None:
        pass

    def on_too_long(self, topic: bytes, length: int) -> None:
        pass

    def skips(self, topic: bytes) -> bool:  # noqa: ARG002
        return False

    def begin(self, most: int) -> None:
        pass

    def acknowledged(self) -> None:
        pass
