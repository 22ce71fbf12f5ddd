"""Ages of commands, by the clocks of their senders.

Pings show an age as well. But on a thin link it includes the wait for the ping's own way *up*, behind pictures. A drive
command with a stamp ``t`` and a ``key`` needs no pings once an earlier one with this key was fast. In a request for
control, ``id`` takes the place of the key.
"""

from math import inf

from pebble.contract import codec
from pebble.contract.payloads import ControlRequest, Drive
from pebble.errors import PayloadError
from pebble.forwarding.subjects import Subject
from pebble.transports import Message, clock
from pebble.transports.ages import Patience, SenderClocks

MOST = 16  # senders of drive commands, and of requests for control, whose clocks are remembered
STAMP = b'"t"'  # a command without it does not tell its age
STAMP_LETTER = ord("t")  # most commands have none, which is found six times as fast
_LONGEST = 80  # characters of the keys of several motor owners
_PATIENCE = Patience(believed_s=60.0, set_back_s=2.0, silent_s=60.0)


class CommandAges:
    """Ages of drive commands and requests for control that carry a time stamp; thread-safe.

    :attr:`keys` are the present keys of control. The stamp of a command with any other key is not judged, as the motor
    owner refuses the command. None: no motor owner gives keys, and senders choose their keys.
    """

    def __init__(self) -> None:
        self.keys: frozenset[bytes] | None = None
        self._drivers = SenderClocks[tuple[str, str]](MOST, _PATIENCE)
        self._asking = SenderClocks[tuple[str, str]](MOST, _PATIENCE)

    def waited_s(self, subject: Subject, message: Message, account: str) -> float:
        """Return the seconds for which a message with a time stamp has waited; remember the sender's clock.

        The stamp counts if the message has a valid key or id; the clock belongs to that key or id of this ``account``.
        """
        waited_s = message.waited_s
        assert subject.channel is not None  # noqa: S101 - else it is not stamped
        try:
            command: Drive | ControlRequest = codec.decode(subject.channel, message.payload)
        except PayloadError:
            return waited_s
        if isinstance(command, Drive):
            clocks, key = self._drivers, self._key(command)
        else:
            clocks, key = self._asking, command.id
        if not isinstance(command.t, int) or not key:
            return waited_s
        if command.ends():  # it may come another way
            clocks.pass_over((account, key), command.t / 1000, clock.since_boot())
            return waited_s
        if clocks.is_passed((account, key), command.t / 1000):
            return inf  # it was sent again, with QoS 2 for example, after a newer one
        return clocks.age_s((account, key), command.t / 1000, waited_s, clock.since_boot(), subject.waits_s)

    def _key(self, command: Drive) -> str:
        """Return the key or id that identifies the sender of a command; empty if there is no valid key."""
        text, keys = command.key, self.keys
        if not isinstance(text, str) or len(text) > _LONGEST:
            return ""
        if keys is None:
            return text
        return next((key for key in text.split(" ") if key.encode() in keys), "")


def ends_something(subject: Subject, message: Message) -> bool:
    """True if a message can only bring something to rest. Such a message passes however late it is."""
    if subject.channel is None:
        return False
    try:
        return subject.channel.ends(codec.decode(subject.channel, message.payload))
    except PayloadError:
        return False
