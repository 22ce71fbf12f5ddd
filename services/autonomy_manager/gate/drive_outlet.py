"""Publishes what the scripts of one run drive: signed, at a limited rate, and stopped when their connection ends."""

import logging
from collections.abc import Callable, Hashable
from typing import NamedTuple

import msgspec

from pebble.contract import DRIVE, codec
from pebble.contract.payloads import SCRIPT
from pebble.errors import PayloadError
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.services.autonomy_manager.gate.client_filter import DriveCommand
from pebble.services.autonomy_manager.gate.pacer import Pacer
from pebble.transports.counters import Counters

Publish = Callable[[str, bytes, bool], object]  # topic and payload of a command, and whether it moves anything
_encode = msgspec.json.Encoder().encode


class SignedCommand(NamedTuple):
    """A drive command as it is published; ``moves`` is False for one whose axes are all 0."""

    payload: bytes
    moves: bool


def sign(payload: bytes, run: int) -> SignedCommand:
    """``payload`` with ``source`` and ``run`` in the object that holds the axes, bare or under ``value``.

    Raises PayloadError for a command that a motor owner would refuse.
    """
    plain = codec.plain(DRIVE, payload)
    if not isinstance(plain, dict):
        raise PayloadError(f"{DRIVE.metric}: an object is needed")
    inner = plain.get("value")
    signature = {"source": SCRIPT, "run": run}
    plain = {**plain, "value": inner | signature} if isinstance(inner, dict) else plain | signature
    try:
        signed = _encode(plain)
    except (ValueError, OverflowError, msgspec.MsgspecError) as error:
        raise PayloadError(f"{DRIVE.metric}: {error}") from None
    return SignedCommand(signed, codec.decode(DRIVE, signed).moves)


def zero(run: int) -> bytes:
    """The command of a script that stops the wheels."""
    return sign(b'{"x":0.0,"z":0.0}', run).payload


class DriveOutlet:
    """All connections of a run share it: what is newest counts for the run, not for a connection. One thread only."""

    def __init__(self, run: int, publish: Publish, counters: Counters) -> None:
        self._run, self._publish, self._counters = run, publish, counters
        self._pacer = Pacer()
        self._halted = False
        self._moving: dict[str, Hashable] = {}  # which connection sent the last command, where that one moves
        self._log = RateLimitedLog(logging.getLogger(__name__))

    @property
    def due(self) -> float | None:
        """When :meth:`publish_due` has something to publish; None if nothing waits."""
        return self._pacer.due

    def receive(self, command: DriveCommand, connection: Hashable, now: float) -> None:
        """Publish a command, now or in its turn; refuse one that is malformed, or stale."""
        try:
            signed = sign(command.payload, self._run)
        except PayloadError as error:
            self._counters.add("refused")
            self._log.warning("refused", "refused a script's message: %s", error)
            return
        if signed.moves and (self._halted or command.repeated):
            self._counters.add("halted" if self._halted else "stale")
            return
        if signed.moves:
            self._moving[command.topic] = connection
        else:
            self._moving.pop(command.topic, None)
        if self._pacer.offer(command.topic, signed.payload, signed.moves, now):
            self._send(command.topic, signed.payload, signed.moves)

    def publish_due(self, now: float) -> None:
        """Publish the commands whose turn it is."""
        while (taken := self._pacer.take(now)) is not None:
            self._send(*taken)

    def halt(self) -> None:
        """From now on publish zeros only."""
        self._halted = True
        self._pacer.discard()

    def ended(self, connection: Hashable, now: float) -> None:
        """Stop what ``connection`` moves: it sends nothing more."""
        for topic in [topic for topic, mover in self._moving.items() if mover == connection]:
            del self._moving[topic]
            payload = zero(self._run)
            if self._pacer.offer(topic, payload, moves=False, now=now):
                self._send(topic, payload, moves=False)

    def _send(self, topic: str, payload: bytes, moves: bool) -> None:
        self._publish(topic, payload, moves)
        self._counters.add("signed")
