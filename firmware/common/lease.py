"""Control of one motor owner: a lease that it gives, renews and ends. Pure; boards and Linux robots share it.

Control orders people; it is no safety function. A stop and a zero need none. Each drive command carries the key of the
control under which it is sent. The key is new whenever another client gets control, so earlier commands have no effect.
A client is ``(account, id, by, device)``, known by the first two; the account is "" where names are not checked.
"""


class Lease:
    """A lease. Pass requests to ``hold`` and ``release``, drive commands to ``refuses``; call ``tick`` regularly.

    A holder drives until 5 s after it got control or last moved something; after that a request gets control at once.
    ``others``: True if a command without a key has passed here in the last 2 s.
    """

    def __init__(self, now: int, diff, random, strangers: int) -> None:
        """Store the arguments; ``random(4)`` returns 8 hex digits. See latch.py for ``diff``.

        ``strangers``: commands without a key move the motors always (0), while control is free (1), or never (2).
        """
        self.key = ""  # "": control is free
        self.holder: tuple = ()  # (): control is free
        self.asker: tuple = ()
        self.others = False  # in the last 2 s a command without a key passed here; latch or arbiter may have refused it
        self.changed = True  # since the last state
        self.halts = False  # another client has control, or none: the motors are to be stopped
        self.strangers = strangers
        self._diff = diff
        self._random = random
        # times of the last renewal, of the holder's last motion, of the request, and of a command without a key
        self._since = self._held_from = self._asked = self._received = now
        self._limit_ms = self._wait = 0  # how long control, and the asker's request, last after those times
        self._held = False  # in the last 5 s the holder moved something: others have to ask

    def hold(self, client: tuple, ms: int, urgent: bool, now: int) -> None:
        """Give control, renew it, or note the request for it while another client drives.

        ``urgent``: the client gets control at once, also while another one drives.
        """
        self.tick(now)
        ms = min(max(ms, 1000), 10_000)
        if client[:2] == self.holder[:2]:
            self._since = now
            self._limit_ms = ms
        elif urgent or not self._held:
            self.take(client, ms, now)
        elif not self.asker or client[:2] == self.asker[:2]:  # the first asker stays, while its request lasts
            self.changed = self.changed or not self.asker
            self.asker = client
            self._wait = ms
            self._asked = now

    def release(self, client: tuple, now: int) -> None:
        """End control, or the request for it."""
        self.tick(now)
        if client[:2] == self.holder[:2]:
            self._end(now)
        elif client[:2] == self.asker[:2]:
            self.asker = ()
            self.changed = True

    def holds(self, key: str, by: str) -> bool:
        """True if a command of this account is from the holder; ``key`` may list the keys of several motor owners."""
        if not self.key or self.holder[:1] != (by,):
            return False
        return key == self.key or (len(key) < 80 and self.key in key.split(" "))  # nobody can try many keys at once

    def refuses(self, moves: bool, script: bool, key: str, by: str, now: int) -> bool:
        """True if a drive command has no effect. A command of the holder renews control. A zero always has an effect.

        ``script``: this sender needs no key. Call ``tick`` before.
        """
        if self.holds(key, by):
            self._since = now
            if moves:
                self._held_from = now
                self._held = True
        elif moves:
            if key:
                return True
            if not script:
                if self.strangers == 2 or (self.strangers == 1 and self.key):
                    return True
                self._received = now  # a stranger moves the motors: the state shows that for 2 s
                self.changed = self.changed or not self.others
                self.others = True
        return False

    def tick(self, now: int) -> None:
        """End control and requests whose time is over; pass control on to a client that asks once the holder rests.

        Call it at least every few minutes, as clocks of boards wrap.
        """
        diff = self._diff
        if self.others and diff(now, self._received) >= 2000:
            self.others = False
            self.changed = True
        if self.asker and diff(now, self._asked) >= self._wait:
            self.asker = ()
            self.changed = True
        if self._held and diff(now, self._held_from) >= 5000:
            self._held = False
        if self.key and (diff(now, self._since) >= self._limit_ms or (self.asker and not self._held)):
            self._end(now)

    def take(self, client: tuple, ms: int, now: int) -> None:
        """Pass control on to this client for ``ms``. With () and 0 control is free: there is no key."""
        self.holder = client
        self.asker = ()
        self.key = self._random(4) if ms else ""
        self._since = self._held_from = now
        self._limit_ms = ms
        self._held = ms > 0
        self.changed = self.halts = True

    def _end(self, now: int) -> None:
        self.take(self.asker, self._wait if self.asker else 0, now)


def request_of(fields: dict) -> tuple[str, str, str, int] | None:
    """Return ``(id, by, device, for_ms)`` of a request, 0 for a release; None if it is not a request."""
    name = fields.get("id")
    want = fields.get("want", "hold")
    by = fields.get("by", "")
    device = fields.get("device", "")
    ms = fields.get("for_ms", 3000)
    if not (isinstance(name, str) and isinstance(by, str) and isinstance(device, str)):
        return None
    if len(name) != 8 or name.strip("0123456789abcdefABCDEF"):  # of 8 hex digits strip leaves nothing
        return None
    if want not in ("hold", "release") or type(ms) not in (int, float):
        return None
    return name, shown(by, 40), shown(device, 20), int(min(max(ms, 1), 10_000)) if want == "hold" else 0


def shown(text: str, limit: int) -> str:
    """Return ``text`` in lower case, with "_" for what names cannot have; the "/" in SERVER/PERSON stays."""
    letters = "abcdefghijklmnopqrstuvwxyz0123456789_-/"
    return "".join([char if char in letters else "_" for char in text.lower()[:limit]])
