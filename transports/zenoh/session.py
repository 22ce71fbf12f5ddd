"""Configures, opens and closes the Zenoh sessions of a robot, both the hub's and its peers'.

Zenoh's defaults are not used: they listen on all interfaces and join multicast groups.
"""

import json
import os
import signal
import socket
import threading
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Protocol

import zenoh

from pebble.errors import TransportError
from pebble.transports.settings import TlsSettings, ZenohSettings
from pebble.transports.zenoh import callbacks, wire

# By default connections are accepted, opened and read on separate runtimes: a received message wakes a thread that only
# wakes another one (1.15 times the time one way at 20 Hz). Sending has its own runtime, because a callback may send.
# There are more threads than connections, so that one is left to wait for the sockets when all others are in callbacks
# that wait (.callbacks); each takes 15 KB.
_RUNTIME = "(acc: (handover: rx), net: (handover: rx), rx: (worker_threads: 16))"

HUB_SOCKET = "hub.sock"

_SIGNALS = signal.valid_signals()

BLOCK_MS = 300  # a publish waits this long for a receiver that accepts nothing; then its connection is closed
_CONNECT_TIMEOUT_MS = 2000
# Zenoh accepts this only as a whole.
_RETRY = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
_TLS_SCHEMES = ("tls/", "quic/")
_SAFE_SCHEMES = (*_TLS_SCHEMES, "unixsock-stream/")
_LOOPBACK = ("tcp/127.0.0.1:", "tcp/localhost:", "tcp/[::1]:")

# Of Zenoh's access_control: all kinds of messages, the connections of this machine, and the protocols of others.
ALL_MESSAGES: Final = (
    *("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)
LOCAL: Final[Mapping[str, Any]] = {"id": "this machine", "link_protocols": ["unixsock-stream", "tcp"]}
OTHER_MACHINES: Final = ["tls", "quic"]


class _Closable(Protocol):
    def close(self) -> None: ...


def unix_endpoint(path: Path) -> str:
    return f"unixsock-stream/{path}"


def _numbered(endpoint: str) -> str:
    """Return an endpoint, as tls/[fe80::1%eth0]:7447, with the number of the card, whose name Zenoh does not accept."""
    start, percent, rest = endpoint.partition("%")
    name, bracket, port = rest.partition("]")
    try:
        return f"{start}%{socket.if_nametoindex(name)}]{port}" if percent and bracket else endpoint
    except OSError:  # it is a number already, or there is no such card, which Zenoh then reports
        return endpoint


def session_config(
    settings: ZenohSettings, mode: str, *, listen: list[Path], connect: list[Path], rules: Mapping[str, Any] = {}
) -> str:
    """Return the configuration of a ``mode`` (router, peer or client), on unix sockets and the settings' endpoints.

    ``rules``: what a hub permits to each certificate, in place of ``settings.allowed_names``. Raises TransportError for
    endpoints or certificates that can never work.
    """
    for name, endpoints in (("listen", settings.listen), ("connect", settings.connect)):
        for endpoint in endpoints:
            _check_endpoint(name, endpoint, settings.tls)
    rules = rules or _access_control(settings.allowed_names)
    config = json.dumps(_config(settings, mode, listen, connect) | {**rules})
    try:
        zenoh.Config.from_json5(config)
    except zenoh.ZError as error:
        raise TransportError(f"zenoh refuses its configuration: {error}") from None
    return config


def open_session(config: str) -> zenoh.Session:
    """Open a session. Raises ZError if that fails now, TransportError if this process was forked with a session."""
    _refuse_fork()
    # Zenoh reads it once, at the first session. Set here: a fork replaces the environment in which this was imported.
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    # Zenoh's threads inherit this. A signal that the kernel gave to one of them would not wake the main thread, which
    # runs Python's handlers (measured: 5 of 200 hubs on a busy machine did not end).
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        session = zenoh.open(zenoh.Config.from_json5(config))
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    callbacks.use(session)
    return session


def close_session(session: zenoh.Session) -> None:
    callbacks.forget(session)
    session.close()  # type: ignore[no-untyped-call]


def _config(settings: ZenohSettings, mode: str, listen: list[Path], connect: list[Path]) -> dict[str, Any]:
    return {
        "mode": mode,
        "listen": {"endpoints": [*map(unix_endpoint, listen), *map(_numbered, settings.listen)]},
        "connect": {"endpoints": [*map(unix_endpoint, connect), *map(_numbered, settings.connect)], "retry": _RETRY},
        # delay: how long a router or peer waits for scouting before open() returns, in ms; by default 500.
        # gossip: it would announce our unix sockets to programs connected by TLS: two connected robots of a machine had
        # all their processes connect to each other, without TLS. Each process finds its siblings without it.
        "scouting": {"delay": 1, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": False},  # the order of arrival at the hub decides, never a clock
        "transport": {
            "unicast": {"open_timeout": _CONNECT_TIMEOUT_MS, "accept_timeout": _CONNECT_TIMEOUT_MS},
            "shared_memory": {"enabled": False},  # media has its own sessions
            "link": {
                "tx": {
                    "lease": settings.lease_ms,
                    "queue": {"congestion_control": {"block": {"wait_before_close": BLOCK_MS * 1000}}},
                },
                **_tls(settings.tls),
            },
        },
    }


def _check_endpoint(name: str, endpoint: str, tls: TlsSettings | None) -> None:
    if endpoint.startswith(_LOOPBACK):
        return  # it stays on this machine
    if not endpoint.startswith(_SAFE_SCHEMES):
        raise TransportError(f"transport.{name}: {endpoint} leaves this machine unencrypted: use tls/host:port")
    if not endpoint.startswith(_TLS_SCHEMES):
        return  # a Unix socket
    if tls is None:
        raise TransportError(f"transport.{name}: {endpoint} needs transport.tls")
    if name == "listen" and tls.ca_cert is None:
        raise TransportError(
            f"transport.listen: without transport.tls.ca_cert anybody may connect to {endpoint}: "
            "name the authority that signs the certificates of those who may"
        )


def _tls(tls: TlsSettings | None) -> dict[str, Any]:
    """Return Zenoh's TLS settings: one certificate for both directions. With a CA, the other end needs one, too."""
    if tls is None:
        return {}
    link: dict[str, Any] = {"verify_name_on_connect": not tls.insecure}
    if tls.ca_cert is not None:
        link["root_ca_certificate"] = str(tls.ca_cert)
    if tls.client_cert is not None and tls.client_key is not None:
        certificate = {"certificate": str(tls.client_cert), "private_key": str(tls.client_key)}
        link |= {f"{side}_{what}": path for side in ("listen", "connect") for what, path in certificate.items()}
        link["enable_mtls"] = tls.ca_cert is not None
    return {"tls": link}


def _access_control(names: tuple[str, ...] | None) -> dict[str, Any]:
    """Return rules that permit everything to this machine and to certificates with one of ``names``.

    Zenoh does not refuse the others, but drops all that they send, and sends them nothing.
    """
    if names is None:
        return {}
    everything = {"id": "all", "permission": "allow", "flows": ["ingress", "egress"], "messages": ALL_MESSAGES}
    named = {"id": "named", "link_protocols": OTHER_MACHINES, "cert_common_names": names}
    subjects = [LOCAL, named] if names else [LOCAL]
    control = {
        "enabled": True,
        "default_permission": "deny",
        "rules": [everything | {"key_exprs": wire.ALL_KEYS}],
        "subjects": subjects,
        "policies": [{"rules": ["all"], "subjects": [subject["id"] for subject in subjects]}],
    }
    return {"access_control": control}


# -- forks and exits

_opened_by: int | None = None
_open: weakref.WeakSet[_Closable] = weakref.WeakSet()
_registered = False


def _refuse_fork() -> None:
    """Raise TransportError in a forked child: its session is dead without an error, and another would hang for ever."""
    global _opened_by
    check_process(_opened_by)
    _opened_by = os.getpid()


def check_process(opened_by: int | None) -> None:
    """Raise TransportError if the session was opened by another process, from which this one was forked."""
    if opened_by is not None and opened_by != os.getpid():
        raise TransportError("Zenoh does not survive a fork: start child processes with spawn or subprocess")


def close_at_exit(owner: _Closable) -> None:
    """Close ``owner`` before the interpreter waits for threads: a live callback would block the exit for ever (T17).

    ``atexit`` is too late for that, so this uses what concurrent.futures uses.
    """
    global _registered
    _open.add(owner)
    if not _registered:
        _registered = True
        threading._register_atexit(_close_all, os.getpid())  # type: ignore[attr-defined]


def _close_all(pid: int) -> None:
    if pid != os.getpid():
        return  # a fork has nothing to close, and another thread may have held any lock at that moment
    for owner in list(_open):
        owner.close()
