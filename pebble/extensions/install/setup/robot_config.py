"""Conversion between the answers of ``pebble setup`` and a robot's config."""

import os
from pathlib import Path
from typing import Any

from pebble.config import Config
from pebble.config.hosts import is_loopback
from pebble.extensions.fleet import certificates
from pebble.extensions.fleet.folder import PLAIN_PORT, PORT
from pebble.extensions.install.setup.answers import HERE, NONE, PAGE, Answers, needs_login
from pebble.extensions.operator.places import Places
from pebble.extensions.page.config import WebHandler
from pebble.services.av_daemon.config import AvDaemon

UNIT = "pebble.service"
PAGE_PORT = 8080
BROKER_PASSWORD, PAGE_PASSWORD, BROKER_CA = "broker.password", "page.password", "broker-ca.pem"
_SYSTEMCTL = ["systemctl", "--no-ask-password"]
#: What polkit lets a robot ask of its system: a reboot, a restart, an update.
COMMANDS = (
    [*_SYSTEMCTL, "reboot"],
    [*_SYSTEMCTL, "--no-block", "restart", UNIT],
    [*_SYSTEMCTL, "start", "pebble-update.service"],
)


def answers_of(config: Config, places: Places) -> Answers:
    """Return the answers from which setup would write this config."""
    services, devices = config.services, config.section(AvDaemon)
    line, video, remote = services.serial_mcu_bridge, devices.video, services.mqtt_bridge.remote_mqtt
    has_board = line.enabled and line.serial.port is not None
    has_camera = devices.enabled and video.enabled
    has_broker = services.mqtt_bridge.enabled
    if is_loopback(remote.host) and places.broker.exists():
        broker = HERE
    else:
        host = f"[{remote.host}]" if ":" in remote.host else remote.host
        usual = PLAIN_PORT if is_loopback(remote.host) else PORT
        broker = host if remote.port == usual else f"{host}:{remote.port}"
    return Answers(
        id=config.robot.id,
        port=line.serial.port if has_board else NONE,
        protocol=line.protocol if has_board else None,
        baud=line.serial.baud if has_board else None,
        camera=(video.device if video.backend == "v4l2" else video.backend) if has_camera else NONE,
        broker=broker if has_broker else NONE,
        broker_user=remote.username if has_broker else None,
        broker_ca=str(remote.tls.ca_cert) if has_broker and remote.tls.ca_cert is not None else None,
        page=config.section(WebHandler).enabled,
    )


def changed(current: dict[str, Any], before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Return the present config with the changes that the answers ask for; other hand-written keys stay.

    ``before`` and ``after``: the configs that setup writes for the earlier answers, and for those of now.
    """
    result = dict(current)
    for key in {**before, **after}:
        present, old, new = current.get(key), before.get(key), after.get(key)
        if old == new:
            continue
        if isinstance(present, dict) and (isinstance(old, dict) or isinstance(new, dict)):
            result[key] = changed(present, old or {}, new or {})
        elif key in after:
            result[key] = new
        elif present == old:  # setup writes it no longer, and no person has changed it
            result.pop(key, None)
    return result


def config_of(answers: Answers, places: Places) -> dict[str, Any]:
    """Return the content of robot.json."""
    services: dict[str, Any] = {
        name: {"enabled": False} for name in ("av_daemon", "serial_mcu_bridge", "mqtt_bridge", "web_handler")
    }
    services["av_daemon"]["audio"] = {"enabled": False}
    if answers.camera != NONE:
        services["av_daemon"] |= {"enabled": True, "video": _video(str(answers.camera))}
    if answers.port != NONE:
        line = {"port": answers.port, "baud": answers.speed}
        services["serial_mcu_bridge"] = {"enabled": True, "protocol": answers.protocol, "serial": line}
    if answers.broker != NONE:
        reboot, restart, _update = COMMANDS
        services["mqtt_bridge"] = {
            "enabled": True,
            "remote_mqtt": _broker(answers),
            "reboot_control": {"command": reboot},
            "service_restart_control": {"command": restart},
        }
    config: dict[str, Any] = {
        "//": "Written by `pebble setup`. What is changed here by hand stays; `pebble check --keys` lists all keys.",
        "robot": {"id": answers.id},
        "security": {"level": "login"},
        "transport": {"kind": "zenoh", "state_dir": _from_etc(places, places.state)},
        "services": services,
    }
    if answers.page:
        services["web_handler"] = {"enabled": True}
        files = {"certificate": certificates.SERVER_CERT, "key": certificates.SERVER_KEY, "ca": certificates.CA_CERT}
        config["web_interface"] = {
            "host": "0.0.0.0",  # noqa: S104 - phones are other machines
            "port": PAGE_PORT,
            "tls": {key: f"{places.tls.name}/{file}" for key, file in files.items()},
            "people": _from_etc(places, places.people),
        }
        if answers.broker == HERE:
            config["web_interface"]["mqtt"] = _own_login(PAGE, PAGE_PASSWORD)
    return config


def _video(camera: str) -> dict[str, Any]:
    return {"backend": camera} if camera in ("libcamera", "synthetic") else {"backend": "v4l2", "device": camera}


def _broker(answers: Answers) -> dict[str, Any]:
    """Return the section of the broker for operators."""
    if answers.broker == HERE:
        return _own_login(answers.account, BROKER_PASSWORD)
    host, port = answers.remote or ("", 0)
    remote: dict[str, Any] = {"host": host, "port": port}
    if needs_login(answers):
        remote |= {"username": answers.account, "password_file": BROKER_PASSWORD}
    if answers.is_far:
        remote["tls"] = {"enabled": True} | ({"ca_cert": BROKER_CA} if answers.broker_ca else {})
    return remote


def _own_login(account: str, password: str) -> dict[str, Any]:
    return {"host": "127.0.0.1", "port": PLAIN_PORT, "username": account, "password_file": password}


def _from_etc(places: Places, path: Path) -> str:
    """Return the path relative to the config's folder, so that the config is also valid below another root."""
    return os.path.relpath(path, places.etc)
