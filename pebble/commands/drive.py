"""``pebble drive``: drives a robot with the keys of a terminal."""

import socket
import time
from collections import deque
from typing import Annotated

import typer

from pebble.client.broker import ANSWER_S
from pebble.client.connection import Target, connected, put_names, target_of
from pebble.client.terminal.driver import PERIOD_S, TerminalDriver
from pebble.client.terminal.key_decoder import END
from pebble.commands.estop import me
from pebble.commands.options import RobotArgument, with_target
from pebble.commands.terminal.loop import TerminalLoop
from pebble.transports import Message, QoS, State, Transport
from pebble.transports.clock import since_boot as clock

_KEYS = """\
W A S D or arrows drive, Q E grousers, space stops.
! or Esc Esc is the emergency stop, Ctrl-C ends.
T takes control, or asks for it; O takes it over."""
_STOP_S = 3.0  # so long an emergency stop is still sent after the terminal has ended
_ARRIVED = 1000  # messages that wait to be handled


@with_target(program="drive")
def drive(
    robot: RobotArgument,
    speed: Annotated[float, typer.Option(min=0.05, max=1, help="Throttle of a key, and speed of the grousers.")] = 0.6,
    turn: Annotated[float, typer.Option(min=0.05, max=1, help="Steering of a key.")] = 0.8,
    take_over: Annotated[bool, typer.Option("--take-over", help="Also from another driver.")] = False,
    *,
    target: Target,
) -> int:
    """Drive a robot with the keys of this terminal.

    W A S D or the arrows drive, Q and E move the grousers, space stops. ! or twice Escape is the emergency stop,
    which only `pebble estop reset` ends. Ctrl-C ends.

    A key counts as held for 0.4 s after its last repetition: the robot moves on for so long after you let go, and halts
    briefly where the first repetition comes later. What interrupts a drive ends it: let go of all keys, press again.

    Control is taken if nobody has it, and given back after a minute without a drive. T asks another driver for it, O
    takes it over. When another one asks, L lets them drive, K keeps it.

    \b
        pebble drive goob.json
        pebble drive goob --url mqtt://127.0.0.1 --speed 0.3
        pebble drive goob.json --remote --take-over
    """
    from pebble.client.terminal.keys import check_terminal, opened

    check_terminal()
    target = target_of(robot, target)
    with connected(target) as (transport, names):
        by, device = me(names.account), f"terminal on {socket.gethostname()}"
        heartbeat = target.remote or str(target.url).startswith("mqtt")  # within a robot there is none
        driver = TerminalDriver(
            names.base, by=by, device=device, speed=speed, turn=turn, take_over=take_over, heartbeat=heartbeat
        )
        put_names(transport, names, lambda base: base == names.base and driver.robot.named)
        typer.echo(_KEYS)
        with opened() as terminal:
            loop = TerminalLoop(terminal, clock)
            _drive(transport, driver, loop)
    if driver.unconfirmed:
        typer.echo(f"pebble: the emergency stop of {driver.name} is NOT CONFIRMED", err=True)
    return 0 if loop.ended in ("SIGINT", END) else 1


def _drive(transport: Transport, driver: TerminalDriver, loop: TerminalLoop) -> None:
    """Pass keys and messages to the driver, and what it returns to the transport, until the terminal ends."""
    arrived: deque[tuple[Message, float, float]] = deque(maxlen=_ARRIVED)
    for filter_ in driver.filters:
        transport.subscribe(
            filter_, lambda message: arrived.append((message, clock(), time.time())), qos=QoS.DELIVERED, direct=True
        )

    def publish(messages: list[Message]) -> None:
        for message in messages:
            transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)

    def tick() -> None:
        while arrived:
            driver.receive(*arrived.popleft())
        late_s = transport.outgoing.stalled_s
        problem = "" if transport.state is State.CONNECTED else transport.problem or "it was lost"
        problem = problem or ("it does not answer" if late_s > ANSWER_S else "")
        publish(driver.tick(clock(), problem=problem, late_s=late_s))

    def halt(*, leave: bool) -> None:
        publish(driver.halt(clock(), leave=leave))
        for _ in range(3):
            time.sleep(PERIOD_S)
            tick()

    try:
        while not loop.ended:
            keys = loop.keys(PERIOD_S)
            driver.press(keys, clock())
            tick()
            loop.show(driver.status, at_once=bool(keys))
            loop.suspend(lambda: halt(leave=False))
    finally:
        halt(leave=True)
        end = clock() + _STOP_S
        while driver.unconfirmed and clock() < end:
            time.sleep(PERIOD_S)
            tick()
