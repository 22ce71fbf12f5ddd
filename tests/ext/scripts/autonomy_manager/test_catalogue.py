"""Which scripts are offered, with which settings; which files are asked what they are, and which answers count."""

from __future__ import annotations

import json
import logging
import os
import stat
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.config import Config, parse
from pebble.extensions.operator.client.forms import Setting, form
from pebble.services.autonomy_manager import describe
from pebble.services.autonomy_manager.catalogue import MAX_SCRIPTS, Catalogue, files, roots
from pebble.services.autonomy_manager.describe import (
    DescribeError,
    Description,
    ask,
    is_ours,
    read_manifest,
)
from pebble.services.autonomy_manager.environment import environment
from pebble.services.autonomy_manager.interpreter import interpreter, lacking
from pebble.services.autonomy_manager.script import Script
from tests.support import gone, until

ANSWER = '{"label": "Walk", "configs": [{"key": "speed", "arg": "--speed"}, {"key": "laps", "arg": "--laps"}]}'
PRETENDS = f"""
if 0:
    from pebble.script import run
open("asked", "a").write("x")
print({ANSWER!r})
"""


def config(folder: Path, **section: Any) -> Config:
    raw = {"robot": {"id": "rover"}, "services": {"autonomy_manager": {"autonomy_root": str(folder), **section}}}
    return parse(raw, folder=folder, env={})


def write(folder: Path, name: str, text: str = "", file: str = "run.py") -> Path:
    path = folder / name / file
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


def scanned(catalogue: Catalogue) -> dict[str, Script]:
    found: list[dict[str, Script]] = []
    catalogue.scan(found.append)
    return found[-1]


def scripts(folder: Path, **section: Any) -> dict[str, Script]:
    return scanned(Catalogue(config(folder, **section)))


def test_folders_with_an_entry_point_are_scripts(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("beta", "Alpha", ".hidden", "_draft", "off", "bad]name", "\u212b"):
        write(tmp_path, name)
    write(tmp_path, "other", file="main.py")
    write(tmp_path, "empty", file="README")
    (tmp_path / "run.py").write_text("")
    (tmp_path / "elsewhere").symlink_to(tmp_path / "beta")
    two = {"\u00c5": {"enabled": False}, "A\u030a": {}}
    found = scripts(tmp_path, scripts={"off": {"enabled": False}, "other": {"entrypoint": "main.py"}, **two})
    assert list(found) == ["Alpha", "beta", "elsewhere", "other"]
    assert found["beta"].command == ("/usr/bin/python3", str(tmp_path / "beta/run.py"))
    assert "'bad]name' is not offered: rename its folder" in caplog.text
    assert "\u212b is not offered: in services.autonomy_manager.scripts 2 names" in caplog.text
    assert scripts(tmp_path / "missing") == {}


def test_a_relative_folder_is_beside_the_config_and_ours_come_last(tmp_path: Path) -> None:
    own = tmp_path / "own"

    def of(root: str, folder: Path) -> tuple[Path, ...]:
        raw = {"robot": {"id": "rover"}, "services": {"autonomy_manager": {"autonomy_root": root}}}
        return roots(parse(raw, folder=folder, env={}), own)

    originals = tmp_path / "control/configs"
    assert of("autonomy", tmp_path) == (tmp_path / "autonomy", own)
    assert of("autonomy", originals) == (originals / "autonomy", tmp_path / "autonomy", own)
    assert of("..", tmp_path) == (tmp_path / "..", own)
    assert of("/opt/scripts", tmp_path) == (Path("/opt/scripts"),)


def test_one_of_ours_is_asked_once_and_no_other(tmp_path: Path) -> None:
    write(tmp_path, "walk", PRETENDS)
    write(tmp_path, "foreign", "open('asked', 'a').write('x')")
    catalogue = Catalogue(config(tmp_path))
    listed: list[dict[str, bool]] = []
    catalogue.scan(lambda found: listed.append({name: script.asked for name, script in found.items()}))
    assert listed == [{"foreign": True, "walk": False}, {"foreign": True, "walk": True}]
    found = scanned(catalogue)
    assert (tmp_path / "walk/asked").read_text() == "x"
    assert not (tmp_path / "foreign/asked").exists()
    assert (found["walk"].label, found["walk"].ours, found["walk"].command[0]) == ("Walk", True, sys.executable)
    assert [setting.key for setting in found["walk"].settings] == ["speed", "laps"]
    assert (found["foreign"].settings, found["foreign"].ours) == ((), False)


def test_the_config_comes_first_but_one_of_ours_knows_its_options(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, "walk", PRETENDS)
    args = [{"key": "speed", "label": "Pace", "arg": "--velocity", "type": "float"}, {"key": "marker", "arg": "--m"}]
    section = {"args": args, "display_name": "Wander", "dependencies": [{"file": "eyes"}, {"file": "walk"}]}
    walk = scripts(tmp_path, scripts={"walk": section})["walk"]
    assert [(setting.key, setting.label, setting.arg) for setting in walk.settings] == [
        ("speed", "Pace", "--speed"),
        ("laps", None, "--laps"),
    ]
    assert (walk.label, [dependency.file for dependency in walk.dependencies]) == ("Wander", ["eyes"])
    assert "walk has no setting marker: ignored" in caplog.text


def test_any_program_with_a_manifest_is_a_script(tmp_path: Path) -> None:
    write(tmp_path, "shell", "#!/bin/sh", file="go.sh")
    manifest = '{"command": ["./go.sh", "-v"], "configs": [{"key": "n", "arg": "-n"}], "drives": false}'
    write(tmp_path, "shell", manifest, "script.json")
    program = write(tmp_path, "plain", "#!/bin/sh", file="start")
    program.chmod(stat.S_IRWXU)
    write(tmp_path, "venv", "import pebble.script\nraise SystemExit(1)")
    write(tmp_path, "old", "print 'hi'")
    section = {"plain": {"entrypoint": "start"}, "venv": {"python": "venv/bin/python"}, "old": {"python": "python2"}}
    found = scripts(tmp_path, scripts=section)
    assert found["shell"].command == (str(tmp_path / "shell/go.sh"), "-v")
    assert [setting.key for setting in found["shell"].settings] == ["n"]
    assert found["shell"].drives, "nothing keeps it from driving, whatever it declares"
    assert found["plain"].command == (str(program),)
    assert found["old"].broken == "", "what another Python runs may be written for that"
    assert found["venv"].command == (str(tmp_path / "venv/bin/python"), str(tmp_path / "venv/run.py"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "import nump\nfrom pebble import run",
            "its --describe ended with code 1: ModuleNotFoundError: No module named 'nump'",
        ),
        ("from pebble import run\n\ndef main(robot:\n    pass", "run.py, line 3: '(' was never closed"),
    ],
    ids=["no module", "syntax"],
)
def test_a_broken_script_is_not_started_and_the_reason_is_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str, reason: str
) -> None:
    write(tmp_path, "follow", text)
    catalogue = Catalogue(config(tmp_path))
    with caplog.at_level(logging.WARNING):
        found = [scanned(catalogue)["follow"] for _ in range(2)]
    assert all(script.broken.startswith(reason) and script.settings == () for script in found), found
    assert caplog.text.count(reason) == 1
    write(tmp_path, "follow", PRETENDS)
    assert scanned(catalogue)["follow"].broken == ""


def test_a_script_gets_the_password_of_the_robots_broker_and_no_other(tmp_path: Path) -> None:
    write(tmp_path, "foreign")
    raw = {
        "robot": {"id": "rover"},
        "local_mqtt": {"username": "rob", "password_env": "LOCAL"},
        "services": {
            "mqtt_bridge": {"remote_mqtt": {"username": "rob", "password_env": "UPLINK"}},
            "autonomy_manager": {"autonomy_root": str(tmp_path)},
        },
    }
    found = scanned(Catalogue(parse(raw, folder=tmp_path, env={"LOCAL": "near", "UPLINK": "topsecret"})))
    assert found["foreign"].environment == {"LOCAL": "near"}


def test_the_list_is_bounded(tmp_path: Path) -> None:
    for number in range(MAX_SCRIPTS + 5):
        write(tmp_path, f"s{number:03}")
    many = [{"key": f"k{number}"} for number in range(65)]
    found = scripts(tmp_path, scripts={"s000": {"args": many}})
    assert len(found) == MAX_SCRIPTS
    assert found["s000"].settings == ()
    large = tuple(Setting(key=f"k{number}", label="x" * 200) for number in range(60))
    entries = files(msgspec.structs.replace(script, settings=large) for script in found.values())
    assert entries[0]["configs"] == form(large)
    assert entries[-1]["configs"] == []
    assert len(msgspec.json.encode(entries)) < 300_000


def test_a_failure_is_logged_once_and_tried_again_after_a_minute(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    entry = write(tmp_path, "walk", PRETENDS.replace(repr(ANSWER), "'no answer'"))
    now = [0.0]
    catalogue = Catalogue(config(tmp_path), clock=lambda: now[0])
    for now[0] in (0.0, 59.0, 61.0, 70.0):
        assert scanned(catalogue)["walk"].settings == ()
    assert (entry.parent / "asked").read_text() == "xx"
    assert caplog.text.count("walk is offered without settings: its --describe: JSON is malformed") == 1


OLD_NUMPY, CREATE = "numpy below 2.4 (float() of an array)", "cv2.aruco.DetectorParameters_create"
SHMSRC = "import cv2\nPIPE = 'shmsrc socket-path=x ! appsink'\ncv2.VideoCapture(PIPE, cv2.CAP_GSTREAMER)"


@pytest.mark.parametrize(
    ("text", "lacks"),
    [
        ("import nump, msgspec\nfrom nowhere.part import name", ["nump", "nowhere"]),
        ("try:\n    import nump\nexcept ImportError:\n    nump = None\ndef show():\n    import nowhere", []),
        (SHMSRC, ["cv2 with GStreamer"]),
        ("import numpy\nmap(float, numpy.zeros(3))", [OLD_NUMPY]),
        ("from cv2 import aruco as a\nimport cv2\na.DetectorParameters_create()", [CREATE]),
        ("import numpy as np\nnp.zeros(3, np.float)\nnp.linalg.norm(0)", ["numpy.float"]),
        ("import cv2\nif hasattr(cv2.aruco, 'detectMarkers'): cv2.aruco.detectMarkers(0)", []),
        ("import subprocess, sys\nsubprocess.run([sys.executable, 'helper.py'])", ["nowhere"]),
        ("raise SystemExit('it was run')", []),
    ],
)
def test_what_a_script_lacks_is_found_without_running_it(tmp_path: Path, text: str, lacks: list[str]) -> None:
    """The wheel's OpenCV has no GStreamer."""
    entry = write(tmp_path, "walk", text)
    write(tmp_path, "walk", "import nowhere", "helper.py")
    assert lacking((sys.executable, str(entry)), entry.parent, {}) == lacks


def test_python3_of_a_script_of_others_is_the_systems(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = str(Path(sys.prefix, "bin"))
    monkeypatch.setenv("PATH", f"{own}:/usr/bin")
    monkeypatch.setenv("VIRTUAL_ENV", sys.prefix)
    theirs, ours = environment(ours=False), environment()
    assert (theirs["PATH"], "VIRTUAL_ENV" in theirs, ours["PATH"]) == (f"/usr/bin:{own}", False, f"{own}:/usr/bin")
    folder = write(tmp_path, "walk", "import json").parent
    (folder / "script.json").write_text(json.dumps({"command": ["python3", "run.py"]}))
    assert scanned(Catalogue(config(tmp_path)))["walk"].command == (interpreter(None, ours=False), "run.py")


@pytest.fixture
def entry(tmp_path: Path) -> Path:
    return tmp_path / "run.py"


@pytest.mark.parametrize(
    ("text", "ours"),
    [
        ("from pebble import run", True),
        ("import pebble.script", True),
        ("from pebble import camera", False),
        ("'''\nfrom pebble.script import run\n'''", False),
        ("from .pebble import run", False),
        ("x = 1\0", False),
    ],
)
def test_only_what_imports_our_script_module_is_ours(entry: Path, text: str, ours: bool) -> None:
    entry.write_text(text)
    assert is_ours(entry) is ours


def test_what_is_no_python_is_named_with_its_line_and_no_other_file_is_ours(entry: Path) -> None:
    entry.write_text("(" * 5000)
    with pytest.raises(DescribeError, match=r"^run\.py, line 1: "):
        is_ours(entry)
    (shell := entry.with_name("run.sh")).write_text("from pebble import run")
    assert not is_ours(shell)
    assert not is_ours(entry.with_name("missing.py"))


def test_what_is_no_file_is_not_opened(entry: Path) -> None:
    os.mkfifo(pipe := entry.with_name("pipe.py"))  # to open it would wait for a writer
    (device := entry.with_name("device.py")).symlink_to("/dev/zero")  # it has no end
    assert not is_ours(pipe)
    assert not is_ours(device)


def asked(entry: Path, text: str) -> Description:
    entry.write_text(text)
    return ask([sys.executable, str(entry)], entry.parent, os.environ)


def test_the_last_line_of_the_answer_counts(entry: Path) -> None:
    answer = {"label": "Walk", "configs": [{"key": "speed", "type": "float", "default": None, "arg": "--speed"}]}
    found = asked(
        entry, f"import sys\nassert sys.argv[1:] == ['--describe']\nprint('hi')\nprint({json.dumps(answer)!r})"
    )
    assert (found.label, found.configs[0].key, found.dependencies) == ("Walk", "speed", [])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('print(\'{"configs": [{"key": "a"}, {"key": "a"}]}\')', "two settings have the same key"),
        ("import sys\nsys.stdout.write('x' * 300_000)", "its --describe is longer than 262144 bytes"),
        (r"""raise SystemExit("\x1b[31mred\r12:00:00 [ERROR] forged")""", "code 1: "),
    ],
)
def test_a_failing_answer_has_a_reason(entry: Path, text: str, reason: str) -> None:
    with pytest.raises(DescribeError) as caught:
        asked(entry, text)
    assert reason in str(caught.value)
    assert str(caught.value).isprintable(), "fit for a log"


def test_one_that_hangs_ends_with_all_it_started(entry: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(describe, "_LIMIT_S", 1.0)
    hang = "import os, subprocess\np = subprocess.Popen(['sleep', '60'])\nopen('pid', 'w').write(str(p.pid))\np.wait()"
    with pytest.raises(DescribeError, match="takes longer than 1 s"):
        asked(entry, hang)
    pid = int((entry.parent / "pid").read_text())
    assert until(lambda: gone(pid))


def test_a_manifest_describes_a_script_of_any_language(tmp_path: Path) -> None:
    path = tmp_path / "script.json"
    assert read_manifest(path) is None
    path.write_text('{"label": "Shell", "command": ["./run.sh"], "dependencies": [{"file": "eyes"}]}')
    found = read_manifest(path)
    assert found is not None
    assert (found.label, found.command, found.dependencies[0].file) == ("Shell", ["./run.sh"], "eyes")
    path.write_text("x" * 300_000)
    with pytest.raises(DescribeError, match=r"script\.json is longer than"):
        read_manifest(path)
    path.unlink()
    os.mkfifo(path)  # to open it would wait for a writer, and no script would be listed any more
    with pytest.raises(DescribeError, match="no file"):
        read_manifest(path)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{"summary": "%s"}' % ("x" * 161), "longer than 160"),
        ('{"main": ["a", "b", "c", "d"]}', "more than 3 main"),
        (r'{"label": "\u001b[31mred"}', "control characters"),
        (r'{"configs": [{"key": "a\nb"}]}', "control characters"),
        (r'{"configs": [{"key": "a", "arg": "--a\u0000"}]}', "control characters"),
    ],
)
def test_what_operators_read_is_short_and_printable(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "script.json").write_text(text)
    with pytest.raises(DescribeError, match=why):
        read_manifest(tmp_path / "script.json")
