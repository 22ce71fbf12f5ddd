"""The questions of ``pebble setup``, and its answers: from a file, from options, from the last time, or asked."""

import re
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import asdict

from pebble.config import hosts
from pebble.config.web import is_loopback
from pebble.contract.identity import LEVEL, LEVEL_RULE
from pebble.contract.names import NAME
from pebble.contract.serial_protocols import SERIAL_PROTOCOLS
from pebble.errors import PebbleError
from pebble.fleet.folder import ADMIN
from pebble.fleet.people import MIN_PASSWORD

NONE, HERE = "none", "here"
RESERVED = (ADMIN, "page")  # accounts of the robot's own broker
_BAUDS = {"goob_base_v1": 460800}
_OTHER_BAUD = 115200
_PORTS = {True: 1883, False: 8883}  # of a broker on loopback or beyond


class AnswersError(PebbleError):
    """Answers that are missing or wrong; each line names its key. Example: ``--camera (camera) is missing: …``."""


class Answers(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the user wants. ``None`` is not answered yet. Files of passwords are read once and are not among them.

    ``port`` and ``camera`` may be ``none``, ``broker`` ``here`` (on the robot) or ``none`` (yet).
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
        return address.host, address.port or _PORTS[is_loopback(address.host)]

    @property
    def is_far(self) -> bool:
        """Whether the broker is beyond this machine, so that the level `login` demands encryption and an account."""
        return self.remote is not None and not is_loopback(self.remote[0])

    @property
    def account(self) -> str:
        """The robot's login at its broker; its own broker knows it by its name."""
        return account_of(str(self.id)) if self.broker == HERE else str(self.broker_user)

    @property
    def speed(self) -> int:
        return self.baud or _BAUDS.get(str(self.protocol), _OTHER_BAUD)


class Secrets(Struct, frozen=True, kw_only=True):
    """Passwords that were typed or read from files; shown nowhere, and in no file but those that they are for."""

    password: str | None = None
    broker_password: str | None = None

    def __repr__(self) -> str:
        return "Secrets(***)"


#: Each key: what it means, for messages, and the option that answers it.
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
FILES = ("broker_password_file", "password_file")


def decode(text: bytes, name: str) -> dict[str, Any]:
    """The answers of a file. Raises AnswersError."""
    try:
        found = msgspec.json.decode(text, type=dict[str, Any])
    except msgspec.MsgspecError as error:
        raise AnswersError(f"{name}: {error}: write an object with the keys {', '.join(KEYS)}") from None
    unknown = [key for key in found if key not in KEYS and not key.startswith("//")]
    if unknown:
        raise AnswersError(f"{name}: {unknown[0]}: unknown key; there are {', '.join(KEYS)}")
    return {key: value for key, value in found.items() if key in KEYS}


def combined(*sources: Mapping[str, Any]) -> Answers:
    """Later sources go before earlier ones. Raises AnswersError."""
    merged: dict[str, Any] = {}
    for source in sources:
        merged |= {key: value for key, value in source.items() if value is not None and key not in FILES}
    try:
        answers = msgspec.convert(merged, Answers)
    except msgspec.ValidationError as error:
        raise AnswersError(f"answers: {error}") from None
    if wrong := mistakes(answers):
        raise AnswersError("\n".join(wrong))
    return answers


def plain(answers: Answers) -> dict[str, Any]:
    """What the manifest keeps of them."""
    return {key: value for key, value in asdict(answers).items() if value is not None}


def option(key: str) -> str:
    return "--" + key.replace("_", "-")


def mistakes(answers: Answers) -> list[str]:
    """One line for each answer that cannot be."""
    found = []
    if answers.id is not None and not re.search(LEVEL, answers.id):
        found.append(f"id: must be {LEVEL_RULE}, not {answers.id!r}")
    if answers.broker == HERE and account_of(str(answers.id)) in RESERVED:
        found.append(f"id: {answers.id!r} is an account of the robot's own broker already: choose another name")
    if answers.protocol is not None and answers.protocol not in SERIAL_PROTOCOLS:
        found.append(f"protocol: {answers.protocol!r} is none of {', '.join(SERIAL_PROTOCOLS)}")
    if answers.baud is not None and answers.baud < 1:
        found.append(f"baud: {answers.baud} is no speed")
    if answers.broker not in (None, NONE, HERE) and (why := _broker_mistake(str(answers.broker))):
        found.append(f"broker: {why}")
    if answers.page and answers.broker == NONE:
        found.append("page: a page needs a broker: answer broker, too")
    if answers.user is not None and not NAME.fullmatch(answers.user):
        found.append(f"user: {answers.user!r} is no name: use 1 to 32 of a-z, 0-9, _ and -")
    return found


def _broker_mistake(text: str) -> str:
    try:
        address = hosts.split(text)
        hosts.broker_host(address.host)
    except hosts.HostError as error:
        return str(error)
    if address.scheme or address.rest or address.user is not None:
        return "write HOST or HOST:PORT; user and password have keys of their own"
    return ""


def missing(answers: Answers, secrets: Secrets, *, has_login: bool, has_user: bool) -> list[str]:
    """The keys without an answer. ``has_login``: the broker's password is there already; ``has_user``: the user is."""
    wanted = ["id", "port", "camera", "broker", "page"]
    if answers.port not in (None, NONE):
        wanted.append("protocol")
    if answers.is_far:
        wanted.append("broker_user")
    if answers.page:
        wanted.append("user")
    found = [key for key in wanted if getattr(answers, key) is None]
    login = answers.is_far or (answers.remote is not None and answers.broker_user is not None)
    if login and not has_login and secrets.broker_password is None:
        found.append("broker_password_file")
    if answers.page and not has_user and secrets.password is None:
        found.append("password_file")
    return [key for key in KEYS if key in found]


def missing_error(keys: list[str]) -> AnswersError:
    return AnswersError("\n".join(f"{key} is missing: {KEYS[key]} ({option(key)})" for key in keys))


def host_name() -> str:
    """The default name of the robot."""
    return socket.gethostname().partition(".")[0] or "robot"


def account_of(name: str) -> str:
    """The account of a robot of this name, which may have other letters than an account."""
    return re.sub(r"[^a-z0-9_-]", "-", name.lower()).lstrip("-")[:32] or "robot"


def read_file(file: Path) -> bytes:
    """Raises AnswersError."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise AnswersError(f"--answers {file}: {error.strerror}") from None
