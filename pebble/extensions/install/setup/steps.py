"""The steps that set up a robot, in order. Each is checked first, and done only if it is necessary."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from pebble.config import Config, load
from pebble.config.config import parse
from pebble.contract.identity import Identity
from pebble.errors import PebbleError
from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.broker_files import new_password
from pebble.extensions.fleet.people import People, has_user
from pebble.extensions.fleet.roles import Role
from pebble.extensions.install.setup import own_broker
from pebble.extensions.install.setup.answers import (
    HERE,
    KEYS,
    NONE,
    PAGE,
    Answers,
    AnswersError,
    Secrets,
    combined,
    needs_login,
)
from pebble.extensions.install.setup.detect import no_broker
from pebble.extensions.install.setup.robot_config import (
    BROKER_CA,
    BROKER_PASSWORD,
    PAGE_PASSWORD,
    UNIT,
    answers_of,
    changed,
    config_of,
)
from pebble.extensions.install.setup.system import MOSQUITTO, ROBOTS, SetupError, System
from pebble.extensions.operator.places import Places
from pebble.extensions.page.config import WebHandler, WebInterface
from pebble.extensions.page.setting import people_of
from pebble.ownership import read_plain
from pebble.runtime.as_owner import as_owner
from pebble.runtime.connections import check_connections

ROBOT_SERVICE, BROKER_SERVICE = UNIT, "mosquitto.service"


class Step(NamedTuple):
    """A state of the machine to reach. ``restarts``: services that read what the step writes."""

    what: str
    is_done: Callable[[], bool]
    do: Callable[[], object]
    restarts: tuple[str, ...] = (ROBOT_SERVICE,)


def load_config(places: Places) -> Config | None:
    """Return the existing config; None if there is none. Raises ConfigError."""
    if not places.config.exists():
        return None
    return load(places.config, {**os.environ, "STATE_DIRECTORY": str(places.state)})


@dataclass(frozen=True)
class Job:
    """The data of all steps. ``config``: the existing one."""

    system: System
    config: Config | None
    answers: Answers
    secrets: Secrets

    @property
    def places(self) -> Places:
        return self.system.places

    @property
    def earlier(self) -> Answers:
        return Answers() if self.config is None else answers_of(self.config, self.places)

    @property
    def has_login(self) -> bool:
        """True if the robot has logged in at this broker before."""
        return self.config is not None and self.answers.broker == self.earlier.broker

    @property
    def page(self) -> Config | None:
        """The config, if the robot already serves a page."""
        if self.config is None or not self.config.section(WebHandler).enabled:
            return None
        return self.config

    @property
    def people(self) -> Path:
        return self.places.people if self.page is None else people_of(self.page)

    @property
    def needs_user(self) -> bool:
        """True if setup adds a user of the page: if a name was answered, or the page has no user yet."""
        return bool(self.answers.page) and (self.answers.user is not None or not has_user(self.people))

    def with_answers(self, given: Mapping[str, Any], secrets: Secrets | None = None) -> "Job":
        """Return the job with further answers. Raises AnswersError with a line for each mistake."""
        answers = combined(self.answers, given)
        if given.get("broker") == HERE and (why := no_broker(self.places)):
            raise AnswersError(f"broker: {why}")
        return replace(self, answers=answers, secrets=secrets or self.secrets)

    def require(self) -> None:
        """Raise AnswersError with the keys that still need an answer."""
        answers, secrets = self.answers, self.secrets
        is_known = answers.user is not None and has_user(self.people, answers.user)
        is_settled = {  # given, or not needed
            "id": answers.id is not None,
            "port": answers.port is not None,
            "protocol": answers.protocol is not None or answers.port in (None, NONE),
            "camera": answers.camera is not None,
            "broker": answers.broker is not None,
            "broker_user": answers.broker_user is not None or not answers.is_far or self.has_login,
            "broker_password_file": secrets.broker_password is not None or not needs_login(answers) or self.has_login,
            "page": answers.page is not None,
            "user": answers.user is not None or not self.needs_user,
            "password_file": secrets.password is not None or not self.needs_user or is_known,
        }
        if missing := [key for key, settled in is_settled.items() if not settled]:
            raise AnswersError("\n".join(f"{key} is missing: {KEYS[key]}" for key in missing))

    # -- the steps

    def steps(self) -> list[Step]:
        """Return all steps in their order; the config is written after all files that it names."""
        steps = [*self._passwords(), *(self._own_broker() if self.answers.broker == HERE else self._other_broker())]
        if self.answers.page:
            steps += [*self._certificate(), *self._first_user()]
        steps.append(self._config())
        if self.system.has_systemd:
            steps.append(self._enabled())
        return steps

    def _passwords(self) -> Iterator[Step]:
        """Yield the steps that write the passwords of the robot and of its page at the broker."""
        file, page = self.places.etc / BROKER_PASSWORD, self.places.etc / PAGE_PASSWORD
        typed = self.secrets.broker_password
        if typed is not None and self.answers.broker != HERE:
            yield self._file("password of the robot at its broker", file, f"{typed}\n".encode())
        if self.answers.broker == HERE:
            # The robot's password stays if an unfinished setup has made it (there is no config), or if the robot used
            # this same broker before. The page's stays in any case: it was never for another broker.
            keeps_password = self.config is None or self.has_login
            yield self._new_password("password of the robot at its own broker", file, known=keeps_password)
            if self.answers.page:
                yield self._new_password("password of the page at the robot's broker", page)

    def _new_password(self, what: str, file: Path, *, known: bool = True) -> Step:
        """Return the step that writes a new password. With ``known``, a password that is in the file already stays."""
        write = partial(self.system.write, file)
        return Step(what, lambda: known and file.exists(), lambda: write(f"{new_password()}\n".encode()))

    def _file(self, what: str, file: Path, content: bytes, **options: Any) -> Step:
        write = partial(self.system.write, file, content, **options)
        return Step(what, lambda: file.exists() and file.read_bytes() == content, write)

    def _own_broker(self) -> Iterator[Step]:
        """Yield the steps that make mosquitto on this machine the robot's broker."""
        places, folder = self.places, self.places.broker_folder
        base = str(Identity("pebble", "robots", str(self.answers.id))) if self.config is None else self.config.base
        wanted = own_broker.fleet_of(self.answers.account, base, Path(places.named(places.people)))

        def passwords() -> dict[str, str]:
            files = {self.answers.account: places.etc / BROKER_PASSWORD, PAGE: places.etc / PAGE_PASSWORD}
            return {name: file.read_text(encoding="utf-8").strip() for name, file in files.items() if file.exists()}

        def make_or_change() -> None:
            if folder.is_dir():
                own_broker.change(folder, wanted, passwords())
            else:
                make = partial(own_broker.make, fleet=wanted, passwords=passwords())
                self.system.make_folder(folder, 0o700, MOSQUITTO, make)

        yield Step(
            "accounts, rules and certificate of the robot's own broker",
            lambda: folder.is_dir() and own_broker.knows(folder, wanted, passwords()),
            make_or_change,
            # `change` makes a running broker read its files at once; after `make` it has to be restarted.
            (ROBOT_SERVICE,) if folder.is_dir() else (BROKER_SERVICE, ROBOT_SERVICE),
        )
        yield self._file(
            "mosquitto listens with logins, and beyond this machine encrypted",
            places.broker,
            own_broker.conf_text(places, wanted),
            mode=0o644,
            owner="root:root",
        )._replace(restarts=(BROKER_SERVICE,))

    def _other_broker(self) -> Iterator[Step]:
        """Yield the steps that end the robot's own broker, and write the certificate of another broker's authority."""
        broker_conf = self.places.broker
        if broker_conf.exists():
            # False: it is not done yet, as the file exists.
            yield Step("the robot's own broker ends", lambda: False, broker_conf.unlink, (BROKER_SERVICE,))
        if self.answers.broker_ca in (None, self.earlier.broker_ca):
            return
        ca_file = Path(str(self.answers.broker_ca))
        try:
            content = certificates.only_certificates(read_plain(ca_file))
        except OSError as error:
            raise SetupError(f"broker_ca: {ca_file}: {error.strerror}") from None
        if not content:
            raise SetupError(f"broker_ca: {ca_file} holds no certificate")
        yield self._file("authority of the broker", self.places.etc / BROKER_CA, content)

    def _certificate(self) -> Iterator[Step]:
        """Yield the step that makes a certificate for the page, and an authority that signs it."""
        tls = self.places.tls
        if self.page is not None and self.page.section(WebInterface).tls.certificate != tls / certificates.SERVER_CERT:
            return  # the page has another certificate

        def fill(new: Path) -> None:
            certificates.init(new, certificates.own_names())
            (new / certificates.SERVER_KEY).chmod(0o640)  # the robot reads it; only root reads the authority's

        yield Step("certificate of the page", tls.is_dir, lambda: self.system.make_folder(tls, 0o750, ROBOTS, fill))

    def _first_user(self) -> Iterator[Step]:
        """Yield the step that adds the answered user of the page, if one is needed."""
        file, name = self.people, self.answers.user
        if not self.needs_user:
            return

        def add() -> None:
            with as_owner(file.parent), closing(People(file)) as people:
                people.add(str(name), self.secrets.password or "", Role.ADMIN)

        yield Step(f"{name} may log in at the page, as admin", lambda: has_user(file, str(name)), add, restarts=())

    def _config(self) -> Step:
        """Return the step that writes the config, with a copy of the earlier one beside it."""
        file, wanted = self.places.config, config_of(self.answers, self.places)
        current = json.loads(file.read_bytes()) if self.config is not None else {}
        before = config_of(self.earlier, self.places) if self.config is not None else {}
        content = changed(current, before, wanted)

        def write() -> None:
            check_connections(parse(content, folder=self.places.etc, env=os.environ))
            if self.config is not None:
                self.system.write(file.with_name(f"{file.name}.before"), file.read_bytes())
            self.system.write(file, json.dumps(content, indent=1).encode() + b"\n")

        return Step(f"config {self.places.named(file)}", lambda: file.exists() and content == current, write)

    def _enabled(self) -> Step:
        wants = self.places.root / "etc/systemd/system/multi-user.target.wants" / UNIT
        enable = ("systemctl", "enable", UNIT)
        return Step("the robot starts with the machine", wants.exists, lambda: self.system.run(enable))

    # -- doing them

    def left(self) -> list[Step]:
        """Return the steps that are still to be done. Raises PebbleError."""
        return [step for step in self.steps() if not step.is_done()]

    def do(self, steps: list[Step]) -> bool:
        """Do the steps, then restart the services that read the written files; return True if the robot was started.

        Raises SetupError at the first failure.
        """
        unfinished = self.places.unfinished
        services = {service for step in steps for service in step.restarts}
        if unfinished.exists():  # of a setup that failed before its restarts, or of a backup that was restored
            services |= {ROBOT_SERVICE, *([BROKER_SERVICE] if self.answers.broker == HERE else [])}
        try:
            for step in steps:
                if not unfinished.exists():  # written with the first step: without any, nothing is unfinished
                    self.system.write(unfinished, b"")
                step.do()
            for service in (BROKER_SERVICE, ROBOT_SERVICE):
                if service in services and self.system.has_systemd:
                    self.system.run(("systemctl", "restart", service))
            unfinished.unlink(missing_ok=True)
        except (PebbleError, OSError) as error:
            raise SetupError(f"{error}; what was done until then stays, and sudo pebble setup goes on there") from None
        return self.system.has_systemd and ROBOT_SERVICE in services
