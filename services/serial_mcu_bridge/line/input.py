"""What comes from a serial device: how much, when last, and whether the device may have stopped reading."""

UNREAD_S = 1.0  # without a report, from a board that reports at rest


class Input:
    """A pseudo-terminal hides how much its reader has left unread, so a silent device behind one may obey late."""

    def __init__(self) -> None:
        self.reports_at_rest = False  # set by the owner, who knows the protocol
        self.received = 0  # chunks of bytes from the device since it was opened and has booted
        self.unread = 0  # drive lines that were not sent, because earlier ones were probably not read
        self.stopped = False  # one stop was sent in their place
        self.at = 0.0  # when the device last sent something, or was ready, in monotonic seconds

    def begin(self, now: float) -> None:
        """Start to wait for the first bytes of a device that is ready."""
        self.at, self.stopped = now, False

    def receive(self, now: float) -> None:
        self.received += 1
        self.at, self.stopped = now, False
