"""A simulated MCU behind a real pseudo terminal, which the host uses as a serial port."""

import errno
import os
import select
import threading
import time
import tty
from contextlib import suppress
from pathlib import Path
from typing import Self

from pebble.errors import DeviceError
from pebble.extensions.lab.simulation.board import SimulatedMcu
from pebble.extensions.lab.simulation.bodies import Pair
from pebble.extensions.lab.simulation.motion import Pose, RobotMotion
from pebble.extensions.lab.simulation.trace import Entry, Event, Trace, motors_entry
from pebble.runtime.lines import LineSplitter

_NO_HOST_S = 0.005  # a master whose slave is closed is always "ready", so it is polled with this period
_LATE_S = 0.03  # that a turn of the MCU may come after its time
_END_S = 5.0
_CHUNK = 65_536
_TRACED_LINE = 4096  # bytes; far longer than any line that the MCU accepts


class _Recorder:
    """A recorder of the lines that pass the port, in a trace."""

    def __init__(self, trace: Trace, *, is_text: bool, output: bool) -> None:
        self._trace = trace
        self._received = LineSplitter(_TRACED_LINE) if is_text else None
        self._sent = LineSplitter(_TRACED_LINE) if is_text and output else None

    def event(self, event: Event) -> None:
        self._trace.add(Entry(time.monotonic_ns(), event))

    def received(self, ns: int, data: bytes) -> None:
        if self._received is not None:
            self._add(ns, "line", self._received.feed(data))

    def sent(self, ns: int, data: bytes, *, whole: bool) -> None:
        """Note the data that the host gets; not ``whole``: the rest of what was to be sent is lost."""
        if self._sent is not None:
            self._add(ns, "said", self._sent.feed(data))
            if not whole:
                self._sent.reset()  # the host never gets the rest of this line

    def _add(self, ns: int, event: Event, lines: list[bytes]) -> None:
        for line in lines:
            if text := line.strip().decode("utf-8", "backslashreplace"):  # blank lines are not recorded
                self._trace.add(Entry(ns, event, text))


class PtyMcu:
    """A SimulatedMcu with its pty, the thread that runs both, and ``symlink``, the stable path of the port.

    The symlink's folder must exist; only a symlink is replaced. Unplugging closes the pty but leaves the MCU powered:
    its motors stop by failsafe, as on a robot whose MCU is powered by the battery. Each replug makes a new pty behind
    the same symlink. ``motion`` is the robot's motion, used by this object alone. The file ``trace`` also tells when
    the MCU was late; with ``trace_output`` it has the MCU's own lines that the host received.
    """

    def __init__(
        self,
        kind: str,
        symlink: Path,
        *,
        trace: Path | None = None,
        trace_output: bool = False,
        motion: RobotMotion | None = None,
    ) -> None:
        self.symlink = symlink
        self.trace = Trace(trace)
        self.dropped = 0  # bytes of the MCU that no host received
        self._traces_late = trace is not None
        self._lock = threading.RLock()  # of everything below
        self._mcu = SimulatedMcu(kind, time.monotonic(), motion=motion, on_motors=self._moved)
        self._tick_s = self._mcu.profile.tick_s
        self._recorder = _Recorder(self.trace, is_text=self._mcu.profile.is_text, output=trace_output)
        self._master: int | None = None  # the MCU's end of the pty; None while it is unplugged
        self._tty = ""  # the path of the host's end
        self.host = False  # a program has the port open
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"pebble-sim {kind}", daemon=True)

    def open(self) -> Self:
        """Power on and plug in; the port exists when this returns. Raises DeviceError if it cannot be created."""
        try:
            self.replug()
        except OSError as error:
            raise DeviceError(f"cannot create a serial port at {self.symlink}: {error.strerror}") from None
        self._thread.start()
        return self

    def close(self) -> None:
        """Unplug, remove the symlink and end the thread. The trace stays readable."""
        self.unplug()
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)
        self.trace.close()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def unplug(self) -> None:
        """Close the pty and remove the symlink, as pulling the USB plug does."""
        with self._lock:
            if self._master is None:
                return
            # another simulation may have replaced it
            if self.symlink.is_symlink() and self.symlink.readlink() == Path(self._tty):
                self.symlink.unlink()
            os.close(self._master)
            self._master, self.host = None, False
            self._recorder.event("unplugged")

    def replug(self) -> None:
        """Make a pty, and let the symlink lead to it. Raises OSError if the symlink cannot be made."""
        with self._lock:
            if self._master is not None:
                return
            if self.symlink.exists() and not self.symlink.is_symlink():
                raise FileExistsError(errno.EEXIST, "the path exists and is not a symlink")
            new = self.symlink.with_name(self.symlink.name + ".new")
            new.unlink(missing_ok=True)
            master, slave = os.openpty()
            tty.setraw(slave)  # at once: the terminal's echo would send the MCU its own reports as commands
            os.set_blocking(master, False)
            self._master, self._tty = master, os.ttyname(slave)
            os.close(slave)
            new.symlink_to(self._tty)
            self._recorder.event("plugged")
            new.replace(self.symlink)

    def reset(self) -> None:
        """Reboot the MCU, as its reset button does."""
        with self._lock:
            self._mcu.boot(time.monotonic())

    def charge(self, on: bool) -> None:
        """Put the robot on its charger, or take it off."""
        with self._lock:
            self._mcu.battery.charging = on

    def place(self, pose: Pose) -> None:
        """Lift the robot and put it down at ``pose``."""
        with self._lock:
            self._mcu.motion.place(pose)

    @property
    def pose(self) -> Pose:
        """The true pose of the robot."""
        with self._lock:
            self._mcu.body.advance()
            return self._mcu.motion.pose

    # -- the MCU's thread

    def _run(self) -> None:
        read_at = time.monotonic()
        while not self._ending.is_set():
            self._wait()
            with self._lock:
                last_read_at, read_at = read_at, time.monotonic()
                pause_s = read_at - last_read_at
                if self._traces_late and pause_s > self._tick_s + _LATE_S:
                    self.trace.add(Entry(round(read_at * 1e9), "late", f"{pause_s:.3f}"))
                if self._master is not None:
                    self._poll_host(self._master)
                self._transmit(self._mcu.tick(time.monotonic()))

    def _wait(self) -> None:
        """Wait for data from the host, or for the next tick."""
        if self.host and self._master is not None:
            with suppress(OSError, ValueError):  # it is unplugged meanwhile
                select.select([self._master], [], [], self._tick_s)
        else:
            time.sleep(self._tick_s if self._master is None else min(self._tick_s, _NO_HOST_S))

    def _poll_host(self, master: int) -> None:
        """Receive from the host, and note when a program opens or closes the port.

        A pty hangs up while no program has it open, also before the first one. The data of a program that has closed it
        are read first: they may be all that shows that it was open.
        """
        poller = select.poll()
        poller.register(master, select.POLLIN)
        events = poller.poll(0)
        has_data = bool(events and events[0][1] & select.POLLIN)
        hung_up = bool(events and events[0][1] & select.POLLHUP)
        if (has_data or not hung_up) and not self.host:
            self.host = True
            self._recorder.event("opened")
        if has_data:
            self._receive(master)
        elif hung_up and self.host:
            self.host = False
            self._recorder.event("closed")

    def _receive(self, master: int) -> None:
        try:
            data = os.read(master, _CHUNK)
        except OSError:  # the host has just closed the port
            return
        arrived = time.monotonic_ns()
        self._recorder.received(arrived, data)
        self._transmit(self._mcu.receive(data, arrived / 1e9))

    def _transmit(self, data: bytes) -> None:
        """Write to the host. As with a USB device, data that no host receives is lost."""
        if not data:
            return
        sent, began = 0, time.monotonic_ns()
        if self.host and self._master is not None:
            with suppress(OSError):  # the host's buffer is full, or it has just closed
                sent = os.write(self._master, data)
        self.dropped += len(data) - sent
        self._recorder.sent(began, data[:sent], whole=sent == len(data))

    def _moved(self, now: float, motors: Pair) -> None:
        self.trace.add(motors_entry(round(now * 1e9), motors))
