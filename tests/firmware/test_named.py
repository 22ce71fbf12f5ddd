"""A simulated board where names are checked, at a real broker with roles: who moves it, and who stops it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pebble.config import Security
from pebble.contract.names import with_name
from pebble.extensions.fleet.certificates import CA_CERT
from pebble.extensions.fleet.roles import Account
from tests.ext.fleet.broker_client import BrokerClient
from tests.ext.fleet.brokers import HOST, FleetBroker
from tests.firmware.wireless_rig import Robots
from tests.support import until

KIND = "minilamp"
BASE = f"pebble/robots/{KIND}"
ACCOUNTS = {
    KIND: Account(roles=("robot",), bases=(BASE,), plain=True),  # so the broker lets topics without a name pass, too
    "ann": Account(roles=("driver",)),
    "otto": Account(roles=("driver",)),
    "sam": Account(roles=("safety",)),
    "vera": Account(roles=("viewer",)),
}


def command(sender: BrokerClient, metric: str, account: str = "", /, **body: Any) -> None:
    """Returns once the broker has it."""
    topic = f"{BASE}/incoming/{metric}"
    sender.publish(with_name(topic, account) if account else topic, json.dumps(body).encode())
    sender.flush()


def newest(eye: BrokerClient, metric: str) -> dict[str, Any]:
    payloads = [payload for topic, payload in list(eye.received) if topic == f"{BASE}/outgoing/{metric}"]
    state: dict[str, Any] = json.loads(payloads[-1]) if payloads else {}
    return state


def became(eye: BrokerClient, metric: str, **fields: Any) -> dict[str, Any]:
    eye.wait(lambda: fields.items() <= newest(eye, metric).items(), f"deliver {metric} with {fields}")
    return newest(eye, metric)


def test_who_has_control_drives_and_everybody_stops(tmp_path: Path) -> None:
    with FleetBroker(tmp_path / "hall", ACCOUNTS, level="named") as broker:
        login = {"username": KIND, "password": broker.passwords[KIND], "ca": tmp_path / "hall" / CA_CERT}
        named = Security(level="named")
        with (
            Robots(HOST, broker.port, kinds=[KIND], security=named, **login) as boards,
            broker.login("ann") as ann,
            broker.login("otto") as otto,
            broker.login("sam") as sam,
            broker.login("vera") as vera,
        ):
            boards.wait_online()
            vera.subscribe([f"{BASE}/outgoing/#"])
            vera.wait(lambda: newest(vera, "capabilities"), "deliver capabilities")
            assert newest(vera, "capabilities")["value"]["named"] is True
            command(ann, "control", "ann", id="aaaaaaaa", by="Ann B.", for_ms=10_000)
            key = became(vera, "control/mcu", by="ann/ann_b_", named=True)["key"]
            for body in (
                {"key": key},
                {},
                {"source": "autonomy", "run": 7},
                {"source": "autonomy", "run": 8, "key": key},
            ):
                command(otto, "drive-values", "otto", z=-1, **body)
                command(otto, "drive-values", "ann", z=-1, **body)
                command(otto, "drive-values", z=-1, **body)
            command(otto, "control/take", "otto", id="bbbbbbbb")
            command(ann, "drive-values", "ann", z=1, key=key)
            assert until(lambda: boards.moving(KIND))
            command(vera, "estop", by="vera")
            assert until(lambda: not boards.moving(KIND))
            became(vera, "estop/mcu", latched=True, by="vera?")  # who says so was not checked
            command(otto, "estop", stop="00000000000000a1", by="ann")
            became(vera, "estop/mcu", by="ann?", count=2)
            command(otto, "estop", "otto", stop="00000000000000a1")  # the same one, with a name
            state = became(vera, "estop/mcu", by="otto", count=2, latched=True)
            order = {"boot": state["boot"], "count": state["count"]}
            command(otto, "estop-reset", "otto", **order)
            command(otto, "estop-reset", **order)
            command(ann, "control", "ann", id="aaaaaaaa", by="ann", for_ms=10_000)
            command(sam, "estop-reset", "sam", **order)
            became(vera, "estop/mcu", latched=False, count=state["count"])
            command(ann, "drive-values", "ann", z=0, key=key)
            command(ann, "drive-values", "ann", z=1, key=key)
            assert until(lambda: boards.moving(KIND))
            command(otto, "drive-values", z=0)
            assert until(lambda: not boards.moving(KIND))
            command(sam, "control/take", "sam", id="cccccccc", by="sam")
            assert became(vera, "control/mcu", by="sam/sam")["key"] != key
            command(ann, "drive-values", "ann", z=-1, key=key)
            command(sam, "drive-values", "sam", z=1, key=newest(vera, "control/mcu")["key"])
            assert until(lambda: boards.moving(KIND))
            assert not [at for at in boards.moves[KIND] if min(at[1]) < 0]  # no others' commands
