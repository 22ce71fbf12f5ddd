"""Deliberate bugs in the page's modules and in the server; schedules must show each of them."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.robot.lockstep import mutations
from tests.web.driving_lockstep.pages import CORE


@dataclass(frozen=True)
class Mutation:
    """``original``, which is there once in a file of the page or in a module of the server, is replaced."""

    file: str
    original: str
    mutated: str
    schedule: int = 0  # of seed 1, one that shows it: to begin there saves time

    @contextmanager
    def applied(self) -> Iterator[Path]:
        """Yields the folder of the page's modules."""
        if self.file.endswith(".js"):
            with tempfile.TemporaryDirectory(prefix="pbl") as folder:
                self._copy(Path(folder))
                yield Path(folder)
        else:
            with mutations.Mutation(self.file, self.original, self.mutated).applied():
                yield CORE

    def _copy(self, folder: Path) -> None:
        for path in CORE.glob("*.js"):
            shutil.copy(path, folder)
        shutil.copy(CORE.parent / "package.json", folder)
        text = (folder / self.file).read_text()
        assert text.count(self.original) == 1, f"{self.file} has changed: adapt this mutation"
        (folder / self.file).write_text(text.replace(self.original, self.mutated))


_DRIVING, _CLOCK, _CONTROL = "pebble.web.driving", "pebble.web.page_clock", "pebble.web.control"

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
        "        if lease is not None and lease.tab.live is not None and lease.tab.live_ref == ref:\n"
        "            self._end_gesture",
        "        if lease is not None and lease.tab.live is not None and lease.tab.live_ref != ref:\n"
        "            self._end_gesture",
    ),
    "nobody needs the lease": Mutation(
        _DRIVING,
        "        lease = self.leases.get(op.ref)\n        if lease is None or lease.tab is not tab:\n",
        "        lease = self.leases.get(op.ref)\n        if lease is None:\n",
    ),
    "a lost connection stops nothing": Mutation(
        _CONTROL,
        "        self._server.publish(self._server.driving.closed(self._tab, clock()))\n",
        "        self._server.driving.closed(self._tab, clock())\n",
    ),
    "zeros are not forwarded": Mutation(
        _DRIVING,
        "        return [Command(op.ref, FINAL_ZERO if op.final or not mine else ZERO)]\n",
        "        return []\n",
    ),
    "commands are valid for long": Mutation(
        _DRIVING, "Drive(x=op.x, z=op.z, y=op.y, valid_ms=VALID_MS)", "Drive(x=op.x, z=op.z, y=op.y, valid_ms=5000)"
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
    # -- the page
    "keys stay down when the window loses the focus": Mutation(
        "driver.js", "  leave() {\n    this.inputs.leave();\n    this.interrupt();\n", "  leave() {\n"
    ),
    "a hidden page goes on": Mutation(
        "driver.js", "document.hidden && this.leave());", "document.hidden && this.changed());"
    ),
    "an interruption leaves the inputs as they are": Mutation(
        "driver.js",
        "  interrupt() {\n    this.inputs.clear();\n    this.gesture.interrupt(performance.now());\n",
        "  interrupt() {\n    this.gesture.interrupt(performance.now());\n    this.gesture.mustRelease = false;\n",
    ),
    "a repeated key is a pressed key": Mutation("inputs.js", "    if (!repeat) {\n", "    if (repeat || !repeat) {\n"),
    "a gamepad needs no neutral": Mutation(
        "inputs.js", "    this.pad = this.padArmed ? ", "    this.pad = this.padArmed || sample ? "
    ),
    "a refused gesture begins again": Mutation(
        "gesture.js",
        "    this.active = false;\n    this.mustRelease = true;\n    this.last = ZERO;\n    return true;\n",
        "    this.active = false;\n    this.last = ZERO;\n    return true;\n",
    ),
    "the end of a gesture is not sent": Mutation(
        "gesture.js", "    this.command(ZERO, now, final);\n    this.repeats = ", "    this.repeats = "
    ),
    "a page that stood still goes on": Mutation(
        "driver.js",
        "    if (now - this.updatedAt > STALL_MS) this.leave(); // the",
        "    this.gesture.updatedAt = now; // the",
    ),
    "a suspended computer goes on": Mutation("driver.js", "    this.checkClock(now);\n", ""),
    "old events count": Mutation("driver.js", "  return performance.now() - at > STALL_MS;\n", "  return false;\n"),
    "releases that macOS hides are lost": Mutation(
        "driver.js", '  return event.key === "Meta" || event.key === "OS";\n', "  return false;\n"
    ),
    "opposite keys are a release": Mutation(
        "gesture.js",
        "    else if (neutral) this.mustRelease = false;\n",
        "    else if (!moving) this.mustRelease = false;\n",
    ),
    "a frozen gamepad drives on": Mutation("inputs.js", "const FROZEN_MS = 3000;", "const FROZEN_MS = 300000;"),
    "a gesture outlives its connection": Mutation(
        "driver.js",
        "    this.inputs.clear();\n    this.gesture.reset();\n    this.changed();\n",
        "    this.changed();\n",
    ),
    "a dialog ends nothing": Mutation(
        "reasons.js", '  if (s.dialog) return reason("dialog", "Close the panel first");\n', ""
    ),
    "a lost release blocks for good": Mutation(
        "inputs.js",
        "    if (!this.keys.size) this.waiting.clear(); // the release of the others may have been lost\n",
        "",
    ),
    "a press right after a reset is lost without a word": Mutation(
        "reasons.js", "const RESET_MS = 600;", "const RESET_MS = 0;"
    ),
    "a lost connection is not made again": Mutation(
        "control-socket.js", "    this.retry = setTimeout(() => this.connect(), delay);\n", ""
    ),
    "two attempts make two connections": Mutation(
        "control-socket.js", "    clearTimeout(this.retry); // two attempts would be two connections\n", ""
    ),
    "a silent connection is not given up": Mutation(
        "control-socket.js", "    setInterval(() => this.check(), CHECK_MS);\n", ""
    ),
}
