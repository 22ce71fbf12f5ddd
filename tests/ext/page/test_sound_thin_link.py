"""Sound of a whole robot, both ways, through a network that is slow and loses packets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.extensions.lab.bench.impair.conditions import Condition, Shape
from pebble.extensions.lab.bench.impair.network import why_no_namespaces
from tests.ext.page.ears import PLAIN_MICROPHONE, TAP, compared, fake_microphone, played, recorded, write_voice
from tests.ext.page.rig import Rig, linked

pytestmark = [pytest.mark.alone, pytest.mark.thorough]
THIN = Condition("256 kbit/s, 2 %", up=Shape(kbit=256, loss=0.02), down=Shape(loss=0.02))


@pytest.fixture
def far(tmp_path: Path) -> Iterator[Rig]:
    if reason := why_no_namespaces():
        pytest.skip(f"no namespaces: {reason}")
    write_voice(voice := tmp_path / "voice.wav")
    with linked(THIN, "goob", flags=fake_microphone(voice)) as rig:
        yield rig


def test_sound_through_a_slow_and_lossy_network(far: Rig) -> None:
    page = far.page("goob")
    far.until(page, lambda: page.locator("[data-test=listen]:enabled").count(), "no page", 30)
    page.locator("[data-test=video]").click()  # pictures would need all of it
    page.locator("[data-test=listen]").click()
    page.locator("[data-test=gear]").click()
    shown = page.locator("[data-test=sound-state]")
    far.until(page, lambda: "ms buffered · opus" in shown.inner_text(), lambda: shown.inner_text(), 30)
    far.pause(page, 3)
    page.evaluate(TAP)
    far.pause(page, 8)
    rate = int(page.evaluate("pebble.sound.model.context.sampleRate"))
    assert compared(recorded(page), rate, envelopes=True) > 0.9
    page.evaluate(f"() => {{ {PLAIN_MICROPHONE} }}")
    page.locator("[data-test=talk]").hover()
    page.mouse.down()
    far.until(page, lambda: len(played(far.stage)) > 5 * 48_000, lambda: shown.inner_text(), 40)
    page.mouse.up()
    assert compared(played(far.stage), 48_000) > 0.9
