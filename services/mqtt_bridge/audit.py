"""The robot's audit: who did what to it, written by a thread of its own, read by those who have the right.

Forwarding never waits for the disk. What cannot be written waits within bounds, and ``outgoing/audit`` tells so.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

import msgspec

from pebble.config import Config
from pebble.contract import AUDIT, AUDIT_LINES, codec
from pebble.contract.payloads import AuditLines, AuditMark, AuditRead, AuditState
from pebble.runtime.addresses import Addresses
from pebble.services.mqtt_bridge.acts import Acts
from pebble.services.mqtt_bridge.chain_files import ChainFiles
from pebble.transports import QoS, Transport
from pebble.version import __version__

log = logging.getLogger(__name__)

_ACTS_BYTES, _REFUSED_BYTES = 2_000_000, 500_000  # of one of two files
_ROUND_S = 1.0  # between two writes, and two answers
_MARK_S = 10.0  # between two publications of the newest lines
_ASKED = 8  # requests that wait to be answered
LINES_BYTES, THIN_LINES_BYTES = 16_000, 2_000  # of one answer: 2 s of 9.6 kbit/s, in which heartbeats wait behind it
_END_S = 2.0  # longest wait for the last write


def chain_files(config: Config) -> dict[str, ChainFiles]:
    """The two chains of a robot, by name."""
    return {
        name: ChainFiles(config.state_file(f"audit-{name}").with_suffix(".jsonl"), most, synced=name == "acts")
        for name, most in (("acts", _ACTS_BYTES), ("refused", _REFUSED_BYTES))
    }


class Audit(Acts):
    """What :class:`Acts` finds is written once a second; ``remote`` gets the newest marks, and what is asked for."""

    def __init__(self, config: Config, remote: Transport, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(config.base, config.motor_owners, clock, time.time)
        self._remote, self._addresses = remote, Addresses(config)
        self._level = config.security.level
        self._lines_bytes = LINES_BYTES if config.services.mqtt_bridge.link.slowest == "wide" else THIN_LINES_BYTES
        self._chains = {
            name: (files, self.acts if name == "acts" else self.refused) for name, files in chain_files(config).items()
        }
        self._asked: deque[AuditRead] = deque(maxlen=_ASKED)
        self._published, self._publish_at = b"", float("-inf")
        self._saved = True
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)

    def start(self) -> None:
        self.note("start", level=self._level, version=__version__)
        self._thread.start()

    def close(self) -> None:
        """Write what waits, for a bounded time."""
        self._closing.set()
        self._thread.join(_END_S)

    def ask(self, request: AuditRead) -> None:
        """Publish these lines soon: one answer a second."""
        self._asked.append(request)

    # -- the thread

    def _run(self) -> None:
        ends = False
        while not ends:
            ends = self._closing.wait(_ROUND_S)
            try:
                self._do_round(ends=ends)
            except Exception:  # else nothing would be written from now on, and nothing would show it
                if self._saved:
                    log.exception("the audit cannot be written")
                self._saved = False
                self._publish()

    def _do_round(self, *, ends: bool) -> None:
        self.follow_states()
        self._write(all_of_them=ends)
        self._publish()
        if self._asked and not ends:
            self._answer(self._asked.popleft())

    def _write(self, *, all_of_them: bool) -> None:
        problem: OSError | None = None
        for files, waiting in self._chains.values():
            with self.lock:
                rows = waiting.take(self._clock(), all_of_them=all_of_them)
            if not rows:
                continue
            try:
                files.append(rows)
            except OSError as error:
                problem = error
                with self.lock:
                    waiting.give_back(rows, self._clock())
            else:
                with self.lock:
                    waiting.written()
        if problem is not None and self._saved:
            log.error("the audit cannot be written, it waits: %s: %s", problem.filename or "disk", problem.strerror)
        elif problem is None and not self._saved:
            log.warning("the audit is written again")
        self._saved = problem is None

    def _publish(self) -> None:
        now = self._clock()
        if now < self._publish_at:
            return
        marks = {name: AuditMark(n=files.mark.n, h=files.mark.h) for name, (files, _) in self._chains.items()}
        payload = codec.encode(AUDIT, AuditState(**marks, saved=self._saved))
        if payload != self._published:
            self._publish_at, self._published = now + _MARK_S, payload
            address = self._addresses[AUDIT]
            self._remote.publish(address.topic, payload, qos=QoS(address.qos), retain=address.retain)

    def _answer(self, request: AuditRead) -> None:
        files, _ = self._chains[request.chain]
        try:
            lines = [raw.decode(errors="replace") for raw in files.newest(request.before, request.count)]
        except OSError as error:
            log.warning("the audit cannot be read: %s", error.strerror)
            return
        size = 0
        for number, one in enumerate(reversed(lines)):  # the newest ones that fit
            size += len(msgspec.json.encode(one)) + 1
            if size > self._lines_bytes:
                lines = lines[len(lines) - number :]
                break
        address = self._addresses[AUDIT_LINES]
        payload = codec.encode(AUDIT_LINES, AuditLines(chain=request.chain, before=request.before, lines=lines))
        self._remote.publish(address.topic, payload, qos=QoS(address.qos), retain=address.retain)
