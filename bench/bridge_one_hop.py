"""The lower bound: the same commands to a stock client, one hop through a stock broker without other traffic.

As a process: ``python -m pebble.bench.bridge_one_hop PORT TOPIC`` is the client. It writes one line once it is
subscribed, and answers every line with the commands since the last one.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from paho.mqtt.client import MQTTMessage

from pebble.bench.bridge_drive import RATE_HZ, Arrived, DriveSegment
from pebble.bench.bridge_operator import Operator, Wheels, wheels_of
from pebble.contract import DRIVE
from pebble.rig.processes import Processes
from pebble.rig.stock_client import StockClient
from pebble.rig.worker_end import answer, serve

HOP = "one hop"
_BASE = "pebble/robots/one-hop"
_START_S = 15.0
_ANSWER_S = 5.0
_ARRIVE_S = 1.0
_POLL_S = 0.02


class OneHop(Processes):
    """Has the same methods as :class:`DrivenRobot`."""

    kind = HOP

    def start(self) -> None:
        """Raises PebbleError if something does not start."""
        broker = self.broker("hop")
        broker.wait()
        self._subscriber = self.worker("the subscriber", "pebble.bench.bridge_one_hop", broker.port, DRIVE.topic(_BASE))
        self._subscriber.answer(_START_S)
        self._operator = Operator(broker.port, _BASE)
        self.closing.callback(self._operator.close)

    def drive(self, seconds: float) -> DriveSegment:
        began = time.monotonic_ns()
        sent = self._operator.drive(seconds, RATE_HZ)
        return DriveSegment(began, time.monotonic_ns(), sent)

    def match_arrivals(self, segments: Sequence[DriveSegment]) -> list[Arrived]:
        """See :meth:`DrivenRobot.match_arrivals`."""
        received: dict[Wheels, int] = {}
        end = time.monotonic() + _ARRIVE_S
        while True:
            late = time.monotonic() > end
            new = self._subscriber.ask("", _ANSWER_S)["received"]
            received |= {(left, right): ns for left, right, ns in new}
            if late or list(segments[-1].sent)[-1] in received:
                return [_found(segment, received) for segment in segments]
            time.sleep(_POLL_S)


def _found(segment: DriveSegment, received: dict[Wheels, int]) -> Arrived:
    down = [(received[speeds] - sent) / 1e6 for speeds, sent in segment.sent.items() if speeds in received]
    return Arrived(down, sent=len(segment.sent))


def main(arguments: list[str]) -> int:
    port, topic = arguments
    received: list[tuple[int, bytes]] = []

    def receive(message: MQTTMessage) -> None:
        if not message.payload.isspace():  # else a bridge's probe
            received.append((time.monotonic_ns(), bytes(message.payload)))

    def take(_line: str) -> dict[str, Any]:
        new = received.copy()
        del received[: len(new)]
        return {"received": [[*wheels_of(payload), ns] for ns, payload in new]}

    client = StockClient(receive, [(topic, DRIVE.default_qos)], at_once=False).open(int(port))
    client.wait()
    answer({"subscribed": True})
    serve(take)
    client.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
