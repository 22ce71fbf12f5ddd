"""A trial login at a broker: the broker's answer, how long it took, and its certificate."""

import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from pebble.errors import TransportError
from pebble.extensions.checks.broker.peer import BrokerTrial
from pebble.transports.hosts import Address, addresses_of, described
from pebble.transports.mqtt import reasons
from pebble.transports.settings import MqttSettings

TIMEOUT_S = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LoginAttempt:
    """The result of a trial login.

    ``code`` is that of CONNACK (0: accepted), or None if none came; ``problem`` is the reason then. With a code,
    ``problem`` names the host's other addresses that were tried before and failed.
    """

    code: int | None = None
    took_ms: float = 0.0
    problem: str = ""
    expires: float | None = None  # the broker's certificate, in epoch seconds
    address: Address | None = None  # that accepted the login

    @property
    def refusal(self) -> str:
        """Return why the login failed; empty if it was accepted."""
        if self.code == 0:
            return ""
        return self.problem if self.code is None else reasons.connection_refused(self.code)

    @property
    def refuses_login(self) -> bool:
        """True if the broker refuses this user and password, or a login without them; False for any other failure."""
        return self.code is not None and reasons.concerns_login(self.code)


def attempt(settings: MqttSettings, *, login: bool, timeout_s: float = TIMEOUT_S) -> LoginAttempt:
    """Connect and disconnect, with the settings' user and password or (``login=False``) anonymously.

    If the host has several addresses, the result is that of the first address that accepts the login, or else of the
    last one that answers.
    """
    if not login:
        settings = replace(settings, username=None, password=None, password_file=None)
    try:
        addresses = addresses_of(settings.host, settings.port)
    except UnicodeError:  # a part of the name is empty, or too long once it is encoded for DNS
        return LoginAttempt(problem=f"{settings.host} is no name of a host")
    except OSError as error:
        return LoginAttempt(problem=error.strerror or str(error))
    answered = LoginAttempt()
    failures: dict[str, str] = {}  # by address and ":", as `described` prints them
    for address in addresses:
        began = time.monotonic()
        try:
            trial = BrokerTrial(settings, address, "", patience_s=timeout_s)
            connected = trial.peer(protocol=settings.protocol)
            expires = _expiry(connected.sock)
        except TransportError as error:
            code = getattr(error, "code", None)
            if code is None:
                failures[f"{address.text}:"] = str(error)
            else:
                answered = LoginAttempt(code=code)
            continue
        answered = LoginAttempt(code=0, took_ms=1000 * (time.monotonic() - began), expires=expires, address=address)
        trial.close()
        break
    if len(addresses) > 1:
        return replace(answered, problem=described(failures))
    return replace(answered, problem="".join(failures.values()))


def _expiry(sock: object) -> float | None:
    certificate = sock.getpeercert() if isinstance(sock, ssl.SSLSocket) else None
    until = certificate.get("notAfter") if certificate else None
    return ssl.cert_time_to_seconds(until) if isinstance(until, str) else None


@contextmanager
def reached(settings: MqttSettings, below: str, restart: Callable[[], bool] | None = None) -> Iterator[BrokerTrial]:
    """Yield a trial at the broker's first address that accepts the login; clean up afterwards.

    Raises TransportError if there is no such address.
    """
    answer = attempt(settings, login=True)
    if answer.address is None:
        raise TransportError(f"broker {settings.host}:{settings.port} cannot be used: {answer.refusal}")
    trial = BrokerTrial(settings, answer.address, below, restart)
    try:
        yield trial
    finally:
        trial.close()
