"""Which files are asked what they are, and which answers count."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from pebble.services.autonomy_manager import describe
from pebble.services.autonomy_manager.describe import (
    DescribeError,
    Description,
    ask,
    is_ours,
    read_manifest,
)
from tests.support import gone, until


@pytest.fixture
def entry(tmp_path: Path) -> Path:
    return tmp_path / "run.py"


@pytest.mark.parametrize(
    ("text", "ours"),
    [
        ("from pebble import run", True),
        ("from pebble import camera, run as go", True),
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
        ("import no_such_module", "its --describe ended with code 1: ModuleNotFoundError: No module named"),
        ("print('hello')", "its --describe: JSON is malformed"),
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


CONTROL = (
    r'{"label": "\u001b[31mred"}',
    r'{"configs": [{"key": "a\nb"}]}',
    r'{"configs": [{"key": "a", "arg": "--a\u0000"}]}',
)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{"summary": "%s"}' % ("x" * 161), "longer than 160"),
        ('{"main": ["a", "b", "c", "d"]}', "more than 3 main"),
        *((text, "control characters") for text in CONTROL),
    ],
)
def test_what_operators_read_is_short_and_printable(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "script.json").write_text(text)
    with pytest.raises(DescribeError, match=why):
        read_manifest(tmp_path / "script.json")
