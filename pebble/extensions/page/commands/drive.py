"""``pebble drive``: drives a robot with the keys of a terminal."""

import socket
import time
from collections import deque
from typing import Annotated

import typer

from pebble.errors import PebbleError
from pebble.extensions.operator.client.assumed import RISK
from pebble.extensions.operator.client.broker import problem_of
from pebble.extensions.operator.client.connection import (
    Target,
    connected,
    me,
    put_account_into_topics,
    target_of,
)
from pebble.extensions.operator.client.terminal.key_decoder import END
from pebble.extensions.operator.client.terminal.keys import Terminal, has_terminal, opened
from pebble.extensions.operator.commands.options import RobotArgument
from pebble.extensions.operator.commands.target import with_target
from pebble.extensions.page.commands.terminal_driver import PERIOD_S, TerminalDriver
from pebble.transports import Message, QoS, Transport
from pebble.transports.clock import since_boot as clock

_KEYS = "W A S D or arrows drive, Q E grousers, space stops; ! or Esc Esc is the emergency stop, Ctrl-C ends.\n"
_KEYS += "T takes control, or asks for it; O takes it over; L gives it back."
_ZEROS_S, _STOP_S = 0.3, 3.0  # so long zeros, and an emergency stop, are still sent after the terminal has ended
_ARRIVED = 1000  # messages that wait to be handled


@with_target(program="drive")
def drive(
    robot: RobotArgument,
    speed: Annotated[float, typer.Option(min=0.05, max=1, help="Throttle of a key, and speed of the grousers.")] = 0.6,
    turn: Annotated[float, typer.Option(min=0.05, max=1, help="Steering of a key.")] = 0.8,
    assume: Annotated[
        bool, typer.Option("--assume", help=f"It is a board that does not say that it drives. {RISK}")
    ] = False,
    *,
    target: Target,
) -> int:
    """Drive a robot with the keys of this terminal, which it prints. What interrupts a drive ends it: press again.

    \b
        pebble drive goob.json
    """
    if not has_terminal():
        raise PebbleError(
            "driving by keys needs a terminal of Linux or macOS: use `pebble web`, or in a program `pebble topic pub "
            "drive-values`"
        )
    target = target_of(robot, target)
    with connected(target) as (transport, names):
        by, device = me(names.account), f"terminal on {socket.gethostname()}"
        heartbeat = target.remote or str(target.url).startswith("mqtt")  # within a robot there is none
        driver = TerminalDriver(
            names.base, by=by, device=device, speed=speed, turn=turn, heartbeat=heartbeat, assume=assume
        )
        # A robot that takes only commands with the sender's account in the topic says so, after it was subscribed to.
        put_account_into_topics(transport, names, lambda base: base == names.base and driver.robot.named)
        with opened(f"{_KEYS}\n") as terminal:
            _drive(transport, driver, terminal)
    if driver.unconfirmed:
        typer.echo(f"pebble: the emergency stop of {driver.name} is NOT CONFIRMED", err=True)
    return 0 if terminal.ended in ("SIGINT", "SIGTERM", END) and not driver.unconfirmed else 1


def _drive(transport: Transport, driver: TerminalDriver, terminal: Terminal) -> None:
    """Pass keys and messages to the driver, and its commands to the transport, until the terminal ends."""
    arrived = deque[tuple[Message, float, float]](maxlen=_ARRIVED)

    def receive(message: Message) -> None:
        arrived.append((message, clock(), time.time()))

    def tick() -> None:
        while arrived:
            driver.receive(*arrived.popleft())
        for message in driver.tick(clock(), problem_of(transport)):
            transport.publish(message.topic, message.payload, qos=message.qos, urgent=True)

    transport.subscribe_all(dict.fromkeys(driver.filters, receive), qos=QoS.DELIVERED, direct=True)
    try:
        while not terminal.ended:
            keys = terminal.keys(PERIOD_S)
            driver.press(keys, clock())
            tick()
            terminal.show(driver.status, at_once=bool(keys))
    finally:
        began = clock()
        driver.end(began, leave=True)
        tick()
        if driver.unconfirmed:
            terminal.show(lambda: f"{driver.name}: the emergency stop is sent for {_STOP_S:g} s more", at_once=True)
        while clock() < began + (_STOP_S if driver.unconfirmed else _ZEROS_S):
            tick()
            time.sleep(PERIOD_S)
