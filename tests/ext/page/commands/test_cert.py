"""``pebble cert`` makes certificates, and overwrites none."""

from __future__ import annotations

import stat
from pathlib import Path

from tests.commands.command_line import Run


def test_init_prints_what_to_type_next_and_how_phones_trust_it(run: Run, state: Path) -> None:
    state /= "tls"
    assert run("cert", "init", "lab-pc.local", "192.168.1.20") == 0, run.err
    lines = run.out.splitlines()
    assert lines[0] == f"{state} has a certificate for lab-pc.local, 192.168.1.20."
    assert lines[2] == f"    pebble web CONFIG --host 0.0.0.0 --tls {state}"
    assert "https://lab-pc.local:PORT/ca.pem" in run.out
    assert sorted(path.name for path in state.iterdir()) == ["ca.key", "ca.pem", "server.key", "server.pem"]
    assert stat.S_IMODE((state / "ca.key").stat().st_mode) == 0o600


def test_show_and_renew(run: Run, tmp_path: Path) -> None:
    """The certificates themselves are tested where they are made."""
    folder = tmp_path / "tls"
    run("cert", "init", "--folder", folder, "lab-pc.local", "::1")
    assert run("cert", "show", "--folder", folder) == 0
    assert f"{folder}/ca.pem\n    authority\n" in run.out
    assert f"{folder}/server.pem\n    for lab-pc.local, ::1\n" in run.out
    assert run("cert", "renew", "--folder", folder) == 0
    assert run.out.startswith(f"{folder}/server.pem is for lab-pc.local, ::1 until ")
    assert run("cert", "renew", "--folder", folder, "other.local") == 0
    assert "is for other.local until" in run.out
    assert run("cert", "init", "--folder", folder, "lab-pc.local") == 1
    assert run.err.startswith(f"pebble: {folder}/ca.pem exists: `pebble cert renew --folder {folder}`")
