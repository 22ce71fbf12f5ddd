"""The end of a schedule: everything works again, and a human who does what the page says drives within 3 s.

If another one has control and is asked for it, within 3 s after the answer.
"""

from __future__ import annotations

from pebble.extensions.fleet.roles import Role
from tests.ext.page.driving_lockstep.human import KEYS
from tests.ext.page.driving_lockstep.rules import Command
from tests.ext.page.driving_lockstep.world import BASE, World

DRIVES_WITHIN_S = 3.0
_ASKED_S = (
    5.0  # so long after what it moved last who has control is asked, and then loses it (firmware/common/lease.py)
)
CONNECTS_WITHIN_S = 14.5  # an attempt may take 8 s, and the next one comes after 5 s
_SLEEP_S = 0.6  # no computer sleeps for a shorter time
_LOOK_S = 0.05
_HEARTBEAT_S = 1.0
_HELD_S = 0.3
_STILL_S = 0.6


def rest(world: World) -> None:
    """Raise ViolatedError unless each human can drive as if nothing had happened."""
    _mend(world)
    slot = world.layout // 7 % len(world.humans)
    _connected(world, slot)
    _let_go_of_all(world, slot)
    _drives(world, slot)
    _stops(world, slot)


def _mend(world: World) -> None:
    """The faults end."""
    if world.network.era is None:
        world.find_broker()
    if world.server.frozen:
        world.thaw()
    world.server.delay = 0.0
    world.silent_until = 0.0
    world.scheduler.run(_SLEEP_S if any(human.asleep for human in world.humans) else 0.01)
    travels_s = 0.0
    for slot, (wire, human) in enumerate(zip(world.wires, world.humans, strict=True)):
        if human.asleep:
            world.wake[slot]()
        wire.release()
        travels_s = max(travels_s, wire.up.wait, wire.down.wait)
        wire.delay(0.003, 0.003)
        if human.blocked_from is not None:
            world.unblock(slot, human.page, ("input", "network", "timers"))
        if world.server.roles.get(slot) is Role.VIEWER or world.ask(slot)["reason"] in ("role",):
            world.server.roles[slot] = Role.MAINTAINER
        if human.meta:
            world.do_meta(slot, 0)
        if human.has_pad:
            human.pad_frozen = False
            world.show_pad(slot, (0.0, 0.0, 0.0))
        world.do_dialog(slot, 1)
        world.pages.do(human.page, "sliders", {"speed": 0.6, "turn": 0.6, "balance": 0})
        human.acted, human.balance = world.now, 0.0
    world.scheduler.run(travels_s)
    for _ in range(30):  # what is frozen, dead or away for some time is back soon
        world.scheduler.run(0.1)
        if world.reaches() and world.other_until is None and not world.rules.stopping():
            break
    world.scheduler.run(_HEARTBEAT_S)  # one that was lost is no silence any more
    world.rules.faults += 1


def _connected(world: World, slot: int) -> None:
    end = world.now + CONNECTS_WITHIN_S
    while world.now < end:
        state = world.ask(slot)
        if state["open"] and state["reason"] != "role":
            return
        if state["ended"]:  # the session has ended: the human logs in again
            world.leave(slot, vanish=False)
            world.load(slot, "")
        world.scheduler.run(0.1)
    world.scheduler.check(False, "a page does not connect again")


def _let_go_of_all(world: World, slot: int) -> None:
    for one in range(len(world.humans)):
        for name in list(world.humans[one].held):
            world.release(one, name)
    world.pages.do(world.humans[slot].page, "select", BASE)
    world.scheduler.run(0.1)


def _drives(world: World, slot: int) -> None:
    """Do what the page says, until the wheels turn."""
    human = world.humans[slot]
    end = world.now + DRIVES_WITHIN_S
    asks_until = world.now + _ASKED_S * (len(world.humans) - 1)  # of two who ask, one waits for the other
    pressed = False
    state = {"reason": "", "action": ""}
    while world.now < end:
        world.scheduler.run(_LOOK_S)
        if pressed and _driven_by(world, human.page) is not None:
            return
        world.show(slot, visible=True)  # the human has to be at the page
        world.focus(slot, focused=True)
        state = world.ask(slot)
        if state["ended"] or state["reason"] == "role":  # the logout was still under way
            _connected(world, slot)
            _let_go_of_all(world, slot)
            end, pressed = world.now + DRIVES_WITHIN_S, False
            continue
        reason = state["reason"]
        if reason == "asked" and world.now < asks_until:
            end = world.now + DRIVES_WITHIN_S
        if reason and pressed and reason != "late":
            world.release(slot, "KeyW")
            pressed = False
        elif not reason and not pressed:
            world.press_key(slot, "KeyW")
            pressed = True
        elif reason == "release":  # a release was lost
            world.press_key(slot, "KeyW")
            world.release(slot, "KeyW")
        if state["action"] in ("take", "take-over", "ask"):
            world.pages.do(human.page, "take", state["action"] != "take")
        elif reason == "stopped":
            world.pages.do(human.page, "reset")
        elif reason == "pad":
            world.show_pad(slot, (0.0, 0.0, 0.0))
    world.scheduler.check(
        False, f"a human who does what the page says cannot drive: {state['reason'] or 'it gives no reason'}"
    )


def _driven_by(world: World, page: int) -> Command | None:
    command = world.rules.turning()
    return command if command is not None and command.page == page else None


def _stops(world: World, slot: int) -> None:
    """The human goes on, lets go, and the wheels stay at rest."""
    world.scheduler.run(_HELD_S)
    world.scheduler.check(
        _driven_by(world, world.humans[slot].page) is not None, "a drive is interrupted though nothing happens"
    )
    for name in KEYS:
        world.release(slot, name)
    world.scheduler.run(0.05)
    for _ in range(round(_STILL_S / 0.1)):
        world.scheduler.check(world.rules.turning() is None, "a wheel turns though everything is released")
        world.scheduler.run(0.1)
