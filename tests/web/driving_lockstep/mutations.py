"""Deliberate bugs in the page's modules and in the server; schedules must show each of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.kit.mutations import Mutation, in_copy, in_process
from tests.web.driving_lockstep.pages import CORE


@contextmanager
def mutated(mutation: Mutation) -> Iterator[Path]:
    """Yields the folder of the page's modules; the bug is in one of them, or in a module of the server."""
    if mutation.file.endswith(".js"):
        with in_copy(mutation, CORE.parent, "package.json", CORE.name) as folder:
            yield folder / CORE.name
    else:
        with in_process(mutation):
            yield CORE


_DRIVING, _CLOCK, _DRIVERS, _CONTROLS = (
    f"pebble.web.{name}" for name in ("drive.driving", "page_clock", "drive.drivers", "drive.controls")
)
_DRIVER, _INPUTS, _GESTURE, _REASONS, _SOCKET = (
    f"core/{name}.js" for name in ("driver", "inputs", "gesture", "reasons", "control-socket")
)

MUTATIONS = {
    # -- the server
    "no command is too old": Mutation(
        _DRIVING, '        return "Commands are late" if tab.clock.late(op.t, now) else ""\n', '        return ""\n'
    ),
    "a delay that is always there is learned": Mutation(
        _CLOCK,
        "        age = now - t_ms / 1000 + self._highest()\n",
        "        age = now - t_ms / 1000 + max(low for low, _, _ in self._bounds)\n",
    ),
    "the number of a gesture is not checked": Mutation(
        _DRIVING, "        if op.g <= tab.over:\n", "        if op.g <= -2:\n"
    ),
    "a silent gesture goes on": Mutation(
        _DRIVING,
        "                if now - lease.received_at > SILENCE_S:\n",
        "                if now - lease.received_at > 1e9:\n",
    ),
    "a server that stood still goes on": Mutation(
        _DRIVING,
        "        if tab.live is not None and now - lease.received_at > SILENCE_S:\n",
        "        if tab.live is not None and now - lease.received_at > 1e9:\n",
    ),
    "repeated zeros interrupt the next gesture": Mutation(
        _DRIVING, "        self._repeats.pop(op.ref, None)  # they would interrupt it\n", ""
    ),
    "a lease is taken without a zero": Mutation(
        _DRIVING,
        "        commands = [] if lease is None else self._end_lease(ref, now)\n",
        "        commands: list[Command] = []\n",
    ),
    "a stop does not end the gesture": Mutation(
        _DRIVING,
        "        self.interrupt(ref, now)\n        return self._final_zero(ref, now)\n",
        "        return self._final_zero(ref, now)\n",
    ),
    "nobody needs the lease": Mutation(
        _DRIVING,
        "        lease = self.leases.get(op.ref)\n        if lease is None or lease.tab is not tab:\n",
        "        lease = self.leases.get(op.ref)\n        if lease is None:\n",
    ),
    "a lost connection stops nothing": Mutation(
        _DRIVERS, "            self._publish(end(tab, now))\n", "            end(tab, now)\n"
    ),
    "zeros are not forwarded": Mutation(
        _DRIVING,
        "            return [Command(op.ref, FINAL_ZERO)]\n        return [Command(op.ref, lease.signed(ZERO))]",
        "            return []\n        return []",
    ),
    "commands are valid for long": Mutation(
        _DRIVING,
        "y=op.y, valid_ms=WIDE.valid_ms)",
        "y=op.y, valid_ms=5000)",
    ),
    "another server's driver is ignored": Mutation(
        _DRIVING,
        "            if lease is not None:\n                commands += self._end_lease(ref, now)\n",
        "",
    ),
    "a refused gesture ends later ones, too": Mutation(
        _DRIVING,
        "        tab.over = max(tab.over, gesture)\n        ref = tab.live_ref\n",
        "        tab.over = max(tab.over, gesture + 1000)\n        ref = tab.live_ref\n",
    ),
    "control that the robot has given to another is not noticed": Mutation(
        _CONTROLS, "        if has and lease is not None and client.decided != lease.decided:\n", "        if False:\n"
    ),
    # -- the page
    "keys stay down when the window loses the focus": Mutation(
        _DRIVER, "  leave() {\n    this.inputs.leave();\n    this.interrupt();\n", "  leave() {\n"
    ),
    "a hidden page goes on": Mutation(
        _DRIVER, "document.hidden && this.leave());", "document.hidden && this.changed());"
    ),
    "an interruption leaves the inputs as they are": Mutation(
        _DRIVER,
        "  interrupt() {\n    this.inputs.clear();\n    this.gesture.interrupt(performance.now());\n",
        "  interrupt() {\n    this.gesture.interrupt(performance.now());\n    this.gesture.mustRelease = false;\n",
    ),
    "a repeated key is a pressed key": Mutation(_INPUTS, "    if (!repeat) {\n", "    if (repeat || !repeat) {\n"),
    "a gamepad needs no neutral": Mutation(
        _INPUTS, "    this.pad = this.padArmed ? ", "    this.pad = this.padArmed || sample ? "
    ),
    "a refused gesture begins again": Mutation(
        _GESTURE,
        "    this.active = false;\n    this.mustRelease = true;\n    this.last = ZERO;\n    return true;\n",
        "    this.active = false;\n    this.last = ZERO;\n    return true;\n",
    ),
    "the end of a gesture is not sent": Mutation(
        _GESTURE, "    this.command(ZERO, now, final);\n    this.repeats = ", "    this.repeats = "
    ),
    "a page that stood still goes on": Mutation(
        _DRIVER,
        "    if (now - this.updatedAt > STALL_MS) this.leave(); // the",
        "    this.gesture.updatedAt = now; // the",
    ),
    "a suspended computer goes on": Mutation(_DRIVER, "    this.checkClock(now);\n", ""),
    "old events count": Mutation(_DRIVER, "  return performance.now() - at > STALL_MS;\n", "  return false;\n"),
    "releases that macOS hides are lost": Mutation(
        _DRIVER, '  return event.key === "Meta" || event.key === "OS";\n', "  return false;\n"
    ),
    "opposite keys are a release": Mutation(
        _GESTURE,
        "    else if (neutral) this.mustRelease = false;\n",
        "    else if (!moving) this.mustRelease = false;\n",
    ),
    "a frozen gamepad drives on": Mutation(_INPUTS, "const FROZEN_MS = 3000;", "const FROZEN_MS = 300000;"),
    "a dialog ends nothing": Mutation(
        _REASONS, '  if (s.dialog) return reason("dialog", "Close the panel first");\n', ""
    ),
    "a lost release blocks for good": Mutation(
        _INPUTS,
        "    if (!this.keys.size) this.waiting.clear(); // the release of the others may have been lost\n",
        "",
    ),
    "a lost connection is not made again": Mutation(
        _SOCKET, "    this.retry = setTimeout(() => this.connect(), delay);\n", ""
    ),
    "two attempts make two connections": Mutation(
        _SOCKET, "    clearTimeout(this.retry); // two attempts would be two connections\n", ""
    ),
    "a silent connection is not given up": Mutation(_SOCKET, "    setInterval(() => this.check(), CHECK_MS);\n", ""),
}
