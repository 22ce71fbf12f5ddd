"""The audits that robots keep themselves: their newest lines are noted here, as a witness, and read on demand."""

import asyncio
from collections.abc import Callable
from typing import Any

import msgspec

from pebble.client.broker import Broker
from pebble.contract import AUDIT, AUDIT_LINES, AUDIT_READ, chain, codec
from pebble.contract.chain import Mark
from pebble.contract.identity import parse_topic
from pebble.contract.payloads import AuditChain, AuditLines, AuditRead, AuditState
from pebble.errors import PayloadError, PebbleError
from pebble.fleet.audit import Audit
from pebble.transports import Message

ANSWER_S = 5.0  # robots answer once a second; on a thin link it takes longer
NOTE_S = 60.0  # between two notes of one robot
MOST_READS = 8  # at a time
_MOST_BYTES = 64 * 1024  # of an answer


class RobotAudit(msgspec.Struct, frozen=True, kw_only=True):
    """Lines of a robot's audit, the oldest first; ``problem``: what is wrong with them, or with what is missing."""

    lines: list[dict[str, Any]]
    problem: str
    noted: int  # the newest line that this server has noted; 0: none


class RobotAudits:
    """``is_known``: robots of which there are not many; ``answer_s``: of a robot. Only the event loop calls it."""

    def __init__(
        self,
        broker: Broker,
        audit: Audit,
        is_known: Callable[[str], bool],
        is_there: Callable[[str], bool],
        answer_s: Callable[[str], float],
    ) -> None:
        self._broker, self._audit, self._is_known, self._is_there = broker, audit, is_known, is_there
        self._answer_s = answer_s
        self._newest: dict[str, AuditState] = {}  # not noted yet
        self._noted_at: dict[str, float] = {}
        self._reading = 0

    def receive(self, message: Message, _now: float) -> None:
        address = parse_topic(message.topic)
        try:
            state = codec.decode(AUDIT, message.payload)
        except PayloadError:
            return
        if address is not None and self._is_there(address.identity.base):
            self._newest[address.identity.base] = state

    def tick(self, now: float) -> None:
        """Note what is new of robots that are known; of others later, if they ever are."""
        for ref, state in list(self._newest.items()):
            if not self._is_there(ref):
                del self._newest[ref]
            elif self._is_known(ref) and now - self._noted_at.get(ref, float("-inf")) >= NOTE_S:
                del self._newest[ref]
                self._noted_at = {one: at for one, at in self._noted_at.items() if self._is_known(one)} | {ref: now}
                for name, mark in (("acts", state.acts), ("refused", state.refused)):
                    if mark.n:
                        self._audit.note(ref, name, Mark(mark.n, mark.h))

    async def read(self, ref: str, name: AuditChain, before: int) -> RobotAudit:
        """Lines before that number, 0: the newest. Raises PebbleError with the reason why there are none."""
        if self._reading >= MOST_READS:
            raise PebbleError("others are reading: try again")
        self._reading += 1
        try:
            lines = await self._ask(ref, AuditRead(chain=name, before=before))
        finally:
            self._reading -= 1
        marks = await asyncio.to_thread(self._audit.marks, ref, name)
        noted = max((mark.n for mark in marks), default=0)
        return RobotAudit(lines=[_plain(raw) for raw in lines], problem=_problem(lines, before, marks), noted=noted)

    async def _ask(self, ref: str, request: AuditRead) -> list[bytes]:
        answered: asyncio.Future[list[bytes]] = asyncio.get_running_loop().create_future()

        def receive(message: Message, _now: float) -> None:
            lines = _answer(message, request)
            if lines is not None and not answered.done():
                answered.set_result(lines)

        subscription = await self._broker.subscribe(AUDIT_LINES.topic(ref), receive)
        try:
            if not self._broker.publish(AUDIT_READ.topic(ref), codec.encode(AUDIT_READ, request)):
                raise PebbleError("the server cannot reach the broker")
            return await asyncio.wait_for(answered, max(ANSWER_S, self._answer_s(ref)))
        except TimeoutError:
            raise PebbleError("the robot does not answer: it keeps no audit, or this server may not read it") from None
        finally:
            await self._broker.unsubscribe(subscription)


def _problem(lines: list[bytes], before: int, marks: list[Mark]) -> str:
    """What is wrong with the lines before a number; there may be none, because a robot replaces its oldest ones."""
    if before and not lines:
        return ""
    problem = chain.verify(lines, [mark for mark in marks if not before or mark.n < before])
    newest = chain.parse(lines[-1]) if lines else None
    if problem or not before or newest is None or newest.n == before - 1:
        return problem
    return f"lines are missing between {newest.n} and {before}"


def _answer(message: Message, request: AuditRead) -> list[bytes] | None:
    """None: it answers another request."""
    try:
        answer: AuditLines = codec.decode(AUDIT_LINES, message.payload[:_MOST_BYTES])
    except PayloadError:
        return None
    fits = (answer.chain, answer.before) == (request.chain, request.before)
    return [one.encode() for one in answer.lines] if fits else None


def _plain(raw: bytes) -> dict[str, Any]:
    try:
        found = codec.plain(AUDIT_LINES, raw)
    except PayloadError:
        found = None
    return found if isinstance(found, dict) else {"what": raw.decode(errors="replace")}
