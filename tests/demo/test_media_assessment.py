"""The assessment of pictures and sound that are right, too slow, wrong or too few."""

from __future__ import annotations

import numpy as np
import pytest

from pebble.demo.media_assessment import ShownPicture, assess_pictures, assess_rate, assess_sound, best_match, envelope
from pebble.media.speech import PERIOD_S, Speech

RATE = 16_000


def shown(count: int = 41, fps: float = 10.0, camera: float = 15.0) -> list[ShownPicture]:
    return [ShownPicture(1000 + number / fps, round(100 + number * camera / fps)) for number in range(count)]


def test_pictures_as_promised() -> None:
    result = assess_pictures("goob", "json", shown(), 15, 10)
    assert result.wrong == ()
    assert result.measured == "10.0 fps, counter 15.00/s"


def test_a_camera_that_catches_up_after_a_stall_of_the_machine() -> None:
    assert assess_pictures("goob", "json", shown(camera=16.8), 15, 10).wrong == ()


@pytest.mark.parametrize(
    ("pictures", "complaint"),
    [
        (shown(camera=10), "advances by 10.0 a second instead of 15"),
        (shown(fps=6.5), "6.5 pictures a second instead of 10"),
        ([*shown()[:20], *shown()[:20]], "fell back"),
        ([ShownPicture(one.captured_s, None if n % 3 else one.counter) for n, one in enumerate(shown())], "illegible"),
        (shown(3), "only 3 legible"),
        ([], "only 0 legible"),
    ],
)
def test_pictures_that_are_not(pictures: list[ShownPicture], complaint: str) -> None:
    assert any(complaint in wrong for wrong in assess_pictures("goob", "json", pictures, 15, 10).on("").wrong)


def test_an_overloaded_machine_excuses_too_few_pictures_but_no_wrong_ones() -> None:
    busy = "0% were idle"
    few = assess_pictures("goob", "json", shown(fps=6.5), 15, 10).on(busy)
    assert (few.wrong, few.overloaded) == ((), busy)
    many = assess_pictures("goob", "json", shown(fps=14), 15, 10).on(busy)
    assert "14.0 pictures a second instead of 10" in many.wrong[0]
    assert many.overloaded == ""
    both = assess_pictures("goob", "json", shown(fps=6.5, camera=10), 15, 10).on(busy)
    assert ["advances by" in wrong for wrong in both.wrong] == [True]


@pytest.mark.parametrize(
    ("count", "fps", "wrong"),
    [(41, 10.0, ()), (41, 6.5, ("json: 6.5 pictures a second",)), (3, 10, ("json: too few",))],
)
def test_pictures_without_a_counter(count: int, fps: float, wrong: tuple[str, ...]) -> None:
    result = assess_rate("goob", "json", [one.captured_s for one in shown(count, fps)], 10).on("")
    assert [one.startswith(start) for one, start in zip(result.wrong, wrong, strict=True)] == [True] * len(wrong)


def speech(first: int, count: int) -> np.ndarray:
    return Speech(RATE).samples(first, count)[:, 0].astype(float)


def test_sound_as_it_was_made() -> None:
    made = speech(0, 2 * RATE * PERIOD_S)
    assert assess_sound("goob", "pcm", speech(33_333, 3 * RATE), made, RATE).wrong == ()
    assert assess_sound("goob", "opus", speech(33_333, 3 * RATE), made, RATE).wrong == ()


def test_other_sound_and_too_little_of_it() -> None:
    made = speech(0, 2 * RATE * PERIOD_S)
    noise = np.random.default_rng(1).normal(0, 3000, 3 * RATE)
    assert "correlate by" in assess_sound("goob", "pcm", noise, made, RATE).wrong[0]
    assert "correlate by" in assess_sound("goob", "opus", noise, made, RATE).wrong[0]
    assert "too little" in assess_sound("goob", "pcm", made[:100], made, RATE).few[0]


def test_samples_out_of_place_are_noticed() -> None:
    """A packet is missing, without a gap in the stamps."""
    received = np.concatenate((speech(20_000, RATE), speech(20_000 + RATE + 320, 2 * RATE)))
    assert assess_sound("goob", "pcm", received, speech(0, 2 * RATE * PERIOD_S), RATE).wrong


def test_the_best_match_is_one_for_a_part_and_nothing_for_silence() -> None:
    whole = np.random.default_rng(2).normal(size=5000)
    assert best_match(whole[1234:2345], whole) == pytest.approx(1.0)
    assert best_match(np.zeros(100), whole) == 0.0
    assert best_match(np.zeros(0), whole) == 0.0


def test_the_envelope_is_the_loudness_of_each_20_ms() -> None:
    assert envelope(np.concatenate((np.full(320, 3.0), np.full(320, -4.0))), RATE) == pytest.approx([3.0, 4.0])
