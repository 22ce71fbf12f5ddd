"""The hub: the process of a Zenoh robot that connects the others and stores retained messages and wills.

It stores the newest message of every retained topic, and the wills of running clients. Live messages between the
robot's processes do not pass through it. `pebble.runtime.hub` runs one.
"""

from __future__ import annotations

import errno
import logging
import socket
from dataclasses import replace
from typing import Any

import zenoh

from pebble.errors import TransportError
from pebble.transports.counters import Counters
from pebble.transports.peers import FileLock, PeerRegistry, new_name, prepare_run_dir
from pebble.transports.renewed import Renewed
from pebble.transports.settings import ZenohSettings
from pebble.transports.socket_holders import why_not
from pebble.transports.zenoh.hub.admission import Admission
from pebble.transports.zenoh.hub.store import HubStore
from pebble.transports.zenoh.hub.worker import HubWorker
from pebble.transports.zenoh.presence import Barrier
from pebble.transports.zenoh.session import HUB_SOCKET, close_at_exit, close_session, open_session, session_config

log = logging.getLogger(__name__)


class ZenohHub:
    """A hub with its Zenoh session and its worker thread."""

    def __init__(self, settings: ZenohSettings, admission: Admission | None = None) -> None:
        self.name = new_name()
        self.counters = Counters()
        self._settings = settings
        self._socket = settings.run_dir / HUB_SOCKET
        self._lock: FileLock | None = None
        self._session: zenoh.Session | None = None
        self._worker: HubWorker | None = None
        self.store: HubStore | None = None
        self._admission = admission or Admission(settings.wills, settings.unretained)
        self._certificates: Renewed[Any] | None = None
        if settings.tls is not None:
            from pebble.transports.credentials import renewed_context  # ssl, which few hubs need

            self._certificates = renewed_context(settings.tls)
        self._used = self._newest  # certificates and rules of the session; before it opens, those in the files

    @property
    def refused_wills(self) -> int:
        return self._admission.refused

    @property
    def refused(self) -> int:
        """The number of retained messages and wills for which there was no room."""
        return 0 if self.store is None else self.store.refused

    def open(self) -> ZenohHub:
        """Start the hub. Raises TransportError if the run directory has a hub already, or cannot be used."""
        self._lock = self._take_lock()
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        close_at_exit(self)
        return self

    def look(self) -> None:
        """Open the session again, with all stored records, if a certificate or rule has changed. Call this often.

        Zenoh reads certificates and rules when a session begins. Raises TransportError if it cannot listen again, or if
        its files were removed: this hub then ends, and its launcher starts another one.
        """
        if self._lock is None or self._worker is None:
            return
        if not self._lock.in_place:
            raise TransportError(f"{self._lock.path} was removed: this hub ends, as what starts now does not reach it")
        newest = self._newest
        if all(new is old for new, old in zip(newest, self._used, strict=True)):
            return
        self._used = newest
        if self._session is not None:
            close_session(self._session)
        self._listen(self._worker)
        log.info("the hub uses renewed certificates or rules")

    @property
    def _newest(self) -> tuple[object, object]:
        """The certificates and rules that are now in the files."""
        return None if self._certificates is None else self._certificates.get(), self._admission.newest()

    def close(self) -> None:
        if self._session is not None:
            close_session(self._session)  # no new event from here on
        if self._worker is not None:
            self._worker.close()
        if self._lock is not None:
            if self._lock.in_place:  # else they may be another hub's
                for name in (HUB_SOCKET, HUB_SOCKET + ".lock"):
                    (self._settings.run_dir / name).unlink(missing_ok=True)
            self._lock.release()
        self._session = self._worker = self._lock = None

    def _take_lock(self) -> FileLock:
        run_dir = self._settings.run_dir
        prepare_run_dir(run_dir)
        lock = FileLock.take(run_dir / "hub.lock")
        if lock is None:
            raise TransportError(f"there is a hub for {run_dir} already (it holds {run_dir / 'hub.lock'})")
        return lock

    def _start(self) -> None:
        journal = None
        if self._settings.journal is not None:
            from pebble.transports.zenoh.hub.journal import Journal  # sqlite3, 2.5 MB

            journal = Journal(self._settings.journal)
        self.store = store = HubStore(self._settings.max_wills)
        self._worker = HubWorker(self.name, store, self._admission, journal, self.counters)
        self._listen(self._worker)

    def _listen(self, worker: HubWorker) -> None:
        self._session = None
        siblings = PeerRegistry(self._settings.run_dir).sockets()  # to connect to them: their next try may take 0.5 s
        try:
            settings = replace(self._settings, listen=tuple(filter(self._is_free, self._settings.listen)))
            rules = self._admission.rules()
            config = session_config(settings, "router", listen=[self._socket], connect=siblings, rules=rules)
            self._session = open_session(config)
        except zenoh.ZError as error:
            raise TransportError(f"the hub cannot open {self._socket}: {error}") from None
        Barrier(self._session, self.name, lambda: 0)  # the session keeps it: it answers clients that wait for this hub
        worker.serve(self._session)

    def _is_free(self, endpoint: str) -> bool:
        """True unless another process uses the endpoint; then a hub that is no robot's raises TransportError.

        A robot's hub logs it and runs without the endpoint, because any user can take a port.
        """
        kind = socket.SOCK_DGRAM if endpoint.startswith("quic/") else socket.SOCK_STREAM
        place = endpoint.partition("/")[2].partition("#")[0].partition("?")[0]  # without protocol and options
        host, _, port = place.rpartition(":")
        try:
            family, *_, address = socket.getaddrinfo(host.strip("[]"), int(port), type=kind)[0]
            with socket.socket(family, kind) as tried:  # TCP: a port that only ended connections hold is free
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, kind == socket.SOCK_STREAM)
                tried.bind(address)
        except (ValueError, OSError) as error:
            if not (isinstance(error, OSError) and error.errno == errno.EADDRINUSE):
                return True  # Zenoh says what is wrong with it
            fact = f"transport.listen: {endpoint}: {why_not(error, int(port))}"
            if not self._settings.of_robot:
                raise TransportError(f"{fact}; end it, or name another port") from None
            log.error("%s; the robot runs without it: end that process and start the robot again", fact)
            return False
        return True
