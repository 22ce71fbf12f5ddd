"""The audit of a whole robot, at a real broker: what people did stays, and a change of it is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import chain
from pebble.contract.chain import Mark
from tests.commands.command_line import Run
from tests.robot.operator import retained_messages
from tests.robot.rig import BASE, STOP, Rig
from tests.support import cases, until

pytestmark = pytest.mark.alone

OTTO = {"id": "aaaaaaaa", "by": "otto", "for_ms": 10_000}
FLOOD = cases(4_000, 20_000)


def written(rig: Rig, name: str = "acts") -> list[Path]:
    """The file of a chain, once there is one; none is full here."""
    return list((rig.folder / "state").glob(f"audit-{name}-*.jsonl"))


def rows(rig: Rig, name: str = "acts") -> list[dict[str, Any]]:
    return [json.loads(line) for path in written(rig, name) for line in path.read_text().splitlines()]


def acts(rig: Rig) -> list[tuple[str, str]]:
    return [(row["what"], row["who"]) for row in rows(rig)]


def test_what_people_did_stays_and_what_was_changed_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pebble = Run(monkeypatch, capsys)
    with Rig("mqtt") as rig:
        rig.operator.send("incoming/control", OTTO)
        assert until(lambda: ("control-given", "otto?") in acts(rig), 5)
        rig.operator.send("incoming/estop", {"stop": STOP, "by": "ann"})
        assert until(lambda: ("stop", "ann?") in acts(rig), 5)
        for number in range(FLOOD):
            rig.operator.send("incoming/drive-values", {"x": 1, "key": f"{number:08x}"}, qos=0)
            rig.operator.send("incoming/autonomy-command", {"action": "start", "file": f"f{number}"}, qos=0)
        assert until(lambda: any(row["what"] == "wrong key" for row in rows(rig, "refused")), 10)
        rig.kill("mqtt_bridge")
        assert until(lambda: acts(rig).count(("start", "(robot)")) == 2, 20)
        assert acts(rig)[:3] == [("start", "(robot)"), ("control-given", "otto?"), ("stop", "ann?")]
        assert len(rows(rig)) < 250
        assert until(lambda: mark(rig).n == rows(rig)[-1]["n"], 15)
        noted = mark(rig)
        rig.stop()

        assert pebble("fleet", "audit", rig.config, "-n", "1000") == 0
        assert "otto?" in pebble.out
        assert pebble("fleet", "audit", rig.config, "--refused") == 0
        assert "wrong key" in pebble.out
        assert pebble("fleet", "audit", rig.config, "--verify") == 0, pebble.out
        [file] = written(rig)
        whole = file.read_bytes().splitlines(keepends=True)
        for changed, problem in (
            ([*whole[:1], whole[1].replace(b"otto", b"anna"), *whole[2:]], "acts: line 2 was changed"),
            ([*whole[:2], *whole[3:]], "acts: line 3 is missing"),
        ):
            file.write_bytes(b"".join(changed))
            assert pebble("fleet", "audit", rig.config, "--verify") == 1
            assert pebble.out.startswith(problem)
        assert chain.verify((line.rstrip() for line in whole), [noted]) == ""
        assert chain.verify((line.rstrip() for line in whole[: noted.n - 1]), [noted]).endswith(
            "missing: the end was cut off"
        )


def mark(rig: Rig) -> Mark:
    found = retained_messages(rig.remote.port, BASE, 0.3).get("outgoing/audit", b'{"acts": {}}')
    return Mark(**json.loads(found)["acts"])
