"""Answers come from a file, from the config, or are asked, and boards are known by what they send."""

from __future__ import annotations

import json
import os
import re
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.install.setup import detect, system
from pebble.extensions.install.setup.system import SetupError
from pebble.extensions.operator.places import Places
from pebble.services.serial_mcu_bridge.pebble_serial_v1 import frame
from tests.commands.command_line import Run
from tests.ext.install.serial_port import serial_port
from tests.ext.install.setup.conftest import ANSWERS, PASSWORD, answers_in, set_up, tree
from tests.kit.terminal import Terminal
from tests.support import beside


@pytest.mark.parametrize(
    ("given", "keys"),
    [
        *(({name: ANSWERS[name] for name in ANSWERS if name != key}, [key]) for key in ("protocol", "user")),
        (ANSWERS | {"broker": "broker.lab"}, ["broker_user", "broker_password_file"]),
        ({}, ["id", "port", "camera", "broker", "page"]),
    ],
    ids=lambda value: ",".join(value),
)
def test_a_missing_answer_is_named_by_its_key(
    given: dict[str, Any], keys: list[str], root: Path, tmp_path: Path, run: Run
) -> None:
    answers = answers_in(tmp_path)
    password = json.loads(answers.read_text())["password_file"]
    answers.write_text(json.dumps(given | {"password_file": password}))
    before = tree(root)
    assert run("setup", "--answers", answers) == 2
    assert [line.split()[1:4] for line in run.err.splitlines()] == [[key, "is", "missing:"] for key in keys]
    assert tree(root) == before


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"id": "go/ob"}, "id: must be a topic level"),
        ({"id": "page"}, "id: 'page' is an account of the robot's own broker already"),
        ({"protocol": "morse"}, "protocol: 'morse' is none of goob_base_v1"),
        ({"broker": "mqtt://broker.lab"}, "broker: write HOST or HOST:PORT"),
        ({"broker": "ann:secret-1@broker.lab"}, "broker: write HOST or HOST:PORT; user and password have keys"),
        ({"broker": "none"}, "page: a page needs a broker"),
        ({"broker_ca": "/etc/passwd", "broker": "127.0.0.1"}, "broker_ca: /etc/passwd holds no certificate"),
        ({"user": "Ann Lee"}, "user: 'Ann Lee' is no name"),
        ({"colour": "red"}, "colour: unknown key; there are id, port"),
        ({"password_file": "/nowhere"}, "password_file: No such file or directory"),
        ({"id": "fred", "camera": "none"}, "id: this robot is goob"),
        ({"port": "none"}, "broker: mosquitto is not installed: sudo apt install mosquitto, then sudo pebble setup"),
    ],
    ids=lambda value: str(value)[:24],
)
def test_a_wrong_answer_is_one_line_and_nothing_is_written(
    given: dict[str, Any], message: str, root: Path, tmp_path: Path, run: Run
) -> None:
    if "this robot is" in message:
        set_up(root)
    if "not installed" in message:
        (root / "usr/sbin/mosquitto").unlink()
    before = tree(root)
    assert run("setup", "--answers", answers_in(tmp_path, **given)) in (1, 2)
    assert message in run.err
    assert run.err.count("\n") == 1
    assert "secret-1" not in run.err
    assert tree(root) == before


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ((), "standard input is no terminal, so nothing can be asked: --answers FILE"),
        (("--from", "/nowhere"), "/nowhere: No such file or directory"),
    ],
)
def test_options_that_lead_nowhere(line: tuple[str, ...], message: str, root: Path, run: Run) -> None:
    assert run("setup", *line) in (1, 2)
    assert message in run.err
    assert not any(Places(root).etc.iterdir())


def terminal(root: Path) -> Terminal:
    """The command in a terminal of 60 columns."""
    script = (
        "from pathlib import Path; from pebble.extensions.install.setup.session import set_up;"
        "from tests.ext.install.setup.conftest import machine;"
        f"exit(set_up(machine(Path({str(root)!r})), None, None))"
    )
    return Terminal("env", "-u", "SUDO_USER", "COLUMNS=60", sys.executable, "-c", script)


def test_six_questions_in_a_terminal(root: Path) -> None:
    """Wrong names are asked again, choices are numbers or texts, lines end between words, no password shows."""
    asking = terminal(root)
    for prompt, text in (
        ("Name [", "no/name"),
        ("Name [", "goob"),
        ("answer [", "none"),
        ("answer [", "synthetic"),
        ("[:PORT] [here]", "1"),
        ("Page [Y/n]", ""),
        ("everything [", "ann"),
        ("ann: ", PASSWORD),
        ("Again: ", PASSWORD),
        ("Go ahead? [Y/n]", ""),
    ):
        asking.answers(prompt, text)
    assert asking.ends() == 1, "systemd does not run there"
    shown = asking.shown.replace("\r", "")
    assert "id: must be a topic level" in shown
    assert PASSWORD not in shown
    assert [line for line in shown.splitlines() if len(line) > 60 and " " in line.strip()] == []
    assert len(re.findall(r"Open\s+https://", shown)) == 1
    assert json.loads(Places(root).config.read_text())["robot"]["id"] == "goob"


def test_a_login_that_the_broker_refused_is_asked_again(root: Path, tmp_path: Path) -> None:
    set_up(root, broker="127.0.0.1:9", broker_user="goob", port="none")
    asking = terminal(root)
    for prompt in ("answer [none]", "answer [synthetic]", "[:PORT] [127.0.0.1:9]", "Page [Y/n]"):
        asking.answers(prompt, "")
    asking.answers("goob at the broker (empty: as before): ", "another")
    asking.answers("Go ahead?", "")
    asking.ends()
    assert "the broker 127.0.0.1:9 does not" in " ".join(asking.shown.split())
    assert (Places(root).etc / "broker.password").read_text() == "another\n"


# -- what a machine has


_HELLO = frame.encode(frame.Frame(frame.Type.HELLO, b"x"))


@contextmanager
def board(folder: Path, sends: bytes) -> Iterator[int]:
    """A serial port, as a link in a folder, that sends this again and again."""
    ending = threading.Event()

    def send() -> None:
        while not ending.wait(0.01):
            if sends and select.select([], [ours], [], 0)[1]:
                os.write(ours, sends)

    with serial_port() as (ours, path), beside(send, ending):
        (folder / "usb-board").symlink_to(path)
        yield ours


@pytest.mark.parametrize(
    ("sends", "text", "protocol"),
    [
        (b"T t0=1 t1=2 t2=3 chg=1\nC v=7.4\n", "460800 baud, answers, `C`, `T` lines", "goob_base_v1"),
        (b"I n=1 ms=2 ax=0\n", "460800 baud, answers, `I` lines", "imu_mpu6050_v1"),
        (_HELLO, "460800 baud, answers, frames", "pebble_serial_v1"),
        (b"\xff\xfe\x80\n\xc3\x28\n", "silent", None),
    ],
    ids=("motor board", "inertial sensor", "describes itself", "wrong speed"),
)
def test_a_board_is_listened_to(sends: bytes, text: str, protocol: str | None, tmp_path: Path) -> None:
    with board(tmp_path, sends) as ours:
        (found,) = detect.boards(tmp_path, seconds=0.2)
        written = select.select([ours], [], [], 0)[0]
    assert (found.text.rpartition(" at ")[2], found.protocol) == (text, protocol)
    assert written == [], "nothing was written to it"


def test_a_port_that_cannot_be_opened_is_described(tmp_path: Path) -> None:
    (tmp_path / "usb-gone").symlink_to("/dev/no-such-port")
    (found,) = detect.boards(tmp_path)
    assert found.text.startswith("cannot be opened")


def test_a_camera_is_known_by_the_name_that_stays(tmp_path: Path) -> None:
    cameras = tmp_path / "v4l/by-id"
    cameras.mkdir(parents=True)
    for index in (0, 1):
        (cameras / f"usb-cam-video-index{index}").symlink_to("/dev/null")
    assert [camera for camera in detect.cameras(tmp_path) if "usb" in camera] == [f"{cameras}/usb-cam-video-index0"]


@pytest.mark.parametrize("name", ["mosquitto.conf", "conf.d/own.conf"])
def test_a_broker_with_listeners_of_its_own_is_left_alone(name: str, root: Path) -> None:
    assert detect.no_broker(Places(root)) == ""
    (root / "etc/mosquitto" / name).write_text("# mine\nlistener 1883\n")
    assert detect.no_broker(Places(root)).startswith(f"/etc/mosquitto/{name} has its own `listener`")


def test_what_a_machine_lacks_is_named_with_what_to_type(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (root / "usr/lib/polkit-1/polkitd").unlink()
    monkeypatch.setattr("time.time", lambda: 0.0)
    monkeypatch.setattr(detect, "_has_network", lambda: False)
    first, clock, last = detect.lacks(Places(root))
    assert (first, last) == (detect.NO_POLKIT, detect.OFFLINE)
    assert clock.startswith("The clock is set to 1970")


def test_a_machine_without_the_package_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system, "is_root", lambda: False)
    with pytest.raises(SetupError, match=r"^only root can do this: sudo pebble setup$"):
        system.owner_of("root:pebble")
    monkeypatch.setattr(system, "is_root", lambda: True)
    with pytest.raises(SetupError, match=r"^there is no user no-such: sudo apt install no-such, then sudo"):
        system.owner_of("root:no-such")
