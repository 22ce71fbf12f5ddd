"""The control of a robot: a client gets it on request, until it ends, is released or is taken.

Times are milliseconds of a clock that is never set.
"""

from payloads import NAME, clamp, is_hex, is_number, new_hex, only

NO_HOLDER = {"id": "", "by": "", "device": "", "key": ""}
SHORTEST_MS = 1000  # for which one request counts
USUAL_MS = 3000
LONGEST_MS = 10000


class Control:
    """The control of one robot. A command with another key than the holder's does not move the robot.

    At level open, a command without a key still does.
    """

    def __init__(self):
        self.holder = NO_HOLDER
        self._account = ""  # of the holder: a key counts with this account only
        self._for_ms = 0  # how long it lasts without a request or a command
        self._ends_at = 0
        self._asks = ""  # who waits for it
        self._asks_id = ""
        self._asks_until = 0

    @property
    def is_free(self):
        return self.holder["key"] == ""

    def is_held_by(self, key, account):
        return not self.is_free and key == self.holder["key"] and account == self._account

    def renew(self, now):
        """Prolong control, because its holder has sent a command."""
        self._ends_at = max(self._ends_at, now + self._for_ms)

    def request(self, command, account, take, now):
        """Give control to the first client that asks, to its holder again, or to a client that takes it."""
        own_id = command.get("id")
        for_ms = command.get("for_ms", USUAL_MS)
        if not is_hex(own_id, 8) or not is_number(for_ms):
            return
        for_ms = int(clamp(for_ms, SHORTEST_MS, LONGEST_MS))
        by = (account + "/" + only(command.get("by"), NAME, 40)).strip("/")[:40]
        is_holder = own_id == self.holder["id"] and account == self._account
        if command.get("want") == "release":
            if is_holder:
                self.pass_to(NO_HOLDER)
        elif is_holder or take or self.is_free:
            if not is_holder:
                device = only(command.get("device"), NAME, 20)
                self.pass_to({"id": own_id, "by": by, "device": device, "key": new_hex(8)})
            self._account = account
            self._for_ms = for_ms
            self._ends_at = now + for_ms
        elif self._asks_id in ("", own_id):
            self._asks = by
            self._asks_id = own_id
            self._asks_until = now + for_ms

    def pass_to(self, holder):
        self.holder = holder
        self._asks = self._asks_id = ""

    def tick(self, now):
        """End control and requests whose time is over."""
        if not self.is_free and now > self._ends_at:
            self.pass_to(NO_HOLDER)
        if now > self._asks_until:
            self._asks = self._asks_id = ""

    def state(self):
        """Return the state to publish: outgoing/control/OWNER."""
        state = {"asks": self._asks, "asks_id": self._asks_id}
        state.update(self.holder)
        return state
