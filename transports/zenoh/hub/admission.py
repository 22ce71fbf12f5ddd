"""What a hub takes from its clients: which wills, what is retained, and from accounts of other machines what is theirs.

A command that was left as a will would be published as a fresh one, any time later.
"""

import logging
from collections.abc import Mapping, Sequence

from msgspec.structs import replace

from pebble.transports.topics import matches
from pebble.transports.zenoh.access import HubAccount
from pebble.transports.zenoh.hub.records import Record, Retained, StoredWill
from pebble.transports.zenoh.keymap import key_to_topic
from pebble.transports.zenoh.wire import OF, Hello, Will

log = logging.getLogger(__name__)

_CLIENTS = 100  # whose first refusal is logged
_LOGGED = 200  # characters of a topic or a client's id


class Admission:
    """``wills``: filters, and whether a will on such a topic is taken; the last one that matches decides.

    ``unretained``: filters of topics on which nothing is retained. ``accounts``: those of other machines.
    """

    def __init__(self, wills: Sequence[tuple[str, bool]], unretained: Sequence[str] = ()) -> None:
        self.refused = 0
        self.accounts: Mapping[str, HubAccount] = {}
        self._wills = tuple(reversed(wills))
        self._unretained = unretained
        self._logged: set[str] = set()

    def admitted(self, record: Record) -> Record | None:
        """``record`` as it may be stored: a will that is refused becomes none; None: nothing of it."""
        if isinstance(record, Retained):
            return record if not (self._unretained and _any(self._unretained, key_to_topic(record.key))) else None
        if record.will is None or self.takes(record.will.topic):
            return record
        self._refuse_will(record.will, "a command must not be published later")
        return StoredWill(record.name, None)

    def takes(self, topic: str) -> bool:
        return next((taken for filter_, taken in self._wills if matches(filter_, topic)), True)

    def hello(self, account: str, hello: Hello) -> Hello | None:
        """Return ``hello`` without what this account may not; None: it is not answered.

        Its certificate allows an account to ask under its own name only.
        """
        if not account:
            return hello
        known = self.accounts.get(account)
        if known is None or not self.owns(account, hello.name):
            self._log(account, "hello", "its session must be named after an account that is known")
            return None
        offered = hello.own if known.retains else {}
        own = {key: digest for key, digest in offered.items() if _any(known.retains, key_to_topic(key))}
        return replace(hello, will=self._of_account(account, known, hello.will), own=own)

    def owns(self, account: str, session: str) -> bool:
        return not account or session.startswith(account + OF)

    def _of_account(self, account: str, known: HubAccount, will: Will | None) -> Will | None:
        if will is None:
            return None
        will = replace(will, client=f"{account}{OF}{will.client}")  # so that it is no one else's predecessor
        if _any(known.wills, will.topic):
            return will
        self._refuse_will(will, "an account leaves a will for its own robot only")
        return None

    def _refuse_will(self, will: Will, why: str) -> None:
        self.refused += 1
        self._log(will.client[:_LOGGED], "will", f"{why} ({will.topic[:_LOGGED]})")

    def _log(self, client: str, what: str, why: str) -> None:
        if client in self._logged or len(self._logged) >= _CLIENTS:
            return
        self._logged.add(client)
        more = "; those of further clients are only counted" if len(self._logged) == _CLIENTS else ""
        log.warning("refused the %s of %r: %s%s", what, client, why, more)


def _any(filters: Sequence[str], topic: str) -> bool:
    return any(matches(filter_, topic) for filter_ in filters)
