"""The kinds of values of config keys, and the base classes of sections."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta, Struct, field

from pebble.config import hosts
from pebble.contract.identity import LEVEL, LEVEL_RULE

# As pebble.transports.topics checks it: brokers close the connection on these.
_BAD = r"+#\x00-\x1f\x7f-\x9f\ufdd0-\ufdef\ufffe\uffff"
# The topics of stops, control and neighbours, of any robot: nothing else may be published there.
_RESERVED = "(?:[^/]+/){3}(?:incoming|outgoing)/(?:estop|(?:by|control|from|to|neighbours)(?:/|$))"
_TOPIC = rf"^(?!\$)(?!{_RESERVED})(?!(?:[^/]*/){{200}})[^{_BAD}]{{1,250}}$(?!\n)"

# ``expected`` completes a problem's text "must be …, not …".
Level = Annotated[str, Meta(pattern=LEVEL, extra={"expected": LEVEL_RULE, "parse": hosts.typeable})]
Topic = Annotated[
    str,
    Meta(
        pattern=_TOPIC,
        extra={
            "expected": "a topic: 1 to 250 characters, no + or #, no $ at the start, "
            "not one of an emergency stop or control",
            "parse": hosts.no_login,
        },
    ),
]
# ``parse`` reads what was written, or raises a PebbleError that says what to write.
Endpoint = Annotated[
    str,
    Meta(
        pattern=r"^[a-z0-9-]+/.+",
        extra={"expected": 'a Zenoh endpoint such as "tls/192.168.1.7:7447"', "parse": hosts.endpoint},
    ),
]
Host = Annotated[str, Meta(extra={"parse": hosts.host})]
BrokerHost = Annotated[str, Meta(extra={"parse": hosts.broker_host})]
Device = Annotated[str, Meta(extra={"parse": hosts.no_login})]
NameOfPage = Annotated[str, Meta(extra={"parse": hosts.name_of_page})]
CommonName = Annotated[
    str, Meta(min_length=1, max_length=64, extra={"expected": "the name in a certificate", "parse": hosts.no_login})
]
Account = Annotated[
    str, Meta(pattern=r"^[a-z0-9_-]{0,32}$(?!\n)", extra={"expected": "the name of an account: a-z, 0-9, _ and -"})
]
ClientId = Annotated[
    str,
    Meta(
        pattern=r"^[!-~]{1,128}$(?!\n)",
        extra={
            "expected": "the id that the broker knows: 1 to 128 letters, digits and signs, without blanks",
            "parse": hosts.no_login,
        },
    ),
]
_LINE = r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]{1,%d}$(?!\n)"
Label = Annotated[str, Meta(pattern=_LINE % 32, extra={"expected": "a name in one line, 32 characters at most"})]
Sentence = Annotated[str, Meta(pattern=_LINE % 60, extra={"expected": "one line, 60 characters at most"})]
Cells = Annotated[int, Meta(ge=1, le=14)]
_LEVELS = {"WARN": "WARNING", "FATAL": "CRITICAL", "NOTSET": "DEBUG"}
LogLevel = Annotated[
    Literal["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"], Meta(extra={"synonyms": _LEVELS, "unlike": "INFO"})
]
#: A value that is never replaced by a similar one: it is an address, or a right.
EXACT = Meta(extra={"exact": True})
Port = Annotated[int, Meta(ge=1, le=65535), EXACT]
Count = Annotated[int, Meta(ge=1, le=1_000_000_000)]
# A wait beyond 100 days is a typing mistake, and some clocks and locks of the system refuse it.
Seconds = Annotated[float, Meta(ge=0, le=10_000_000)]
Interval = Annotated[float, Meta(gt=0, le=10_000_000)]
# A drive command that a silent connection delays for less is executed: the limit is that of drive_timeout_seconds.
Silence = Annotated[float, Meta(gt=0, le=5)]
#: A list of words, or one line that is split as a shell would; it is never run by a shell.
Command = tuple[str, ...]
#: Relative to the config file; ``~`` is the user's home.
File = Annotated[Path, Meta(extra={"expected": "a path", "parse": hosts.no_url})]
SharedMemoryName = Annotated[
    str, Meta(pattern=r"^/?(?!\.{0,2}$)[^/\x00]{1,200}$(?!\n)", extra={"expected": "a name without /"})
]
#: Environment variables by name.
Variables = dict[Annotated[str, Meta(pattern="^[^=]+$", extra={"expected": "the name of a variable, without ="})], str]
Password = Annotated[str, Meta(extra={"secret": True})]


#: The default of a key that holds an object of any keys.
EMPTY: Any = field(default_factory=dict)


def doc(text: str) -> Meta:
    """Return the meaning of a key as an annotation, for `pebble check --keys` and for editors."""
    return Meta(description=text)


#: Why a key is retired whose value is a constant.
ONE_VALUE = "one value serves all robots"
UNIT = "the robot's unit sets variables for all: `systemctl edit pebble`"
COMMAND = "a command may begin with `env -C FOLDER NAME=VALUE`"
#: The delivery of a channel, which no config changes (paper 4.3 and 4.4).
BY_CONTRACT: Mapping[str, str] = dict.fromkeys(("qos", "retain"), "the contract fixes QoS and retain flag")


class Secret(str):
    """A text that is not shown by accident: ``repr()`` hides it, ``str()`` does not."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "'***'"


class Section(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An object of a config file. Subclasses are data: keys, defaults, limits and meanings."""

    #: Keys that are accepted and do nothing, with what replaces them; a final ``*`` stands for any ending.
    retired: ClassVar[Mapping[str, str]] = {}
    #: Other names of keys, which the original or its libraries know.
    other_names: ClassVar[Mapping[str, str]] = {}
    #: Sections of other programs may be here: an unknown key is a warning unless it is like a known one.
    holds_others: ClassVar[bool] = False
    #: Keys of earlier versions that are errors, and what to write.
    refused: ClassVar[Mapping[str, str]] = {}

    def connections(self) -> Iterator[tuple[tuple[str, ...], "Section"]]:
        """Yield the connections of this section that are in use, with their keys, to check the security level."""
        yield from ()

    @classmethod
    def meaning(cls) -> str:
        """Return the purpose of the section: the first line of its docstring."""
        return (cls.__doc__ or "").partition("\n")[0]

    @classmethod
    def all_retired(cls) -> dict[str, str]:
        """Return the keys that this class and its base classes no longer use, each with the reason."""
        return {key: why for kind in reversed(cls.__mro__) for key, why in getattr(kind, "retired", {}).items()}


class ServiceSection(Section, frozen=True, kw_only=True):
    """The base class of the sections of services."""

    retired: ClassVar = {
        "retained_publish_interval_seconds": "services.defaults has one for all",
        "log_level": "the one of the file is for all services",
    }

    enabled: Annotated[bool, doc("Start this service.")] = False
