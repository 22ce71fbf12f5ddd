"""Which robots people drive from the operator page, by what its server announces. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from pebble.contract import DRIVING, codec
from pebble.contract.identity import parse_topic
from pebble.contract.payloads import Driver
from pebble.errors import PayloadError
from pebble.transports import Message

EXPIRES_S = 3.0  # announcements come every second


@dataclass(frozen=True, slots=True)
class _Visit:
    server: str
    driver: Driver
    announced: float  # monotonic
    over: bool = False


class Visitors:
    """The newest visit of every robot, by base topic; times are monotonic. One thread receives, another reads."""

    def __init__(self) -> None:
        self._visits: dict[str, _Visit] = {}

    def receive(self, message: Message, now: float) -> None:
        address = parse_topic(message.topic)
        if address is None or not address.identity.is_server or message.retain:
            return
        try:
            payload = codec.decode(DRIVING, message.payload)
        except PayloadError:  # from something that is no server of ours
            return
        server = address.identity.id
        for base, visit in list(self._visits.items()):
            if visit.server == server and not visit.over and base not in payload.robots:
                self._visits[base] = _Visit(server, visit.driver, now, over=True)
        for base, driver in payload.robots.items():
            self._visits[base] = _Visit(server, driver, now)

    def driver(self, base: str, now: float) -> str:
        """Who has that robot now, for display; empty: nobody."""
        visit = self._visits.get(base)
        if visit is None or visit.over or now - visit.announced > EXPIRES_S:
            return ""
        return f"{visit.driver.by} on {visit.driver.device}" if visit.driver.device else visit.driver.by

    def driven_since(self, base: str, since: float, now: float) -> bool:
        """Whether a person has it, or had it at any time after ``since``."""
        visit = self._visits.get(base)
        return visit is not None and (visit.announced >= since or bool(self.driver(base, now)))
