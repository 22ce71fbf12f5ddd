"""Judges the silence of a board on a serial line. Pure."""

from pebble.services.serial_mcu_bridge.line.serial_line import LineState

CHECK_S = 1.0
_RECENT_S, _SILENT_S = 1.0, 10.0
_REGULAR = 5  # checks in a row; our motor boards report at least twice a second, also at rest


class Silence:
    """A watch for silence. Call :meth:`check` about once a second, and when the state of the line changes.

    A board that has sent data unasked in five checks in a row, while nothing was sent to it, is known to report at
    rest: if it becomes silent, it or its wires have failed. Other boards may be silent by design.
    """

    def __init__(self) -> None:
        self._opened = 0  # how often the line was opened, at the last check
        self._received = 0  # how many messages had come, at the last check
        self._received_at: float | None = None  # when a message last came; None: none since the line was opened
        self._counted_at = 0.0  # when ``_unasked`` was last updated
        self._unasked = 0  # checks in a row in which data had come unasked

    def check(self, state: LineState, opened: int, received: int, now: float, *, idle: bool) -> tuple[str, int | None]:
        """Return the line's state, and how long the board has been silent: at least 0, 1000 or 10000 ms.

        ``opened`` counts openings; ``received`` counts the protocol's messages since the last opening; ``idle``:
        nothing was sent to the board for a second.
        """
        if opened != self._opened:
            self._opened, self._received, self._received_at, self._unasked = opened, 0, None, 0
        has_sent = received != self._received
        self._received = received
        if has_sent:
            self._received_at = now
        if self._unasked < _REGULAR and now - self._counted_at >= 0.9 * CHECK_S:  # sooner it is an extra check
            self._counted_at = now
            self._unasked = self._unasked + 1 if has_sent and idle else 0
        if self._received_at is None or state is not LineState.READY:
            return state.value, None
        age_s = now - self._received_at
        if age_s >= _SILENT_S:
            return ("silent" if self._unasked >= _REGULAR else state.value), 10_000
        return state.value, (0 if age_s < _RECENT_S else 1_000)
