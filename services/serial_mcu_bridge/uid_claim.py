"""Two devices with one uid would speak over one another: the first one has it, the other waits. Pure.

Whoever wants a uid asks for it; whoever has it answers with its manifest. Of two who ask at once the one with the
greater token wins. So it is of two who both have it, because they could not hear one another when they asked. What a
line says may come back to itself: only the token tells its own words from another's.
"""

from __future__ import annotations

from enum import Enum

ASK_S = 0.2  # for an answer to come; processes of one robot answer within milliseconds
AGAIN_S = 5.0


class Move(Enum):
    """What the caller has to do."""

    NOTHING = "nothing"
    ASK = "publish the question"
    ANSWER = "publish the manifest"
    INSIST = "publish the question, and that it is ours"
    HOLD = "it is ours: begin"
    YIELD = "it is somebody else's: wait"


class _State(Enum):
    IDLE = "wants nothing"
    ASKING = "waits for an objection"
    HELD = "has it"
    TAKEN = "somebody else has it"


class UidClaim:
    """One line's claim. ``token`` is random, of this process."""

    def __init__(self, token: str) -> None:
        self.token = token
        self._state = _State.IDLE
        self._uid = ""
        self._due: float | None = None

    @property
    def due(self) -> float | None:
        """When :meth:`tick` has something to do."""
        return self._due

    def want(self, uid: str, now: float) -> Move:
        self._state, self._uid, self._due = _State.ASKING, uid, now + ASK_S
        return Move.ASK

    def release(self) -> None:
        self._state, self._uid, self._due = _State.IDLE, "", None

    def tick(self, now: float) -> Move:
        if self._due is None or now < self._due:
            return Move.NOTHING
        if self._state is _State.TAKEN:
            return self.want(self._uid, now)
        self._state, self._due = _State.HELD, None
        return Move.HOLD

    def hear_question(self, uid: str, token: str, now: float, *, has: bool = False) -> Move:
        """Somebody asks who has ``uid``, perhaps having it himself; our own question may come back to us."""
        if uid != self._uid or token == self.token or self._state not in (_State.ASKING, _State.HELD):
            return Move.NOTHING
        if self._state is _State.HELD:
            if not has:
                return Move.ANSWER
            return self._yield(now) if token > self.token else Move.INSIST
        # the weaker one may have begun to listen after we had asked
        return self._yield(now) if has or token > self.token else Move.ASK

    def hear_manifest(self, uid: str, now: float) -> Move:
        """Somebody has just said the manifest of ``uid``: us, or somebody who has it too. Kept copies: only if held."""
        if uid == self._uid and self._state is _State.HELD:
            return Move.INSIST
        return self._yield(now) if uid == self._uid and self._state is _State.ASKING else Move.NOTHING

    def hear_leaving(self, uid: str, now: float) -> Move:
        """The manifest of ``uid`` was taken back."""
        return self.want(uid, now) if uid == self._uid and self._state is _State.TAKEN else Move.NOTHING

    def _yield(self, now: float) -> Move:
        self._state, self._due = _State.TAKEN, now + AGAIN_S
        return Move.YIELD
