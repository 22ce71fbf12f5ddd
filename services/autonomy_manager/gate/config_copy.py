"""Writes the config that a script gets: a copy of the robot's, in which the broker is the gate."""

import json
import os
import shutil
from itertools import islice
from typing import Any

from pebble.config import Config, Mqtt
from pebble.config.secret_text import is_secret, without_secrets
from pebble.errors import PebbleError

_MOST_LINKS = 1000
#: What the original's scripts read of camera and microphone. Where it is missing, each assumes something else.
_MEDIA = {
    "video": ("width", "height", "fps", "rotate_degrees", "socket_path"),
    "audio": ("rate", "channels", "socket_path"),
}


class ConfigCopy:
    """A private folder in the run directory with the copy, and links to what is beside the original."""

    def __init__(self, config: Config) -> None:
        if config.path is None:
            raise PebbleError("a script that speaks MQTT needs the robot's config in a file")
        self._config, self._source = config, config.path
        self._folder = config.run_dir() / "autonomy"
        self.path = self._folder / config.path.name
        self._written: tuple[int, str, str] | None = None

    def write(self, port: int, username: str, password: str) -> None:
        """Write the copy for a gate on loopback ``port``. Raises PebbleError."""
        broker = {"host": "127.0.0.1", "port": port, "username": username, "password": password}
        try:
            self.remove()
            self._folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._folder.mkdir(mode=0o700)
            self._link()
            self.path.touch(mode=0o600, exist_ok=False)
            self.path.write_text(json.dumps(self._data(broker), indent=2, default=str), encoding="utf-8")
        except (OSError, ValueError) as error:
            raise PebbleError(f"the config of scripts, {self.path}, cannot be written: {error}") from None
        self._written = port, username, password

    def keep(self) -> None:
        """Write the copy again if it was removed with the run directory. Raises PebbleError."""
        if (written := self._written) is not None and not self.path.exists():
            try:
                self.write(*written)
            finally:
                self._written = written

    def remove(self) -> None:
        """Delete the folder, not what its links lead to."""
        self._written = None
        shutil.rmtree(self._folder, ignore_errors=True)

    def _data(self, broker: dict[str, Any]) -> dict[str, Any]:
        data = _public(json.loads(self._source.read_text(encoding="utf-8-sig")))
        data["local_mqtt"] = broker
        data["transport"] = {
            "kind": "mqtt",
            "run_dir": str(self._config.run_dir()),
            "state_dir": str(self._config.state_dir()),
        }
        self._fill(data.setdefault("services", {}).setdefault("av_daemon", {}))
        return dict(data)

    def _fill(self, devices: dict[str, Any]) -> None:
        """Write into the section of camera and microphone what it leaves to defaults, and whole paths."""
        for name, keys in _MEDIA.items():
            used = getattr(self._config.services.av_daemon, name)
            values = {key: getattr(used, key) for key in keys}
            devices.setdefault(name, {}).update({key: value for key, value in values.items() if value is not None})

    def _link(self) -> None:
        """Scripts of the original look for ``camera_calibration.yaml`` beside their config."""
        for entry in islice(os.scandir(self._source.parent), _MOST_LINKS):
            if entry.name != self._source.name:
                (self._folder / entry.name).symlink_to(entry.path)


def _public(value: Any) -> Any:
    """``value`` without keys that may hold a secret, and without logins in its texts."""
    if isinstance(value, dict):
        return {key: _public(item) for key, item in value.items() if not is_secret(key)}
    if isinstance(value, list):
        return [_public(item) for item in value]
    return without_secrets(value) if isinstance(value, str) else value


def broker_of(config: Config) -> Mqtt:
    """The broker that has the robot's topics. Raises PebbleError if there is none."""
    broker = config.local_mqtt if config.transport.kind == "mqtt" else config.transport.mqtt_mirror
    if broker is None:
        raise PebbleError("it speaks MQTT, and this robot has no broker: set transport.mqtt_mirror")
    return broker
