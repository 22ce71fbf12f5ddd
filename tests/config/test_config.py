"""Config files: what they mean, and every way in which they can be wrong."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from functools import reduce
from pathlib import Path
from typing import Any, ClassVar

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import ValidationError, convert
from msgspec.structs import asdict

from pebble.config import LAUNCHER_LOCK, Config, load, parse, resolved
from pebble.config.config import file_name
from pebble.config.transport import Tls
from pebble.config.types import Topic
from pebble.contract import CHANNELS, channel_of
from pebble.errors import ConfigError
from pebble.extensions.page.config import WebInterface
from pebble.runtime.connections import hub_settings
from pebble.services.av_daemon.config import AvDaemon
from pebble.services.soundboard_handler.config import SoundboardHandler
from pebble.transports.topics import check_topic
from tests.kit import configs
from tests.support import ROOT

ORIGINAL = ROOT / "tests" / "data" / "original-shaped-config.json"
OURS = ("goob", "fred", "minilamp", "benjr", "pitcam", "minimal")
FOLDER = Path("/nowhere")
INCOMING = "pebble/robots/goob/incoming"
UPLINK = {"kind": "zenoh", "connect": ["tls/base.example:7447"]}
SOCKET = {"socket_path": "/tmp/a.sock"}
LISTENS = {"kind": "zenoh", "listen": ["tcp/127.0.0.1:7447", "quic/[::]:7447"]}


def at(path: str, value: Any) -> dict[str, Any]:
    """A config with one key set, besides the robot's id."""
    raw = configs.at(path, value)
    robot = raw.get("robot", {})
    return {**raw, "robot": {"id": "goob", **robot} if isinstance(robot, dict) else robot}


def read(raw: dict[str, Any], env: Mapping[str, str] | None = None, folder: Path = FOLDER) -> Config:
    return parse(raw, folder=folder, env={} if env is None else env)


def problems(raw: dict[str, Any], env: Mapping[str, str] | None = None, folder: Path = FOLDER) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        read(raw, env, folder)
    return caught.value.problems


def only_problem(raw: dict[str, Any], env: Mapping[str, str] | None = None, folder: Path = FOLDER) -> str:
    found = problems(raw, env, folder)
    assert len(found) == 1, found
    return found[0]


def written(folder: Path, text: str) -> Path:
    path = folder / "robot.json"
    path.write_text(text)
    return path


def file_problem(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert len(caught.value.problems) == 1
    return caught.value.problems[0]


class TestMeaning:
    def test_an_id_is_enough_and_services_run_only_when_asked_except_the_launcher(self) -> None:
        config = read({"robot": {"id": "goob"}})
        assert config.base == "pebble/robots/goob"
        assert (config.identity.system, config.identity.type, config.identity.id) == ("pebble", "robots", "goob")
        assert (config.transport.kind, config.robot.platform, config.warnings) == ("mqtt", "linux", ())
        assert (config.local_mqtt.host, config.local_mqtt.port) == ("127.0.0.1", 1883)
        services = config.services
        enabled = {name for name in services.__struct_fields__ if getattr(getattr(services, name), "enabled", False)}
        assert enabled == {"launcher"}
        with pytest.raises(AttributeError):
            config.log_level = "DEBUG"  # type: ignore[misc]

    @pytest.mark.parametrize("name", OURS)
    def test_our_own_files_load_without_a_remark(self, name: str) -> None:
        config = load(ROOT / "configs" / f"{name}.json", env={})
        assert config.warnings == ()
        assert config.path == ROOT / "configs" / f"{name}.json"

    def test_an_empty_string_and_null_mean_not_set(self) -> None:
        raw = {"host": "", "port": None, "username": "", "tls": None}
        assert read(at("local_mqtt", raw)).local_mqtt == read({"robot": {"id": "goob"}}).local_mqtt

    def test_comments_may_stand_anywhere_and_more_than_once(self, tmp_path: Path) -> None:
        raw = {"//": "x", "robot": {"id": "a", "// id": 3}, "transport": {"kind": "x", "settings": {"// a": 1, "b": 2}}}
        assert load(written(tmp_path, '{"//": 0, ' + json.dumps(raw)[1:])).transport.settings == {"b": 2}

    @pytest.mark.parametrize(
        ("line", "words"),
        [("sudo -n reboot 'now now'", ("sudo", "-n", "reboot", "now now")), (["a", ""], ("a", "")), ([], ())],
    )
    def test_commands_are_words(self, line: Any, words: tuple[str, ...]) -> None:
        config = read(at("services.mqtt_bridge.git_pull_control.command", line))
        assert config.services.mqtt_bridge.git_pull_control.command == words

    def test_paths_are_relative_to_the_file_and_a_mirror_exists_only_where_it_is_written(self, tmp_path: Path) -> None:
        path = written(tmp_path, json.dumps(at("transport", {"kind": "zenoh", "journal": "kept", "run_dir": "/r"})))
        transport = load(path, env={}).transport
        assert (transport.journal, transport.run_dir) == (tmp_path / "kept", Path("/r"))
        assert transport.mqtt_mirror is None
        mirror = read(at("transport", {"kind": "zenoh", "mqtt_mirror": {"port": 1884}})).transport.mqtt_mirror
        assert mirror is not None
        assert (mirror.host, mirror.port) == ("127.0.0.1", 1884)


class TestOriginal:
    def test_it_loads_unchanged_and_is_an_mqtt_robot(self) -> None:
        config = load(ORIGINAL, env={})
        assert config.transport.kind == "mqtt"
        assert config.base == "pebble/robots/rover-7"
        assert config.services.mqtt_bridge.remote_mqtt.host == "broker.example"
        assert config.services.mqtt_bridge.remote_mqtt.password == "change-me"
        assert config.services.mqtt_bridge.reboot_control.command == ("sudo", "-n", "/sbin/reboot")
        assert config.services.serial_mcu_bridge.topics.drive_values == "pebble/robots/rover-7/incoming/drive-values"
        assert list(config.serial_instances()) == [""]

    def test_every_key_whose_meaning_is_gone_is_reported_in_one_line(self) -> None:
        (gone,) = [line for line in load(ORIGINAL, env={}).warnings if "no longer used" in line]
        for key in ("video.shm_size", "audio_publisher.input_shm", "mqtt_bridge.video_control", "heartbeat.qos"):
            assert f" {key}," in gone
        assert gone.endswith("; `pebble check --keys` says what replaces each")

    def test_hall_memory_is_offered_to_its_scripts(self) -> None:
        services = load(ORIGINAL, env={}).services
        assert services.av_daemon.sockets() == {
            "video": Path("/run/pebble/video.sock"), "audio": Path("/run/pebble/audio.sock")
        }  # fmt: skip
        ring = services.serial_mcu_bridge.odometry_shm
        assert ring is not None
        assert (ring.enabled, ring.name) == (True, "pebble_robots_rover-7_odometry_raw")
        own = read({"robot": {"id": "goob"}}).services
        assert (own.av_daemon.sockets(), own.serial_mcu_bridge.odometry_shm) == ({}, None), "only where it is written"

    @pytest.mark.parametrize(
        ("place", "written", "value"),
        [
            ("local_mqtt.port", "1883", 1883),
            ("local_mqtt.tls", "false", Tls()),
            ("log_level", "warn", "WARNING"),
            ("services.mqtt_bridge.heartbeat.enabled", "yes", True),
            ("services.mqtt_bridge.reboot_control.command", ["sleep", 5], ("sleep", "5")),
            ("services.mqtt_bridge.reboot_control.env", {"_A": 1, "B": ""}, {"_A": "1", "B": ""}),
            ("services.av_daemon.video.rotate_degrees", -90, 270),
            ("services.soundboard_handler.playback.player_command", [], ("aplay",)),
            ("services.soundboard_handler", True, SoundboardHandler(enabled=True)),
        ],
    )
    def test_other_forms_of_a_value_are_read_without_a_remark(self, place: str, written: Any, value: Any) -> None:
        config = read(at(place, written))
        assert (reduce(getattr, place.split("."), config), config.warnings) == (value, ())

    @pytest.mark.parametrize(
        ("place", "written", "value", "used"),
        [
            ("robot.battery_cells", 0, None, "not 0; it counts as not set"),
            ("log_level", "LOUD", "INFO", '; "INFO" is used'),
            ("local_mqtt.port", 0, 1883, "not 0; 1883 is used"),
            ("services.serial_mcu_bridge.safety.drive_timeout_seconds", 0, 0.75, "not 0; 0.75 is used"),
            ("services.serial_mcu_bridge.safety.drive_timeout_seconds", "9", 5, 'not the text "9"; 5 is used'),
            ("services.av_daemon.video.rotate_degrees", 45, 0, "not 45; 0 is used"),
            ("services.launcher.enabled", [], True, "not a list; true is used"),
        ],
    )
    def test_a_form_of_the_original_is_replaced_with_a_warning(
        self, place: str, written: Any, value: Any, used: str
    ) -> None:
        config = read(at(place, written))
        (warning,) = config.warnings
        assert warning.startswith(f"{place}: must be ")
        assert warning.endswith(used)
        assert reduce(getattr, place.split("."), config) == value

    def test_other_names_of_keys_are_read_and_names_that_begin_with_an_underscore_are_not(self, tmp_path: Path) -> None:
        (tmp_path / "ca.pem").write_text("x")
        raw = at("local_mqtt.tls", {"enabled": 1, "ca_certs": "ca.pem", "_why": "a\nb"})
        raw["services"] = {"_old": {"enabled": True}, "av_daemon": {"video": {"controls": {"brightness": 3}}}}
        config = read(raw, folder=tmp_path)
        assert config.local_mqtt.tls.ca_cert == tmp_path / "ca.pem"
        assert config.section(AvDaemon).video.camera_controls == {"brightness": 3}
        assert config.warnings == ()

    def test_without_a_remote_host_operators_connect_to_the_robots_own_broker(self) -> None:
        place = "services.mqtt_bridge.remote_mqtt.host"
        bridge, own = {"enabled": True, "remote_mqtt": {"host": ""}}, {"host": "10.0.0.2", "port": 1884}
        raw = at("services.mqtt_bridge", bridge)
        config = read({**raw, "local_mqtt": own})
        (warning,) = config.warnings
        assert (
            warning == f"{place}: is empty: there is no uplink, operators connect to the robot's own broker, 10.0.0.2"
        )
        assert asdict(config.services.mqtt_bridge.remote_mqtt) == {**asdict(config.local_mqtt), "client_id": None}
        mirrored = read({**raw, "transport": {"kind": "zenoh", "mqtt_mirror": own}})
        assert mirrored.services.mqtt_bridge.remote_mqtt.port == 1884
        alone = read({**raw, "transport": {"kind": "zenoh"}})
        assert [line.partition(",")[0] for line in alone.warnings] == [f"{place}: is empty: there is no uplink"]
        assert not alone.services.mqtt_bridge.enabled
        board = {**raw, "robot": {"id": "a", "platform": "esp32"}}
        assert only_problem(board) == f"{place}: is missing, write the name of the remote broker"

    @pytest.mark.parametrize(
        ("section", "command", "expected"),
        [
            ("service_restart_control", ["sudo", "-n", "systemctl", "restart", "pebble-control.service"],
             "starts the original, too, at the same serial port, and needs a right that our unit denies: "
             "write `systemctl --no-block restart pebble.service`"),
            ("reboot_control", "/usr/bin/sudo -n /sbin/reboot", "needs a right that our unit denies: write"),
            ("git_pull_control", "git -C /opt/pebble pull --ff-only", "updates Pebble only if it runs from"),
            ("reboot_control", "systemctl --no-ask-password reboot", ""),
            ("git_pull_control", "/opt/pseudo/digit pull", ""),
        ],
    )  # fmt: skip
    def test_commands_of_the_original_are_pointed_out(self, section: str, command: Any, expected: str) -> None:
        bridge = {"enabled": True, "remote_mqtt": {"host": "a"}, section: {"command": command}}
        (warning,) = read(at("services.mqtt_bridge", bridge)).warnings or ("",)
        assert warning.removeprefix(f"services.mqtt_bridge.{section}.command: ").startswith(expected)
        assert bool(warning) == bool(expected)
        assert read(at("services.mqtt_bridge", {**bridge, "enabled": False})).warnings == ()


class TestOverridePoints:
    PATHS = tuple(one.override.removeprefix("services.") for one in CHANNELS if one.override is not None)

    @pytest.mark.parametrize("path", PATHS)
    def test_each_is_a_key_that_is_not_set_by_itself_and_takes_a_topic(self, path: str) -> None:
        def value(config: Config) -> Any:
            found: Any = config.services
            for key in path.split("."):
                found = getattr(found, key)
            return found

        assert value(read({"robot": {"id": "goob"}})) is None
        assert value(read(at(f"services.{path}", "other/topic"))) == "other/topic"
        assert only_problem(at(f"services.{path}", "other/#")).startswith(f"services.{path}: must be a topic")
        assert only_problem(at(f"services.{path}", "pebble/robots/goob/incoming/estop")).startswith(f"services.{path}")

    @pytest.mark.parametrize(
        "metric",
        ["incoming/estop", "incoming/estop-reset", "outgoing/estop/mcu", "incoming/control", "incoming/control/take",
         "outgoing/control/mcu"],
    )  # fmt: skip
    def test_no_channel_takes_a_topic_of_an_emergency_stop_or_control_and_those_keep_theirs(self, metric: str) -> None:
        """Not even another robot's: the driver of this one would stop that one."""
        channel = channel_of(metric)
        assert channel is not None
        assert channel.override is None
        for base in ("pebble/robots/goob", "pebble/robots/other"):
            line = {"enabled": True, "serial": {"port": "/dev/null"}, "topics": {"drive_values": f"{base}/{metric}"}}
            problem = only_problem(at("services.serial_mcu_bridge.instances", {"arm": line}))
            assert "not one of an emergency stop" in problem
        assert read(at("services.launcher.logs.topic", f"site/{metric}"))  # nobody's

    @given(st.text(st.characters(codec="utf-8"), min_size=1, max_size=260) | st.text("a/", min_size=190, max_size=260))
    def test_every_transport_carries_an_accepted_topic(self, topic: str) -> None:
        with suppress(ValidationError):
            assert check_topic(convert(topic, Topic)) == topic

    @pytest.mark.parametrize(
        ("services", "expected"),
        [
            (
                {"serial_mcu_bridge": {"topics": {"drive_values": "a/b", "lights_solid": "a/b"}}},
                "serial_mcu_bridge.topics.lights_solid: is also the topic of incoming/drive-values, choose another",
            ),
            (
                {"mqtt_bridge": {"heartbeat": {"topic": "pebble/robots/goob/outgoing/status"}}},
                "mqtt_bridge.heartbeat.topic: is also the topic of outgoing/status, choose another",
            ),
            (
                {"serial_mcu_bridge": {"instances": {"rear": {"topics": {"lights_flash": f"{INCOMING}/audio"}}}}},
                "serial_mcu_bridge.instances.rear.topics.lights_flash: is also the topic of incoming/audio, choose",
            ),
        ],
    )
    def test_two_channels_with_one_topic_are_an_error(self, services: dict[str, Any], expected: str) -> None:
        assert only_problem(at("services", services)).startswith(f"services.{expected}")

    def test_lines_may_share_a_channel_and_channels_may_change_places(self) -> None:
        swapped = {"drive_values": f"{INCOMING}/lights-solid", "lights_solid": f"{INCOMING}/drive-values"}
        read(at("services.serial_mcu_bridge.topics", swapped))
        read(at("services.serial_mcu_bridge", {"topics": {"drive_values": "a/b"}, "instances": {"b": {}, "c": {}}}))


class TestSerialInstances:
    ROOT_LINE: ClassVar[dict[str, Any]] = {
        "enabled": True,
        "serial": {"port": "/dev/a", "baud": 9600},
        "safety": {"drive_timeout_seconds": 0.4},
        "topics": {"drive_values": "x/drive"},
    }

    def test_an_instance_is_laid_over_the_root_entry_object_by_object(self) -> None:
        rear = {"serial": {"port": "/dev/b"}, "topics": {"drive_values": ""}}
        instances = {"rear": {**rear, "safety": {"drive_timeout_seconds": 0.2}}, "off": {**rear, "enabled": False}}
        lines = read(at("services.serial_mcu_bridge", {**self.ROOT_LINE, "instances": instances})).serial_instances()
        assert list(lines) == ["", "rear"], "zero and false cover, an empty string does not"
        found = lines["rear"]
        assert (found.serial.port, found.serial.baud) == ("/dev/b", 9600)
        assert found.safety.drive_timeout_seconds == 0.2
        assert found.topics.drive_values == "x/drive"
        assert lines[""].safety.drive_timeout_seconds == 0.4

    def test_the_root_entry_is_a_line_only_with_a_port(self) -> None:
        raw = {"enabled": True, "instances": {"rear": {"serial": {"port": "/dev/b"}}}}
        assert list(read(at("services.serial_mcu_bridge", raw)).serial_instances()) == ["rear"]

    @pytest.mark.parametrize(
        ("instances", "expected"),
        [
            ({"rear": {}}, "instances.rear: shares /dev/a with serial_mcu_bridge"),
            ({"": {"serial": {"port": "/dev/b"}}}, "instances.: must be named with"),
            ({"rear": 5}, "instances.rear: must be an object {…}, not 5"),
            (
                {"rear": {"instances": {"b": {}}, "serial": {"port": "/dev/b"}}},
                "instances.rear.instances: must be left",
            ),
        ],
    )
    def test_mistakes(self, instances: dict[str, Any], expected: str) -> None:
        raw = at("services.serial_mcu_bridge", {**self.ROOT_LINE, "instances": instances})
        assert only_problem(raw).startswith(f"services.serial_mcu_bridge.{expected}")


class TestMistakes:
    @pytest.mark.parametrize(
        ("path", "value", "expected"),
        [
            ("robot.description", "x" * 61, "must be one line, 60 characters at most"),
            ("robot", 5, "must be an object {…}, not 5"),
            ("local_mqtt.port", 65536, "must be a whole number from 1 to 65535"),
            ("local_mqtt.port", True, "must be a whole number"),
            ("local_mqtt.tls.insecure", "maybe", "must be true or false, not text"),
            ("security.level", False, 'must be "open", "login" or "named", not false'),
            ("local_mqtt.tls.ca_cert", 5, "must be a path, not 5"),
            ("services.launcher.logs.topic", "+0", "must be a topic: 1 to 250 characters, no + or #"),
            ("services.launcher.logs", "+0", 'must be an object {…}, not the text "+0"'),
            ("services.launcher.enabled", "-0", 'must be true or false, not the text "-0"'),
            ("robot.system", "+0", "must be a topic level"),
            ("local_mqtt.protocol", "0", 'must be "3.1.1" or "5", not the text "0"'),
            ("services.homeassistant.expose", "00", 'must be a list […], not the text "00"'),
            ("services.ros1_bridge.telemetry.wheel_odometry.enabled", "x", "must be true or false, not text"),
            ("services.soundboard_handler.playback.player_command", " ", "holds no word: write a list of words"),
            ("local_mqtt.port", [], "must be a whole number from 1 to 65535, not a list"),
            ("local_mqtt.password_file", "~nobody-at-all/x", "names a home folder that"),
            ("local_mqtt.password_file", "a\x00b", "holds U+0000, which is not shown: remove it"),
            ("services.av_daemon.env", {"A\x00B": ""}, 'has a key "A\\u0000B" that holds U+0000'),
            ("services.mqtt_bridge.reboot_control.env", {"A=B": "c"}, "must be the name of a variable, without ="),
            ("local_mqtt.username", "ü" * 40_000, "is longer than MQTT carries, 65535 bytes"),
            ("services.defaults.retained_publish_interval_seconds", float("nan"), "must be a number, not nan"),
            ("services.mqtt_bridge.heartbeat.topic", "$SYS/x", "must be a topic"),
            ("services.mqtt_bridge.reboot_control.command", "sudo 'oops", "cannot be split into words: No closing quo"),
            ("services.serial_mcu_bridge.odometry_shm.name", "../x", "must be a name without /"),
        ],
    )
    def test_a_wrong_value_is_named_with_what_to_write(self, path: str, value: Any, expected: str) -> None:
        found = problems(at(path, value))
        assert found[0].startswith(f"{path}: {expected}"), found

    def test_items_of_lists_are_reported_by_number(self) -> None:
        found = problems(at("transport", {"kind": "zenoh", "listen": ["tcp/0.0.0.0:7447", "7447"]}))
        assert found == [
            'transport.listen[1]: must be a Zenoh endpoint such as "tls/192.168.1.7:7447", not the text "7447"'
        ]
        script = {"args": [{"key": "a", "type": "intt"}, {"label": "b"}]}
        assert [
            line.partition(":")[0] for line in problems(at("services.autonomy_manager.scripts", {"s": script}))
        ] == ["services.autonomy_manager.scripts.s.args[0].type", "services.autonomy_manager.scripts.s.args[1].key"]

    @pytest.mark.parametrize(
        ("path", "nearest"),
        [
            ("services.mqtt_bridge.heartbeet", 'did you mean "heartbeat"?'),
            ("transports", 'did you mean "transport"?'),
            ("services.launcher.web", 'the nearest is "enabled" of capabilities, '),
        ],
    )
    def test_an_unknown_key_names_the_nearest_one(self, path: str, nearest: str) -> None:
        assert only_problem(at(path, {})).startswith(f"{path}: unknown key, {nearest}")

    @pytest.mark.parametrize(
        ("raw", "expected"),
        [
            ({}, "robot.id: is missing, write a topic level"),
            (at("local_mqtt", {"hosts": ["a"]}), "local_mqtt: hosts is no key any more: write host, a name that has"),
            (at("transport", {"run_dir": "x"}), "transport.kind: is missing"),
            (at("transport.kind", "mqtt") | at("transport", {"kind": "mqtt", "mqtt_mirror": {}}),
             "transport.mqtt_mirror: only a Zenoh robot has a mirror"),
            (at("transport.kind", "zenoh") | {"robot": {"id": "a", "platform": "esp32"}},
             'transport.kind: must be "mqtt" where robot.platform is "esp32"'),
            (at("services.mqtt_bridge", {"enabled": True, "remote": {"kind": "zenoh"}}),
             "services.mqtt_bridge.remote.connect: is missing"),
            (at("services.mqtt_bridge.remote", {**UPLINK, "listen": ["tls/0.0.0.0:7447"]}),
             "services.mqtt_bridge.remote.listen: "),
            *((at("services.serial_mcu_bridge", {"enabled": True, **section}),
               f"services.serial_mcu_bridge.{line}serial.port: is missing")
              for section, line in (({}, ""), ({"instances": {"rear": {}}}, "instances.rear."))),
            (at("services.av_daemon", {"enabled": True, "video": SOCKET, "audio": SOCKET}),
             "services.av_daemon.audio.socket_path: is also that of video, write another"),
            (at("services.mqtt_bridge.link", {"kbit": 9.6}),
             'services.mqtt_bridge.link.kbit: has no effect at profile "wide": write "thin" or "auto"'),
            (at("services.mqtt_bridge", {"link": {"profile": "auto"},
                                         "remote": {"kind": "zenoh", "connect": ["tcp/a:1"]}}),
             'services.mqtt_bridge.link.profile: cannot be "auto": only MQTT connections are measured'),
            (at("services.mqtt_bridge.remote", {**UPLINK, "account": "goob"}),
             "services.mqtt_bridge.remote.account: needs tls.client_cert, in which it is the name"),
            (at("services.mqtt_bridge.remote", {**UPLINK, "account": "Goob"}),
             "services.mqtt_bridge.remote.account: must be the name of an account"),
            # who listens for other machines names who signs their certificates
            (at("transport", LISTENS), "transport.tls.enabled: must be true, quic/[::]:7447 needs"),
            (at("transport", {**LISTENS, "tls": {"enabled": True}}),
             "transport.tls.ca_cert: is missing: without it anybody may connect to quic/[::]:7447"),
            ({"robot": {"id": "a", "type": "servers"}}, 'robot.type: must not be "servers"'),
            *(
                (at("web_interface", keys), f"web_interface.{expected}")
                for keys, expected in (
                    ({"tls": {"certificate": "a"}}, "tls.key: is missing, it belongs to certificate"),
                    ({"tls": {"key": "a"}}, "tls.certificate: is missing, it belongs to key"),
                )
            ),
        ],
    )  # fmt: skip
    def test_missing_and_contradicting_keys_are_named(self, raw: dict[str, Any], expected: str) -> None:
        assert only_problem(raw).startswith(expected)

    @pytest.mark.parametrize(
        ("place", "value", "warning"),
        [
            ("services.mqtt_bridge.heartbeat", {"qos": 0, "retain": False},
             ".qos, services.mqtt_bridge.heartbeat.retain: no longer used, the contract fixes QoS and retain flag"),
            ("services.mqtt_bridge", {"remote": UPLINK, "remote_mqtt": {"host": "broker.example"}},
             '.remote_mqtt: not used: remote.kind is "zenoh"'),
            ("services.serial_mcu_bridge", {"safety": {"stop_on_shutdown": False}, "instances": {"a": {}}},
             ".safety.stop_on_shutdown: "),
            ("services.serial_mcu_bridge", {"safety": {"ignore_retained_drive": False}},
             ".safety.ignore_retained_drive: "),
            ("services.av_daemon", {"enabled": True, "audio": {"socket_path": "/none/a.sock"}},
             ".audio.socket_path: there is no folder /none"),
            ("local_mqtt.password", "x", ": is not sent: there is no username"),
            ("local_mqtt", {"tls": {"ca_cert": "ca.pem"}}, ".tls.enabled: is false: nothing is encrypted, ca_cert unu"),
            *((place, {"port": 1}, ": is not read: nothing that is installed has a section of this name")
              for place in ("charging", "services.mqtt_logger", "version", "services.web")),
            ("web_interface", {"mqtt_history": {"enabled": True}},
             ".mqtt_history: no longer used, `services.recorder` records into"),
            ("web_interface", {"robots": [{"id": "goob", "video": {"controls": True}}]},
             ".robots[0].video: no longer used, robots say"),
        ],
    )  # fmt: skip
    def test_what_has_no_effect_is_one_warning(self, place: str, value: Any, warning: str) -> None:
        (found,) = read(at(place, value)).warnings
        assert found.startswith(f"{place}{warning}")

    def test_the_names_of_certificates_that_may_connect(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("text")
        names = {"kind": "zenoh", "allowed_names": ["anna", "base station"]}
        endpoints = {"listen": ["tls/0.0.0.0:7447"], "tls": {"enabled": True, "ca_cert": "file"}}
        config = read(at("transport", names | endpoints), folder=tmp_path)
        assert (config.transport.allowed_names, config.warnings) == (("anna", "base station"), ())
        assert hub_settings(config).allowed_names == ("anna", "base station")
        assert read(at("transport", {"kind": "zenoh"})).transport.allowed_names is None
        assert read(at("transport", names)).warnings == (
            "transport.allowed_names: has no effect: no tls/ or quic/ endpoint is listed",
        )
        assert only_problem(at("transport", {"kind": "zenoh", "allowed_names": [""]})).startswith(
            "transport.allowed_names[0]: must be the name in a certificate"
        )
        both = at("transport", names | endpoints | {"access": "file"})
        assert only_problem(both, folder=tmp_path).startswith("transport.allowed_names: must be left out: access says")
        config = read(at("transport", {"kind": "zenoh", "access": "file"} | endpoints), folder=tmp_path)
        assert hub_settings(config).access == tmp_path / "file"


def _nested(levels: int) -> str:
    return (
        '{"robot": {"id": "a"}, "transport": {"kind": "x", "settings": ' + '{"a":' * levels + "1" + "}" * levels + "}}"
    )


class TestFiles:
    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ('{\n "robot": {"id": "a",}\n}', "robot.json: line 2, column 22: not JSON: "),
            ("", "robot.json: line 1, column 1: not JSON"),
            ("[" * 100_000, "robot.json: nested too deeply"),
            *((_nested(levels), "transport.settings: is nested more than 50 levels deep") for levels in (60, 900)),
            ('{"a": ' + "9" * 5000 + "}", "robot.json: not JSON: Exceeds the limit"),
            ("[]", "(the whole file): must be an object {…}, not a list"),
            ('{"robot": {"id": "a", "id": "b"}}', "robot.id: occurs twice in one object"),
            ('{"robot": {"id": "a"}, "local_mqtt": {"port": 1e999}}', "local_mqtt.port: must be a number, not inf"),
        ],
    )
    def test_text_that_is_not_a_config(self, tmp_path: Path, text: str, expected: str) -> None:
        assert expected in file_problem(written(tmp_path, text))

    def test_no_file_a_folder_and_no_text(self, tmp_path: Path) -> None:
        assert file_problem(tmp_path / "none.json").endswith("none.json: there is no such file")
        assert "is a folder" in file_problem(tmp_path)
        (tmp_path / "binary").write_bytes(b"{\xff")
        assert "is not UTF-8 at its byte 1, in line 1" in file_problem(tmp_path / "binary")
        (loop := tmp_path / "loop.json").symlink_to(loop)
        assert "cannot be read" in file_problem(loop)
        world = written(tmp_path, '{"family": "APRILTAG_25h9", "robots": {"goob": {}}}')
        assert "this is a world file" in file_problem(world)


class TestPasswords:
    SECRET = "correct horse"

    def remote(self, **keys: Any) -> dict[str, Any]:
        return at("services.mqtt_bridge.remote_mqtt", {"username": "goob", **keys})

    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        (tmp_path / "password").write_text(f"{self.SECRET}\n")
        return tmp_path

    @pytest.mark.parametrize(
        "keys", [{"password": SECRET}, {"password_file": "password"}, {"password_env": "PEBBLE_PASSWORD"}]
    )
    def test_it_comes_from_three_places_and_is_never_shown(self, folder: Path, keys: dict[str, str]) -> None:
        config = read(self.remote(**keys), {"PEBBLE_PASSWORD": self.SECRET}, folder)
        assert config.services.mqtt_bridge.remote_mqtt.password == self.SECRET
        assert self.SECRET not in repr(config)
        assert self.SECRET not in json.dumps(resolved(config))

    @pytest.mark.parametrize(
        ("keys", "expected"),
        [
            ({"password_file": "none"}, "password_file: there is no such file in /"),
            ({"password_file": "fifo"}, "password_file: /"),
            ({"password_file": "key"}, "password_file: holds several lines, a password is one"),
            ({"password_env": "NOT_SET"}, "password_env: the environment variable NOT_SET is not set"),
            ({"password": SECRET, "password_env": "X"}, "password_env: is a second password beside password"),
        ],
    )
    def test_mistakes_do_not_show_the_password(self, folder: Path, keys: dict[str, Any], expected: str) -> None:
        os.mkfifo(folder / "fifo")
        (folder / "key").write_text("4711\n4711\n")
        found = only_problem(self.remote(**keys), {}, folder)
        assert found.startswith(f"services.mqtt_bridge.remote_mqtt.{expected}")
        assert self.SECRET not in found
        assert "4711" not in found

    def test_values_of_variables_and_words_of_commands_are_hidden_too(self) -> None:
        look = {"env": {"API_KEY": "k3y", "STREAM_PASS": "p4ss", "PLAIN": "pl41n"}}
        look["args"] = [{"key": "api_key", "default": "d3fault"}]  # type: ignore[assignment]
        stream = {
            "command": [
                "stream",
                "--api-key=0ption",
                "key-int-max=15",
                "rtsp://me:p@ss@cam.example/x?token=qu3ry&fps=5",
            ],
        }
        raw = at("services.video_stream", stream)
        raw["services"]["autonomy_manager"] = {"scripts": {"look": look}}
        raw["services"]["mqtt_bridge"] = {"reboot_control": {"env": {"X": "y0u"}}}
        raw["transport"] = {"kind": "other", "settings": {"API_KEY": "an0ther"}}
        shown = resolved(read(raw))
        scripts = shown["services"]["autonomy_manager"]["scripts"]
        assert scripts["look"]["env"] == dict.fromkeys(look["env"], "***")
        assert shown["services"]["video_stream"]["command"] == ["stream", "***", "***", "***"]
        assert all(secret not in json.dumps(shown) for secret in ("y0u", "an0ther", "d3fault"))


class TestWebInterface:
    @pytest.mark.parametrize(
        ("host", "local"), [("127.1.2.3", True), ("::1", True), ("::", False), ("goob.local", False)]
    )
    def test_it_is_for_this_machine_by_default(self, host: str, local: bool) -> None:
        web = read({"robot": {"id": "goob"}}).web_interface
        assert (web.host, web.port, web.local, web.mqtt.host) == ("127.0.0.1", 8080, True, "")
        assert (web.plain_http, web.plain_http_drive) == (False, False)
        config = read(at("web_interface.host", host))
        assert config.section(WebInterface).local is local
        warned = [] if local else [f"web_interface.host: other machines reach {host}"]
        assert [warning.partition(", ")[0] for warning in config.warnings] == warned
        assert read(at("web_interface", {"host": host, "plain_http": not local})).warnings == ()


def test_missing_files_and_half_a_pair_of_a_certificate_are_problems(tmp_path: Path) -> None:
    raw = at("transport", {"kind": "zenoh", "tls": {"enabled": True, "client_key": "no.key"}})
    assert problems(raw, {}, tmp_path) == [
        f"transport.tls.client_key: there is no file {tmp_path / 'no.key'}",
        "transport.tls.client_cert: is missing, it belongs to client_key",
    ]


class TestRunDirectory:
    @pytest.mark.parametrize(
        ("env", "parent"),
        [
            ({"XDG_RUNTIME_DIR": "/run/user/7", "TMPDIR": "/t"}, "/run/user/7/pebble"),
            ({}, "/tmp/pebble-"),
            ({"XDG_RUNTIME_DIR": "/run/caf\udce9", "TMPDIR": "/t\udce9"}, "/tmp/pebble-"),  # sockets need UTF-8
        ],
    )
    def test_each_robot_has_its_own(self, env: dict[str, str], parent: str) -> None:
        goob, fred = (read({"robot": {"id": name}}, env).run_dir() for name in ("goob", "fred"))
        assert str(goob).startswith(parent)
        assert goob != fred
        assert len(goob.name) == 8
        assert int(goob.name, 16) >= 0

    def test_a_tool_in_a_shell_finds_that_of_our_unit(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("pebble.config.config.RUN_DIR_OF_UNIT", tmp_path)
        goob, fred = {"robot": {"id": "goob"}}, {"robot": {"id": "fred"}}
        assert read(goob, {}).run_dir() != tmp_path
        for text in ("", "1\n", "1\npebble/robots/fred\n", "\xff\n\xff"):
            (tmp_path / LAUNCHER_LOCK).write_text(text)
            assert read(goob, {}).run_dir() != tmp_path, text
        (tmp_path / LAUNCHER_LOCK).write_text("1\npebble/robots/goob\n")
        assert read(goob, {"XDG_RUNTIME_DIR": "/run/user/7"}).run_dir() == tmp_path
        assert read(fred, {}).run_dir() != tmp_path
        assert read(goob, {"RUNTIME_DIRECTORY": "/run/other"}).run_dir() == Path("/run/other")

    def test_the_configs_own_comes_before_all_then_systemds(self, tmp_path: Path) -> None:
        systemds = {"RUNTIME_DIRECTORY": "/run/pebble:/run/more", "XDG_RUNTIME_DIR": "/run/user/7"}
        assert read({"robot": {"id": "goob"}}, systemds).run_dir() == Path("/run/pebble")
        raw = at("transport", {"kind": "zenoh", "run_dir": "run"})
        assert read(raw, systemds, tmp_path).run_dir() == tmp_path / "run"
        with pytest.raises(ConfigError, match=r"transport.run_dir: /caf\\udce9/run: is no UTF-8"):
            read(raw, {}, Path("/caf\udce9"))


class TestStateDirectory:
    @pytest.mark.parametrize(
        ("env", "parent"),
        [
            ({"STATE_DIRECTORY": "/var/lib/pebble:/more", "XDG_STATE_HOME": "/state"}, "/var/lib/pebble"),
            ({"XDG_STATE_HOME": "/state"}, "/state/pebble"),
            ({}, str(Path.home() / ".local/state/pebble")),
        ],
    )
    def test_each_robot_has_its_own(self, env: dict[str, str], parent: str) -> None:
        assert read({"robot": {"id": "goob"}}, env).state_dir() == Path(parent, "pebble+robots+goob")

    def test_a_directory_that_robots_share_has_a_file_for_each(self, tmp_path: Path) -> None:
        raw = at("transport", {"kind": "mqtt", "state_dir": "state"})
        goob, fred = (read({**raw, "robot": {"id": name}}, {}, tmp_path) for name in ("goob", "fred"))
        assert goob.state_dir() == fred.state_dir() == tmp_path / "state"
        assert goob.state_file("estop-serial") == tmp_path / "state" / "estop-serial-pebble+robots+goob.json"
        assert fred.state_file("estop-serial") != goob.state_file("estop-serial")

    def test_the_longest_identity_is_no_problem_for_a_file_system(self, tmp_path: Path) -> None:
        robot = {"system": "\N{PILE OF POO}" * 64, "type": "t" * 64, "id": "\N{PILE OF POO}" * 64}
        config = read({"robot": robot}, {"XDG_STATE_HOME": str(tmp_path)})
        config.state_dir().mkdir(parents=True)
        config.state_file(f"estop-{'o' * 32}").touch()


class TestResolved:
    def test_it_is_a_config_again_and_means_the_same(self) -> None:
        config = load(ROOT / "configs" / "goob.json", env={})
        shown = resolved(config)
        derived = shown.pop("derived")
        again = read(json.loads(json.dumps(shown)))
        assert resolved(again)["services"] == shown["services"]
        assert derived["base"] == config.base
        assert derived["run_dir"] == str(config.run_dir())
        assert derived["serial_instances"] == ["", "imu"]


def test_a_folder_whose_name_is_no_utf8_has_a_name_for_its_files() -> None:
    long = "/h\udce9/" * 60
    assert file_name("/h\udce9") == "+h\udce9"
    assert len(file_name(long)) == 64
