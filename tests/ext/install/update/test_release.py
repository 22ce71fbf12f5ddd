"""A release counts only whole, newer, and signed by a key that the robot trusts; a refusal names the reason."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.install.update.release import MANIFEST, SIGNATURE, ReleaseError, main, verify
from tests.kit.releases import WHEEL, Key, release
from tests.support import ROOT

OURS, OTHER = Key.fresh(), Key.fresh()
REFUSED = {
    "the same": ({"sequence": 11}, "release 0.3.0 is number 11, and number 11 was taken here"),
    "too far ahead": ({"from": "7.0.0"}, "release 0.3.0 follows 7.0.0 or newer, and this is "),
    "another Python": ({"python": ">=3.99"}, "release 0.3.0 needs Python >=3.99"),
    "no number": ({"sequence": "12"}, r"RELEASE.json: Expected `int`, got `str` - at `\$.sequence`"),
    "a path": ({"files": {"../etc/x": "0"}}, r"RELEASE.json names \.\./etc/x: not a wheel and robot.txt"),
    "another name": ({"files": {WHEEL: "0", "robot.txt": "0", "run.sh": "0"}}, "not a wheel and robot.txt"),
}


def test_a_whole_one_is_taken(tmp_path: Path) -> None:
    found = verify(release(tmp_path / "r", OURS), [OTHER.public, OURS.public], above=11)
    assert (found.version, found.sequence, found.oldest, found.keys) == ("0.3.0", 12, "0.1.0", (OURS.public,))


@pytest.mark.parametrize(("changes", "reason"), REFUSED.values(), ids=REFUSED)
def test_what_its_signer_should_not_have_signed(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ReleaseError, match=reason):
        verify(release(tmp_path / "r", OURS, **changes), [OURS.public], above=11)


def test_one_flipped_bit_in_any_byte_is_refused(tmp_path: Path) -> None:
    """Only the comment that minisign calls untrusted may differ: it is shown nowhere."""
    folder = release(tmp_path / "r", OURS)
    flipped = 0
    for path in sorted(folder.iterdir()):
        data = path.read_bytes()
        start = data.index(b"\n") if path.name == SIGNATURE else 0
        for at in range(start, len(data)):
            path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
            with pytest.raises(ReleaseError):
                verify(folder, [OURS.public])
            flipped += 1
        path.write_bytes(data)
    assert flipped > 550
    verify(folder, [OURS.public])


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda folder: (folder / SIGNATURE).unlink(), "RELEASE.json.minisig: No such file"),
        (lambda folder: (folder / "robot.txt").unlink(), "robot.txt: No such file"),
        (lambda folder: [(folder / MANIFEST).unlink(), os.mkfifo(folder / MANIFEST)], "json: is no plain file"),
        (lambda folder: (folder / SIGNATURE).write_bytes(bytes(2000)), "minisig has more than 1024 bytes"),
        (lambda folder: (folder / SIGNATURE).write_text("a\nb\n"), "is no signature by minisign"),
        (lambda folder: (folder / "other.whl").touch(), "has more than RELEASE.json names: other.whl"),
        (lambda folder: OTHER.sign(folder / MANIFEST), "which is none of this robot's"),
    ],
)
def test_what_is_missing_or_by_others(tmp_path: Path, spoil: Callable[[Path], object], reason: str) -> None:
    folder = release(tmp_path / "r", OURS)
    spoil(folder)
    with pytest.raises(ReleaseError, match=reason):
        verify(folder, [OURS.public])


def test_the_test_key_is_the_only_one_so_far_and_refused_outside_tests(tmp_path: Path) -> None:
    keys = json.loads((ROOT / "configs/debian/release.json").read_text())["keys"]
    assert keys == [Key.test().public]
    folder = release(tmp_path / "r", Key.test())
    with pytest.raises(ReleaseError, match="by a test key, with which everybody can sign"):
        verify(folder, keys)
    assert verify(folder, keys, test_key=True).version == "0.3.0"


def test_the_command_names_the_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trusted, folder = release(tmp_path / "now", OURS), release(tmp_path / "r", OURS)
    command = [str(folder), "--trusted", str(trusted), "--above", str(tmp_path / "sequence")]
    assert main(command) == 0
    (tmp_path / "sequence").write_text("12\n")
    assert main(command) == 1
    assert capsys.readouterr().err == "pebble: refused: release 0.3.0 is number 12, and number 12 was taken here\n"


@pytest.mark.skipif(shutil.which("minisign") is None, reason="needs minisign (apt install minisign)")
def test_minisign_accepts_what_we_accept_and_signs_what_we_accept(tmp_path: Path) -> None:
    folder = release(tmp_path / "r", OURS)
    manifest = str(folder / MANIFEST)
    subprocess.run(["minisign", "-V", "-P", OURS.public, "-m", manifest], check=True, capture_output=True)
    public, secret = tmp_path / "p", tmp_path / "s"
    subprocess.run(["minisign", "-G", "-W", "-p", str(public), "-s", str(secret)], check=True, capture_output=True)
    subprocess.run(["minisign", "-S", "-s", str(secret), "-m", manifest], check=True, capture_output=True, input=b"")
    assert verify(folder, [public.read_text().splitlines()[1]]).sequence == 12
