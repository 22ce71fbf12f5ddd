"""The answers of ``pebble setup``: from the existing robot, a file or the terminal, and which are missing."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import asdict

from pebble.config import hosts
from pebble.config.hosts import is_loopback
from pebble.config.text_files import NotTextError, read_password, read_text
from pebble.contract.identity import LEVEL, LEVEL_RULE, untypeable
from pebble.contract.names import NAME
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.errors import PebbleError
from pebble.extensions.fleet.folder import PLAIN_PORT, PORT
from pebble.extensions.fleet.people import MIN_PASSWORD, usable

NONE, HERE = "none", "here"
PAGE = "page"  # the account of the robot's own page at the robot's own broker
_BAUDS = {"goob_base_v1": 460800}
_OTHER_BAUD = 115200


class AnswersError(PebbleError):
    """An error: answers are missing or wrong; each line names its key. Example: ``camera is missing: a device, …``."""


class Answers(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The user's answers; None: not answered yet.

    The text ``none`` is an answer: no board (``port``), no ``camera``, or no ``broker`` yet. The broker ``here`` is one
    on the robot itself.
    """

    id: str | None = None
    port: str | None = None
    protocol: str | None = None
    baud: int | None = None
    camera: str | None = None
    broker: str | None = None
    broker_user: str | None = None
    broker_ca: str | None = None
    page: bool | None = None
    user: str | None = None

    @property
    def remote(self) -> tuple[str, int] | None:
        """Host and port of a broker that is not the robot's own."""
        if self.broker in (None, NONE, HERE):
            return None
        address = hosts.split(str(self.broker))
        return address.host, address.port or (PLAIN_PORT if is_loopback(address.host) else PORT)

    @property
    def is_far(self) -> bool:
        """True if the broker is beyond this machine: there the level `login` demands encryption and an account."""
        return self.remote is not None and not is_loopback(self.remote[0])

    @property
    def account(self) -> str:
        """Account of the robot at its broker: as answered, else the robot's id in the characters of account names."""
        return self.broker_user or re.sub(r"[^a-z0-9_-]", "-", str(self.id).lower()).lstrip("-")[:32] or "robot"

    @property
    def speed(self) -> int:
        return self.baud or _BAUDS.get(str(self.protocol), _OTHER_BAUD)


class Secrets(Struct, frozen=True, kw_only=True):
    """Passwords that were typed or read from files: shown nowhere, and written only to files that need them."""

    password: str | None = None
    broker_password: str | None = None

    def __repr__(self) -> str:
        return "Secrets(***)"


#: What each key of a file of answers means.
KEYS: Mapping[str, str] = {
    "id": "the name of the robot, one level of its topics",
    "port": "the board's serial port, or none",
    "protocol": f"what the board speaks: {', '.join(SERIAL_PROTOCOLS)}",
    "baud": "its speed, unless the protocol's usual one",
    "camera": "a device, libcamera, synthetic, or none",
    "broker": "here (on this robot), HOST[:PORT], or none (yet)",
    "broker_user": "the robot's account there",
    "broker_password_file": "a file with the password of that account",
    "broker_ca": "a file with the authority of its certificate",
    "page": "whether phones may open the robot's page: true or false",
    "user": "the first user of the page",
    "password_file": f"a file with that user's password, of {MIN_PASSWORD} characters or more",
}
#: Keys whose earlier answers no longer fit when another one changes.
_DEPENDING = {"broker": ("broker_user", "broker_ca"), "protocol": ("baud",)}
_PASSWORD, _BROKER_PASSWORD = "password_file", "broker_password_file"


def read_file(file: Path) -> tuple[dict[str, Any], Secrets]:
    """Read a file of answers, and the passwords in the files that it names. Raises PebbleError."""
    try:
        written = msgspec.json.decode(read_text(file), type=dict[str, Any])
    except OSError as error:
        raise AnswersError(f"--answers {file}: {error.strerror}") from None
    except (msgspec.MsgspecError, NotTextError) as error:
        raise AnswersError(f"{file}: {error}: write an object with the keys {', '.join(KEYS)}") from None
    written = {key: value for key, value in written.items() if not key.startswith("//")}
    if unknown := [key for key in written if key not in KEYS]:
        raise AnswersError(f"{file}: {unknown[0]}: unknown key; there are {', '.join(KEYS)}")
    files = {key: written.pop(key) for key in (_PASSWORD, _BROKER_PASSWORD) if key in written}
    passwords = {key: read_password(Path(str(named)), key, file) for key, named in files.items()}
    if _PASSWORD in passwords:
        usable(passwords[_PASSWORD])
    return written, Secrets(password=passwords.get(_PASSWORD), broker_password=passwords.get(_BROKER_PASSWORD))


def combined(earlier: Answers, given: Mapping[str, Any]) -> Answers:
    """Return the earlier answers, with given ones in their place. Raises AnswersError with a line per mistake.

    An earlier answer that fits only the earlier broker or protocol is dropped if that changes.
    """
    fields = asdict(earlier)
    for key, dependent in _DEPENDING.items():
        if key in given and given[key] != fields[key]:
            fields |= dict.fromkeys(dependent)
    try:
        answers = msgspec.convert(fields | dict(given), Answers)
    except msgspec.ValidationError as error:
        raise AnswersError(f"answers: {error}") from None
    if wrong := [*_mistakes(earlier, answers)]:
        raise AnswersError("\n".join(wrong))
    return answers


def _mistakes(earlier: Answers, answers: Answers) -> Iterator[str]:
    if answers.id is not None and not re.search(LEVEL, answers.id):
        yield f"id: must be {LEVEL_RULE}, not {answers.id!r}"
    elif answers.id is not None and (why := untypeable(answers.id)):
        yield f"id: {why}"
    if earlier.id not in (None, answers.id):
        yield f"id: this robot is {earlier.id}; docs/life-of-a-robot.md says how it gets another name"
    if answers.broker == HERE and answers.account == PAGE:
        yield f"id: {answers.account!r} is an account of the robot's own broker already: choose another name"
    if answers.protocol is not None and answers.protocol not in SERIAL_PROTOCOLS:
        yield f"protocol: {answers.protocol!r} is none of {', '.join(SERIAL_PROTOCOLS)}"
    if answers.baud is not None and answers.baud < 1:
        yield f"baud: {answers.baud} is no speed"
    if answers.broker not in (None, NONE, HERE) and (why := _broker_mistake(str(answers.broker))):
        yield f"broker: {why}"
    if answers.page and answers.broker == NONE:
        yield "page: a page needs a broker: answer broker, too"
    if answers.user is not None and not NAME.fullmatch(answers.user):
        yield f"user: {answers.user!r} is no name: use 1 to 32 of a-z, 0-9, _ and -"


def _broker_mistake(text: str) -> str:
    try:
        address = hosts.split(text)
        hosts.broker_host(address.host)
    except hosts.HostError as error:
        return str(error)
    if address.scheme or address.rest or address.user is not None:
        return "write HOST or HOST:PORT; user and password have keys of their own"
    return ""


def needs_login(answers: Answers) -> bool:
    """True if the robot logs in at a broker of others."""
    return answers.is_far or (answers.remote is not None and answers.broker_user is not None)
