"""A simulated MiniLAMP or BenJr as a program: ``python -m pebble.simulation.networked --kind benjr --broker HOST``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from pebble.config.hosts import HostError, split
from pebble.config.security import Security
from pebble.config.text_files import PASSWORD, password
from pebble.contract.identity import Identity
from pebble.errors import ConfigError, PebbleError
from pebble.simulation.fleet import ConnectionReporter, Fleet
from pebble.simulation.mcu import Snapshot
from pebble.simulation.trace import Trace, motors_entry
from pebble.simulation.wireless import KINDS, BrokerAddress, Motors, WirelessRobot

_MOVING_S = 0.01  # period of turns while motors run and sockets are idle
_PORT, _TLS_PORT = 1883, 8883


class StopSignal:
    """Records SIGTERM, SIGINT or SIGHUP, which interrupt nothing."""

    def __init__(self) -> None:
        self.received = False
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._receive)

    def _receive(self, *_: object) -> None:
        self.received = True


def main(arguments: list[str] | None = None) -> int:
    """Run until a signal, or until the reader of the report closes the pipe."""
    options = _parser().parse_args(arguments)
    try:
        broker = broker_address(options)
        identity = Identity("pebble", "robots", options.id or options.kind)
        files, trace = options.files, options.trace
        return run(options.kind, identity, broker, name=options.name, trace=trace, report=options.report, files=files)
    except PebbleError as error:
        sys.stderr.write(f"{error}\n")
        return 1


def run(
    kind: str,
    identity: Identity,
    broker: BrokerAddress,
    *,
    name: str = "",
    security: Security | None = None,
    trace: Path | None = None,
    report: bool = False,
    files: Path | None = None,
) -> int:
    """Run one robot until a signal; ``name``: what people call it. ``security``: of its config; None: open."""
    stop_signal = StopSignal()
    record = Trace(trace)
    with Fleet(broker) as fleet:
        options = {"name": name, "security": security or Security(), "files": files}
        robot = fleet.add(kind, identity, moving_s=_MOVING_S, on_motors=_recorder(record), **options)
        reporter = ConnectionReporter([robot], lambda line: print(line, file=sys.stderr, flush=True))  # noqa: T201

        def job() -> None:
            reporter.poll()
            if report and not _report(robot):
                stop_signal.received = True

        fleet.run(lambda: not stop_signal.received, job)
    record.close()
    return 0


def broker_address(options: argparse.Namespace) -> BrokerAddress:
    """Make the broker's address from the options. Raises ConfigError."""
    tls = options.tls or options.ca is not None
    try:
        named = split(options.broker)
    except HostError as error:
        raise ConfigError(f"--broker must be HOST or HOST:PORT: it {error}") from None
    if named.scheme or named.user is not None or named.rest:
        raise ConfigError("--broker must be HOST or HOST:PORT, and nothing else")
    return BrokerAddress(
        host=named.host,
        port=named.port or (_TLS_PORT if tls else _PORT),
        username=options.username,
        password=password(options.password_file) if options.username else None,
        tls=tls,
        ca=options.ca,
    )


def _recorder(trace: Trace) -> Callable[[float, Motors], None]:
    return lambda now, motors: trace.add(motors_entry(int(now * 1e9), motors))


def _report(robot: WirelessRobot) -> bool:
    snapshot = Snapshot(time.monotonic_ns(), robot.network.radio.connected, robot.online, robot.state())
    try:
        os.write(sys.stdout.fileno(), msgspec.json.encode(snapshot) + b"\n")
    except BrokenPipeError:  # the reader has closed the pipe
        return False
    return True


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m pebble.simulation.networked", description=__doc__)
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument("--id", help="the robot's id; by default its kind")
    parser.add_argument("--name", default="", help="what people call it")
    parser.add_argument("--trace", type=Path, help="file to append every change of the motors to, with its time")
    parser.add_argument("--files", type=Path, help="folder of the board's files, which survive the program")
    parser.add_argument("--report", action="store_true", help="write the state to standard output at 10 Hz")
    add_broker_options(parser)
    return parser


def add_broker_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--broker", required=True, metavar="HOST[:PORT]")
    parser.add_argument("--username")
    parser.add_argument("--password-file", type=Path, help=f"by default the password is ${PASSWORD}")
    parser.add_argument("--tls", action="store_true", help="TLS without verifying the broker's certificate")
    parser.add_argument("--ca", type=Path, help="certificate of the authority that signed the broker's; enables TLS")


if __name__ == "__main__":
    sys.exit(main())
