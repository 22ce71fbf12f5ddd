"""The floor: the same commands to a stock client, one hop through a stock broker that carries nothing else."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Self

from pebble.bench.bridge_drive import RATE_HZ, Found, Stretch
from pebble.bench.bridge_observer import Observer
from pebble.bench.bridge_operator import Operator, Wheels
from pebble.contract import DRIVE
from pebble.demo.broker import Broker, BrokerKind
from pebble.demo.programs import end_all

HOP = "one hop"
_NOBODY = "pebble/robots/nobody"
_ARRIVE_S = 1.0
_LOOK_S = 0.02
_END_S = 2.0


class Hop:
    """Drives and is looked up as a robot is."""

    kind = HOP

    def __enter__(self) -> Self:
        """Raises PebbleError if something does not start."""
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pbl-")))
            broker = Broker("hop", BrokerKind.MOSQUITTO, folder)
            stack.callback(end_all, [broker.program], _END_S)
            broker.wait(threading.Event())
            observer = Observer(broker.port, DRIVE.topic(_NOBODY), folder / "observer.log")
            self._observer = stack.enter_context(observer)
            self._operator = stack.enter_context(closing(Operator(broker.port, _NOBODY)))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def drive(self, seconds: float) -> Stretch:
        began = time.monotonic_ns()
        sent = self._operator.drive(seconds, RATE_HZ)
        return Stretch(began, time.monotonic_ns(), sent)

    def look_up(self, stretches: Sequence[Stretch]) -> list[Found]:
        """As :func:`pebble.bench.bridge_drive.look_up` does."""
        heard: dict[Wheels, int] = {}
        end = time.monotonic() + _ARRIVE_S
        while True:
            late = time.monotonic() > end
            heard |= self._observer.heard()
            if late or list(stretches[-1].sent)[-1] in heard:
                return [_found(stretch, heard) for stretch in stretches]
            time.sleep(_LOOK_S)


def _found(stretch: Stretch, heard: dict[Wheels, int]) -> Found:
    down = [(heard[speeds] - sent) / 1e6 for speeds, sent in stretch.sent.items() if speeds in heard]
    return Found(down, sent=len(stretch.sent))
