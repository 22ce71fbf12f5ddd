"""The scripts of a robot, as its autonomy_manager publishes them, and commands to start and stop them."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from pebble.contract import AUTONOMY_COMMAND, AUTONOMY_FILES, AUTONOMY_STATUS, CAPABILITIES, LINK, STATUS, codec
from pebble.contract.payloads import AutonomyCommand, AutonomyStatus
from pebble.errors import PayloadError, PebbleError
from pebble.extensions.operator.client import forms
from pebble.extensions.operator.client.names import Names
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message, QoS, Transport

_BYTES = 512 * 1024  # of a list of scripts
_RECEIVED = (CAPABILITIES, LINK, STATUS, AUTONOMY_FILES, AUTONOMY_STATUS)
_STARTS_S = 5.0  # that a script may take until its status shows it

Entry = dict[str, Any]


class RobotScripts:
    """The scripts that a robot offers, and the running one. Other threads may read while it receives."""

    def __init__(self, names: Names) -> None:
        self.robot = RobotView(names.base)
        self.files: dict[str, Entry] | None = None  # by name; None: the robot has not published any list
        self.answers = 0  # new statuses that were not retained: answers to commands
        self._channels = {names.topic(channel.metric): channel for channel in _RECEIVED}
        self._command_topic = names.topic(AUTONOMY_COMMAND.metric)

    @property
    def status(self) -> AutonomyStatus | None:
        """Return the newest status; None if there is none."""
        return self.robot.autonomy

    @property
    def answer_s(self) -> float:
        """Return how long to wait for another status before a command counts as ignored."""
        return max(_STARTS_S, self.robot.pace.answer_s)

    def subscribe(self, transport: Transport) -> None:
        """Subscribe on ``transport``; return when the retained messages have arrived."""
        for topic in self._channels:
            transport.subscribe(topic, self.receive, direct=True)

    def receive(self, message: Message) -> None:
        """Update from a message of this robot; malformed ones are ignored."""
        channel, status_before = self._channels.get(message.topic), self.status
        if channel is not AUTONOMY_FILES:
            self.robot.receive(channel, message, 0.0, 0.0)  # nothing here reads times
            if self.status is not status_before and not message.retain:
                self.answers += 1
        elif len(message.payload) <= _BYTES:
            with suppress(PayloadError):
                listed = codec.decode(AUTONOMY_FILES, message.payload).files
                self.files = {entry["file"]: entry for entry in listed if isinstance(entry.get("file"), str)}

    def start(self, transport: Transport, file: str, words: Sequence[str]) -> bool:
        """Publish a start with the options in ``words``; return False if it was not sent. Raises PebbleError."""
        if self.files is None:
            raise PebbleError(
                "the robot has published no scripts: is services.autonomy_manager.enabled true, is it up?"
            )
        if file not in self.files:
            names = ", ".join(self.files) or "none"
            raise PebbleError(f"there is no script {file}, only: {names}; just after the robot's start, try again")
        if self.files[file].get("asked") is False:
            raise PebbleError(f"the robot has just started, and still asks {file} what it needs: try again")
        chosen = settings(self.files[file], words)
        return self._publish(transport, AutonomyCommand(action="start", file=file, config=chosen))

    def stop(self, transport: Transport) -> bool:
        return self._publish(transport, AutonomyCommand(action="stop"))

    def _publish(self, transport: Transport, command: AutonomyCommand) -> bool:
        raw = codec.encode(AUTONOMY_COMMAND, command)
        return transport.publish(self._command_topic, raw, qos=QoS(AUTONOMY_COMMAND.default_qos), urgent=True)


def settings(entry: Entry, words: Sequence[str]) -> dict[str, Any]:
    """Return the values that words such as ``--tag-id 5 --no-search`` give to a script's form.

    Raises PebbleError.
    """
    options: dict[str, tuple[forms.Setting, bool | None]] = {}  # by name: the setting, and the value of a flag
    for setting in forms.listed(entry.get("configs")):
        options |= {option: (setting, value) for option, value in options_of(setting)}
    chosen: dict[str, Any] = {}
    remaining = iter(words)
    for word in remaining:
        option, equals_sign, text = word.partition("=")
        if option not in options:
            names = ", ".join(options) or "it has none"
            raise PebbleError(f"{option} is no option of {entry['file']}: {names}")
        setting, value = options[option]
        if value is not None and equals_sign:
            raise PebbleError(f"{option} takes no value: its opposite is an option of its own")
        if value is None and not equals_sign:  # the value is the next word
            following = next(remaining, None)
            if following is None:
                raise PebbleError(f"{option} needs a value")
            text = following
        try:
            chosen[setting.key] = forms.accepted(setting, text) if value is None else value
        except forms.SettingError as error:
            raise PebbleError(f"{option} of {entry['file']}: {error}") from None
    return chosen


def options_of(setting: forms.Setting) -> list[tuple[str, bool | None]]:
    """Return the options of a setting by name, each with the value that a flag sets, or None if a value follows.

    The script's own names come before those made from the setting's key.
    """
    key = setting.key.replace("_", "-")
    on = _distinct(setting.arg, f"--{key}")
    if setting.type != "bool":
        return [(option, None) for option in on]
    off = _distinct(setting.arg_false, f"--no-{key}")
    return [*((option, True) for option in on), *((option, False) for option in off)]


def _distinct(option_of_script: str | None, option_of_key: str) -> list[str]:
    if option_of_script is None or not option_of_script.startswith("--"):
        return [option_of_key]
    return list(dict.fromkeys((option_of_script, option_of_key)))
