"""Compares the folder of a fleet with its broker, and tries what the broker lets accounts do."""

import json
import secrets
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from pebble.fleet import broker_files, certificates, dynsec
from pebble.fleet.applying import admin_password, change_brokers, conf_differences, control, places, zenoh_differences
from pebble.fleet.attempts import READS, ROWS, Row, may, topics
from pebble.fleet.broker_client import BrokerClient, Place, RefusedError, UnreachableError
from pebble.fleet.folder import ACL, ADMIN, PASSWORDS, SECURITY, Fleet, FleetError, Server
from pebble.fleet.roles import CONTROL_ANSWERS, CONTROL_TOPIC, Account, ProgramRole, Role, Rule
from pebble.transports.base import Message, QoS

_SOON_DAYS = 30
_ADOPTED_S = 3.0  # for mosquitto to read its files again, and for a will
_OTHER = "check-other"  # whose name others take


# -- folder and broker


def compare(folder: Path, fleet: Fleet) -> list[str]:
    """What a broker has too much or too little, and what will not do for long; one line each. Raises FleetError."""
    others = [line for _, found in of_others(folder, fleet) for line in found]
    return [*by_hand(folder, fleet), *of_rules(folder, fleet), *others]


def by_hand(folder: Path, fleet: Fleet) -> list[str]:
    """Return those of them that no command mends; each line names what does."""
    return [*conf_differences(folder, fleet), *_certificates(folder, fleet)]


def of_rules(folder: Path, fleet: Fleet) -> list[str]:
    """Return those of accounts and rules, which a second `pebble fleet init` gives again."""
    found = list(zenoh_differences(folder, fleet))
    if fleet.rules == "files":
        return [*found, *_of_files(folder, fleet)]
    connection = control(folder, fleet.brokers[0], own=True)
    if connection is None:
        return [*found, *_of_security(folder, fleet)]
    with connection:
        return [*found, *_of_plugin(fleet, connection)]


def of_others(folder: Path, fleet: Fleet) -> Iterator[tuple[Server, list[str]]]:
    """Return the same of each further broker, which has its files on another machine; and whether it has rules at all.

    One that is away, or is no broker of this fleet, keeps no other one from being compared.
    """
    for server in fleet.brokers[1:]:
        place, found = next(places(folder, server, own=False)), list[str]()
        try:
            found += _doors(folder, place)
            if fleet.rules == "plugin" and not found:
                with dynsec.Control(place, ADMIN, admin_password(folder)) as connection:
                    found += [f"broker {place}: {line}" for line in _of_plugin(fleet, connection)]
        except FleetError as error:
            found.append(str(error))
        yield server, found


def _doors(folder: Path, place: Place) -> Iterator[str]:
    """Whether this broker lets strangers in, or an account do what none may."""
    password, topic = admin_password(folder), f"check-{secrets.token_hex(4)}/robots/a/outgoing/junk"
    for what, name, given in (("without a name", None, None), ("with a wrong password", ADMIN, "wrong")):
        if _gets_in(place, name, given):
            yield f"broker {place} lets in clients {what}: start it with a copy of the files in {folder}"
    with BrokerClient(place, ADMIN, password) as client:
        client.subscribe([topic])
        client.publish(topic, b"")
        client.flush()
        client.subscribe([f"{topic}-2"])  # answered after what was sent before
        if client.received:
            yield f"broker {place} has no rules, each account may do all: start it with a copy of the files in {folder}"


def _gets_in(place: Place, name: str | None, password: str | None) -> bool:
    try:
        BrokerClient(place, name, password).__exit__()
    except (RefusedError, UnreachableError):
        return False
    return True


def _certificates(folder: Path, fleet: Fleet) -> Iterator[str]:
    renewed = {folder / certificates.SERVER_CERT: f"`pebble cert renew --folder {folder}`, then restart mosquitto"}
    for name in fleet.accounts:
        file = folder / certificates.ACCOUNTS / f"{name}.pem"
        if file.exists():
            renewed[file] = f"`pebble fleet certificate {name}`, with its hosts, and move it to its machine"
    for file, how in renewed.items():
        days = certificates.show(file).days_left
        if days < _SOON_DAYS:
            yield f"{file} ends in {days:.0f} days: {how}"


def _of_plugin(fleet: Fleet, connection: dynsec.Control) -> Iterator[str]:
    default = connection.ask("getDefaultACLAccess")
    group = connection.anonymous_group()
    yield from _compared(fleet, connection.accounts(), connection.roles(), default.get("acls", []), group)


def _of_security(folder: Path, fleet: Fleet) -> Iterator[str]:
    file = folder / SECURITY
    try:
        whole = json.loads(file.read_text(encoding="utf-8"))
        default = [{"acltype": type_, "allow": allow} for type_, allow in whole["defaultACLAccess"].items()]
        yield from _compared(fleet, whole["clients"], whole["roles"], default, whole.get("anonymousGroup"))
    except OSError as error:
        raise FleetError(f"{file}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise FleetError(f"{file} is no file of the dynamic-security plugin") from None


def _compared(
    fleet: Fleet,
    clients: Iterable[Mapping[str, Any]],
    roles: Iterable[Mapping[str, Any]],
    default: Iterable[Mapping[str, Any]],
    anonymous: Any,
) -> Iterator[str]:
    """``clients`` and ``roles`` as the plugin lists them."""
    rules = {role["rolename"]: broker_files.rules_in(role["acls"]) for role in roles}
    held: dict[str, set[Rule | str]] = {}
    for client in clients:
        name = client["username"]
        held[name] = set().union(*(rules.get(role["rolename"], set()) for role in client.get("roles", ())))
        if client.get("groups"):
            yield f"{name}: is in {len(client['groups'])} group(s) of the broker, which the fleet does not know"
        if client.get("disabled"):
            yield f"{name}: is disabled at the broker"
    wanted = {one["acltype"]: one["allow"] for one in broker_files.default_access()}
    for one in default:
        if wanted.get(one["acltype"]) != one["allow"]:
            yield f"everybody: one rule too many: {one['acltype']} is {'allowed' if one['allow'] else 'denied'} for all"
    if anonymous:
        yield f"clients without a name: have the rights of group {anonymous}: stop mosquitto before the next line"
    yield from _rules_compared(fleet, held)


def _of_files(folder: Path, fleet: Fleet) -> Iterator[str]:
    try:
        held = broker_files.rules_in_acl((folder / ACL).read_text(encoding="utf-8"))
        logins = broker_files.passwords_in((folder / PASSWORDS).read_text(encoding="utf-8"))
    except OSError as error:
        raise FleetError(f"{error.filename}: {error.strerror}") from None
    except ValueError as error:
        raise FleetError(f"{folder / PASSWORDS}: {error}") from None
    for rule in held.pop("", set()):
        yield f"everybody: one rule too many: {_shown(rule)}"
    for name in held.keys() - logins.keys():
        yield f"{name}: has rules and no password: `pebble fleet password {name}`"
    yield from _rules_compared(fleet, {name: held.get(name, set()) for name in logins})


def _rules_compared(fleet: Fleet, held: Mapping[str, set[Rule | str]]) -> Iterator[str]:
    for name in sorted(held.keys() - fleet.accounts.keys()):
        yield f"{name}: an account too many: the broker lets it in, and fleet.json does not have it"
    for name in fleet.accounts:
        if name not in held:
            yield f"{name}: an account too few: the broker does not have it: `pebble fleet password {name}`"
            continue
        wanted = set(fleet.rules_of(name))
        yield from (f"{name}: one rule too many: {_shown(rule)}" for rule in sorted(held[name] - wanted, key=_shown))
        yield from (f"{name}: one rule too few: {_shown(rule)}" for rule in sorted(wanted - held[name], key=_shown))


def _shown(rule: Rule | str) -> str:
    return rule if isinstance(rule, str) else f"{rule.access} {rule.filter}"


# -- attempts


@dataclass
class Tried:
    """``wrong``: one line for each attempt that went another way than the table says."""

    attempts: int = 0
    wrong: list[str] = field(default_factory=list)

    def note(self, who: str, what: str, topic: str, *, expected: bool, seen: bool) -> None:
        self.attempts += 1
        if expected != seen:
            kind = "one rule too many" if seen else "one rule too few"
            self.wrong.append(f"{who}: {kind}: {what}: {topic} was {'' if seen else 'not '}let through")


def attempt(folder: Path, fleet: Fleet) -> Tried:
    """Make each attempt, with accounts that exist only meanwhile, at robots that do not exist. Raises FleetError.

    Further brokers of `fleet` have their turn as well, unless they know rules by files, which no command changes there.
    """
    tried = Tried()
    for number in range(len(fleet.brokers) if fleet.rules == "plugin" else 1):
        _Attempts(folder, fleet, number, tried).run()
    return tried


class _Attempts:
    """Two robots that do not exist, one account of each role, and what each of them gets through."""

    def __init__(self, folder: Path, fleet: Fleet, number: int, tried: Tried) -> None:
        """``number``: that of the broker."""
        self._folder, self._fleet = folder, fleet
        nonce = secrets.token_hex(4)
        self._base, self._other = (f"check-{nonce}/robots/{one}" for one in ("a", "b"))
        robot = (ProgramRole.ROBOT,)
        made = {f"check-{role}-{nonce}": Account(roles=(role,)) for role in (*Role, ProgramRole.PAGE)}
        made |= {
            f"check-{_name(base)}-{nonce}": Account(roles=robot, bases=(base,)) for base in (self._base, self._other)
        }
        self._robot, self._admin = f"check-a-{nonce}", f"check-admin-{nonce}"
        self._fleet_then = replace(fleet, accounts=fleet.accounts | made)
        self._passwords = {name: broker_files.new_password() for name in made}
        self._server, self._own = fleet.brokers[number], number == 0
        self._place = self._reachable()
        self._tried = tried

    def run(self) -> None:
        change_brokers(self._folder, self._fleet, self._fleet_then, self._passwords)
        try:
            self._wait_until_known()
            with self._login(self._robot) as robot, self._login(self._admin) as admin:
                robot.subscribe([f"{self._base}/#"])
                admin.subscribe(["+/+/+/outgoing/#", CONTROL_ANSWERS])
                for name in self._passwords:
                    self._writes(name, robot, admin)
                    self._reads(name, robot)
            self._strangers()
        finally:
            change_brokers(self._folder, self._fleet_then, self._fleet, {})

    def _writes(self, name: str, robot: BrokerClient, admin: BrokerClient) -> None:
        tried: list[tuple[Row, str, bytes]] = []
        robot.received.clear()
        admin.received.clear()
        with self._login(name) as client:
            client.subscribe([CONTROL_ANSWERS])
            for row in ROWS:
                for topic in topics(row, self._base, name, self._fleet.level, _OTHER):
                    payload = f"{len(tried)}-{name}".encode()
                    tried.append((row, topic, payload))
                    if row.will:
                        self._leave(name, Message(topic, payload, qos=QoS.DELIVERED))
                    elif topic == CONTROL_TOPIC:
                        client.publish(topic, b'{"commands":[{"command":"getDefaultACLAccess"}]}')
                    else:
                        client.publish(topic, payload, retain=row.retained)
            client.flush()
            client.subscribe([f"{self._base}/end"])  # answered after the plugin's answer
            rules = self._fleet_then.rules_of(name)
            expected = {payload for _, topic, payload in tried if may(rules, "write", topic) and topic[0] != "$"}
            visible = {payload for _, topic, payload in tried if topic.startswith(self._base) or "/outgoing/" in topic}
            self._wait_for(robot, admin, expected & visible)
            seen = {payload for _, payload in (*robot.received, *admin.received)}
            for row, topic, payload in tried:
                if row.retained and topic.startswith(self._base):
                    robot.publish(topic, b"", retain=True)  # nothing stays at the broker
                if topic == CONTROL_TOPIC:
                    if self._fleet.rules == "plugin":
                        self._note(name, row.what, topic, may(rules, "write", topic), bool(client.received))
                elif payload in visible:
                    self._note(name, row.what, topic, payload in expected, payload in seen)

    def _wait_for(self, robot: BrokerClient, admin: BrokerClient, expected: set[bytes]) -> None:
        """Until what was expected is here, and then what was sent before a last message of the robot."""
        deadline = time.monotonic() + _ADOPTED_S
        while time.monotonic() < deadline and not expected <= {one for _, one in (*robot.received, *admin.received)}:
            robot.listen(0.01)
            admin.listen(0.01)
        end = secrets.token_bytes(8)
        robot.publish(f"{self._base}/outgoing/end", end)
        for one in (robot, admin):
            one.wait(partial(_has, one, end), "deliver messages")

    def _reads(self, name: str, robot: BrokerClient) -> None:
        topics_ = [f"{self._base}/{suffix}" for _, suffixes in READS for suffix in suffixes]
        with self._login(name) as client:
            client.subscribe(["#", *topics_])
            for topic in topics_:
                robot.publish(topic, name.encode())
            robot.flush()
            rules = self._fleet_then.rules_of(name)
            expected = {topic for topic in topics_ if may(rules, "read", topic)}
            deadline = time.monotonic() + _ADOPTED_S
            while time.monotonic() < deadline and not expected <= {topic for topic, _ in client.received}:
                client.listen(0.01)
            client.subscribe([f"{self._base}/end"])  # answered after all that was sent before
            seen = {topic for topic, _ in client.received}
            for topic in topics_:
                self._note(name, "read", topic, topic in expected, topic in seen)

    def _strangers(self) -> None:
        """Clients without an account or the right password, and those that come unencrypted."""
        logins = {"without a name": (None, None), "with a wrong password": (ADMIN, "wrong"), "unknown": ("x1", "x")}
        ports = {place: f"port {place.port}" for place in (self._place, *self._unencrypted())}
        for place, shown in ports.items():
            for what, (name, password) in logins.items():
                self._note("stranger", f"log in {what}", shown, False, _gets_in(place, name, password))

    def _unencrypted(self) -> Iterator[Place]:
        port = self._server.unencrypted
        if port is not None:
            yield Place(self._place.host, port, None)

    def _note(self, name: str, what: str, topic: str, expected: bool, seen: bool) -> None:
        who = name.removeprefix("check-").rpartition("-")[0] or name
        at = "" if self._own else f"broker {self._place}: "
        shown = at + {"a": "robot", "b": "another robot"}.get(who, who)
        self._tried.note(shown, what, topic.replace(name, "NAME"), expected=expected, seen=seen)

    def _leave(self, name: str, will: Message) -> None:
        BrokerClient(self._place, name, self._passwords[name], will=will).cut()

    def _login(self, name: str) -> BrokerClient:
        return BrokerClient(self._place, name, self._passwords[name])

    def _wait_until_known(self) -> None:
        deadline = time.monotonic() + _ADOPTED_S
        last = list(self._passwords)[-1]
        while not _gets_in(self._place, last, self._passwords[last]):
            if time.monotonic() > deadline:
                raise FleetError(f"broker {self._place} does not know new accounts: has it read its files?")
            time.sleep(0.05)

    def _reachable(self) -> Place:
        """Raises FleetError."""
        why: FleetError | None = None
        for place in places(self._folder, self._server, own=self._own):
            try:
                BrokerClient(place, ADMIN, admin_password(self._folder)).__exit__()
            except UnreachableError as error:
                why = error
            else:
                return place
        raise FleetError(f"{why}: attempts need a broker that runs")


def _has(client: BrokerClient, payload: bytes) -> bool:
    return any(one == payload for _, one in client.received)


def _name(base: str) -> str:
    return base.rpartition("/")[2]
