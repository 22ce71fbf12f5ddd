"""Help, usage, errors and exit codes of every command."""

from __future__ import annotations

import fcntl
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.commands import app
from pebble.extension import ours
from tests.commands.command_line import Run, config_file, program
from tests.support import ROOT, free_port, some, until

NAMES = [tuple(words.split()) for words in app.commands(["up"])]
TOPIC = [("topic", name) for name in ("list", "echo", "pub", "hz", "contract", "expand")]


def test_a_command_leaves_logging_as_it_was(run: Run) -> None:
    before = list(logging.getLogger("pebble").handlers)
    assert run("--version") == 0
    assert run("nonsense") == 2
    assert logging.getLogger("pebble").handlers == before


def test_the_package_runs_as_the_command_does() -> None:
    package, command = (
        subprocess.run(
            [sys.executable, "-m", module, "nonsense"], cwd=ROOT, capture_output=True, text=True, check=False
        )
        for module in ("pebble", "pebble.cli")
    )
    assert (package.returncode, package.stdout, package.stderr) == (command.returncode, command.stdout, command.stderr)


@pytest.mark.parametrize("command", NAMES + TOPIC)
def test_every_command_explains_itself_with_an_example(run: Run, command: tuple[str, ...]) -> None:
    assert run(*command, "--help") == 0
    assert f"\n      pebble {command[0]}" in run.out
    assert max(map(len, run.out.splitlines())) <= 80
    assert run.err == ""


@pytest.mark.parametrize("arguments", [(), ("--help",)])
def test_all_commands_are_listed_on_one_screen(run: Run, arguments: tuple[str, ...]) -> None:
    assert run(*arguments) == 0
    usage, *lines = run.out.splitlines()
    assert [line[9:20].rstrip() for line in lines] == [name for name, *below in NAMES if not below]
    assert [line.split()[0] for line in lines if line[0] != " "] == ["use", "own", "write", "share", "measure"]
    assert len(lines) <= 24, "a screen of 24 lines shows all but the usage"
    assert max(map(len, (usage, *lines))) <= 80


@pytest.mark.parametrize("group", ["topic", "fleet", "web user"])
def test_a_group_without_a_command_lists_those_below_it(run: Run, group: str) -> None:
    assert run(*group.split()) == 0
    assert "Commands:" in run.out
    assert max(map(len, run.out.splitlines())) <= 80


@pytest.mark.parametrize(("former", "now"), [row for one in ours() for row in one.former.items()])
def test_a_former_name_is_one_line_with_the_new_one(run: Run, former: str, now: str) -> None:
    assert run(*former.split(), "goob.json", "--help") == 2
    assert run.out == ""
    help_ = f"pebble {now.partition(' --')[0]} --help"
    assert run.err == f'pebble: "{former}" is now "{now}": {help_}\n'


def test_a_command_imports_no_other() -> None:
    code = (
        "import sys; from pebble import cli; sys.argv = ['pebble', *sys.argv[1:]]; cli.main();"
        "names = [name for name in sys.modules if name.count('.') > 2 or name.startswith('pebble.commands.')];"
        "print(sorted(name for name in names if name.startswith(('pebble.commands.', 'pebble.extensions.'))))"
    )
    for words, commands in (("--help", "app"), ("up --help", "app up")):
        done = subprocess.run([sys.executable, "-c", code, *words.split()], cwd=ROOT, capture_output=True, text=True)
        assert done.stdout.splitlines()[-1] == str([f"pebble.commands.{name}" for name in commands.split()])


@pytest.mark.parametrize(
    ("arguments", "named", "help_"),
    [
        (("flyy",), "flyy", "pebble --help"),
        (("up",), "CONFIG", "pebble up --help"),
        (("topic", "contract", "--bad"), "--bad", "pebble topic contract --help"),
        (("sim", "bob"), "bob", "pebble sim --help"),
        (("sim", "minilamp"), "--broker URL", "pebble sim --help"),
        (("sim", "goob", "--robots", "2"), "goob takes no --robots", "pebble sim --help"),
        (("sim", "goob", "spot"), "goob takes no spot", "pebble sim --help"),
        (("sim", "world", "--lnk", "/tmp"), "--lnk", "pebble sim --help"),
        (("doctor", "--running"), "which robot", "pebble doctor --help"),
        (("doctor", "--running", "--report", "a.zip"), "--running or --report", "pebble doctor --help"),
        (("doctor", "goob.json", "--may-move"), "--may-move is for --running", "pebble doctor --help"),
        (("watch", "goob.json"), "--picture", "pebble watch --help"),
        (("topic", "pub", "drive-values"), "PAYLOAD", "pebble topic pub --help"),
        (("topic", "pub", "drive-values", "{}", "--qos", "2"), "qos", "pebble topic pub --help"),
        (("up", "/nowhere/goob.json"), "/nowhere/goob.json", ""),
        (("doctor", "/nowhere/goob.json"), "/nowhere/goob.json", ""),
        (("topic", "list"), "--config CONFIG or --url URL", ""),
        (("topic", "list", "--config", "a", "--url", "b"), "--config CONFIG or --url URL", ""),
        (("topic", "list", "--url", "http://x"), "mqtt://HOST", ""),
        (("topic", "list", "--url", "mqtt://127.0.0.1", "--remote"), "--remote", ""),
        (("topic", "echo", "online", "--url", "mqtt://127.0.0.1", "--robot", "a/b"), "--robot a/b", ""),
        (
            ("topic", "list", "--url", "mqtt://127.0.0.1", "--password-file", "/nowhere/p"),
            "--password-file: No such file",
            "",
        ),
        (("topic", "list", "--url", "mqtt://127.0.0.1:1"), "127.0.0.1:1", ""),
        (("topic", "contract", "--base", "a/b"), "a/b", ""),
    ],
)
def test_what_is_wrong_is_one_line_and_exit_code_1_or_for_a_command_line_2(
    run: Run, arguments: tuple[str, ...], named: str, help_: str
) -> None:
    assert run(*arguments) == (2 if help_ else 1)
    assert run.out == ""
    assert run.err.startswith("pebble: ")
    assert run.err.count("\n") == 1
    assert named in run.err
    assert help_ in run.err


def test_up_loads_nothing_that_a_running_robot_does_not_need(tmp_path: Path) -> None:
    code = (
        "import sys; sys.argv = ['pebble', 'up', sys.argv[1]];"
        "from pebble import cli; from pebble.launcher import launcher;"
        "launcher.Launcher.run = lambda self: 7; code = cli.main();"
        "print(code, sorted({'typer', 'click', 'rich', 'numpy', 'zenoh', 'paho', 'serial'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", code, str(config_file(tmp_path))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "7 []\n"


def test_up_refuses_a_robot_that_runs_on_its_own_mcu(run: Run, tmp_path: Path) -> None:
    assert run("up", config_file(tmp_path, robot={"id": "benjr", "platform": "esp8266"})) == 1
    assert "runs on its own MCU" in run.err


@pytest.mark.parametrize("closed", some(["<&- >&- 2>&-", "<&- 2>&-", ">&-"], 3))
def test_a_robot_runs_without_standard_streams(tmp_path: Path, closed: str) -> None:
    config = config_file(
        tmp_path, transport={"kind": "mqtt", "run_dir": str(tmp_path / "run")}, local_mqtt={"port": free_port()}
    )
    command = [sys.executable, "-m", "pebble.cli", "up", str(config)]
    with subprocess.Popen(["sh", "-c", f'exec "$@" {closed}', "sh", *command], cwd=ROOT) as robot:
        children = Path(f"/proc/{robot.pid}/task/{robot.pid}/children")
        assert until(lambda: robot.poll() is not None or children.read_text(), 30)
        robot.terminate()
        assert robot.wait(20) == 0


def test_a_reader_that_goes_away_is_no_error() -> None:
    read, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    # Unbuffered, Python itself would lose what a broken pipe did not accept, without an error.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    process = program("topic", "contract", "--json", stdout=write, env=env)
    os.close(write)
    assert os.read(read, 1) == b"["
    os.close(read)
    assert process.communicate(timeout=60)[1] == ""
    assert process.returncode == 1


def test_a_command_whose_package_is_missing_says_what_to_install() -> None:
    code = "import sys; sys.modules['cv2'] = None; sys.argv = ['pebble', 'demo'];"
    code += "from pebble import cli; sys.exit(cli.main())"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    needs = 'pebble: demo needs the package cv2, which is not installed: pip install "pebble-robot[all]"\n'
    assert (done.returncode, done.stderr) == (1, needs)
