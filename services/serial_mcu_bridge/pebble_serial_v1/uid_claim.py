"""Ensures that one uid is used by one device: the first one holds it, others wait. Pure.

A process that requests a uid publishes a question; the holder answers with its manifest. Of two that ask at once, the
one with the greater token wins. If two hold it (they were disconnected when they asked), the greater token wins, too.
A process may receive its own question; it recognises its token.
"""

from enum import Enum

ASK_S = 0.2  # to wait for an answer; processes of one robot answer within milliseconds
AGAIN_S = 5.0


class Move(Enum):
    """The next move of the caller."""

    NOTHING = "nothing"
    ASK = "publish the question"
    ANSWER = "publish the manifest"
    INSIST = "publish the question, and that this process holds the uid"
    HOLD = "acquired: begin"
    YIELD = "another device holds it: wait"


class _State(Enum):
    IDLE = "requests nothing"
    ASKING = "waits for an objection"
    HELD = "holds it"
    TAKEN = "another device holds it"


class UidClaim:
    """The claim of one instance. ``token`` is random and identifies its process."""

    def __init__(self, token: str) -> None:
        self.token = token
        self._state = _State.IDLE
        self._uid = ""
        self._due: float | None = None

    @property
    def due(self) -> float | None:
        """When :meth:`tick` has something to do."""
        return self._due

    def request(self, uid: str, now: float) -> Move:
        self._state, self._uid, self._due = _State.ASKING, uid, now + ASK_S
        return Move.ASK

    def release(self) -> None:
        self._state, self._uid, self._due = _State.IDLE, "", None

    def tick(self, now: float) -> Move:
        if self._due is None or now < self._due:
            return Move.NOTHING
        if self._state is _State.TAKEN:
            return self.request(self._uid, now)
        self._state, self._due = _State.HELD, None
        return Move.HOLD

    def on_question(self, uid: str, token: str, now: float, *, has: bool = False) -> Move:
        """Handle a question about ``uid``; with ``has`` its sender claims to hold it. Ignores its own questions."""
        if uid != self._uid or token == self.token or self._state not in (_State.ASKING, _State.HELD):
            return Move.NOTHING
        if self._state is _State.HELD:
            if not has:
                return Move.ANSWER
            return self._yield(now) if token > self.token else Move.INSIST
        # the one with the smaller token may have subscribed after this question
        return self._yield(now) if has or token > self.token else Move.ASK

    def on_manifest(self, uid: str, now: float) -> Move:
        """Handle a manifest of ``uid`` from another process. Pass retained ones only while the uid is held."""
        if uid == self._uid and self._state is _State.HELD:
            return Move.INSIST
        return self._yield(now) if uid == self._uid and self._state is _State.ASKING else Move.NOTHING

    def on_withdrawal(self, uid: str, now: float) -> Move:
        """Handle a cleared manifest of ``uid``."""
        return self.request(uid, now) if uid == self._uid and self._state is _State.TAKEN else Move.NOTHING

    def _yield(self, now: float) -> Move:
        self._state, self._due = _State.TAKEN, now + AGAIN_S
        return Move.YIELD
