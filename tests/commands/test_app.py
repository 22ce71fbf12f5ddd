"""Help, usage, errors and exit codes of every command."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import product
from pathlib import Path

import pytest

from pebble.commands import app
from pebble.extension import ours
from tests.commands.command_line import Run, config_file, running
from tests.support import ROOT, WAIT_S, Broker, cases, free_port, some, until

NAMES = [tuple(words.split()) for words in app.commands(["up"])]


@pytest.mark.parametrize("arguments", [(), ("--help",)])
def test_all_commands_are_listed_on_one_screen(run: Run, arguments: tuple[str, ...]) -> None:
    assert run(*arguments) == 0
    usage, *lines = run.out.splitlines()
    assert [line[9:20].rstrip() for line in lines] == [name for name, *below in NAMES if not below]
    assert [line.split()[0] for line in lines if line[0] != " "] == ["use", "own", "write", "share", "measure"]
    assert len(lines) <= 24, "a screen of 24 lines shows all but the usage"
    assert max(map(len, (usage, *lines))) <= 80


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
        (("mqtt://me:sentinel@a",), "mqtt://***@a", "pebble --help"),
        (("estop", "--password", "x"), "--password (Possible options: --password-file)", "pebble estop --help"),
        (("up",), "CONFIG", "pebble up --help"),
        (("sim", "bob"), "bob", "pebble sim --help"),
        (("drive", "--speed", "nan"), "nan is not a finite number", "pebble drive --help"),
        (("topic", "list", "-s", "inf"), "inf is not a finite number", "pebble topic list --help"),
        (("sim", "minilamp"), "--broker URL", "pebble sim --help"),
        (("doctor", "--running", "--report", "a.zip"), "--running or --report", "pebble doctor --help"),
        (("watch", "goob.json"), "--picture", "pebble watch --help"),
        (("record", "configs/goob.json"), "use -c configs/goob.json", "pebble record --help"),
        (("topic", "hz", "online", "configs/goob.json"), "use -c configs/goob.json", "pebble topic hz --help"),
        (("topic", "list", "configs/goob.json"), "use -c configs/goob.json", ""),
        (("topic", "echo", "configs/goob.json"), "use -c configs/goob.json", ""),
        (("up", "/nowhere/goob.json"), "/nowhere/goob.json", ""),
        (("topic", "list"), "--config CONFIG or --url URL", ""),
        (("topic", "list", "--url", "mqtt://127.0.0.1", "--remote"), "--remote", ""),
        (("topic", "echo", "online", "--url", "mqtt://127.0.0.1", "--robot", "a/b"), "--robot a/b", ""),
        (("topic", "list", "--url", "mqtt://127.0.0.1:1"), "127.0.0.1:1", ""),
        (("topic", "list", "--url", "zenoh:/nowhere"), "`pebble up CONFIG` starts it", ""),
    ],
)
def test_what_is_wrong_is_one_line_and_exit_code_1_or_for_a_command_line_2(
    run: Run, arguments: tuple[str, ...], named: str, help_: str
) -> None:
    assert run(*arguments) == (2 if help_ else 1)
    assert run.out == ""
    assert run.err.startswith("pebble: ")
    (error,) = (line for line in run.err.splitlines() if not line.startswith("pebble: connecting to "))
    assert named in error
    assert help_ in error


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


_BLOCKED = "import os, signal, sys; signal.pthread_sigmask(0, range(1, 32)); os.execvp(sys.argv[1], sys.argv[1:])"


@pytest.mark.parametrize(
    "caller",
    some(
        [
            'exec "$@" <&- >&- 2>&-',
            'exec "$@" >&-',
            f"trap '' TERM; exec {sys.executable} -c '{_BLOCKED}' \"$@\"",
        ],
        2,
    ),
)
def test_a_robot_runs_and_ends_whatever_its_caller_has_closed_blocked_or_ignored(tmp_path: Path, caller: str) -> None:
    config = config_file(
        tmp_path, transport={"kind": "mqtt", "run_dir": str(tmp_path / "run")}, local_mqtt={"port": free_port()}
    )
    command = [sys.executable, "-m", "pebble.cli", "up", str(config)]
    with subprocess.Popen(["sh", "-c", caller, "sh", *command], cwd=ROOT) as robot:
        children = Path(f"/proc/{robot.pid}/task/{robot.pid}/children")
        assert until(lambda: robot.poll() is not None or children.read_text())
        robot.terminate()
        assert robot.wait(WAIT_S) == 0


_AT = ["--url", "URL"]
_PUBLISH = ["topic", "pub", "a/b", "{}", "--rate", "10", *_AT]
#: Commands that run until they are ended. The first of each row prints something once all of them work.
UNTIL_ENDED = [
    [["up", "CONFIG"]],
    [["sim", "goob", "--link", "goob"]],
    [["web", *_AT, "--port", "0", "--people", "people"]],
    [["record", *_AT, "--into", "recordings"]],
    [["foxglove", *_AT, "--port", "0"]],
    [["exporter", *_AT, "--port", "0"]],
    [["fleet", "hub", "HUB"]],
    [["topic", "echo", "a/b", *_AT], _PUBLISH],
    [["topic", "hz", "a/b", *_AT], _PUBLISH],
    [["topic", "hz", "a/silent", *_AT]],
]


@pytest.mark.parametrize("commands", UNTIL_ENDED, ids=lambda commands: " ".join(commands[0][:3]))
def test_sigterm_is_the_orderly_end_of_a_command_that_runs_until_then(
    tmp_path: Path, broker: Broker, commands: list[list[str]]
) -> None:
    services = {"serial_mcu_bridge": {"enabled": True, "serial": {"port": str(tmp_path / "none")}}}
    transport = {"kind": "mqtt", "run_dir": str(tmp_path / "run"), "state_dir": str(tmp_path)}
    config = config_file(tmp_path, transport=transport, services=services, local_mqtt={"port": broker.port})
    hub = tmp_path / "hub.json"
    hub.write_text(json.dumps({"listen": [f"tcp/127.0.0.1:{free_port()}"]}))
    meant = {"URL": f"mqtt://127.0.0.1:{broker.port}", "CONFIG": str(config), "HUB": str(hub)}
    env = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    with ExitStack() as stack:
        processes = [
            stack.enter_context(
                running(*(meant.get(word, word) for word in words), cwd=tmp_path, env=env, stderr=subprocess.STDOUT)
            )
            for words in commands
        ]
        assert processes[0].stdout is not None
        printed = processes[0].stdout.readline()
        for process in processes:
            process.terminate()
        assert [process.wait(WAIT_S) for process in processes] == [0] * len(processes), printed


def test_a_command_whose_package_is_missing_says_what_to_install() -> None:
    code = "import sys; sys.modules['cv2'] = None; sys.argv = ['pebble', 'demo'];"
    code += "from pebble import cli; sys.exit(cli.main())"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    needs = 'pebble: demo needs the package cv2, which is not installed: pip install "pebble-robot[all]"\n'
    assert (done.returncode, done.stderr) == (1, needs)


# -- what a command's environment may lack: a home, a name for the user, an encoding, an output


_PATH = {"PATH": os.defpath}
_NO_USER = ("setpriv", "--reuid=12345", "--regid=12345", "--clear-groups")
changes_users = pytest.mark.skipif(
    os.getuid() != 0 or subprocess.run([*_NO_USER, sys.executable, "-c", ""], capture_output=True).returncode != 0,
    reason="needs root, and a Python that other users may run",
)

#: Words before the command, the environment, and what the command says instead of ending with a traceback.
ENVIRONMENTS = [
    pytest.param(_NO_USER, {}, "~/.local/state: the home folder is not known; set HOME", marks=changes_users),
    pytest.param(_NO_USER, {"HOME": "/nonexistent"}, "", marks=changes_users),
    ((), {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}, "pebble/robots/gö🤖b"),
    ((), {"PYTHONIOENCODING": "ascii"}, "pebble/robots/g\\xf6\\U0001f916b"),
    ((), {"LC_ALL": "xx_YY.UTF-8"}, "pebble/robots/gö🤖b"),
    ((), {"HOME": "/", "TMPDIR": "/nonexistent", "PATH": ""}, "pebble/robots/gö🤖b"),
]
COMMANDS = [["check"], ["check", "--json"]]


@pytest.fixture
def config() -> Iterator[Path]:
    """A copy in a folder that every user may read."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    path = folder / "robot.json"
    services = {"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": 1}}}
    path.write_text(json.dumps({"robot": {"id": "gö🤖b"}, "transport": {"kind": "zenoh"}, "services": services}))
    yield path
    shutil.rmtree(folder)


@pytest.mark.parametrize(("before", "environment", "printed"), ENVIRONMENTS)
def test_a_command_runs_or_names_what_is_missing(
    config: Path, before: tuple[str, ...], environment: dict[str, str], printed: str
) -> None:
    for words in COMMANDS[: 1 if printed.startswith("~") else cases(1, 2)]:
        command = [*before, sys.executable, "-m", "pebble.cli", *words, str(config)]
        env = {**_PATH, "HOME": str(config.parent), **environment, "PYTHONPATH": str(ROOT)}
        if printed.startswith("~"):
            del env["HOME"]
        done = subprocess.run(command, env=env, cwd="/", capture_output=True, timeout=60)
        text = (done.stdout + done.stderr).decode(errors="replace")
        assert "Traceback" not in text
        assert "Error" not in text
        assert done.returncode == int(printed.startswith("~")), text
        assert printed in text or words != ["check"], text


OUTPUTS = [">/dev/full", "2>/dev/full", ">/dev/full 2>&1", "| true"]


@pytest.mark.parametrize(("words", "outputs"), some(product([COMMANDS[0], ["--help"], ["nonsense"]], OUTPUTS), 5))
def test_an_output_that_is_full_or_gone_ends_a_command_in_order(config: Path, words: list[str], outputs: str) -> None:
    command = [sys.executable, "-m", "pebble.cli", *words, *([str(config)] if words in COMMANDS else [])]
    done = subprocess.run(["sh", "-c", f'"$@" {outputs}', "sh", *command], cwd=ROOT, capture_output=True, timeout=60)
    assert done.returncode in (0, 1, 2)
    assert b"Traceback" not in done.stderr
    assert b"Exception ignored" not in done.stderr
