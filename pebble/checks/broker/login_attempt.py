"""One login at a broker, without a client library: latency, the broker's answer, its certificate."""

import socket
import ssl
import time
from dataclasses import dataclass, replace

from pebble.errors import TransportError
from pebble.transports.hosts import Address, addresses_of, described, dial
from pebble.transports.mqtt import client_ids, packets
from pebble.transports.settings import MqttSettings
from pebble.transports.tls import make_context

TIMEOUT_S = 3.0  # of each of its steps
_KEEPALIVE_S = 10
_CONNACK = 0x20
REFUSED_ID = 2
#: Return codes of CONNACK (MQTT 3.1.1, table 3.1) that concern the login.
REFUSED_LOGINS = {4: "user name or password is wrong", 5: "not authorised"}


@dataclass(frozen=True, slots=True, kw_only=True)
class LoginAttempt:
    """The result of one login. ``code`` is CONNACK's (0: accepted), None without one; ``problem`` is the reason.

    With a code, ``problem`` names the addresses of the host that were tried before and failed.
    """

    code: int | None = None
    connect_ms: float = 0.0  # TCP alone
    problem: str = ""
    expires: float | None = None  # the broker's certificate, in epoch seconds


def attempt(settings: MqttSettings, *, login: bool, timeout_s: float = TIMEOUT_S) -> LoginAttempt:
    """Connect and disconnect, with the settings' user and password or (``login=False``) anonymously.

    Where the host has several addresses, the first one counts that accepts the login, else the last one that answers.
    """
    try:
        addresses = addresses_of(settings.host, settings.port)
    except UnicodeError:  # a label that is too long as it travels
        return LoginAttempt(problem=f"{settings.host} is no name of a host")
    except OSError as error:
        return LoginAttempt(problem=error.strerror or str(error))
    answered, failures = LoginAttempt(), {}
    for address in addresses:
        tried = _attempt(settings, address, login=login, timeout_s=timeout_s)
        if tried.code is None:
            failures[f"{address.text}:"] = tried.problem
        else:
            answered = tried
        if tried.code == 0 or len(addresses) == 1:
            break
    return tried if len(addresses) == 1 else replace(answered, problem=described(failures))


def _attempt(settings: MqttSettings, address: Address, *, login: bool, timeout_s: float) -> LoginAttempt:
    before = time.monotonic()
    try:
        with dial(address, timeout_s) as plain:
            connect_ms = (time.monotonic() - before) * 1000
            if settings.tls is None:
                return LoginAttempt(code=_log_in(plain, settings, login), connect_ms=connect_ms)
            with make_context(settings.tls).wrap_socket(plain, server_hostname=settings.host) as encrypted:
                code, expires = _log_in(encrypted, settings, login), _expiry(encrypted)
                return LoginAttempt(code=code, connect_ms=connect_ms, expires=expires)
    except TransportError as error:
        return LoginAttempt(problem=str(error))
    except OSError as error:  # TLS failures are some of these
        return LoginAttempt(problem=getattr(error, "reason", None) or error.strerror or str(error))


def _log_in(connection: socket.socket, settings: MqttSettings, login: bool) -> int:
    connection.sendall(connect_packet(settings, login=login))
    answer = b""
    while len(answer) < 4:
        part = connection.recv(4 - len(answer))
        if not part:
            raise ConnectionError("it closed the connection: is this an MQTT broker?")
        answer += part
    if answer[0] != _CONNACK:
        raise ConnectionError("it does not speak MQTT")
    connection.sendall(packets.DISCONNECT)
    return answer[3]


def connect_packet(settings: MqttSettings, *, login: bool) -> bytes:
    """A CONNECT of MQTT 3.1.1 with a clean session and no will."""
    client_id = settings.client_id or client_ids.unique("pebble-doctor")
    username, password = (settings.username, settings.password) if login else (None, None)
    return packets.connect(
        client_id, modern=False, bridge=False, keepalive_s=_KEEPALIVE_S, will=None, username=username, password=password
    )


def _expiry(connection: ssl.SSLSocket) -> float | None:
    certificate = connection.getpeercert()
    until = certificate.get("notAfter") if certificate else None
    return ssl.cert_time_to_seconds(until) if isinstance(until, str) else None
