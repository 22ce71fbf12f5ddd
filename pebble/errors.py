"""The exceptions that Pebble raises."""


class PebbleError(Exception):
    """The base class. Only the command line and the outermost lines of a process catch it; users read its text."""


class ConfigError(PebbleError):
    """The mistakes in a config file. ``problems`` holds a line for each, with its JSON path.

    Example: ``services.mqtt_bridge.heartbeet: unknown key, did you mean "heartbeat"?``
    """

    def __init__(self, problems: list[str] | str) -> None:
        self.problems = [problems] if isinstance(problems, str) else list(problems)
        super().__init__("\n".join(self.problems))


class TransportError(PebbleError):
    """A topic, filter or payload that no transport may carry, or a transport that cannot be made.

    A lost connection is *not* an error: transports connect again, and their state shows it.
    """


class PayloadError(PebbleError):
    """A payload that does not follow its channel's contract. Example: ``drive-values: x is NaN``."""


class DeviceError(PebbleError):
    """A serial line, camera or other device that cannot be opened or has stopped answering."""


class NotRunningError(DeviceError):
    """An error for a device that is simulated by a program which does not run; it may be started later."""
