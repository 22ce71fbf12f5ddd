"""Which wills a hub takes: a command that was left as a will would be published as a fresh one, any time later."""

import logging
from collections.abc import Sequence

from pebble.transports.topics import matches
from pebble.transports.zenoh.hub.store import Record, StoredWill

log = logging.getLogger(__name__)

_CLIENTS = 100  # whose first refused will is logged
_LOGGED = 200  # characters of a topic or a client's id


class WillAdmission:
    """By ``rules``, each a filter and whether a will on such a topic is taken; the last one that matches decides."""

    def __init__(self, rules: Sequence[tuple[str, bool]]) -> None:
        self.refused = 0
        self._rules = tuple(reversed(rules))
        self._logged: set[str] = set()

    def admitted(self, record: Record) -> Record:
        """``record`` as it may be stored: a will that is refused becomes none."""
        if not isinstance(record, StoredWill) or record.will is None or self.takes(record.will.topic):
            return record
        self.refused += 1
        self._log(record.will.client[:_LOGGED], record.will.topic[:_LOGGED])
        return StoredWill(record.name, None)

    def takes(self, topic: str) -> bool:
        return next((taken for filter_, taken in self._rules if matches(filter_, topic)), True)

    def _log(self, client: str, topic: str) -> None:
        if client in self._logged or len(self._logged) >= _CLIENTS:
            return
        self._logged.add(client)
        more = "; those of further clients are only counted" if len(self._logged) == _CLIENTS else ""
        log.warning("refused the will of %r: a command must not be published later (%s)%s", client, topic, more)
