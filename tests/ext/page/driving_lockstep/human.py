"""A human before one page, as they really are: what they hold, and what the page can know of it. This is the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pebble.extensions.page.messages import DriveOp

STALL_S = 0.25  # a page that stood still for so long ends its gesture
PAD_S = 0.06  # a gamepad is read every 50 ms
PAD_FROZEN_S = 3.1  # so long one whose radio was lost is believed
SOON_S = 0.06  # from an action of the human to the command

KEYS = {
    "KeyW": (0, 1, 0),
    "KeyS": (0, -1, 0),
    "KeyA": (-1, 0, 0),
    "KeyD": (1, 0, 0),
    "KeyQ": (0, 0, 1),
    "KeyE": (0, 0, -1),
    "ArrowUp": (0, 1, 0),
    "ArrowRight": (1, 0, 0),
}

Axes = tuple[float, float, float]  # x, z, y


@dataclass(slots=True, eq=False)
class Press:
    """An input from the moment in which it leaves neutral. After ``until`` no command may be made of it."""

    name: str
    axes: Axes
    at: float
    until: float = float("inf")
    why: str = ""
    pending: bool = False  # it has ended while the page stood still, which learns it when it goes on

    def end(self, at: float, why: str) -> None:
        if at < self.until:
            self.until, self.why = at, why


@dataclass(slots=True, eq=False)
class Human:
    """``page`` is the number of the page before them; a page that is loaded anew has a new number."""

    page: int
    visible: bool = True
    focused: bool = True
    mac: bool = False
    held: dict[str, Press] = field(default_factory=dict)
    ended: list[Press] = field(default_factory=list)
    acted: float = float("-inf")
    blocked_from: float | None = None
    unblocked: float = float("-inf")
    balance: float = 0.0
    dialog: int = 0  # counts what is opened and closed
    has_pad: bool = False
    without_pad: float = float("-inf")  # since when
    pad_frozen: bool = False
    meta: bool = False
    asleep: bool = False  # their computer
    gesture: tuple[int, int] | None = None  # socket and number of the gesture of the newest command, if that moves
    sent: float = float("-inf")  # the newest command that moves

    # -- inputs

    def press(self, name: str, axes: Axes, now: float) -> None:
        self.acted = now
        self.held[name] = press = Press(name, axes, now)
        if self.asleep:
            press.end(float("-inf"), "the computer slept")

    def change(self, name: str, axes: Axes, now: float) -> None:
        """The same input in another position."""
        self.acted = now
        press = self.held[name]
        if name == "pad" or self.blocked_from is not None:  # the page learns it a little later
            before = Press(name, press.axes, press.at, press.until, press.why)
            self._end(before, now + (PAD_S if name == "pad" else 0.0), "it was moved")
            self.ended.append(before)
        press.axes = axes

    def let_go(self, name: str, now: float) -> None:
        press = self.held.pop(name, None)
        if press is None:
            return
        self.acted = now
        late = 0.0 if name != "pad" else PAD_FROZEN_S if self.pad_frozen else PAD_S
        self._end(press, now + late, "it was released")
        self.ended = [*(one for one in self.ended if one.until >= now - 5), press]

    def interrupt(self, now: float, why: str, before: float = float("inf")) -> None:
        """What is held, and was pressed before then, moves nothing any more, until it was released."""
        for press in (*self.held.values(), *self.ended):
            if press.at < before:
                self._end(press, now, why)

    def _end(self, press: Press, at: float, why: str) -> None:
        """A page that stands still learns it when it goes on, if that is soon."""
        press.pending = self.blocked_from is not None
        press.end(at + (STALL_S + 0.01 if press.pending else 0.0), why)

    # -- the page's main thread

    def block(self, now: float) -> None:
        if self.blocked_from is None:
            self.blocked_from = now

    def unblock(self, now: float) -> None:
        if self.blocked_from is None:
            return
        if self.acted >= self.blocked_from:  # of which the page learns now
            self.acted = now
        for press in (*self.held.values(), *self.ended):
            if press.pending:
                press.until = min(press.until, max(now, press.until - STALL_S))
            if now - max(press.at, self.blocked_from) > STALL_S + 0.01:
                press.end(max(press.at, self.blocked_from) + STALL_S, "the page stood still")
        self.blocked_from, self.unblocked = None, now

    # -- what the page does

    def check(self, socket: int, op: DriveOp, now: float) -> str:
        """Why the page may not send this command now; empty if it may."""
        if not (op.x or op.z or op.y):
            ended, self.gesture = self.gesture is not None, None
            if op.final and ended and self.unblocked != now:  # else it is about something that happened before
                self.interrupt(now, "the page has ended the gesture")
            return ""
        begins = self.gesture != (socket, op.g)
        self.gesture, self.sent = (socket, op.g), now
        if begins and not (now - self.acted <= SOON_S or self.unblocked == now):
            return "a gesture begins though the human does nothing"
        if not self.visible and self.blocked_from is None and self.unblocked != now:
            return "a hidden page commands motion"
        return self._explained(op, now)

    def _explained(self, op: DriveOp, now: float) -> str:
        valid = [one for one in (*self.held.values(), *self.ended) if now <= one.until]
        if not valid:
            whys = sorted({one.why for one in (*self.held.values(), *self.ended)} - {""})
            return f"a page commands motion though no input is held that counts: {', '.join(whys) or 'none'}"
        for axis, value in enumerate((op.x, op.z, op.y)):
            if value and not self._pushes(valid, axis, value):
                return "a page commands motion along an axis along which no input is held that counts"
        return ""

    def _pushes(self, valid: list[Press], axis: int, value: float) -> bool:
        if self.balance and axis < 2:
            return any(one.axes[0] or one.axes[1] for one in valid)
        return any(one.axes[axis] * value > 0 for one in valid)


def sliders(number: int) -> dict[str, Any]:
    """Positions of the three sliders."""
    speed, turn, balance = ((0.6, 0.6, 0), (1, 1, 0), (0, 0.5, 0), (0.3, 0.8, -0.4), (1, 0.2, 1), (0.5, 0, 0))[
        number % 6
    ]
    return {"speed": speed, "turn": turn, "balance": balance}
