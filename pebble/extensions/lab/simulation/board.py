"""Simulated MCUs on serial lines: bytes in, bytes out, a clock passed in.

They run the firmware of the real boards (``firmware/``) on simulated pins, whose outputs move a simulated body.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pebble.errors import ConfigError
from pebble.extensions.lab.simulation.bodies import Pair, body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.extensions.lab.simulation.micropython.runner import Runner
from pebble.extensions.lab.simulation.motion import RobotMotion

_REPLAYED_S = 0.5  # after a pause up to this all turns of the loop are made up for
_DEADLINES_S = 2.0  # after a longer one only these, without their output: all of the firmware's deadlines are over then


@dataclass(frozen=True, slots=True)
class Profile:
    """The timing of a board: ``turn_s`` is the period of its firmware's loop, ``tick_s`` that of calls of ``tick``."""

    turn_s: float
    tick_s: float
    is_text: bool = True  # its protocol is goob_base_v1


KINDS: Final = {
    "goob": Profile(0.005, 0.02),
    "fred": Profile(0.005, 0.02),
    "goob_imu": Profile(0.0025, 0.005, is_text=False),
}


class SimulatedMcu:
    """A board. Pass the host's data to ``receive``, call ``tick`` often, and send what both return to the host.

    ``now`` is a monotonic time in seconds from one clock for all calls. ``motion`` tells the robot's place and its
    ground. ``on_motors(now, (left, right))`` is called at each change of the motors, + = forward.
    """

    def __init__(
        self,
        kind: str,
        now: float,
        *,
        motion: RobotMotion | None = None,
        on_motors: Callable[[float, Pair], None] | None = None,
    ) -> None:
        if kind not in KINDS:
            raise ConfigError(f"unknown simulated MCU {kind!r}; known: {', '.join(KINDS)}")
        self.kind, self.profile = kind, KINDS[kind]
        self._clock = VirtualClock(now)
        self.board = Board(self._clock)
        self.body = body_of(kind, self.board, motion)
        if on_motors is not None:
            self.body.on_motors = on_motors
        self.motion, self.battery = self.body.motion, self.body.battery
        self._boot_output = b""
        self._runner = Runner(self.board, kind)
        self._start()

    @property
    def robot(self) -> Any:
        """Robot object that the firmware made at the last boot."""
        return self._runner.robot

    @property
    def resets(self) -> int:
        """Number of times that the board has restarted by itself."""
        return self.board.resets

    def boot(self, now: float) -> None:
        """Press the reset button: pose and battery remain, everything else restarts."""
        self._clock.until(now)
        self._runner.boot()
        self._start()

    def receive(self, data: bytes, now: float) -> bytes:
        """Process ``data``, which may end in the middle of a line; return the board's output."""
        output = self._advance(now, self.profile.tick_s)
        console = self.board.console
        console.type(data)
        output += self._turn(now)
        while (
            unread := len(self.board.console.typed)
        ) and self._clock.now() <= now:  # past ``now`` the firmware blocks
            output += self._turn(now)
            if len(console.typed) == unread:  # the firmware reads nothing now
                break
        return output

    def tick(self, now: float) -> bytes:
        """Advance to ``now``; return the board's output until then."""
        boot_output, self._boot_output = self._boot_output, b""
        return boot_output + self._advance(now, self.profile.turn_s) + self._turn(now)

    # -- time

    def _advance(self, now: float, turn_s: float) -> bytes:
        """Run the loop every ``turn_s`` until just before ``now``; return the board's output.

        After a long pause it runs only until the firmware's deadlines are over, and the output is dropped.
        """
        output = b""
        behind = now - self._clock.now()
        is_long_pause = behind > _REPLAYED_S
        until = min(now, self._clock.now() + _DEADLINES_S) if is_long_pause else now
        while (moment := self._clock.now() + turn_s) < until:
            output += self._turn(moment)
        return b"" if is_long_pause else output

    def _turn(self, now: float) -> bytes:
        """Run one turn of the firmware's loop at ``now``, unless the firmware still blocks then."""
        if self._clock.now() > now:
            return b""
        self._clock.until(now)
        self._runner.step()
        self.body.end_turn()
        return self.board.console.take_output()

    def _start(self) -> None:
        """Run the first turn. Its output belongs to the boot, and answers no command."""
        self._runner.step()
        self._boot_output = self.board.console.take_output()
