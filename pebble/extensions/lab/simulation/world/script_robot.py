"""The robot of a script in a lockstep world: it runs ``main(robot, options)`` unchanged, on a virtual clock."""

import importlib.util
import logging
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from msgspec.structs import replace

from pebble.config import parse
from pebble.contract import DRIVE, Channel
from pebble.contract.payloads import Drive, EstopState
from pebble.errors import PebbleError
from pebble.extensions.lab.simulation.world.lockstep import STEP_S, LockstepWorld
from pebble.extensions.lab.simulation.world.world_file import read_world
from pebble.extensions.scripts.script import EXIT_ENDED, Robot, Stopped
from pebble.extensions.scripts.script.drive_sender import DriveSender
from pebble.extensions.scripts.script.robot import check_publish
from pebble.runtime.addresses import Addresses

_WATCHDOG_S = 0.75  # of serial_mcu_bridge
_PATIENCE = 10_000  # calls during which no time passes

Image = Any
Handler = Callable[..., None]


def load_script(file: Path) -> ModuleType:
    """Return the module of a script's ``run.py``. Scripts share that name, so an import would find only the first.

    Raises OSError, and what the module raises.
    """
    name = str(file.absolute())
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise PebbleError(f"{file} is no Python file")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class SimulatedRobot(Robot):
    """A robot of the world in ``file``, for tests of a script.

    Time passes only in ``camera()``, ``picture()`` and ``sleep()``, so the same test always has the same result. A test
    passes messages of other programs to :meth:`receive`; the script's own messages are in ``published``.

    Example::

        robot = SimulatedRobot("room.json", "goob")
        robot.run(main, Options(), seconds=20)
        assert robot.distance_to(tag=13) < 0.7
    """

    def __init__(self, file: Path | str, name: str = "goob") -> None:
        """Read the world. Raises ConfigError if the file is wrong, PebbleError if the robot is not in it."""
        model = read_world(Path(file))
        if name not in model.robots:
            raise PebbleError(f"{file}: there is no robot {name!r}, only {', '.join(model.robots) or 'an empty world'}")
        self.world = LockstepWorld(model)
        self.config = parse({"robot": {"id": name}}, folder=Path(file).absolute().parent, env={})
        self.log = logging.getLogger(f"pebble.script.{name}")
        self.published: list[tuple[Channel, Any]] = []
        self._addresses = Addresses(self.config)
        self._last_values: dict[Channel, Callable[[], Any]] = {}  # by publish_at_end
        self.body = self.world.robots[name]  # its true pose, and its motor board
        self._model = model
        self._sender = DriveSender(1, self._drive)
        self._driven_at = -math.inf  # when the last command was sent; infinite once the watchdog has stopped the wheels
        self._end_at = math.inf
        self._messages: dict[Channel, tuple[Any, float]] = {}  # by channel: the newest value, and when it came
        self._handlers: list[tuple[Channel, Handler]] = []
        self._picture: tuple[Image, float] | None = None  # the newest one, and the time that it shows
        self._calls = 0  # of the script since time last passed; too many end it
        self._latched = False

    # -- for tests

    def run(self, main: Callable[..., None], *options: Any, seconds: float) -> None:
        """Run a script for ``seconds``, or until it returns; then stop the wheels and publish its last values."""
        self._end_at = self.world.now() + seconds
        try:
            main(self, *options)
        except Stopped:
            self.log.debug("its time is over")
        self._sender.end("its time is over", self.world.now())
        self.published += [(channel, value()) for channel, value in self._last_values.items()]

    def distance_to(self, *, tag: int) -> float:
        """Return the distance of the robot's middle from a tag's, along the floor, in m.

        Raises PebbleError if there is no such tag.
        """
        for placed in self._model.tags:
            if placed.id == tag:
                return math.hypot(placed.x - self.body.pose.x, placed.y - self.body.pose.y)
        raise PebbleError(f"there is no tag {tag} in this world")

    def receive(self, channel: Channel, value: Any) -> None:
        """Receive a message of another program. A drive command without a source is a person's."""
        self._messages[channel] = (value, self.world.now())
        if channel == DRIVE:
            self._sender.receive(value, self.world.now())  # so that the script's own commands give way
            self._drive(value)  # the motor owner's part: here it obeys every sender
        for wanted, handler in self._handlers:
            if wanted == channel:
                handler(value)

    def estop(self, by: str = "a person") -> None:
        """Stop the robot as STOP does: its motor owner latches, which ends a script that drives."""
        free = EstopState(latched=False, boot="0", count=0, recent=[], by="", why="", since=0)
        for state in (free, replace(free, latched=True, count=1, by=by, since=1)):
            self._sender.owners({"serial": state}, self.world.now())
        self._latched = True
        self.body.drive(0.0, 0.0)

    # -- for scripts

    def camera(self, *, width: int | None = None, views: bool = False, timeout: float | None = None) -> Iterator[Image]:
        """Yield each picture once. Time passes while there is none."""
        del width, views, timeout  # without effect here
        while True:
            self._pass_step()
            picture = self.body.picture()
            if picture is not None:
                yield picture.pixels

    def picture(self, max_age: float = 0.5) -> Image | None:
        self._pass_step()
        picture = self.body.picture()
        if picture is not None:
            self._picture = (picture.pixels, picture.at)
        if self._picture is None:
            return None
        pixels, at = self._picture
        return pixels if self.world.now() - at <= max_age else None

    def latest(self, channel: Channel, max_age: float = 1.0) -> Any:
        self._check()
        value, at = self._messages.get(channel, (None, -math.inf))
        return value if self.world.now() - at <= max_age else None

    def on(self, channel: Channel, handler: Handler) -> None:
        self._handlers.append((channel, handler))

    def drive(self, x: float = 0.0, z: float = 0.0, y: float = 0.0) -> bool:
        self._check()
        return self._sender.drive(Drive(x=x, z=z, y=y), self.world.now())

    @property
    def overridden(self) -> bool:
        return self._sender.overridden(self.world.now())

    @property
    def why_refused(self) -> str:
        return self._sender.refusal(self.world.now())

    def publish(self, channel: Channel, value: Any, **names: str) -> bool:
        self._check()
        check_publish(channel.topic(self.config.base, **names), self._addresses)
        self.published.append((channel, value))
        return True

    def sleep(self, seconds: float) -> None:
        for _ in range(max(1, round(seconds / STEP_S))):
            self._pass_step()

    def end(self, why: str, exit_code: int = 0) -> None:
        del exit_code
        self._sender.end(why, self.world.now())
        self._end_at = self.world.now()

    def close(self) -> None:
        self.end("closed")

    # -- time

    def _check(self) -> None:
        """Raise Stopped if the script has to end, PebbleError if it waits for time that does not pass."""
        self._calls += 1
        if self._calls > _PATIENCE:
            raise PebbleError("time stands still: wait with robot.sleep(), not with time.sleep()")
        if self.world.now() >= self._end_at:
            raise Stopped(0)
        if why := self._sender.ended(self.world.now()):
            self.log.warning("%s", why)
            raise Stopped(EXIT_ENDED)

    def _pass_step(self) -> None:
        """Let a step of time pass; stop the wheels if no command came for too long, as the motor owner does."""
        self._check()
        self._calls = 0
        self.world.step()
        now = self.world.now()
        self._sender.tick(now)
        if now - self._driven_at > _WATCHDOG_S:
            self._driven_at = math.inf
            self.body.drive(0.0, 0.0)

    def _drive(self, command: Drive) -> bool:
        if not self._latched:
            self._driven_at = self.world.now()
            self.body.drive(command.x, command.z)
        return True
