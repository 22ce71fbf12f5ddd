"""The addresses of a host. Each is tried in turn, however the one before it has failed."""

import socket
from collections.abc import Callable
from typing import Any, NamedTuple

CONNECT_TIMEOUT_S = 2.0  # for each of TCP and TLS, and again for the broker's CONNACK (T12)
HANDSHAKE_S = 10.0  # for TLS while bytes arrive, and where it took long: at 9.6 kbit/s two certificates of RSA take 3 s
SMALL_SEGMENT = 1200  # bytes of TCP in a packet: with all headers 1280, which every way takes (RFC 8200, section 5)
STEADY_S = 30.0  # an address that held a connection for so long is tried once more before the others
_LONGEST = 8  # addresses whose failures are described one by one


class HostPort(NamedTuple):
    """A host as it is named in a config, and its port."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class Address(NamedTuple):
    """An address for a socket, as `socket.getaddrinfo` returns it."""

    family: int
    place: tuple[Any, ...]

    @property
    def text(self) -> str:
        return str(self.place[0])


def addresses_of(host: str, port: int) -> list[Address]:
    """Return all addresses of ``host``, each once. Raises OSError; ValueError for a host that cannot be a name."""
    name = host.encode() if host.isascii() else host  # for text Python loads what only other names need, 0.3 MB
    infos = socket.getaddrinfo(name, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(Address(family, place) for family, _type, _protocol, _name, place in infos))


def dial(address: Address, *, max_segment: int = 0) -> socket.socket:
    """Return a TCP connection, whose socket keeps its timeout for the TLS handshake. Raises OSError.

    ``max_segment``: bytes of one segment; 0: the system's value.
    """
    sock = socket.socket(address.family, socket.SOCK_STREAM)
    try:
        sock.settimeout(CONNECT_TIMEOUT_S)
        if max_segment:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, max_segment)
        sock.connect(address.place)
    except BaseException:
        sock.close()
        raise
    return sock


def described(failures: dict[str, str]) -> str:
    """Return one line of limited length with the addresses and the reason why each failed."""
    shown_failures = [f"{address} {why}" for address, why in list(failures.items())[:_LONGEST]]
    hidden = len(failures) - len(shown_failures)
    return "; ".join(shown_failures) + (f"; and {hidden} more" if hidden else "")


class AddressRound:
    """A round through the addresses of one host. Each round resolves the host's name again.

    It ends when each address has failed once; only then there is a pause.
    """

    def __init__(self, host_port: HostPort, resolve: Callable[[str, int], list[Address]] = addresses_of) -> None:
        self.host_port, self._resolve = host_port, resolve
        self._left: list[Address] = []  # of this round; it is the turn of the first one
        self.several = False  # the host has several addresses: after a failure the next has its turn without a pause
        self._steady: Address | None = None  # an address that held a connection for long: it begins the next round
        self._is_first = True  # this is the first round
        self._failures: dict[str, str] = {}  # why each address failed last, without a success since
        self._slow: set[Address] = set()  # addresses where TLS took long, or was not there in time

    def address(self) -> Address:
        """Return the address to try now. May wait for a name server. Raises OSError, ValueError."""
        if not self._left:
            addresses = self._resolve(*self.host_port)
            if not addresses:
                raise OSError("it has no address")
            self._left = sorted(addresses, key=lambda address: address != self._steady)  # False is less: it comes first
            self._steady, self.several = None, len(addresses) > 1
            self._slow &= set(addresses)
            texts = {address.text for address in addresses}
            self._failures = {text: why for text, why in self._failures.items() if text in texts}
        return self._left[0]

    @property
    def where(self) -> str:
        """The broker in words, with its present address if the host has several."""
        return f"broker {self.host_port}" + (f" at {self._left[0].text}" if self.several and self._left else "")

    @property
    def untried(self) -> bool:
        """True if the host has several addresses, and this first round has not tried all of them."""
        return self._is_first and self.several

    @property
    def patience_s(self) -> float:
        """Seconds for which the present address may be silent during TLS."""
        return HANDSHAKE_S if self._left and self._left[0] in self._slow else CONNECT_TIMEOUT_S

    def opened(self, seconds: float) -> None:
        """Note how long TCP and TLS took. If that was short, the way is fast: no address counts as slow any more."""
        self._slow = {self._left[0]} if seconds > CONNECT_TIMEOUT_S else set()

    def was_slow(self) -> None:
        """Note that TLS was silent for too long; the next attempt gets more time."""
        self._slow.add(self._left[0])

    def succeeded(self) -> str:
        """Note that the present address is connected; return a text about those that failed before it."""
        failed, self._failures, self._is_first = described(self._failures), {}, False
        return failed

    def failed(self, why: str, held_s: float = 0.0) -> str:
        """Note a connection that was not made, or was lost after ``held_s``; return how each address failed."""
        if not self._left:  # the name was not resolved
            return why
        address = self._left.pop(0)
        self._failures.pop(address.text, None)  # so that the newest failure is the last
        self._failures[address.text] = why
        if held_s >= STEADY_S:
            self._steady, self._left = address, []  # this round is over: the next begins with it
        if self.is_over:
            self._is_first = False
        return described(self._failures)

    @property
    def is_over(self) -> bool:
        """True if the round is over, so that a pause is due."""
        return not self._left
