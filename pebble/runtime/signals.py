"""An event that is set by the signals that end a program."""

import select
import signal

from pebble.transports.wakeup import WakeupPipe

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # the last one is unknown to Windows


def ending_signals() -> list[signal.Signals]:
    """Return the signals that end a program on this system; without SIGHUP if that is ignored, as under nohup."""
    numbers = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    return [number for number in numbers if number.name != "SIGHUP" or signal.getsignal(number) is not signal.SIG_IGN]


class EndSignal:
    """An event that a signal, or :meth:`set`, sets for good. Make it on the main thread.

    A threading.Event does not do: a signal handler may interrupt a wait for that event, which holds the event's lock,
    and would wait for ever. And a signal that arrives on a library's thread does not interrupt a wait on the main
    thread; a byte in the pipe does.
    """

    def __init__(self) -> None:
        self._wakeup = WakeupPipe()
        signal.set_wakeup_fd(self._wakeup.set_fileno, warn_on_full_buffer=False)
        for number in ending_signals():
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda *_: self.set())

    def set(self) -> None:
        self._wakeup.set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait up to ``timeout`` seconds; True if the event is set."""
        return bool(select.select([self._wakeup], [], [], timeout)[0])
