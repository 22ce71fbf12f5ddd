"""A hub's connections to other hubs, and when they have to be made anew. Pure.

Where a router comes back while others still think about its going, Zenoh's routers lose some of what it, or others,
declare, and never ask for it again: after nearly every hang (13 of 15), and after a line that was cut for a moment.
"""

from __future__ import annotations

import random
from collections import deque

from pebble.transports.zenoh.hub.wills import LINK_S

CUT_S = 4.0  # a connection to a hub that is not seen stands so long, or up to twice that, before all are made anew
RENEWALS, RENEWALS_S = 5, 3600.0  # of them that do not help in so many seconds: each costs clients some 0.3 s


class Links:
    """``now`` is of any clock that does not go back."""

    def __init__(self, now: float) -> None:
        self.routers: set[str] = set()  # hubs that this one has a connection to, by Zenoh's ids
        # Two that miss each other do not begin anew at one instant.
        self._patience_s = CUT_S * random.uniform(1, 2)  # noqa: S311  (not a secret)
        self._whole_at = now  # when it last saw as many hubs as it has connections to
        self._renewed_at: deque[float] = deque(maxlen=RENEWALS)  # and that did not help so far
        self._renewed_with = 0  # connections to hubs, the last time
        self._still_until = float("-inf")
        self._lost_still = False

    def on_new_session(self) -> None:
        self.routers.clear()
        self._still_until, self._lost_still = float("-inf"), False

    def on_link(self, router: str, now: float, *, present: bool) -> None:
        """There is a connection to a hub, or it is lost."""
        (self.routers.add if present else self.routers.discard)(router)
        self._lost_still |= not present and now < self._still_until

    def on_standstill(self, now: float) -> None:
        """This hub hung: others have closed its connections meanwhile."""
        self._still_until = now + LINK_S

    def is_cut(self, hubs: int | None, now: float) -> bool:
        """Whether all have to be made anew: some were lost while this hub hung, or are to hubs that it does not see.

        ``hubs``: how many it sees; None: it has never seen any, so that a connection may be to what is no hub of ours.
        """
        times = self._renewed_at
        is_whole = hubs is not None and hubs >= len(self.routers)
        if is_whole or hubs is None:
            self._whole_at = now
        if is_whole and len(self.routers) >= self._renewed_with:
            times.clear()  # what has helped may be done again
        if self._lost_still:
            self._whole_at = now
            return True
        if now - self._whole_at < self._patience_s or (len(times) == RENEWALS and now - times[0] < RENEWALS_S):
            return False
        self._whole_at = now
        self._renewed_with = len(self.routers)
        times.append(now)
        return True
