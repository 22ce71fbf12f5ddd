"""Humans at pages, the network, the server, the broker and a robot in virtual time.

Of a step's numbers ``a`` chooses the page, mostly. Every step is possible at any time, and does nothing where it has
no meaning, so steps can be left out of a schedule.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import msgspec

from pebble.contract import CAPABILITIES, CONTROL, CONTROL_STATE, CONTROL_TAKE, ONLINE, codec
from pebble.contract.payloads import ControlRequest
from pebble.extensions.fleet.roles import Role
from pebble.extensions.page import messages as m
from pebble.transports import Message, QoS, State
from tests.ext.page.driving_lockstep.human import KEYS, SOON_S, Human, sliders
from tests.ext.page.driving_lockstep.link import Link, Wire
from tests.ext.page.driving_lockstep.pages import CORE, EPOCH, Output, Pages, PagesScheduler
from tests.ext.page.driving_lockstep.rules import RecordedWheels, Rules
from tests.ext.page.driving_lockstep.web_server import BOOT_S, TIME, WebServer, virtual
from tests.kit.schedules import Step
from tests.robot.lockstep.network import Network
from tests.robot.lockstep.owner import Disk, Owner
from tests.robot.lockstep.processes import Process
from tests.robot.lockstep.world import Folder

BASE, OTHER_BASE = "pebble/robots/goob", "pebble/robots/fred"
WAITS_S = (0.0, 0.004, 0.01, 0.03, 0.05, 0.08, 0.12, 0.16, 0.2, 0.26, 0.3, 0.35, 0.45, 0.6, 0.9, 1.6)
_BLOCKS_S = (0.03, 0.1, 0.2, 0.24, 0.3, 0.4, 0.8, 1.6, 2.5)
_DELAYS_S = (0.001, 0.003, 0.02, 0.05, 0.1, 0.16, 0.25, 0.31, 0.4, 0.7, 1.2)
_FAST_S = (0.003, 0.003)
_FIRST_DELAYS_S = (_FAST_S, (0.4, 0.01), _FAST_S, (0.02, 0.02), _FAST_S, _FAST_S, (0.16, 0.16))
_STALLS_S = (0.05, 0.15, 0.28, 0.4, 0.7, 1.2, 1.8, 3.0)
_OUTAGES_S = (0.05, 0.3, 0.7, 1.5, 2.5)
_ORDERS = (
    ("input", "network", "timers"),
    ("timers", "input", "network"),
    ("network", "timers", "input"),
    ("input", "timers", "network"),
    ("timers", "network", "input"),
    ("network", "input", "timers"),
)
_NAMES = tuple(KEYS)
_STICK = ((0.0, 0.9), (0.7, 0.3), (-0.8, 0.0), (0.05, 0.02), (0.3, -0.9))
_HEARTBEAT_S = 1.0
_CONTROL_STATE = CONTROL_STATE.topic(BASE, owner="serial")

_GONE = {"reason": "gone", "action": "", "open": False, "ended": False, "dragged": False, "token": ""}

_decoder = msgspec.json.Decoder(m.FromPage)


class Rig:
    """What worlds share, one after the other: the process of node, and the virtual clocks. A context manager."""

    def __init__(self, folder: Path = CORE) -> None:
        self.folder = folder

    def __enter__(self) -> Self:
        self._stack = ExitStack()
        self._stack.enter_context(virtual())
        self.pages = Pages(self.folder)
        self._stack.callback(self.pages.close)
        self.robot = Folder()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


class World:
    """``layout`` chooses how many humans there are, their computers, and the phases of timers."""

    def __init__(self, layout: int, rig: Rig) -> None:
        self.rig = rig
        self.layout, self.pages = layout, rig.pages
        self.keeps = layout // 42 % 2 == 1  # the robot keeps control itself
        self.scheduler = scheduler = PagesScheduler(100.0 + (layout % 7) * 0.0071, rig.pages)
        scheduler.on_output = self._output
        TIME.clock = scheduler.clock
        self.rules = Rules(scheduler, BASE)
        self.network = Network(scheduler, lambda *_: None, self._published)
        wheels = RecordedWheels(scheduler)
        wheels.moved = self.rules.moved
        self.rules.wheels = wheels
        self.disk: Disk = {}
        self.owner = self.rules.owner = Owner(self.network, rig.robot.configs[0], self.disk, wheels)
        self.robot = Process("robot", scheduler)
        self.silent_until = 0.0
        self.server = WebServer(self.network, self.rules.rewrite, self._handling)
        self.rules.stopping = lambda: any(not one.finished for one, _ in self.server.server.stops._senders.values())
        self.server.base, self.server.lease_moved = BASE, self.rules.lease_moved
        self.rules.driven = lambda: self.server.driven(BASE)
        self.rules.reachable = self.reaches
        self.rules.owner_up = self._owner_up
        self.rules.path_s = lambda: 0.003 + self.server.delay + self.owner.delay
        self.humans: list[Human] = []
        self.wake: dict[int, Callable[[], None]] = {}  # computers that sleep
        self.wires: list[Wire] = []
        self.links: dict[tuple[int, int], Link] = {}
        self.states: dict[int, dict[str, Any]] = {}
        self._loads = 0
        self._lease: Any = None
        self._take = False  # the other server does so with its next request
        self.other_until: float | None = None  # another server has control, or asks for it
        self.owner.start()
        self.server.start()
        self._announce()
        self._heartbeat()
        scheduler.run(0.3)
        for slot in range(1 + layout % 3):
            self.wires.append(Wire(scheduler))
            self.wires[-1].delay(*_FIRST_DELAYS_S[layout // 12 % len(_FIRST_DELAYS_S)])
            self.humans.append(Human(-1, mac=layout % 4 == 1))
            self.load(slot, "")
        scheduler.run(0.1 + 4 * (self.wires[0].up.delay + self.wires[0].down.delay))

    def perform(self, steps: list[Step]) -> None:
        for action, a, b in steps:
            getattr(self, "do_" + action)(a, b)
            self.scheduler.flush()

    def end(self) -> None:
        self.server.leave()
        self.server.end()

    @property
    def now(self) -> float:
        return self.scheduler.now

    # -- pages

    def load(self, slot: int, token: str) -> None:
        """A new page before this human."""
        human = self.humans[slot]
        human.page = self._loads * 8 + slot
        self._loads += 1
        human.interrupt(self.now, "the page is another one")
        human.gesture = None
        human.visible = human.focused = True
        human.blocked_from = None
        human.asleep = False
        drift = (0.0, 0.0003, -0.0003, 0.0)[(self.layout // 3 + slot) % 4]
        options = {"token": token, "drift": drift, "seed": 1 + slot + self.layout, "mac": human.mac}
        self.pages.do(human.page, "load", options, BASE)
        for name in human.held:
            self.pages.do(human.page, "held", name) if name in KEYS else None

    def slot(self, page: int) -> int | None:
        """Before which human this page is; None: before none."""
        slot = page % 8
        return slot if self.humans[slot].page == page else None

    def ask(self, slot: int) -> dict[str, Any]:
        """What the page shows."""
        page = self.humans[slot].page
        self.states.pop(page, None)
        self.pages.do(page, "ask")
        self.scheduler.flush()
        return self.states.get(page, _GONE)

    def _output(self, output: Output) -> None:
        slot = self.slot(output.page)
        if output.what == "state":
            self.states[output.page] = output.value
        elif slot is None:
            return
        elif output.what == "connect":
            others = [one for one in self.links.values() if one.page == output.page and not (one.broken or one.closed)]
            self.scheduler.check(not others, "a page has two connections")
            deliver = lambda text: self._delivered(output.page, output.value, text)
            link = Link(output.page, output.value, self.wires[slot], self.server, self.pages, deliver)
            link.first = len(self.rules.sent)
            self.links[output.page, output.value] = link
        elif output.what == "close":
            self.links[output.page, output.value].close()
            self._void(slot, "the page has closed the connection")
        else:
            self._sent(slot, output)

    def _sent(self, slot: int, output: Output) -> None:
        op = _decoder.decode(output.text)
        if isinstance(op, m.DriveOp):
            self.rules.page_sends(output.page, op.t)
            if op.ref == BASE:
                why = self.humans[slot].check(output.value, op, self.now)
                self.scheduler.check(not why, why)
        self.links[output.page, output.value].send(output.text)

    def _delivered(self, page: int, socket: int, text: str) -> None:
        slot = self.slot(page)
        if slot is None or '"refused"' not in text[:20]:
            return
        human, message = self.humans[slot], json.loads(text)
        if message["cmd"] == "drive" and message["ref"] == BASE and human.gesture == (socket, message["g"]):
            # what is pressed while the page stands still begins another gesture
            before = float("inf") if human.blocked_from is None else human.blocked_from
            human.interrupt(self.now, f"the server has refused it: {message['why']}", before)
            human.gesture = None

    def _published(self, sender: Process, message: Message) -> None:
        if sender is self.owner and message.topic == _CONTROL_STATE:
            self.rules.control_given(msgspec.json.decode(message.payload)["id"])

    def _void(self, slot: int, why: str) -> None:
        self.humans[slot].interrupt(self.now, why)

    def reaches(self) -> bool:
        """Whether commands get from the server to the wheels."""
        server = self.server
        return self._owner_up() and server.alive and not server.frozen and bool(server.server.broker.connected)

    def _owner_up(self) -> bool:
        if self.network.era is None:
            return False
        return self.owner.connection is not None and self.owner.connection.state is State.CONNECTED

    def _handling(self, control: Any, op: Any, before: bool) -> None:
        if not self.server.alive:
            return
        self.rules.handling(control, op, before)
        if not before:
            tab = self.server.driven(BASE).tab
            if self._lease is not None and self._lease is not tab:
                self.rules.lease_moved(self._lease)
            self._lease = tab

    # -- time

    def do_wait(self, a: int, b: int) -> None:
        self.scheduler.run(WAITS_S[b % len(WAITS_S)])

    # -- inputs

    def do_press(self, a: int, b: int) -> None:
        slot, _human = self._human(a)
        self.press_key(slot, _NAMES[b % len(_NAMES)])

    def press_key(self, slot: int, code: str) -> None:
        human = self.humans[slot]
        if code in human.held:
            return
        if human.focused and human.visible:
            human.press(code, KEYS[code], self.now)
        else:
            human.press(code, KEYS[code], self.now)
            human.held[code].end(float("-inf"), "it was pressed elsewhere")
        self.pages.do(human.page, "key", code, True)

    def do_release(self, a: int, b: int) -> None:
        """One input, or all."""
        slot, human = self._human(a)
        names = list(human.held)
        for name in names if b % 4 == 0 else names[b % max(1, len(names)) :][:1]:
            self.release(slot, name)

    def release(self, slot: int, name: str) -> None:
        human = self.humans[slot]
        if name in KEYS:
            human.let_go(name, self.now)
            self.pages.do(human.page, "key", name, False)
        elif name.startswith("stick"):
            human.let_go(name, self.now)
            self.pages.do(human.page, "stickEnd", int(name[5:]))
        elif name == "hold":
            human.let_go(name, self.now)
            self.pages.do(human.page, "hold", "up", 0)
        else:
            self.show_pad(slot, (0.0, 0.0, 0.0))
        if not human.held and not human.pad_frozen and not (human.mac and human.meta):
            late = max((press.until - self.now for press in human.ended), default=0.0)  # of a gamepad
            self._at_rest(slot, "everything is released", late=max(0.0, late))

    def do_tap(self, a: int, b: int) -> None:
        slot, _human = self._human(a)
        name = _NAMES[b % len(_NAMES)]
        self.press_key(slot, name)
        self.scheduler.run((0.0, 0.01, 0.04, 0.1)[b // 8 % 4])
        self.release(slot, name)

    def do_stick(self, a: int, b: int) -> None:
        """A finger on the stick: it begins, or moves."""
        slot, human = self._human(a)
        if not human.visible:
            return
        finger = b // 8 % 2
        name, (x, z) = f"stick{finger}", _STICK[b % len(_STICK)]
        axes = (x, z, 0.0)
        if name in human.held:
            human.change(name, axes, self.now)
            self.pages.do(human.page, "stickMove", finger, x, z)
        elif f"stick{1 - finger}" in human.held:
            if self.ask(slot)["dragged"]:
                self._void(slot, "a second finger has touched the stick")
            human.press(name, axes, self.now)  # it is the first one for a page that has refused the other
            self.pages.do(human.page, "stickStart", finger, x, z)
        else:
            human.press(name, axes, self.now)
            self.pages.do(human.page, "stickStart", finger, x, z)

    def do_cancel(self, a: int, b: int) -> None:
        """The browser takes the pointer away; the finger stays where it is."""
        slot, human = self._human(a)
        for finger in range(2):
            if f"stick{finger}" in human.held and self.ask(slot)["dragged"]:
                self._void(slot, "the browser has taken the pointer")
                self.pages.do(human.page, "stickCancel", finger)

    def do_hold(self, a: int, b: int) -> None:
        _slot, human = self._human(a)
        if human.visible and "hold" not in human.held:
            human.press("hold", (0.0, 0.0, 1.0), self.now)
            self.pages.do(human.page, "hold", "up", 1)

    def do_slide(self, a: int, b: int) -> None:
        _slot, human = self._human(a)
        human.acted = self.now
        positions = sliders(b)
        human.balance = positions["balance"] or (human.balance and 0.001)  # what was sent with it is on the way
        self.pages.do(human.page, "sliders", positions)

    def do_pad(self, a: int, b: int) -> None:
        """Move the stick of the gamepad, let it go, lose its radio, or take it away."""
        slot, human = self._human(a)
        if b % 8 == 7:
            if not human.pad_frozen:
                self.show_pad(slot, None)
        elif b % 8 == 6:
            human.pad_frozen = "pad" in human.held
        elif b % 8 == 5:
            self.show_pad(slot, (0.0, 0.0, 0.0))
        else:
            self.show_pad(
                slot, ((0.0, 0.8, 0.0), (0.9, 0.2, 0.0), (-0.5, 0.0, 0.0), (0.0, 0.0, 0.8), (0.0, -1.0, 0.0))[b % 5]
            )

    def do_lose_pad(self, a: int, b: int) -> None:
        """The radio of a gamepad is lost while its stick is moved, and the human lets go."""
        slot, human = self._human(a)
        if "pad" in human.held or human.pad_frozen:
            return
        self.show_pad(slot, (0.0, 0.0, 0.0))
        self.scheduler.run(0.06)
        self.show_pad(slot, (0.0, 0.8, 0.0))
        self.scheduler.run(0.1)
        human.pad_frozen = True
        human.let_go("pad", self.now)
        self.scheduler.run((0.3, 3.2)[b % 2])

    def show_pad(self, slot: int, axes: tuple[float, float, float] | None) -> None:
        human = self.humans[slot]
        x, z, y = axes or (0.0, 0.0, 0.0)
        appears = not human.has_pad and human.blocked_from is None and self.now - human.without_pad > SOON_S
        if human.has_pad and axes is None:
            human.without_pad = self.now
        human.has_pad = axes is not None
        if axes and (x or z or y):
            if "pad" in human.held:
                human.change("pad", axes, self.now)
            else:
                human.press("pad", axes, self.now)
                if appears:
                    human.held["pad"].end(float("-inf"), "it was not in neutral when it appeared")
        else:
            human.let_go("pad", self.now)
        if human.pad_frozen and axes is not None and "pad" in human.held:
            return
        if human.pad_frozen and axes is not None:
            human.pad_frozen = False  # it is let go, and comes back after a while
            page = human.page
            self.scheduler.after(3.5, lambda: self.pages.do(page, "pad", _pad_of((0.0, 0.0, 0.0), self.now)))
            return
        self.pages.do(human.page, "pad", None if axes is None else _pad_of(axes, self.now))

    def do_space(self, a: int, b: int) -> None:
        slot, human = self._human(a)
        if human.visible and human.focused:
            self._void(slot, "the human has pressed the space bar")
            self.pages.do(human.page, "shortcut", "Space", {})

    def do_meta(self, a: int, b: int) -> None:
        """A key after which macOS swallows the release of others."""
        slot, human = self._human(a)
        human.meta = not human.meta
        if human.focused and human.visible:
            self._void(slot, "a key of the system is pressed")
        self.pages.do(human.page, "meta", human.meta)

    # -- the window

    def do_blur(self, a: int, b: int) -> None:
        slot, human = self._human(a)
        self.focus(slot, focused=not human.focused)

    def focus(self, slot: int, *, focused: bool) -> None:
        human = self.humans[slot]
        if focused and not human.visible:
            return
        if human.focused and not focused:
            self._void(slot, "the window lost the focus")
            self._at_rest(slot, "the window lost the focus")
        human.focused = focused
        self.pages.do(human.page, "focus", focused)

    def do_hide(self, a: int, b: int) -> None:
        slot, human = self._human(a)
        self.show(slot, visible=not human.visible, blur=b % 2 == 0)

    def show(self, slot: int, *, visible: bool, blur: bool = True) -> None:
        human = self.humans[slot]
        if visible == human.visible:
            return
        human.visible = visible
        if not visible:
            self._void(slot, "the page is hidden")
            self._at_rest(slot, "the page is hidden")
            if blur:
                human.focused = False
                self.pages.do(human.page, "focus", False)
        self.pages.do(human.page, "hidden", not visible)
        if visible:
            human.focused = True
            self.pages.do(human.page, "focus", True)

    def do_event(self, a: int, b: int) -> None:
        """What ends a gesture."""
        slot, human = self._human(a)
        where, name = (
            ("document", "contextmenu"),
            ("screen", "change"),
            ("window", "pagehide"),
            ("document", "freeze"),
        )[b % 4]
        self._void(slot, f"{name} has happened")
        self._at_rest(slot, f"{name} has happened")
        self.pages.do(human.page, "event", where, name)

    def do_dialog(self, a: int, b: int) -> None:
        slot, human = self._human(a)
        human.dialog += 1
        opened, dialog = b % 2 == 0, human.dialog
        self.pages.do(human.page, "dialog", opened)
        if opened:  # which the page notices within 50 ms
            self.scheduler.after(SOON_S, lambda: dialog == human.dialog and self._void(slot, "a dialog is open"))

    def do_block(self, a: int, b: int) -> None:
        """Its main thread is busy, or it is frozen."""
        slot, human = self._human(a)
        if human.blocked_from is None:
            self._block(slot)
            page, order = human.page, _ORDERS[b % len(_ORDERS)]
            self.scheduler.after(_BLOCKS_S[b % len(_BLOCKS_S)], lambda: self.unblock(slot, page, order))

    def _block(self, slot: int) -> None:
        human = self.humans[slot]
        human.block(self.now)
        self.pages.do(human.page, "block")
        self.rules.page_stands_still(human.page, self.wires[slot].up.wait)

    def unblock(self, slot: int, page: int, order: tuple[str, ...]) -> None:
        human = self.humans[slot]
        if human.page == page:
            human.unblock(self.now)
            self.pages.do(page, "unblock", order)

    def do_suspend(self, a: int, b: int) -> None:
        """The computer of the page sleeps; on some, the page's clock does, too."""
        slot, human = self._human(a)
        if human.blocked_from is not None:
            return
        self._block(slot)
        human.asleep = True
        wire, page, began, stands = self.wires[slot], human.page, self.now, b // 4 % 2 == 0
        sleeps_s = (0.6, 1.1, 2.0, 5.0)[b % 4]
        self.pages.do(page, "asleep")
        wire.stall(self.now + sleeps_s)

        def wake() -> None:
            if human.page == page and human.asleep:
                human.asleep = False
                self.pages.do(page, "awake", self.now - began if stands else 0.0)
                wire.release()
                self.unblock(slot, page, _ORDERS[b // 8 % len(_ORDERS)])

        self.wake[slot] = wake
        self.scheduler.after(sleeps_s, wake)

    def do_clock(self, a: int, b: int) -> None:
        """The wall clock of the computer is set."""
        _slot, human = self._human(a)
        if not human.asleep:
            self.pages.do(human.page, "wall", (5000, -5000, 400, -400)[b % 4])

    def do_reload(self, a: int, b: int) -> None:
        """The page is loaded again: by the same tab, by a copy of it, or by another one; the old one may hang on."""
        slot, _human = self._human(a)
        token = "" if b % 4 == 3 else self.ask(slot)["token"]
        self.leave(slot, vanish=b % 4 == 2)
        self.load(slot, token)

    def leave(self, slot: int, *, vanish: bool) -> None:
        page = self.humans[slot].page
        self.pages.do(page, "gone")
        self.rules.page_stands_still(page, self.wires[slot].up.wait)
        for link in [link for link in self.links.values() if link.page == page]:
            link.vanish() if vanish else link.close()

    # -- lease and stops

    def do_take(self, a: int, b: int) -> None:
        slot, human = self._human(a)
        if human.visible:
            self._void(slot, "the human takes control")
            self.pages.do(human.page, "take", b % 2 == 1)

    def do_give(self, a: int, b: int) -> None:
        slot, human = self._human(a)
        self._void(slot, "the human releases the robot")
        self.pages.do(human.page, "release")

    def do_select(self, a: int, b: int) -> None:
        slot, human = self._human(a)
        ref = OTHER_BASE if b % 3 == 0 else BASE
        if self.ask(slot).get("ref") != ref:
            self._void(slot, "another robot is selected")
        self.pages.do(human.page, "select", ref)

    def do_estop(self, a: int, b: int) -> None:
        slot, human = self._human(a)
        self._void(slot, "an emergency stop")
        self.pages.do(human.page, "estop")

    def do_reset(self, a: int, b: int) -> None:
        _slot, human = self._human(a)
        self.pages.do(human.page, "reset")

    def do_other(self, a: int, b: int) -> None:
        """Another server takes control over, or asks for it."""
        if self.keeps:
            self.other_until = self.now + (0.1, 0.9, 2.5)[a % 3]
            self._take = b % 3 == 0
            self._request_as_other()

    def do_role(self, a: int, b: int) -> None:
        """The human may no longer drive, or may again."""
        slot, _human = self._human(a)
        self.server.roles[slot] = Role.VIEWER if b % 2 == 0 else Role.MAINTAINER

    # -- faults

    def do_delay(self, a: int, b: int) -> None:
        slot = a % len(self.humans)
        up, down = _DELAYS_S[b % len(_DELAYS_S)], _DELAYS_S[b // 3 % len(_DELAYS_S)]
        self.wires[slot].delay(up, down)

    def do_stall(self, a: int, b: int) -> None:
        slot = a % len(self.humans)
        wire = self.wires[slot]
        wait, stalls_s = wire.up.wait, _STALLS_S[b // 3 % len(_STALLS_S)]
        wire.stall(self.now + stalls_s, up=b % 3 != 1, down=b % 3 != 2)
        if wire.up.stalled:
            self.rules.page_stands_still(self.humans[slot].page, wait)
        self.scheduler.after(stalls_s, wire.release)

    def do_break(self, a: int, b: int) -> None:
        """The connection breaks; both ends notice, or neither."""
        slot = a % len(self.humans)
        page, wire = self.humans[slot].page, self.wires[slot]
        wire.changed += 1
        self.rules.page_stands_still(page, wire.up.wait)
        for link in [link for link in self.links.values() if link.page == page]:
            link.vanish() if b % 2 else link.reset(server_knows=b % 4 == 0)
        if b % 2:
            stalls_s = _STALLS_S[b // 2 % len(_STALLS_S)]
            wire.stall(self.now + stalls_s)
            self.scheduler.after(stalls_s, wire.release)

    def do_freeze(self, a: int, b: int) -> None:
        """SIGSTOP of the server."""
        if self.server.alive and not self.server.frozen:
            self.rules.server_stands_still()
            self.server.freeze()
            self.scheduler.after((0.1, 0.2, 0.28, 0.5, 1.0, 2.5)[b % 6], self.thaw)

    def thaw(self) -> None:
        self.rules.faults += 1
        self.server.thaw()

    def do_kill(self, a: int, b: int) -> None:
        """SIGKILL of the server; it is started again later."""
        if not self.server.alive:
            return
        self.rules.server_stands_still()
        self.server.kill((0.0, 0.3, 1.5)[b % 3] + BOOT_S)
        self._lease = None
        for link in self.links.values():
            link.reset(server_knows=False)

    def do_outage(self, a: int, b: int) -> None:
        """The broker restarts."""
        if self.network.era is None:
            return
        self.rules.broker_is_lost()
        self.network.stop(forget=a % 4 == 3)
        self.scheduler.after(_OUTAGES_S[b % len(_OUTAGES_S)], self.find_broker)

    def find_broker(self) -> None:
        self.rules.faults += 1
        if self.network.era is None:
            self.network.start()
            self._announce()

    def do_lose(self, a: int, b: int) -> None:
        """The server's connection to the broker is lost."""
        if self.server.alive and self.server.connection is not None:
            self.rules.broker_is_lost()
            self.server.connection.lose(_OUTAGES_S[b % len(_OUTAGES_S)])

    def do_owner(self, a: int, b: int) -> None:
        """The motor owner is killed, and started again."""
        self.rules.faults += 1
        self.owner.kill((0.02, 0.5)[b % 2])

    def do_silent(self, a: int, b: int) -> None:
        """The robot sends no heartbeats for a while."""
        self.silent_until = self.now + (1.5, 2.5, 4.0)[b % 3]

    def do_slow(self, a: int, b: int) -> None:
        self.rules.faults += 1
        self.server.delay = (0.0, 0.003, 0.02)[b % 3]

    # -- parts

    def _human(self, a: int) -> tuple[int, Human]:
        slot = a % len(self.humans)
        return slot, self.humans[slot]

    def _at_rest(self, slot: int, why: str, late: float = 0.0) -> None:
        """Motion ends at this page now, if it can say so."""
        human, wire = self.humans[slot], self.wires[slot]
        links = [link for link in self.links.values() if link.page == human.page and link.open]
        if human.gesture is None:
            return
        if human.blocked_from is None and not wire.up.stalled and links and self.reaches():
            link = links[-1]
            changed = lambda: (wire.changed, human.blocked_from, human.page, link.open, human.sent)
            self.rules.let_go(human.page, link.first, wire.up.wait + late, why, changed)

    def _announce(self) -> None:
        for base in (BASE, OTHER_BASE):
            drive = {"available": True, "controls": True, "arbitrates": True}
            drive |= {"control": True} if self.keeps and base == BASE else {}
            value = {"drive": drive, "estop": {"available": True, "owners": ["serial"] if base == BASE else []}}
            self._publish(CAPABILITIES.topic(base), {"t": 1, "value": value}, retain=True)

    def _heartbeat(self) -> None:
        if self.now >= self.silent_until:
            for base in (BASE, OTHER_BASE):
                self._publish(ONLINE.topic(base), {"t": int(1000 * (EPOCH + self.now))})
        self.scheduler.after(_HEARTBEAT_S, self._heartbeat)

    def _request_as_other(self) -> None:
        if self.other_until is None:
            return
        ends = self.now >= self.other_until
        request = ControlRequest(id="0e0e0e0e", by="eve", want="release" if ends else "hold")
        channel, self._take = CONTROL_TAKE if self._take else CONTROL, False
        self._send(Message(channel.topic(BASE), codec.encode(channel, request), QoS.DELIVERED))
        if ends:
            self.other_until = None
        else:
            self.scheduler.after(min(1.0, self.other_until - self.now), self._request_as_other)

    def _publish(self, topic: str, value: Any, *, retain: bool = False) -> None:
        self._send(Message(topic, msgspec.json.encode(value), QoS.DELIVERED, retain))

    def _send(self, message: Message) -> None:
        if self.network.era is not None:
            publisher: Callable[..., Any] = SimpleNamespace(process=self.robot)  # type: ignore[assignment]
            self.network.distribute(message, publisher)


def _pad_of(axes: tuple[float, float, float], now: float) -> dict[str, Any]:
    x, z, y = axes
    return {"axes": [y or x, -z], "buttons": [{"pressed": False}, {"pressed": y != 0}], "timestamp": 1000 * now}
