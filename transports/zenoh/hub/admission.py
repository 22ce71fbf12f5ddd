"""Rules of a hub about its clients' wills and retained messages.

They matter because a command that was left as a will would be published as a new one, at any later time.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from pebble.transports.topics import matches
from pebble.transports.zenoh.hub.records import Record, Retained, StoredWill
from pebble.transports.zenoh.keymap import key_to_topic
from pebble.transports.zenoh.wire import Hello, Will

log = logging.getLogger(__name__)

_CLIENTS = 100  # whose first refusal is logged
_LOGGED = 200  # characters of a topic or a client's id


class Admission:
    """Rules for clients of this machine; a subclass may admit accounts of other machines.

    ``wills``: filters, each with whether a will on such a topic is accepted; the last one that matches decides.
    ``unretained``: filters of topics on which nothing is retained.
    """

    def __init__(self, wills: Sequence[tuple[str, bool]], unretained: Sequence[str] = ()) -> None:
        self.refused = 0  # wills
        self._wills = tuple(reversed(wills))
        self._unretained = unretained
        self._logged: set[str] = set()

    def newest(self) -> object:
        """Return the newest rules for other machines: the same object until they change. None: there are none."""
        return None

    def rules(self) -> Mapping[str, Any]:
        """Return Zenoh's configuration of the rights of connections from other machines."""
        return {}

    def hello(self, account: str, hello: Hello) -> Hello | None:
        """Return a client's ``hello``, reduced to what the client may do; None if the hub must not answer."""
        return None if account else hello

    def owns(self, account: str, session: str) -> bool:
        """True if the session of this name belongs to the account."""
        return not account and bool(session)

    def admitted(self, record: Record) -> Record | None:
        """Return ``record`` to be stored, without a refused will, which is counted; None if it must not be stored."""
        if isinstance(record, Retained):
            refused = any(matches(filter_, key_to_topic(record.key)) for filter_ in self._unretained)
            return None if refused else record
        if record.will is None or self.takes(record.will.topic):
            return record
        self.refuse_will(record.will, "a command must not be published later")
        return StoredWill(record.name, None)

    def takes(self, topic: str) -> bool:
        """True if a will on this topic is accepted."""
        return next((is_taken for filter_, is_taken in self._wills if matches(filter_, topic)), True)

    def refuse_will(self, will: Will, why: str) -> None:
        """Count a refused will, and log the first refusal of its client."""
        self.refused += 1
        self.log(will.client[:_LOGGED], "will", f"{why} ({will.topic[:_LOGGED]})")

    def log(self, client: str, what: str, why: str) -> None:
        """Log the first refusal of each client, for a limited number of clients."""
        if client in self._logged or len(self._logged) >= _CLIENTS:
            return
        self._logged.add(client)
        more = "; those of further clients are only counted" if len(self._logged) == _CLIENTS else ""
        log.warning("refused the %s of %r: %s%s", what, client, why, more)
