"""Brokers of several makers, real ones on free loopback ports, and what each was seen to do and to lack.

Two accounts: :data:`ROBOT` may publish all but :data:`FORBIDDEN`, and clients without a name may do everything.
`make long PART=brokers` installs those that are missing.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pebble.extensions.checks.broker.login_attempt import attempt
from pebble.transports import MqttSettings
from tests.support import ROOT, WAIT_S, Broker, Child, free_port, until

ROBOT: Mapping[str, str] = {"username": "robot", "password": "secret"}
FORBIDDEN = ("touch-sensors", "forbidden")  # metrics below any robot's outgoing/
_AEDES = ROOT / ".venv" / "brokers"
_RABBITMQ = Path("/usr/lib/rabbitmq/bin/rabbitmq-server")


def found(program: str) -> str | None:
    """Where a program is: beside this Python, or in the PATH."""
    return shutil.which(program, path=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}")


class Maker(NamedTuple):
    """``make``: starts one in a folder. ``closes``: on a forbidden message. ``by_name``: what it retains comes only to
    subscriptions of exact names."""

    make: Callable[[Path], Broker]
    missing: Callable[[], bool]
    closes: bool = False
    by_name: bool = False


class _Other(Broker):
    """Another program than mosquitto."""

    def __init__(self, port: int, command: list[str]) -> None:
        self.host, self.port, self._command = "127.0.0.1", port, command
        self._process = None
        self.start()


def _mosquitto(folder: Path) -> Broker:
    rules = folder / "acl"
    own = ["user robot", "topic readwrite #", *(f"topic deny pebble/robots/+/outgoing/{one}" for one in FORBIDDEN)]
    rules.write_text("\n".join(["topic readwrite #", *own, ""]))
    return Broker(folder, f"acl_file {rules}")


def _nats(folder: Path) -> Broker:
    deny = json.dumps([f"pebble.robots.*.outgoing.{one}" for one in FORBIDDEN])
    own = f"user: {ROBOT['username']}, password: {ROBOT['password']}, permissions {{ publish {{ deny: {deny} }} }}"
    return _nats_of(folder, "", "no_auth_user: anyone", "{ user: anyone, password: anyone }", f"{{ {own} }}")


def named_nats(folder: Path, robot: str, person: str, passwords: Mapping[str, str], tls: tuple[Path, Path]) -> Broker:
    """It has the rules of level named for one robot and one person. ``tls``: its certificate and its key."""
    subject = f"pebble.robots.{robot}"
    mqtt = ["$MQTT.>"]  # what NATS itself uses for messages with QoS 1
    may = {
        robot: ([f"{subject}.>"], [f"{subject}.>"]),
        person: (
            [f"{subject}.incoming.by.{person}.>", f"{subject}.incoming.estop"],
            [f"{subject}.outgoing", f"{subject}.outgoing.>"],
        ),
    }
    users = (
        f"{{ user: {name}, password: {json.dumps(passwords[name])}, permissions {{ "
        f"publish {{ allow: {json.dumps(publish + mqtt)} }}, subscribe {{ allow: {json.dumps(read + mqtt)} }} }} }}"
        for name, (publish, read) in may.items()
    )
    return _nats_of(folder, f'tls {{ cert_file: "{tls[0]}", key_file: "{tls[1]}" }}', "", *users)


def _nats_of(folder: Path, tls: str, other: str, *users: str) -> Broker:
    port, rules, separator = free_port(), folder / "nats.conf", "\n"
    rules.write_text(f"""
        server_name: one
        listen: "127.0.0.1:{free_port()}"
        jetstream {{ store_dir: "{folder}/store" }}
        mqtt {{ host: "127.0.0.1", port: {port}
            {tls} }}
        {other}
        authorization {{ users: [
            {separator.join(users)}
        ] }}
    """)
    return _Other(port, [found("nats-server") or "nats-server", "-c", str(rules)])


class _RabbitMq(_Other):
    """A private node: its data in ``folder``, and a port mapper of its own, which Erlang would leave running."""

    def __init__(self, folder: Path) -> None:
        port, mapper = free_port(), free_port()
        self._epmd = ["epmd", "-port", str(mapper), "-address", "127.0.0.1"]
        self._mapper: subprocess.Popen[bytes] | None = None
        (folder / "plugins").write_text("[rabbitmq_mqtt].")
        (folder / "definitions.json").write_text(json.dumps(self._definitions()))
        (folder / "rabbitmq.conf").write_text(
            f"listeners.tcp = none\nmqtt.listeners.tcp.1 = 127.0.0.1:{port}\nmqtt.allow_anonymous = true\n"
            "mqtt.default_user = anyone\nmqtt.default_pass = anyone\n"
            f"load_definitions = {folder}/definitions.json\n"
        )
        variables = {
            "HOME": folder,
            "ERL_EPMD_PORT": mapper,
            "RABBITMQ_NODENAME": f"n{port}@localhost",
            "RABBITMQ_DIST_PORT": free_port(),
            "RABBITMQ_CONF_ENV_FILE": "/dev/null",
            "RABBITMQ_CONFIG_FILE": folder / "rabbitmq.conf",
            "RABBITMQ_ADVANCED_CONFIG_FILE": folder / "none.config",
            "RABBITMQ_ENABLED_PLUGINS_FILE": folder / "plugins",
            "RABBITMQ_MNESIA_BASE": folder,
            "RABBITMQ_FEATURE_FLAGS_FILE": folder / "features",
            "RABBITMQ_PID_FILE": folder / "pid",
            "RABBITMQ_LOG_BASE": folder / "log",
            "RABBITMQ_SERVER_ADDITIONAL_ERL_ARGS": "-noinput -kernel inet_dist_use_interface {127,0,0,1}",
            "RABBITMQ_ALLOW_INPUT": "true",  # else a shell stays between this process and the broker
        }
        super().__init__(port, ["env", *(f"{name}={value}" for name, value in variables.items()), str(_RABBITMQ)])

    def start(self) -> None:
        self._mapper = Child(self._epmd, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._process = Child(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        assert until(self.answers, 240, step=0.05), "RabbitMQ did not start"

    def answers(self) -> bool:
        """It listens some time before it lets a client in."""
        return super().answers() and attempt(MqttSettings(host=self.host, port=self.port), login=False).code == 0

    def end(self, how: Callable[[subprocess.Popen[bytes]], None]) -> None:
        super().end(how)
        if self._mapper is not None:
            self._mapper.kill()
            self._mapper.wait(WAIT_S)
            self._mapper = None

    @staticmethod
    def _definitions() -> dict[str, Any]:
        accounts = {"anyone": "anyone", ROBOT["username"]: ROBOT["password"]}
        everything = {"vhost": "/", "configure": ".*", "write": ".*", "read": ".*"}
        allowed = rf"^(?!.*\.outgoing\.({'|'.join(map(re.escape, FORBIDDEN))})$)"
        return {
            "vhosts": [{"name": "/"}],
            "users": [{"name": name, "password": word, "tags": ""} for name, word in accounts.items()],
            "permissions": [{"user": name, **everything} for name in accounts],
            "topic_permissions": [
                {"user": ROBOT["username"], "vhost": "/", "exchange": "amq.topic", "write": allowed, "read": ".*"}
            ],
        }


def _aedes(folder: Path) -> Broker:
    del folder
    port = free_port()
    program = f"""
        import net from "node:net";
        import {{ Aedes }} from "aedes";
        const forbidden = {json.dumps([f"/outgoing/{one}" for one in FORBIDDEN])};
        const broker = await Aedes.createBroker();
        broker.authenticate = (client, name, _word, done) => {{ client.account = name; done(null, true); }};
        broker.authorizePublish = (client, {{ topic }}, done) => {{
            const denied = client?.account === "{ROBOT["username"]}" && forbidden.some((one) => topic.endsWith(one));
            done(denied ? new Error("forbidden") : null);
        }};
        net.createServer(broker.handle).listen({port}, "127.0.0.1");
    """
    # From its folder: there Node.js looks for the packages that such a program imports.
    return _Other(port, ["env", "-C", str(_AEDES), "node", "--input-type=module", "--eval", program])


MAKERS = {
    "mosquitto": Maker(_mosquitto, lambda: False),
    "nats": Maker(_nats, lambda: found("nats-server") is None),
    "rabbitmq": Maker(_RabbitMq, lambda: not _RABBITMQ.exists(), closes=True, by_name=True),
    "aedes": Maker(_aedes, lambda: not (_AEDES / "node_modules/aedes").exists() or found("node") is None, True),
}
