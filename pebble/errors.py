"""The exceptions that Pebble raises."""


class PebbleError(Exception):
    """Base class. Only the CLI and the outermost lines of a process catch it; its text is the message a user reads."""


class ConfigError(PebbleError):
    """A config file is wrong. ``problems`` holds one line per mistake, each with its JSON path.

    Example: ``services.mqtt_bridge.heartbeet: unknown key, did you mean "heartbeat"?``
    """

    def __init__(self, problems: list[str] | str) -> None:
        self.problems = [problems] if isinstance(problems, str) else list(problems)
        super().__init__("\n".join(self.problems))


class TransportError(PebbleError):
    """A topic, filter or payload that no transport may carry, or a transport that cannot be set up at all.

    A lost connection is *not* an error: transports reconnect by themselves, and their state shows it.
    """


class PayloadError(PebbleError):
    """A payload does not follow its channel's contract. Example: ``drive-values: x is NaN``."""


class DeviceError(PebbleError):
    """A serial line, camera or other device cannot be opened or stopped answering."""


class NotRunningError(DeviceError):
    """The program that plays a device's part does not run; it may be started later."""
