"""Every address of every host gets its turn, whatever way the one before failed."""

import socket
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

CONNECT_TIMEOUT_S = 2.0  # for each of TCP and TLS, and again for the broker's CONNACK (T12)
HANDSHAKE_S = 10.0  # for TLS while bytes arrive, and where it took long: at 9.6 kbit/s two certificates of RSA take 3 s
STEADY_S = 30.0  # an address that held a connection for so long is tried once more before the others
_LONGEST = 8  # addresses whose failures are described one by one


class Place(NamedTuple):
    """A host as it is named in a config, and its port."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class Address(NamedTuple):
    """Where a socket connects to, as `socket.getaddrinfo` returns it."""

    family: int
    place: tuple[Any, ...]

    @property
    def text(self) -> str:
        return str(self.place[0])


def addresses_of(host: str, port: int) -> list[Address]:
    """All addresses of ``host``, each once. Raises OSError; ValueError for a host that cannot be a name."""
    name = host.encode() if host.isascii() else host  # for text Python loads what only other names need, 0.3 MB
    found = socket.getaddrinfo(name, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(Address(family, place) for family, _type, _protocol, _name, place in found))


def dial(address: Address, timeout: float | None = None, *, max_segment: int = 0) -> socket.socket:
    """A TCP connection; the same ``timeout`` goes on for what follows, TLS. Raises OSError.

    ``max_segment``: bytes of one segment; 0: the system's.
    """
    sock = socket.socket(address.family, socket.SOCK_STREAM)
    try:
        sock.settimeout(CONNECT_TIMEOUT_S if timeout is None else timeout)
        if max_segment:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, max_segment)
        sock.connect(address.place)
    except BaseException:
        sock.close()
        raise
    return sock


def described(failures: dict[str, str]) -> str:
    """One line of bounded length that names addresses and why each failed."""
    some = [f"{address} {why}" for address, why in list(failures.items())[:_LONGEST]]
    more = len(failures) - len(some)
    return "; ".join(some) + (f"; and {more} more" if more else "")


class Turns:
    """Whose turn it is among the addresses of all hosts. Each host is resolved anew in each round, when it is due.

    A round ends when each address has failed once; only then there is a pause. ``places`` is asked when one begins.
    """

    def __init__(
        self, places: Callable[[], Sequence[Place]], resolve: Callable[[str, int], list[Address]] = addresses_of
    ) -> None:
        self._places, self._resolve = places, resolve
        self.place = places()[0]  # whose turn it is
        self._due: list[Place] = []  # of this round: hosts that are not resolved yet,
        self._left: list[Address] = []  # and addresses of the newest one; the first one has its turn
        self.has_hosts = self._has_addresses = False  # several of them in this round, and of this host
        self._steady: tuple[Place, Address] | None = None  # has lost a connection that held for long: begins the next
        self._is_first = True  # round
        self._failures: dict[str, str] = {}  # why each address failed last, without a success since
        self._slow: set[Address] = set()  # where TLS took long, or was not there in time

    def address(self) -> Address:
        """The address whose turn it is; may wait for a resolver. Raises OSError, ValueError."""
        if self.is_over:
            places, steady = self._places(), self._steady and self._steady[0]
            self._due = sorted(places, key=lambda one: one != steady)
            self.has_hosts = len(places) > 1
            names = {str(one) for one in places}
            if self.has_hosts:
                self._failures = {one: why for one, why in self._failures.items() if one.split(" ")[0] in names}
        while not self._left:
            self.place = self._due.pop(0)
            try:
                self._begin_host()
            except (OSError, ValueError) as error:
                if not self._due:
                    raise
                self._note(str(self.place), f"cannot be reached: {error}")
        return self._left[0]

    def _begin_host(self) -> None:
        self._has_addresses = False
        found = self._resolve(*self.place)
        if not found:
            raise OSError("it has no address")
        steady = self._steady[1] if self._steady and self._steady[0] == self.place else None
        self._left = sorted(found, key=lambda one: one != steady)
        self._steady, self._has_addresses = None, len(found) > 1
        if not self.has_hosts:
            self._slow &= set(found)
            self._failures = {one.text: self._failures[one.text] for one in found if one.text in self._failures}

    @property
    def several(self) -> bool:
        """Whether another address has its turn after a failure, without a pause."""
        return self.has_hosts or self._has_addresses

    @property
    def where(self) -> str:
        """The broker whose turn it is, in words; with its address if the host has several."""
        return f"broker {self.place}" + (f" at {self._left[0].text}" if self._has_addresses and self._left else "")

    @property
    def untried(self) -> bool:
        """Whether one of several addresses has not had its first turn yet."""
        return self._is_first and self.several

    @property
    def patience_s(self) -> float:
        """TLS may be silent for so long at the address whose turn it is."""
        return HANDSHAKE_S if self._left and self._left[0] in self._slow else CONNECT_TIMEOUT_S

    def opened(self, seconds: float) -> None:
        """TCP and TLS took so long there; an address that has not answered in time was not slow, then, but dead."""
        self._slow = {self._left[0]} if seconds > CONNECT_TIMEOUT_S else set()

    def was_slow(self) -> None:
        """TLS was silent for too long: the next time it gets longer."""
        self._slow.add(self._left[0])

    def succeeded(self) -> str:
        """The address has a connection; returns which ones failed before it, and how."""
        failed, self._failures, self._is_first = described(self._failures), {}, False
        return failed

    def failed(self, why: str, held_s: float = 0.0) -> str:
        """The connection at the address was not made, or is lost after ``held_s``.

        Returns how each address failed. The next one has its turn; `is_over` says whether that begins a new round.
        """
        if not self._left:  # the name was not resolved
            if not self.has_hosts:
                return why
            self._note(str(self.place), why)
            self._is_first = False
            return described(self._failures)
        address = self._left.pop(0)
        text = address.text if self._has_addresses or not self.has_hosts else ""
        self._note(f"{self.place} {text}".rstrip() if self.has_hosts else text, why)
        if held_s >= STEADY_S:
            self._steady = self.place, address
            self.begin_anew()
        self._is_first &= not self.is_over
        return described(self._failures)

    def _note(self, name: str, why: str) -> None:
        self._failures.pop(name, None)
        self._failures[name] = why

    def begin_anew(self) -> None:
        """The next turn begins a new round."""
        self._due, self._left = [], []

    @property
    def is_over(self) -> bool:
        return not self._left and not self._due
