"""Command lines of ``pebble bench``: what is wrong is refused in one line before anything starts."""

from __future__ import annotations

import sys

import pytest

from pebble import cli


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("control --variants nats", "--variants: unknown nats: there are stand-in, mqtt"),
        ("control --variants mqtt,mqtt", "--variants: name each one once"),
        ("control --loads heavy", "--loads: unknown heavy"),
        ("control --sizes big", "--sizes: big is not a list of numbers"),
        ("control --sizes 8", "--sizes 8: must be at least 40"),
        ("control --rates nan", "--rates nan: must be at least 1"),
        ("control --seconds 0", "0"),
        ("control --rounds 0", "0"),
        ("bridge --variants carrier-pigeon", "there are stand-in, mqtt, zenoh"),
        ("startup --variants ,", "holds no name"),
        ("frames --seconds 4000", "4000"),
        ("cost --output /dev/null/there", "Not a directory"),
        ("frames --size 3x3", "there are 640x480, 1280x720, 1920x1080"),
        ("scale --boards 0", "--boards 0: must be at least 1"),
        ("impair --trials 512", "--trials: unknown 512: there are base-start"),
        ("impair --subjects pigeon", "there are mqtt original"),
        ("report out --only nonsense", "--only: unknown nonsense: there are control, bridge"),
        ("wire", "No such command 'wire'"),
    ],
)
def test_a_wrong_command_line_is_one_line(
    line: str, named: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["pebble", "bench", *line.split()])
    assert cli.main() != 0
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1
