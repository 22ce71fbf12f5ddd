"""A robot at the level named, behind a broker that knows roles and has accounts for people."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

from pebble.extensions.fleet.roles import Account
from tests.ext.fleet.brokers import FleetBroker
from tests.robot.operator import Operator
from tests.robot.rig import BASE, Rig, lines
from tests.support import free_port, until

DRIVE, CONTROL, STATE = "drive-values", "control", "control/serial"
PEOPLE = {"otto": "driver", "mia": "driver", "zoe": "driver", "vera": "viewer", "boss": "driver,safety,maintainer"}
_ids = itertools.count()


class Hall(FleetBroker):
    """The broker of a fleet, as a robot's remote broker: without TLS, because it is on loopback."""

    def __init__(self, folder: Path, level: Literal["login", "named"] = "named") -> None:
        known = {name: Account(roles=tuple(roles.split(","))) for name, roles in PEOPLE.items()}
        robot = {"rover": Account(roles=("robot",), bases=(BASE,))}
        self.plain_port = free_port()
        super().__init__(folder, known | robot, level=level, unencrypted=self.plain_port)

    def client(self, name: str, listens: str = "outgoing/#", **options: Any) -> Operator:
        return Operator(self.plain_port, BASE, listens, login=(name, self.passwords[name]), **options)


class Named(Rig):
    """A robot with an account. ``person`` and ``send`` are for people with accounts of their own.

    ``options`` are a rig's.
    """

    def __init__(
        self, kind: str, hall: Hall, security: Mapping[str, str], *, start: bool = True, **options: Any
    ) -> None:
        self.hall, self._people = hall, dict[str, Operator]()
        options = {"direct": True, "autonomy_manager": {"enabled": True}} | options
        # what a rig needs of its broker, which others end
        remote: Any = SimpleNamespace(port=hall.plain_port, kill=hall.stop, start=hall.start, stop=lambda: None)
        super().__init__(kind, remote=remote, operator=hall.client("boss"), start=False, **options)
        self._people["boss"] = self.operator
        try:
            self.configure(**security)
            if start:
                self.start()
        except BaseException:
            self.close()  # the caller cannot: it has no rig yet
            raise

    def configure(self, **security: str) -> None:
        """Write the config anew; a hub's journal outlives the robot's restart, as the local broker does."""
        raw = json.loads(self.config.read_text()) | {"security": security}
        login = {"username": "rover", "password": self.hall.passwords["rover"]}
        raw["services"]["mqtt_bridge"]["remote_mqtt"] |= login
        raw["transport"] |= {"zenoh": {"journal": str(self.folder / "journal")}}.get(self.kind, {})
        self.config.write_text(json.dumps(raw))
        self.config.chmod(0o600)

    def person(self, name: str) -> Operator:
        if name not in self._people:
            self._people[name] = self.hall.client(name)
        return self._people[name]

    def send(self, name: str, metric: str, body: Any, **options: Any) -> None:
        """Publish under one's own name."""
        self.person(name).send(f"incoming/by/{name}/{metric}", body, **options)

    def sends(self, name: str, metric: str, body: Any, has_effect: Callable[[], object]) -> bool:
        """Publish again and again until it has its effect: what a busy machine holds up is dropped as too late."""
        return until(lambda: has_effect() or self.send(name, metric, body) or has_effect(), step=0.2)

    def state(self) -> dict[str, Any]:
        return self.operator.newest(STATE)

    @contextmanager
    def held(self, name: str, metric: str = CONTROL, for_ms: int = 10_000) -> Iterator[str]:
        """The key of this person's control, which is released at the end."""
        client = {"id": f"{next(_ids):08x}", "for_ms": for_ms}
        held = lambda: self.state().get("id") == client["id"]  # noqa: E731
        assert self.sends(name, metric, client, held), self.state()
        assert (self.state()["by"], self.state()["named"]) == (name, True)
        try:
            yield self.state()["key"]
        finally:
            self.send(name, CONTROL, client | {"want": "release"})

    def judged(self, name: str, key: str, z: float) -> None:
        """What was sent before has been judged: the holder's command, which moves so, has come after it."""
        assert self.sends(name, DRIVE, {"x": 0, "z": z, "key": key}, lambda: lines(self, z)), z

    def close(self) -> None:
        for name, client in self._people.items():
            if name != "boss":
                client.close()
        super().close()
