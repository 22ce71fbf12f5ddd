"""A side that has gone back to an older save: what was changed since counts, above all what was switched off."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import pytest

from pebble.forwarding import side as side_module
from pebble.services.mqtt_bridge.requests.media import Media
from tests.forwarding.links.rig import LOCAL, REMOTE, End, MqttEnd, Side, ZenohEnd
from tests.forwarding.links.test_other_ways import Make
from tests.forwarding.links.test_other_ways import make as make
from tests.support import some, until

FLAG, STATUS = "incoming/flags/mqtt-audio", "outgoing/autonomy-status"
STOP, STATE = "incoming/estop", "outgoing/estop/mcu"
TRUE, FALSE = b'{"value": true}', b'{"value": false}'

#: The service, both ends, and which of them is restored: the one whose programs set the microphone, too.
LINKS: dict[str, tuple[str, Callable[[Path], End], Callable[[Path], End], Side]] = {
    "bridge, the robot's broker": ("bridge", partial(MqttEnd, keeps=True), MqttEnd, LOCAL),
    "bridge, the robot's hub": ("bridge", partial(ZenohEnd, keeps=True), MqttEnd, LOCAL),
    "mirror, its broker": ("mirror", ZenohEnd, partial(MqttEnd, keeps=True), REMOTE),
}
#: Who sets the microphone, in order: an operator, a program on the robot that lives on, and one that is not asked to
#: repeat what it set. Each history ends with the microphone switched off, after the save.
HISTORIES = [
    *("operator:on save operator:off", "program:on save program:off", "once:on save once:off"),
    *("operator:on save program:off", "operator:on save once:off", "program:on save operator:off"),
    *("once:on save operator:off", "program:on operator:off program:on save operator:off"),
    *("save operator:on operator:off", "save program:on operator:off", "save operator:on once:off"),
    *("operator:off operator:on save operator:off", "program:off once:on save program:off"),
]
#: How long the side is away; ``longer``: than an outage in which an operator could choose an earlier value again.
WHEN = ("briefly", "longer", "while the robot is off")


@pytest.mark.parametrize(("link", "when", "history"), some(product(LINKS, WHEN, HISTORIES), 23))
def test_a_microphone_that_was_switched_off_stays_off_when_a_side_is_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Make, link: str, when: str, history: str
) -> None:
    monkeypatch.setattr(side_module, "RESTORED_S", 0.0 if when == "longer" else 30.0)
    allowed: list[bool] = []
    monkeypatch.setattr(Media, "allow", lambda _media, _flag, on: allowed.append(on))
    service, local, remote, restored = LINKS[link]
    rig = make(service, local(tmp_path), remote(tmp_path))
    rig.start()
    operator, end = rig.clients[restored.other], rig.ends[restored]
    setters = {"operator": operator, "program": rig.clients[restored], "once": rig.client(restored)}

    def set_microphone(who: str, value: bytes) -> None:
        others = [client for name, client in setters.items() if name != who]
        setters[who].publish(FLAG, value, retain=True, remember=who == "program")
        assert until(lambda: all(client.payloads(FLAG)[-1:] == [value] for client in others))
        assert until(lambda: rig.service.forwarder.retained.value(f"{rig.base}/{FLAG}") == value)

    for word in history.split():
        who, _, value = word.partition(":")
        set_microphone(who, TRUE if value == "on" else FALSE) if value else end.save()
    assert service == "mirror" or until(lambda: allowed[-1:] == [False])
    before, seen = rig.connections(restored), len(operator.on(FLAG))
    if when == WHEN[2]:
        rig.close()
    allowed.clear()
    end.stop()
    assert when == WHEN[2] or until(lambda: not rig.connections(restored))
    end.restore()
    if when == WHEN[2]:
        rig.start()
    else:
        assert until(lambda: rig.connections(restored) > before and rig.synchronized)
    assert until(lambda: {rig.retained(side).get(FLAG) for side in Side} == {FALSE})
    assert (True in allowed, TRUE in operator.payloads(FLAG)[seen:]) == (False, False)
