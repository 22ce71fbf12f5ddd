"""The steps that make a robot of a machine, in their order, from the answers."""

import json
import os
import pwd
import re
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from pebble.checks.broker.login_attempt import REFUSED_LOGINS, attempt
from pebble.config.config import file_name, parse
from pebble.contract.identity import Identity
from pebble.fleet import certificates
from pebble.fleet.broker_files import new_password
from pebble.fleet.folder import ACL, ADMIN_PASSWORD, FLEET, PASSWORDS, PLAIN_PORT
from pebble.fleet.people import People, has_user
from pebble.fleet.roles import Role
from pebble.runtime.connections import check_connections
from pebble.setup import own_broker, retained
from pebble.setup.detect import Machine
from pebble.setup.manifest import Manifest, SetupError
from pebble.setup.places import Places
from pebble.setup.questions import HERE, NONE, Answers, Secrets, account_of
from pebble.setup.steps import BESIDE, Step
from pebble.transports import MqttSettings
from pebble.transports.settings import TlsSettings

_UNIT, _MOSQUITTO = "pebble.service", "mosquitto starts with its part"
_WANTS = f"etc/systemd/system/multi-user.target.wants/{_UNIT}"
_SYSUSERS = b'u pebble - "Pebble robot" /var/lib/pebble\n'
PAGE_PORT = 8080
_ROBOTS = "root:pebble"  # what the robot reads, and only root changes


@dataclass(frozen=True, slots=True)
class Plan:
    """All that the steps depend on."""

    places: Places
    answers: Answers
    machine: Machine
    manifest: Manifest
    secrets: Secrets

    @property
    def base(self) -> str:
        return base_of(str(self.answers.id))

    @property
    def broker_password(self) -> Path:
        return self.places.etc / "broker.password"

    @property
    def page_password(self) -> Path:
        return self.places.etc / "page.password"

    @property
    def ca(self) -> Path:
        return self.places.etc / "broker-ca.pem"

    @property
    def has_login(self) -> bool:
        """Whether the robot logs in at a broker that is not its own."""
        return self.answers.remote is not None and (self.answers.is_far or self.answers.broker_user is not None)

    @property
    def has_own_broker(self) -> bool:
        return self.answers.broker == HERE


def base_of(robot: str) -> str:
    return str(Identity("pebble", "robots", robot))


def steps(plan: Plan) -> list[Step]:
    """All of them, in their order."""
    places = plan.places
    found = [
        *_leaving(plan),
        *_users(plan),
        Step(what="folder of the config", target=places.etc, mode=0o750, owner=_ROBOTS),
        Step(what="folder of what survives a power cut", target=places.state, mode=0o700, owner="pebble:pebble"),
        *_passwords(plan),
        *(_own_broker(plan) if plan.has_own_broker else _other_broker(plan)),
        *(_certificate(plan) if plan.answers.page else ()),
        *_config(plan),
        *(_first_user(plan) if plan.answers.page else ()),
        *_polkit(plan),
        *_service(plan),
    ]
    if not plan.machine.writable:
        return found
    return [replace(step, cannot=plan.machine.writable) for step in found]


def config_of(plan: Plan) -> dict[str, Any]:
    """The content of robot.json."""
    answers = plan.answers
    services: dict[str, Any] = {}
    if answers.camera != NONE:
        services["av_daemon"] = {"enabled": True, "video": _video(str(answers.camera)), "audio": {"enabled": False}}
    if answers.port != NONE:
        line = {"port": answers.port, "baud": answers.speed}
        services["serial_mcu_bridge"] = {"enabled": True, "protocol": answers.protocol, "serial": line}
    if answers.broker != NONE:
        unit = ["systemctl", "--no-ask-password"]
        services["mqtt_bridge"] = {
            "enabled": True,
            "remote_mqtt": _login(plan),
            "reboot_control": {"command": [*unit, "reboot"]},
            "service_restart_control": {"command": [*unit, "--no-block", "restart", _UNIT]},
        }
    config: dict[str, Any] = {
        "//": "Written by `pebble setup`. What is changed here by hand stays; docs/configuration.md lists all keys.",
        "robot": {"id": answers.id},
        "security": {"level": "login"},
        "transport": {"kind": "zenoh", "state_dir": _beside(plan.places.etc, plan.places.state)},
        "services": services,
    }
    if answers.page:
        services["web_handler"] = {"enabled": True}
        tls = {"certificate": certificates.SERVER_CERT, "key": certificates.SERVER_KEY, "ca": certificates.CA_CERT}
        own = {name: f"{plan.places.tls.name}/{file}" for name, file in tls.items()}
        people = _beside(plan.places.etc, plan.places.people)
        config["web_interface"] = {"host": "0.0.0.0", "port": PAGE_PORT, "tls": own, "people": people}  # noqa: S104
        if plan.has_own_broker:
            config["web_interface"]["mqtt"] = _own_login(own_broker.PAGE, plan.page_password)
    return config


def _video(camera: str) -> dict[str, Any]:
    return {"backend": camera} if camera in ("libcamera", "synthetic") else {"backend": "v4l2", "device": camera}


def _login(plan: Plan) -> dict[str, Any]:
    if plan.has_own_broker:
        return _own_login(plan.answers.account, plan.broker_password)
    host, port = plan.answers.remote or ("", 0)
    found: dict[str, Any] = {"host": host, "port": port}
    if plan.has_login:
        found |= {"username": plan.answers.account, "password_file": plan.broker_password.name}
    if plan.answers.is_far:
        found["tls"] = {"enabled": True} | ({"ca_cert": plan.ca.name} if plan.answers.broker_ca else {})
    return found


def _own_login(account: str, password: Path) -> dict[str, Any]:
    return {"host": "127.0.0.1", "port": PLAIN_PORT, "username": account, "password_file": password.name}


def _beside(folder: Path, path: Path) -> str:
    """The path from a folder, so that a config means the same below another root."""
    return os.path.relpath(path, folder)


# -- groups of steps


def _leaving(plan: Plan) -> Iterator[Step]:
    """What an earlier name left: the stop and the audit under that name, and messages at the broker."""
    state, ran = plan.places.state, plan.manifest.ran
    waits = _waiting_config(plan)
    for earlier in plan.manifest.leaving:
        old, new = file_name(base_of(earlier)), file_name(plan.base)
        yield Step(
            what=f"{earlier} stands still",
            command=("systemctl", "stop", _UNIT),
            live=True,
            cannot=waits or _no_service(plan),
        )
        yield Step(
            what=f"what {earlier} saved, its stop too, is {plan.answers.id}'s",
            act=partial(_rename, state, old, new),
            done=lambda old=old: not _of_robot(state, old),  # type: ignore[misc]
            cannot=waits,
        )
        what = removal_of(earlier)
        yield Step(
            what=what,
            act=partial(_remove_earlier, plan, earlier),
            done=lambda what=what: what in ran,  # type: ignore[misc]
            live=plan.has_own_broker,
            cannot=waits,
        )


def removal_of(robot: str) -> str:
    """The step after which an earlier name is forgotten."""
    return f"the retained messages of {robot} leave the broker"


def _waiting_config(plan: Plan) -> str:
    """Why an earlier name is in use still: the config that has it is not ours."""
    file = plan.places.config
    if not plan.manifest.leaving or not file.exists():
        return ""
    if plan.manifest.is_ours(plan.places.named(file), content := file.read_bytes()):
        return ""
    if json.loads(content)["robot"]["id"] == plan.answers.id:
        return ""
    return f"{plan.places.named(file)} was changed by hand: set robot.id there, as in {file.name}{BESIDE}, then again"


def _remove_earlier(plan: Plan, earlier: str) -> None:
    remove_retained(plan, earlier)
    plan.manifest.ran[removal_of(earlier)] = ""


def remove_retained(plan: Plan, robot: str) -> None:
    """Remove the retained messages of a robot of this name with the login of this one's config. Raises PebbleError."""
    file = plan.places.config
    is_elsewhere = plan.has_own_broker and not plan.places.is_live
    if not file.exists() or plan.answers.broker == NONE or is_elsewhere:
        return
    raw = json.loads(file.read_bytes())
    raw["robot"]["id"] = robot
    retained.remove(parse(raw, folder=file.parent, env=os.environ))


def _of_robot(folder: Path, name: str) -> list[Path]:
    """Files that the robot with this name of files has saved."""
    return sorted(path for path in folder.glob("*") if re.search(rf"-{re.escape(name)}\.[a-z.]+$", path.name))


def _rename(folder: Path, old: str, new: str) -> None:
    for path in _of_robot(folder, old):
        path.rename(path.with_name(path.name.replace(f"-{old}.", f"-{new}.")))


def _users(plan: Plan) -> Iterator[Step]:
    root = plan.places.root
    entry = root / "etc/sysusers.d/pebble.conf"
    if not (root / "usr/lib/sysusers.d/pebble.conf").exists():
        yield Step(what="entry of the user pebble", target=entry, content=_SYSUSERS)
    yield Step(what="user pebble", command=("systemd-sysusers", entry.name), done=_has_user_pebble, live=True)


def _has_user_pebble() -> bool:
    try:
        pwd.getpwnam("pebble")
    except KeyError:
        return False
    return True


def _passwords(plan: Plan) -> Iterator[Step]:
    whose = {plan.broker_password: "the robot", plan.page_password: "the robot's page"}
    for target, name in whose.items():
        content: bytes | Callable[[], bytes] = _new_password
        if target == plan.page_password and not (plan.answers.page and plan.has_own_broker):
            continue
        if not plan.has_own_broker:
            if not plan.has_login:
                continue
            given = plan.secrets.broker_password
            content = f"{given}\n".encode() if given is not None else _no_password
        yield Step(what=f"password of {name} at its broker", target=target, content=content, mode=0o640, owner=_ROBOTS)


def _new_password() -> bytes:
    return f"{new_password()}\n".encode()


def _no_password() -> bytes:
    raise SetupError("there is no password: --broker-password-file FILE")


def _own_broker(plan: Plan) -> Iterator[Step]:
    places, cannot = plan.places, plan.machine.mosquitto
    folder = places.broker_folder
    wanted = own_broker.fleet_of(plan.answers.account, plan.base, Path(places.named(places.people)))

    def passwords() -> dict[str, str]:
        files = {plan.answers.account: plan.broker_password, own_broker.PAGE: plan.page_password}
        return {name: file.read_text(encoding="utf-8").strip() for name, file in files.items() if file.exists()}

    earlier = set() if _waiting_config(plan) else {account_of(robot) for robot in plan.manifest.leaving}
    yield Step(
        what="accounts, rules and certificate of the robot's own broker",
        target=folder,
        make=lambda new: own_broker.make(new, wanted, passwords()),
        mode=0o700,
        owner="mosquitto:mosquitto",
        cannot=cannot,
    )
    yield Step(
        what="mosquitto listens with logins, and beyond this machine encrypted",
        target=places.broker,
        content=own_broker.conf_text(places, wanted),
        cannot=cannot,
    )
    yield Step(
        what=f"accounts of {plan.answers.id} and its page",
        act=lambda: own_broker.change(folder, wanted, passwords(), earlier),
        done=lambda: folder.exists() and own_broker.knows(folder, wanted, passwords()),
        changes=(folder / ACL, folder / FLEET, folder / PASSWORDS),
        cannot=cannot,
    )
    yield _restart_of_mosquitto(plan, cannot)


def _restart_of_mosquitto(plan: Plan, cannot: str = "") -> Step:
    restart, folder = ("systemctl", "restart", "mosquitto.service"), plan.places.broker_folder
    return Step(
        what=_MOSQUITTO,
        command=restart,
        after=restart,
        of=(plan.places.broker, folder / certificates.SERVER_CERT, folder / ADMIN_PASSWORD),
        cannot=cannot or plan.machine.systemd,
        live=True,
    )


def _other_broker(plan: Plan) -> Iterator[Step]:
    if _MOSQUITTO in plan.manifest.ran:  # with a part that was ours, and is removed
        yield _restart_of_mosquitto(plan)
    if plan.answers.remote is None:
        return
    if plan.answers.broker_ca is not None:
        yield Step(what="authority of the broker", target=plan.ca, content=_authority(Path(plan.answers.broker_ca)))
    host, port = plan.answers.remote
    yield Step(what=f"broker {host}:{port} lets the robot in", done=lambda: True, cannot=_refusal(plan))


def _authority(file: Path) -> bytes | Callable[[], bytes]:
    """The file that was named; later that may be gone, and its copy stays."""
    try:
        return file.read_bytes()
    except OSError as error:
        why = f"broker_ca: {file}: {error.strerror}"

        def raise_() -> bytes:
            raise SetupError(why)

        return raise_


def _refusal(plan: Plan) -> str:
    """Why the broker does not let the robot in; empty: it does."""
    host, port = plan.answers.remote or ("", 0)
    password = plan.secrets.broker_password
    if password is None and os.access(plan.broker_password, os.R_OK):
        password = plan.broker_password.read_text(encoding="utf-8").strip()
    given = None if plan.answers.broker_ca is None else Path(plan.answers.broker_ca)
    ca = given if given is None or given.is_file() else plan.ca
    user = plan.answers.account if plan.has_login else None
    tls = TlsSettings(ca_cert=ca) if plan.answers.is_far else None
    settings = MqttSettings(host=host, port=port, username=user, password=password, tls=tls)
    found = attempt(settings, login=True)
    if found.code == 0:
        return ""
    why = found.problem if found.code is None else REFUSED_LOGINS.get(found.code, f"code {found.code}")
    return f"it does not: {why}; the robot tries again: pebble doctor {plan.places.named(plan.places.config)}"


def _certificate(plan: Plan) -> Iterator[Step]:
    def make(new: Path) -> None:
        certificates.init(new, certificates.own_names())
        (new / certificates.SERVER_KEY).chmod(0o640)  # the robot reads it; only root signs others

    yield Step(what="certificate of the page", target=plan.places.tls, make=make, mode=0o750, owner=_ROBOTS)


def _config(plan: Plan) -> Iterator[Step]:
    config = config_of(plan)

    def check(_content: bytes) -> None:
        check_connections(parse(config, folder=plan.places.etc, env=os.environ))

    content = json.dumps(config, indent=1).encode() + b"\n"
    yield Step(
        what="config",
        target=plan.places.config,
        content=content,
        check=check,
        mode=0o640,
        owner=_ROBOTS,
        undo_act=partial(remove_retained, plan, str(plan.answers.id)),
    )


def _first_user(plan: Plan) -> Iterator[Step]:
    name, file = str(plan.answers.user), plan.places.people

    def add() -> None:
        with closing(People(file)) as people:
            people.add(name, plan.secrets.password or "", Role.ADMIN)

    yield Step(what=f"{name} may log in at the page, as admin", act=add, done=lambda: has_user(file, name))


def _polkit(plan: Plan) -> Iterator[Step]:
    rules = "polkit-1/rules.d/50-pebble.rules"
    if (plan.places.root / "usr/share" / rules).exists():
        return
    content = (files("pebble") / "configs/systemd/50-pebble.rules").read_bytes()
    what = "the page may restart and reboot the robot"
    yield Step(what=what, target=plan.places.root / "etc" / rules, content=content, cannot=plan.machine.polkit)


def _service(plan: Plan) -> Iterator[Step]:
    places, cannot = plan.places, _no_service(plan)
    yield Step(
        what="the robot starts with the machine",
        command=("systemctl", "enable", _UNIT),
        done=(places.root / _WANTS).exists,
        undo=("systemctl", "disable", "--now", _UNIT),
        live=True,
        cannot=cannot,
    )
    own = (plan.broker_password, plan.page_password, plan.ca, places.tls / certificates.SERVER_CERT)
    yield Step(
        what="the robot runs with this config",
        command=("systemctl", "restart", _UNIT),
        of=(places.config, *own),
        live=True,
        cannot=cannot,
    )


def _no_service(plan: Plan) -> str:
    return plan.machine.systemd or plan.machine.unit
