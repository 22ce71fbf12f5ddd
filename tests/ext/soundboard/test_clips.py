"""The folder of clips: what is listed can be found, and nothing else."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pebble.services.soundboard_handler.clips import Clips


def put(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_everything_that_is_listed_is_found(tmp_path: Path) -> None:
    put(tmp_path, "a b.wav", "~.wav", "~nobody.wav", "ä ö\u00a0ü.wav", "line\nbreak.wav", "d/e/f.wav", "x.mp3", "y.ogg")
    (tmp_path / "link.wav").symlink_to("d/e/f.wav")
    clips = Clips(tmp_path)
    found = {name: clips.find(name) for name in clips.scan()}
    assert len(found) == 9
    assert all(clip is not None for clip in found.values())
    assert {name: clip.name for name, clip in found.items() if clip and clip.name != name} == {"link.wav": "d/e/f.wav"}


def test_what_leads_outside_is_neither_listed_nor_found(tmp_path: Path) -> None:
    inside, outside = tmp_path / "sounds", tmp_path / "sounds-other"
    put(inside, "a.wav", "text.txt")
    put(outside, "b.wav")
    (inside / "b.wav").symlink_to(outside / "b.wav")
    (inside / "other").symlink_to(outside)
    (inside / "circle.wav").symlink_to("circle.wav")
    (inside / "folder.wav").mkdir()
    clips = Clips(inside)
    assert clips.scan() == ["a.wav"]
    names = ["b.wav", "other/b.wav", "../sounds-other/b.wav", "a.wav/../../sounds-other/b.wav", str(outside / "b.wav")]
    for name in (*names, "circle.wav", "folder.wav", "text.txt", "~nobody/a.wav"):
        assert clips.find(name) is None, name


def test_the_folder_may_be_a_link_and_a_name_a_way_around(tmp_path: Path) -> None:
    put(tmp_path / "real", "a.wav", "sub/b.wav")
    (tmp_path / "link").symlink_to("real")
    clips = Clips(tmp_path / "link")
    assert clips.scan() == ["a.wav", "sub/b.wav"]
    for name in (str(tmp_path / "link" / "a.wav"), "sub/../a.wav"):
        clip = clips.find(name)
        assert clip is not None
        assert clip.name == "a.wav"


def test_the_list_is_bounded_and_what_is_not_listed_can_be_played(tmp_path: Path) -> None:
    for number in range(1_400):
        os.close(os.open(f"{tmp_path}/{number:04}{'s' * 192}.wav", os.O_CREAT | os.O_WRONLY))
    clips = Clips(tmp_path)
    assert len(clips.scan()) == 256 * 1024 // 200
    assert clips.problem == "only the first 1310 of 1400 are listed"
    assert clips.find(f"1399{'s' * 192}.wav")


def test_what_cannot_be_read_or_named_is_left_out_and_reported(tmp_path: Path) -> None:
    missing = Clips(tmp_path / "missing")
    assert missing.scan() == []
    assert missing.problem == f"{tmp_path}/missing cannot be read: No such file or directory"
    assert missing.find("a.wav") is None
    put(tmp_path, "good.wav", "back\\slash.wav")
    clips = Clips(tmp_path)
    assert clips.scan() == ["good.wav"]
    assert clips.problem == "'back\\\\slash.wav' cannot be named in commands: rename it"
    (tmp_path / "back\\slash.wav").unlink()
    latin = Path(os.fsdecode(os.fsencode(tmp_path) + b"/latin\xe4.wav"))
    latin.touch()
    (tmp_path / "link.wav").symlink_to(latin)
    assert clips.scan() == ["good.wav", "link.wav"]
    link = clips.find("link.wav")
    assert link is not None
    assert (link.name, link.path.name) == ("link.wav", "latin\udce4.wav")
    latin.unlink()
    assert (clips.scan(), clips.problem) == (["good.wav"], "")


def test_names_are_sorted_without_regard_to_case_and_are_those_of_what_can_be_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(tmp_path, "b.wav", "A.WAV", "c/B.wav", "C.wav", "a.txt", ".wav.bak", "d.mp3", "e.OGG", "f.flac", "g.m3u")
    assert Clips(tmp_path).scan() == ["A.WAV", "b.wav", "C.wav", "c/B.wav", "d.mp3", "e.OGG", "f.flac"]
    monkeypatch.setattr("pebble.extensions.media.pyav.find_spec", lambda _name: None)
    clips = Clips(tmp_path)
    assert clips.scan() == ["A.WAV", "b.wav", "C.wav", "c/B.wav"]
    assert clips.find("d.mp3") is None
