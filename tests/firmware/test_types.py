"""The type check of the firmware finds what a board does not have."""

from __future__ import annotations

from pathlib import Path

import pytest

from pebble.extensions.install.flash.boards import FIRMWARE
from tests.firmware.types import check

pytestmark = pytest.mark.computing


@pytest.mark.parametrize(
    ("robot", "code", "complaint"),
    [
        ("goob", "import network\n", 'named "network"'),
        ("benjr", "from machine import PWM, Pin\nPWM(Pin(4), duty=0.5)\n", 'keyword argument "duty"'),
        ("minilamp", "import machine\nmachine.WDT(0, timeout='long')\n", 'incompatible type "str"'),
        ("fred", "import time\ntime.monotonic()\n", 'no attribute "monotonic"'),
    ],
)
def test_it_knows_each_board(robot: str, code: str, complaint: str, tmp_path: Path) -> None:
    (tmp_path / robot).mkdir()
    (tmp_path / robot / "robot.py").write_text(code)
    assert complaint in check(FIRMWARE[robot], tmp_path)


def test_it_knows_what_they_have(tmp_path: Path) -> None:
    (tmp_path / "goob").mkdir()
    (tmp_path / "goob" / "robot.py").write_text(
        "import time\nfrom machine import ADC, Pin\n\n\ndef read() -> int:\n"
        "    time.sleep_ms(5)\n    return ADC(Pin('PA02')).read_u16() + time.ticks_ms()\n"
    )
    assert check(FIRMWARE["goob"], tmp_path) == ""
