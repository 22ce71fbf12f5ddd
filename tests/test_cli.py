"""The `pebble` command: what it prints, what it refuses, and how it exits."""

from __future__ import annotations

import fcntl
import itertools
import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble import cli
from pebble.commands import app, show
from pebble.commands.names import Names, base_of
from pebble.commands.outgoing import draft
from pebble.commands.rates import Rates
from pebble.commands.url import UrlError, settings_of
from pebble.contract import CHANNELS
from pebble.errors import PebbleError
from pebble.topic_schemas import schemas
from pebble.transports import Message, MqttSettings, QoS, ZenohSettings
from tests.support import ROOT, Broker, until
from tests.transports.zenoh_net import HubProcess

GOOB = "pebble/robots/goob"
_numbers = itertools.count(1)
GROUP = ("list", "echo", "pub", "hz", "bw")


class Run:
    """One command line, run inside this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys
        self.out = self.err = ""

    def __call__(self, *arguments: str | Path, columns: int = 80) -> int:
        self._monkeypatch.setattr(sys, "argv", ["pebble", *map(str, arguments)])
        self._monkeypatch.setenv("COLUMNS", str(columns))
        code = cli.main()
        self.out, self.err = self._capsys.readouterr()
        return code


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    return Run(monkeypatch, capsys)


def test_a_command_leaves_logging_as_it_was(run: Run) -> None:
    before = list(logging.getLogger("pebble").handlers)
    assert run("--version") == 0
    assert run("nonsense") == 2
    assert logging.getLogger("pebble").handlers == before


def config_file(folder: Path, **changes: Any) -> Path:
    path = folder / "robot.json"
    path.write_text(json.dumps({"robot": {"id": "goob"}, **changes}))
    return path


def program(*arguments: str | Path, **options: Any) -> subprocess.Popen[str]:
    """One command line as a process of its own."""
    command = [sys.executable, "-m", "pebble.cli", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    return subprocess.Popen(command, cwd=ROOT, text=True, **pipes)


# -- help, usage and errors


@pytest.mark.parametrize("command", [(name,) for name in app.COMMANDS] + [("topic", name) for name in GROUP])
def test_every_command_explains_itself_with_an_example(run: Run, command: tuple[str, ...]) -> None:
    assert run(*command, "--help") == 0
    assert f"\n      pebble {command[0]}" in run.out
    assert max(map(len, run.out.splitlines())) <= 80
    assert run.err == ""


@pytest.mark.parametrize("arguments", [(), ("--help",), ("topic",)])
def test_without_a_command_the_commands_are_listed(run: Run, arguments: tuple[str, ...]) -> None:
    assert run(*arguments) == 0
    assert "Commands:" in run.out
    assert max(map(len, run.out.splitlines())) <= 80


@pytest.mark.parametrize(
    ("arguments", "named", "help_"),
    [
        (("flyy",), "flyy", "pebble --help"),
        (("up",), "config", "pebble up --help"),
        (("topics", "--bad"), "--bad", "pebble topics --help"),
        (("sim", "bob"), "bob", "pebble sim --help"),
        (("topic", "pub", "drive-values"), "payload", "pebble topic --help"),
        (("topic", "pub", "drive-values", "{}", "--qos", "2"), "qos", "pebble topic --help"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_exit_code_2(
    run: Run, arguments: tuple[str, ...], named: str, help_: str
) -> None:
    assert run(*arguments) == 2
    assert run.out == ""
    assert run.err.startswith("pebble: ")
    assert run.err.count("\n") == 1
    assert named in run.err
    assert help_ in run.err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("up", "/nowhere/goob.json"), "/nowhere/goob.json"),
        (("doctor", "/nowhere/goob.json"), "/nowhere/goob.json"),
        (("topic", "list"), "--config CONFIG or --url URL"),
        (("topic", "list", "--config", "a", "--url", "b"), "--config CONFIG or --url URL"),
        (("topic", "list", "--url", "http://x"), "mqtt://HOST"),
        (("topic", "list", "--url", "mqtt://127.0.0.1", "--remote"), "--remote"),
        (("topic", "echo", "online", "--url", "mqtt://127.0.0.1", "--robot", "a/b"), "--robot a/b"),
        (("topic", "list", "--url", "mqtt://127.0.0.1", "--password-file", "/nowhere/p"), "/nowhere/p"),
        (("topic", "list", "--url", "mqtt://127.0.0.1:1"), "127.0.0.1:1"),
        (("topics", "--base", "a/b"), "a/b"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_exit_code_1(run: Run, arguments: tuple[str, ...], named: str) -> None:
    assert run(*arguments) == 1
    assert run.err.startswith("pebble: ")
    assert run.err.count("\n") == 1
    assert named in run.err


def test_version(run: Run) -> None:
    from pebble.version import __version__

    assert run("--version") == 0
    assert run.out == f"pebble {__version__}\n"


# -- up


def test_up_loads_nothing_that_a_running_robot_does_not_need(tmp_path: Path) -> None:
    look = (
        "import sys; sys.argv = ['pebble', 'up', sys.argv[1]];"
        "from pebble import cli; from pebble.launcher import launcher;"
        "launcher.Launcher.run = lambda self: 7; code = cli.main();"
        "print(code, sorted({'typer', 'click', 'rich', 'numpy', 'zenoh', 'paho', 'serial'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", look, str(config_file(tmp_path))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "7 []\n"


def test_up_refuses_a_robot_that_runs_on_its_own_mcu(run: Run, tmp_path: Path) -> None:
    assert run("up", config_file(tmp_path, robot={"id": "benjr", "platform": "esp8266"})) == 1
    assert "runs on its own MCU" in run.err


# -- check


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("[!s]*.json")), ids=lambda path: path.stem)
def test_every_config_we_ship_is_right(run: Run, path: Path) -> None:
    assert run("check", path) == 0
    assert run.err == ""
    assert run.out.startswith("pebble/")
    assert max(map(len, run.out.splitlines())) <= 80


def test_check_knows_which_transports_there_are(run: Run, tmp_path: Path) -> None:
    assert run("check", config_file(tmp_path, transport={"kind": "zenho"})) == 1
    assert 'transport.kind: no transport "zenho": known are memory, mqtt, zenoh' in run.err


def test_all_of_our_configs_can_be_checked_at_once(run: Run) -> None:
    assert run("check", *sorted((ROOT / "configs").glob("*.json"))) == 0
    assert run.err == "pebble: schema.json: describes the other files for editors; it is no robot's\n"


def test_check_shows_links_processes_and_effective_topics_but_no_secret(run: Run, tmp_path: Path) -> None:
    remote = {"host": "broker.example", "username": "goob", "password": "hush-hush"}
    bridge = {"enabled": True, "remote_mqtt": remote, "heartbeat": {"topic": "else/where"}}
    serial = {"enabled": True, "serial": {"port": "/dev/ttyACM7"}}
    path = config_file(
        tmp_path, transport={"kind": "zenoh"}, services={"mqtt_bridge": bridge, "serial_mcu_bridge": serial}
    )
    assert run("check", path, columns=120) == 0
    for expected in ("broker.example:1883", "user goob, password ***", "/dev/ttyACM7", "else/where",
                     "zenoh_hub, announcer, serial_mcu_bridge, mqtt_bridge",
                     "incoming/drive-values", "incoming/flags/reboot"):  # fmt: skip
        assert expected in run.out
    assert "outgoing/online" not in run.out
    assert run("check", path, "--json") == 0
    assert json.loads(run.out)["services"]["mqtt_bridge"]["heartbeat"]["topic"] == "else/where"
    assert "hush-hush" not in run.out


def test_check_shows_what_runs_on_request(run: Run, tmp_path: Path) -> None:
    services = {
        "av_daemon": {"enabled": True},
        "mqtt_bridge": {
            "enabled": True,
            "remote_mqtt": {"host": "broker.example"},
            "media": {"audio_receiver": {"topic": "else/where"}},
        },
    }
    assert run("check", config_file(tmp_path, services=services), columns=120) == 0
    lines = [" ".join(line.split()) for line in run.out.splitlines()]
    assert "processes launcher, announcer, av_daemon, mqtt_bridge" in lines
    assert "on request camera_publisher, audio_publisher, audio_receiver" in lines
    for expected in ("camera_publisher says outgoing/front-camera", "audio_receiver hears else/where"):
        assert any(line.startswith(expected) for line in lines)


def test_check_tells_every_problem_of_every_file(run: Run, tmp_path: Path) -> None:
    wrong = {"robot": {"id": "goob", "sistem": "x"}, "local_mqtt": {"port": "1883"}, "services": {"mqtt_brigde": {}}}
    path = config_file(tmp_path, **wrong)
    assert run("check", path, ROOT / "configs" / "fred.json") == 1
    assert len(run.err.splitlines()) == 3
    for named in ("robot.sistem", "local_mqtt.port", "services.mqtt_brigde"):
        assert f"pebble: robot.json: {named}" in run.err
    assert "pebble/robots/fred" in run.out


# -- topics


@pytest.mark.parametrize("columns", [80, 120])
def test_the_contract_as_a_table_spells_every_metric_out(run: Run, columns: int) -> None:
    assert run("topics", columns=columns) == 0
    words = set(run.out.split())
    assert [channel.metric for channel in CHANNELS if channel.metric not in words] == []
    assert max(map(len, run.out.splitlines())) <= columns


def test_the_contract_for_programs(run: Run) -> None:
    assert run("topics", "--json", "--base", "goob") == 0
    listed = {entry["topic"]: entry for entry in json.loads(run.out)}
    assert listed.keys() == {f"{GOOB}/{channel.suffix}" for channel in CHANNELS}
    assert listed[f"{GOOB}/outgoing/heartbeat"]["synonym_of"] == "online"
    assert listed[f"{GOOB}/incoming/drive-values"]["retain"] is False
    assert run("topics", "--json-schema") == 0
    assert json.loads(run.out) == schemas()


def test_a_reader_that_goes_away_is_no_error() -> None:
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    # Unbuffered, Python itself would lose what a broken pipe did not take, and tell nobody.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    process = program("topics", "--json", stdout=write, env=env)
    os.close(write)
    assert os.read(read, 1) == b"["
    os.close(read)
    assert process.communicate(timeout=60)[1] == ""
    assert process.returncode == 1


# -- demo and sim


def test_demo_hands_over(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    from pebble.demo import main

    asked: list[float | None] = []
    monkeypatch.setattr(main, "run", lambda seconds: asked.append(seconds) or 3)
    assert run("demo") == 3
    assert run("demo", "--seconds", "20") == 3
    assert asked == [None, 20.0]


def test_sim_is_there_until_ctrl_c(tmp_path: Path) -> None:
    link = tmp_path / "goob"
    process = program("sim", "goob", "--link", link)
    try:
        assert until(link.exists, 30)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert (process.returncode, err) == (0, "")
    assert str(link) in out
    assert not link.exists()


# -- URLs


@pytest.mark.parametrize(
    ("url", "settings"),
    [
        ("mqtt://broker", MqttSettings(host="broker")),
        ("mqtt://broker:1884/", MqttSettings(host="broker", port=1884)),
        ("mqtt://ann%40home@[::1]", MqttSettings(host="::1", username="ann@home")),
    ],
)
def test_mqtt_urls(url: str, settings: MqttSettings) -> None:
    assert settings_of(url) == ("mqtt", settings)


def test_encrypted_urls_and_run_directories(tmp_path: Path) -> None:
    kind, settings = settings_of("mqtts://ann@broker", password="secret", ca_cert=tmp_path / "ca.pem")
    assert isinstance(settings, MqttSettings)
    assert (kind, settings.port, settings.username, settings.password) == ("mqtt", 8883, "ann", "secret")
    assert settings.tls is not None
    assert settings.tls.ca_cert == tmp_path / "ca.pem"
    assert settings_of(f"zenoh:{tmp_path}") == ("zenoh", ZenohSettings(run_dir=tmp_path, client=True))


@pytest.mark.parametrize("url", ["mqtt://ann:geheim@broker", "mqtts://:geheim@broker", "mqtt://ann:geheim@broker:x"])
def test_a_password_in_a_url_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(UrlError) as caught:
        settings_of(url)
    assert "geheim" not in str(caught.value)


@pytest.mark.parametrize(
    "url", ["", "broker", "mqtt:broker", "http://broker", "mqtt://", "mqtt://broker:99999", "mqtt://broker/a/topic",
            "zenoh:", "zenoh:/nowhere/at/all"],
)  # fmt: skip
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(UrlError):
        settings_of(url)


# -- names


@pytest.mark.parametrize(
    ("name", "filters"),
    [
        ("drive-values", [f"{GOOB}/incoming/drive-values"]),
        ("online", [f"{GOOB}/outgoing/online", f"{GOOB}/outgoing/heartbeat"]),
        ("audio", [f"{GOOB}/outgoing/audio"]),
        ("incoming/audio", [f"{GOOB}/incoming/audio"]),
        ("outlets/o1/power", [f"{GOOB}/incoming/outlets/o1/power"]),
        ("flags/reboot", [f"{GOOB}/incoming/flags/reboot"]),
        ("pebble/robots/fred/outgoing/online", ["pebble/robots/fred/outgoing/online"]),
        ("#", ["#"]),
        ("house/lamp", ["house/lamp"]),
    ],
)
def test_names_to_listen_to(name: str, filters: list[str]) -> None:
    assert Names(GOOB).filters(name) == filters


def test_names_to_publish_to() -> None:
    names = Names(base_of("goob"))
    assert names.topic("audio") == f"{GOOB}/incoming/audio"
    assert names.topic("outgoing/audio") == f"{GOOB}/outgoing/audio"
    assert Names().filters("drive-values") == ["+/+/+/incoming/drive-values"]
    with pytest.raises(PebbleError, match="--robot"):
        Names().topic("drive-values")


@pytest.mark.parametrize("name", ["drive-valus", "flags/mqtt-vdeo", "incoming/drive-valus"])
def test_a_misspelt_name_gets_a_suggestion(name: str) -> None:
    with pytest.raises(PebbleError, match="did you mean"):
        Names(GOOB).filters(name)


# -- what is published


def test_the_contract_fills_in_how_to_publish(tmp_path: Path) -> None:
    def made(name: str, text: str, **options: Any) -> tuple[str, bytes, int, bool]:
        message = draft(Names(GOOB), name, text, **{"retain": None, "qos": None, "force": False, **options})
        assert message.doubts == ()
        return message.topic, message.payload, message.qos, message.retain

    (tmp_path / "drive.json").write_bytes(b'{"x": 1}')
    assert made("drive-values", f"@{tmp_path}/drive.json") == (f"{GOOB}/incoming/drive-values", b'{"x": 1}', 1, False)
    assert made("flags/mqtt-video", "true") == (f"{GOOB}/incoming/flags/mqtt-video", b"true", 1, True)
    assert made("flags/mqtt-video", "true", retain=False, qos=0)[2:] == (0, False)
    assert made("drive-values", "", retain=True)[3] is True  # removes a kept copy
    assert made("drive-values", "{}", retain=True, force=True)[3] is True


@pytest.mark.parametrize("name", ["drive-values", "flags/reboot", "audio-stream", "front-camera"])
def test_a_kept_command_is_refused(name: str) -> None:
    with pytest.raises(PebbleError, match="--force"):
        draft(Names(GOOB), name, "true", retain=True, qos=None, force=False)


@pytest.mark.parametrize(
    ("name", "text", "doubt"),
    [
        ("drive-values", '{"x": NaN}', "will refuse"),
        ("flags/reboot", "1", "will refuse"),
        ("outgoing/online", '{"t": 1}', "robot says"),
        ("heartbeat", '{"t": 1}', "older name of online"),
        ("house/lamp", "on", "not in the contract"),
    ],
)
def test_doubtful_messages_are_sent_with_a_warning(name: str, text: str, doubt: str) -> None:
    message = draft(Names(GOOB), name, text, retain=None, qos=None, force=False)
    assert any(doubt in one for one in message.doubts)


# -- how messages are shown


def test_bodies() -> None:
    assert show.body(b'{"t":1}', 80) == '{"t": 1}'
    assert show.body(b'{"a":{"b":1}}', 8).count("\n") == 4
    assert show.body(b"true", 80) == "true"
    assert show.body(b"", 80).startswith("(empty")
    assert show.body(b"hello", 80) == "hello"
    assert show.body("é".encode(), 80) == "é"
    assert show.body(b"PBAT\x01\x01" + bytes(40), 80).splitlines()[0] == "PBAT sound, 46 bytes"
    assert show.body(b"PBVD\x01\x01", 80).splitlines()[1].startswith("  0000  50 42 56 44 01 01")
    assert show.body(b"\xff\xd8\xff", 80).startswith("JPEG picture")
    assert show.body(b"\x00\x80", 80).startswith("binary, 2 bytes")
    assert max(map(len, show.body(bytes(100), 60).splitlines())) <= 60


@pytest.mark.parametrize("payload", [b"\x1b[31mred", b'"\\u001b[31m"', '"\x9b31m"'.encode(), b'"\\ud800"', b"[" * 5000])
def test_no_payload_upsets_the_terminal(payload: bytes) -> None:
    text = show.body(payload, 80)
    text.encode()
    assert "\x1b" not in text
    assert "\x9b" not in text


def test_headlines() -> None:
    stamped = Message("a/b", b'{"t": 1710969600000}', QoS.DELIVERED, retain=True)
    assert show.headline(stamped, 1710969603.0) == "a/b  20 B  qos 1  kept copy  stamped 3.0 s ago"
    assert show.headline(Message("a", b"x", keep=True), 0.0) == "a  1 B  qos 0  to be kept"
    assert show.age(-0.5) == "500 ms ahead"
    assert [show.duration(seconds) for seconds in (0.012, 99, 130, 7200, 200_000)] == [
        "12 ms", "99.0 s", "2 min", "2 h", "2 d",
    ]  # fmt: skip


def test_rates() -> None:
    rates = Rates(10)
    assert rates.frequency_line() is None
    for number in range(50):
        rates.add(number * 0.25, 100)
    assert rates.hz == pytest.approx(4.0)
    assert str(rates.frequency_line()).startswith("4.000 Hz  min 0.2500 s  max 0.2500 s")
    assert str(rates.bandwidth_line()).startswith("400 B/s (3.2 kbit/s)  mean 100 B")


# -- on the wire


@pytest.fixture(scope="module")
def fabrics(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """A broker and a hub, by kind of transport, as URLs."""
    folder = tmp_path_factory.mktemp("b")
    run_dir = tmp_path_factory.mktemp("z")
    broker = Broker(folder)
    hub = HubProcess(run_dir).start()
    yield {"mqtt": f"mqtt://127.0.0.1:{broker.port}", "zenoh": f"zenoh:{run_dir}"}
    hub.end()
    broker.stop()


@pytest.fixture(params=["mqtt", "zenoh"])
def at(request: pytest.FixtureRequest, fabrics: dict[str, str]) -> tuple[str, str, str]:
    """Options that lead there, with a robot of the test's own."""
    return "--url", fabrics[request.param], f"--robot=r{next(_numbers)}"


def test_what_is_published_is_echoed_on_either_transport(at: tuple[str, str, str]) -> None:
    echo = program("topic", "echo", "drive-values", "--count", "3", "--seconds", "60", *at)
    pub = program("topic", "pub", "drive-values", '{"x": 0.5}', "--rate", "20", *at)
    try:
        out, err = echo.communicate(timeout=90)
    finally:
        pub.send_signal(signal.SIGINT)
        said = pub.communicate(timeout=30)
        echo.kill()
    assert (echo.returncode, err) == (0, "")
    assert out.splitlines()[1::2] == ['{"x": 0.5}'] * 3
    assert "incoming/drive-values  10 B  qos 1" in out
    assert (pub.returncode, said) == (130, ("", ""))


def test_kept_topics_are_listed_with_their_synonym_and_echoed_raw(at: tuple[str, str, str]) -> None:
    assert program("topic", "pub", "flags/mqtt-video", "true", *at).wait(60) == 0
    assert program("topic", "pub", "heartbeat", '{"t": 1710969600123}', *at).wait(60) == 0
    out, err = program("topic", "list", "--seconds", "1", *at).communicate(timeout=60)
    assert err == ""
    rows = {line.split()[0]: line.split()[1:] for line in out.splitlines()}
    assert rows["incoming/flags/mqtt-video"] == ["yes", "4", "B", "?", "flag"]
    assert rows["outgoing/heartbeat"][0] == "yes"
    assert rows["outgoing/heartbeat"][-3:] == ["state", "(like", "online)"]
    out, _ = program("topic", "echo", "online", "--raw", "--count", "1", "--seconds", "30", *at).communicate(timeout=60)
    assert out == '{"t": 1710969600123}\n'


def test_rates_are_measured_and_kept_copies_do_not_count(at: tuple[str, str, str]) -> None:
    assert program("topic", "pub", "charging-level", '{"value": 7.4}', *at).wait(60) == 0
    silent = program("topic", "hz", "charging-level", "--seconds", "1.5", *at)
    pub = program("topic", "pub", "drive-values", "{}", "--rate", "40", *at)
    hz = program("topic", "hz", "drive-values", "--seconds", "3", *at)
    bw = program("topic", "bw", "drive-values", "--seconds", "3", *at)
    try:
        assert " Hz  min " in hz.communicate(timeout=60)[0]
        assert " kbit/s)  mean 2 B" in bw.communicate(timeout=60)[0]
        assert set(silent.communicate(timeout=60)[0].splitlines()) == {"no new messages"}
    finally:
        pub.kill()
        pub.communicate()
    assert (hz.returncode, bw.returncode, silent.returncode) == (0, 0, 1)


def test_ctrl_c_ends_an_echo_quietly(at: tuple[str, str, str]) -> None:
    assert program("topic", "pub", "flags/mqtt-audio", "true", *at).wait(60) == 0
    process = program("topic", "echo", "flags/mqtt-audio", *at)
    try:
        assert process.stdout is not None
        assert "kept copy" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=30)
    finally:
        process.kill()
    assert (process.returncode, err) == (130, "")


def test_a_config_leads_to_its_own_side_and_to_the_remote_one(tmp_path: Path, fabrics: dict[str, str]) -> None:
    port = int(fabrics["mqtt"].rpartition(":")[2])
    path = config_file(
        tmp_path,
        robot={"id": "two-sided"},
        transport={"kind": "zenoh", "run_dir": fabrics["zenoh"].removeprefix("zenoh:")},
        services={"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": port}}},
    )
    sides = {"robot": ("--config", path), "operators": ("--config", path, "--remote")}
    for side, where in sides.items():
        assert program("topic", "pub", "status", json.dumps({"value": {"side": side}}), *where).wait(60) == 0
    for side, where in sides.items():
        out, _ = program("topic", "echo", "status", "-n", "1", "-s", "30", "--raw", *where).communicate(timeout=60)
        assert json.loads(out)["value"]["side"] == side


def test_a_password_comes_from_a_file_or_the_environment(tmp_path: Path) -> None:
    passwords = tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "ann", "geheim"], check=True, capture_output=True)
    passwords.chmod(0o644)
    broker = Broker(tmp_path, "allow_anonymous false", f"password_file {passwords}")
    (tmp_path / "right").write_text("geheim\n")
    url = f"mqtt://ann@127.0.0.1:{broker.port}"
    pub = ("topic", "pub", "status", "{}", "--robot", "goob", "--url", url)
    try:
        assert program(*pub, "--password-file", tmp_path / "right").wait(60) == 0
        assert program(*pub, env={**os.environ, "PEBBLE_PASSWORD": "geheim"}).wait(60) == 0
        refused = program(*pub)
        _, err = refused.communicate(timeout=60)
    finally:
        broker.stop()
    assert refused.returncode == 1
    assert err.count("\n") == 1
    assert "cannot connect" in err
