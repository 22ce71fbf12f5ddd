"""A simulated MCU behind a real pseudo terminal: for the host it is a serial port like any other."""

from __future__ import annotations

import errno
import logging
import os
import queue
import select
import threading
import time
import tty
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from pebble.errors import LinkError
from pebble.services.serial_mcu_bridge.splitter import LineSplitter
from pebble.simulation.board import BoardState, SimulatedMcu
from pebble.simulation.bodies import Pair
from pebble.simulation.micropython.board import UID
from pebble.simulation.trace import Entry, Event, Trace, motors_entry

log = logging.getLogger(__name__)

_NO_HOST_S = 0.005  # a master whose slave is closed is always "ready", so it has to be asked now and then
_ANSWER_S = 5.0
_CHUNK = 65_536
_TRACED_LINE = 4096  # bytes; far longer than any line the MCU itself would take

T = TypeVar("T")


class PtyMcu:
    """A SimulatedMcu, its pty, the thread they live on, and a stable ``link`` to the pty as the path of the port.

    The symlink's folder must exist; only a symlink is replaced. Unplugging takes the link to the host away, not the
    MCU's power: its motors stop by failsafe, as on a robot whose MCU hangs on the battery. Each replug makes a new pty
    behind the same symlink. With ``trace_said`` the trace also has what the host took of the MCU's own lines.
    """

    def __init__(
        self,
        kind: str,
        link: Path,
        *,
        trace: Path | None = None,
        trace_said: bool = False,
        failsafe_s: float | None = None,
        charging: bool = False,
        uid: bytes = UID,
    ) -> None:
        self.link = link
        self.trace = Trace(trace)
        self.dropped = 0  # bytes of the MCU that no host took
        self._mcu = SimulatedMcu(
            kind, time.monotonic(), failsafe_s=failsafe_s, charging=charging, uid=uid, on_motors=self._moved
        )
        self._tick_s = self._mcu.profile.tick_s
        is_text = self._mcu.profile.is_text
        self._splitter = LineSplitter(_TRACED_LINE) if is_text else None
        self._said = LineSplitter(_TRACED_LINE) if is_text and trace_said else None
        self._master: int | None = None
        self._tty = ""
        self._host = False
        self._ending = False
        self._requests: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = queue.SimpleQueue()
        self._awake, self._waker = os.pipe()
        os.set_blocking(self._awake, False)
        self._thread = threading.Thread(target=self._run, name=f"pebble-sim {kind}", daemon=True)

    def open(self) -> Self:
        """Power on and plug in; the port exists when this returns. Raises LinkError if it cannot be put there."""
        self._thread.start()
        try:
            self.replug()
        except OSError as error:
            self.close()
            raise LinkError(f"there can be no serial port at {self.link}: {error.strerror}") from None
        return self

    def close(self) -> None:
        """Unplug, and leave neither a symlink nor a thread. The trace stays readable."""
        if self._ending:
            return
        self.unplug()
        self._ask(self._end)
        self._thread.join(_ANSWER_S)
        self.trace.close()
        os.close(self._awake)
        os.close(self._waker)

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def unplug(self) -> None:
        """Take the device away from under the host's hands."""
        self._ask(self._unplug)

    def replug(self) -> None:
        self._ask(self._replug)

    def reset(self) -> None:
        """Boot the MCU anew, as its button does."""
        self._ask(lambda: self._mcu.boot(time.monotonic()))

    def charge(self, on: bool) -> None:
        """Put the robot on its charger, or take it off."""
        self._ask(lambda: setattr(self._mcu.battery, "charging", on))

    def disturb(self, on: bool) -> None:
        """Make the devices on the board's I2C bus fail, or work again."""
        self._ask(lambda: self._mcu.disturb(on))

    def state(self) -> BoardState:
        return self._ask(self._mcu.state)

    @property
    def plugged(self) -> bool:
        return self._master is not None

    @property
    def host(self) -> bool:
        """Whether a program has the port open."""
        return self._host

    def _ask(self, job: Callable[[], T]) -> T:
        """Have ``job`` done on the MCU's thread: nothing else ever touches the pty."""
        if not self._thread.is_alive():
            raise LinkError(f"the simulated MCU at {self.link} is not running")
        answer: Future[T] = Future()
        self._requests.put((answer, job))
        os.write(self._waker, b"!")
        return answer.result(_ANSWER_S)

    # -- the MCU's thread

    def _run(self) -> None:
        while not self._ending:
            self._wait()
            if self._master is not None:
                self._listen(self._master)
            self._transmit(self._mcu.tick(time.monotonic()))
            self._answer()

    def _wait(self) -> None:
        """Until the host wrote, somebody asks, or time has to pass on the board."""
        watched = [self._awake]
        if self._host and self._master is not None:
            watched.append(self._master)
        unasked = self._master is not None and not self._host
        ready, _, _ = select.select(watched, [], [], min(self._tick_s, _NO_HOST_S) if unasked else self._tick_s)
        if self._awake in ready:
            with suppress(BlockingIOError):
                os.read(self._awake, _CHUNK)

    def _listen(self, master: int) -> None:
        poller = select.poll()
        poller.register(master, select.POLLIN)
        events = poller.poll(0)
        has_data = bool(events and events[0][1] & select.POLLIN)
        hung_up = bool(events and events[0][1] & select.POLLHUP)
        if (has_data or not hung_up) and not self._host:
            self._host = True
            self._note("opened")
        if has_data:
            self._receive(master)
        elif hung_up and self._host:
            self._host = False
            self._note("closed")

    def _receive(self, master: int) -> None:
        try:
            data = os.read(master, _CHUNK)
        except OSError:  # hung up in this very moment
            return
        arrived = time.monotonic_ns()
        if self._splitter is not None:
            self._record(arrived, "line", self._splitter.feed(data))
        self._transmit(self._mcu.receive(data, arrived / 1e9))

    def _transmit(self, data: bytes) -> None:
        """As a USB device does: what no host takes is lost."""
        if not data:
            return
        sent, began = 0, time.monotonic_ns()
        if self._host and self._master is not None:
            with suppress(OSError):  # the host's buffer is full, or it has just closed
                sent = os.write(self._master, data)
        self.dropped += len(data) - sent
        if self._said is not None:
            self._record(began, "said", self._said.feed(data[:sent]))
            if sent < len(data):
                self._said.reset()  # the host never gets the rest of this line

    def _answer(self) -> None:
        with suppress(queue.Empty):
            while True:
                answer, job = self._requests.get_nowait()
                try:
                    answer.set_result(job())
                except OSError as error:
                    answer.set_exception(error)

    def _replug(self) -> None:
        if self._master is not None:
            return
        if self.link.exists() and not self.link.is_symlink():
            raise FileExistsError(errno.EEXIST, "there is something else")
        new = self.link.with_name(self.link.name + ".new")
        new.unlink(missing_ok=True)
        master, slave = os.openpty()
        tty.setraw(slave)  # before anybody reads: the terminal's echo would command the MCU with its own reports
        os.set_blocking(master, False)
        self._master, self._tty = master, os.ttyname(slave)
        os.close(slave)
        new.symlink_to(self._tty)
        self._note("plugged")
        new.replace(self.link)

    def _unplug(self) -> None:
        if self._master is None:
            return
        if self.link.is_symlink() and self.link.readlink() == Path(self._tty):  # else another simulation took it over
            self.link.unlink()
        os.close(self._master)
        self._master, self._host = None, False
        self._note("unplugged")

    def _end(self) -> None:
        self._ending = True

    def _moved(self, now: float, motors: Pair) -> None:
        self.trace.add(motors_entry(round(now * 1e9), motors))

    def _record(self, ns: int, event: Event, lines: list[bytes]) -> None:
        for line in lines:
            if text := line.strip().decode("utf-8", "backslashreplace"):  # blank lines say nothing
                self.trace.add(Entry(ns, event, text))

    def _note(self, event: Event) -> None:
        self.trace.add(Entry(time.monotonic_ns(), event))
