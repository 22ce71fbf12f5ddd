"""The audit of a whole robot, at a real broker: what people did stays, through a flood and a killed bridge."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.commands.command_line import Run
from tests.robot.operator import retained_messages
from tests.robot.rig import BASE, Rig
from tests.support import cases, until

pytestmark = pytest.mark.alone

OTTO = {"id": "aaaaaaaa", "by": "otto", "for_ms": 10_000}
STOP = "0123456789abcdef"
FLOOD = cases(4_000, 20_000)


def rows(rig: Rig) -> list[dict[str, Any]]:
    """The rows so far; the file is not full here."""
    files = (rig.folder / "state").glob("audit-*.jsonl")
    return [json.loads(line) for file in files for line in file.read_text().splitlines()]


def acts(rig: Rig) -> list[tuple[str, str]]:
    return [(row["what"], row.get("who", "")) for row in rows(rig)]


def test_what_people_did_stays(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pebble = Run(monkeypatch, capsys)
    with Rig("mqtt") as rig:
        rig.operator.send("incoming/control", OTTO)
        assert until(lambda: ("control-given", "otto?") in acts(rig), 5)
        rig.operator.send("incoming/estop", {"stop": STOP, "by": "ann"})
        assert until(lambda: ("stop", "ann?") in acts(rig), 5)
        for number in range(FLOOD):
            rig.operator.send("incoming/drive-values", {"x": 1, "key": f"{number:08x}"}, qos=0)
            rig.operator.send("incoming/autonomy-command", {"action": "start", "file": f"f{number}"}, qos=0)
        assert until(lambda: ("script-start", "") in acts(rig), 10), "beyond the bound they are counted"
        rig.kill("mqtt_bridge")
        assert until(lambda: acts(rig).count(("start", "(robot)")) == 2, 20)
        assert acts(rig)[:3] == [("start", "(robot)"), ("control-given", "otto?"), ("stop", "ann?")]
        assert len(rows(rig)) < 400
        assert not [topic for topic in retained_messages(rig.remote.port, BASE, 0.3) if "audit" in topic]
        rig.stop()
        assert pebble("fleet", "audit", rig.config, "-n", "1000") == 0
        assert "otto?" in pebble.out
        assert f"stop {STOP}" in " ".join(pebble.out.split())
