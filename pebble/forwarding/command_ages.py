"""Ages of commands, by the clocks of their senders.

Pings show an age as well. But on a thin link it includes the wait for the ping's own way *up*, behind pictures. A drive
command with a stamp ``t`` and a ``key`` needs no pings once an earlier command with this key came without delay. In a
request for control, ``id`` takes the place of the key.
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
        # By account and key, and by account and id:
        self._drive_clocks = SenderClocks[tuple[str, str]](MOST, _PATIENCE)
        self._request_clocks = SenderClocks[tuple[str, str]](MOST, _PATIENCE)

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
            clocks, key = self._drive_clocks, self._key(command)
        else:
            clocks, key = self._request_clocks, command.id
        if not isinstance(command.t, int) or not key:
            return waited_s
        sender, sent_s, now = (account, key), command.t / 1000, clock.since_boot()
        if command.ends():  # it may come another way, with another delay: only its stamp is noted
            clocks.pass_over(sender, sent_s, now)
            return waited_s
        if clocks.is_passed(sender, sent_s):
            return inf  # a newer one came before: this one was sent again, with QoS 2 for example
        return clocks.age_s(sender, sent_s, waited_s, now, subject.waits_s)

    def _key(self, command: Drive) -> str:
        """Return the first of a command's keys, one per motor owner, that is in :attr:`keys`; empty if none is."""
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
