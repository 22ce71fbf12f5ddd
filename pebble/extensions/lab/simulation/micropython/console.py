"""Standard input and output of a simulated board, which are its USB serial port on a real one."""

from collections.abc import Callable
from typing import Any

from pebble.extensions.lab.simulation.micropython.modules.streams import POLLIN, POLLOUT

_FULL_WAIT_S = 0.5  # how long MicroPython waits for room in the USB buffer before it gives up
_BUFFER = 256  # bytes that the board buffers for a host that does not read


class Console:
    """The serial port of a board. The host sends with ``type`` and receives with ``take_output``.

    ``interrupt`` is the byte that stops the program (Ctrl-C), -1 for none: micropython.kbd_intr. With ``reading`` off,
    the host has the port open but reads nothing: the board's buffer fills up, and then each write takes half a second
    and loses its data, as with a real USB port.
    """

    def __init__(self, pause: Callable[[float], None], wait: Callable[[], None]) -> None:
        self.interrupt = 3
        self.reading = True
        self.lost = 0  # bytes
        self._pause, self._wait = pause, wait  # the board's: for some seconds, and until there is input
        self.typed = bytearray()  # what the firmware has not read yet
        self._output = bytearray()
        self.is_interrupted = False

    def reset(self) -> None:
        """Return to the state after a reset: Ctrl-C is enabled, and the input is empty."""
        self.interrupt = 3
        self.typed.clear()
        self.is_interrupted = False

    def type(self, data: bytes) -> None:
        """Send data from the host to the board."""
        if self.interrupt >= 0 and self.interrupt in data:
            self.is_interrupted = True
            data = data[data.rindex(self.interrupt) + 1 :]
            self.typed.clear()
        self.typed += data

    def take_output(self) -> bytes:
        """Return the board's output since the last call."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def check_interrupt(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C was received. Called wherever the firmware checks its input."""
        if self.is_interrupted:
            self.is_interrupted = False
            raise KeyboardInterrupt

    def take(self, count: int) -> bytearray:
        """Return the next ``count`` bytes of input, once they have come. Raises KeyboardInterrupt at Ctrl-C."""
        self.check_interrupt()
        typed = self.typed
        while len(typed) < count:
            self._wait()
            self.check_interrupt()
        chunk = typed[:count]
        del typed[:count]
        return chunk

    def write(self, data: Any) -> int:
        """Write to the host; return how many bytes it has received, or will receive."""
        if not self.reading:
            room = max(0, _BUFFER - len(self._output))
            if len(data) > room:
                self._pause(_FULL_WAIT_S)
                self.lost += len(data) - room
                data = data[:room]
        self._output += data
        return len(data)

    def writable(self) -> bool:
        return len(self._output) < _BUFFER


class Input:
    """The board's sys.stdin: text, with ``buffer`` for bytes; both can be polled."""

    def __init__(self, console: Console, *, text: bool = True, buffer: bool = True) -> None:
        self._console, self._text = console, text
        if buffer and text:
            self.buffer = Input(console, text=False)

    def ready(self, mask: int) -> int:
        console = self._console
        if console.is_interrupted:
            console.check_interrupt()
        return mask & POLLIN if console.typed else 0

    def read(self, count: int) -> Any:
        """Read exactly ``count``, and wait for them as MicroPython does."""
        data = self._take(count)
        return data.decode() if self._text else bytes(data)

    def readinto(self, buffer: bytearray | memoryview) -> int:
        buffer[:] = self._take(len(buffer))
        return len(buffer)

    def _take(self, count: int) -> bytearray:
        data = self._console.take(count)
        return data.replace(b"\r", b"\n") if self._text else data


class Output:
    """The board's sys.stdout: text, with ``buffer`` for bytes; both can be polled."""

    def __init__(self, console: Console, *, text: bool = True, buffer: bool = True) -> None:
        self._console, self._text = console, text
        if buffer and text:
            self.buffer = Output(console, text=False)

    def ready(self, mask: int) -> int:
        console = self._console
        return mask & POLLOUT if console.reading or console.writable() else 0

    def write(self, data: Any, start: int = 0, length: int | None = None) -> int:
        """Write, as ``write(data)`` or ``write(data, offset, length)``; return how much of ``data`` was written.

        Text counts as written, even if the host reads nothing.
        """
        data = data if length is None else data[start : start + length]
        if not self._text:
            return self._console.write(data)
        raw = data.encode() if isinstance(data, str) else bytes(data)
        self._console.write(raw.replace(b"\n", b"\r\n"))
        return len(data)
