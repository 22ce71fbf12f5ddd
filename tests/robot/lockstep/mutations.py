"""Deliberate bugs in the manager, the script API, the gate and the motor owner; schedules must show each of them."""

from __future__ import annotations

from tests.kit.mutations import Mutation

_SERVICES = "pebble.services"
_MANAGER, _GATE = f"{_SERVICES}.autonomy_manager", f"{_SERVICES}.autonomy_manager.gate"
_MOTORS = f"{_SERVICES}.serial_mcu_bridge"
_SENDER = "pebble.script.drive_sender"

MUTATIONS = {
    # -- the motor owner
    "waiting commands are told apart by their topic only": Mutation(
        f"{_MOTORS}.motion.motion_inbox",
        "            sender = run_of(drive)\n",
        "            sender = 1\n",
        schedule=42,
    ),
    "a zero that is replaced is lost": Mutation(
        f"{_MOTORS}.motion.motion_inbox",
        "        return [*zeros, newest]\n",
        "        return [newest]\n",
        schedule=382,
    ),
    "the wheels have no deadline": Mutation(
        f"{_MOTORS}.text.motor_bridge", "        self._set_deadline(now + valid_s)\n", ""
    ),
    "a stop leaves the wheels turning": Mutation(
        f"{_MOTORS}.text.motor_bridge",
        "        for stop in batch.stops:\n            self._halt()\n",
        "        for stop in batch.stops:\n",
        schedule=48,
    ),
    "every command is a person's": Mutation(
        f"{_MOTORS}.motion.motion_inbox",
        "    if drive.source != SCRIPT:\n        return PERSON\n",
        "    return PERSON\n",
    ),
    # -- every service
    "retained commands are obeyed": Mutation(
        "pebble.runtime.receive", "if one_shot and message.retain:", "if one_shot and not channel.kind:"
    ),
    # -- the manager
    "final stops are not signed": Mutation(
        f"{_MANAGER}.service", "self.publish(DRIVE, Drive(source=SCRIPT, run=run))", "self.publish(DRIVE, Drive())"
    ),
    "a start does not wait for the end of the earlier script": Mutation(
        f"{_MANAGER}.runner",
        "        if self._run is None and self._next is not None:\n",
        "        if self._next is not None:\n",
    ),
    "a stop does not cancel the start that waits": Mutation(
        f"{_MANAGER}.runner", "        self.error, self._next = error, None\n", "        self.error = error\n"
    ),
    "numbers of runs are used again": Mutation(
        f"{_MANAGER}.service",
        "next_run(self.config, self._owners.barred, self._owners.newest_run)",
        "max(102, self._owners.barred)",
    ),
    "a barred run goes on": Mutation(
        f"{_MANAGER}.motor_owners",
        "            if state.last_barred != barred and not",
        "            if run < 0 and not",
    ),
    "a run outlives a restart of the motor owner": Mutation(
        f"{_MANAGER}.motor_owners", "            if state.boot != boot:\n", "            if run < 0:\n"
    ),
    "a run outlives an emergency stop": Mutation(
        f"{_MANAGER}.motor_owners",
        "            if state.latched or (state.boot == boot and state.count != count):\n",
        "            if run < 0:\n",
    ),
    "a script starts while the robot is stopped": Mutation(
        f"{_MANAGER}.motor_owners",
        " for owner, state in self._states.items() if state.latched), ",
        " for owner, state in () if state.latched), ",
    ),
    "a script that does not end is not killed": Mutation(
        f"{_MANAGER}.runner", "                part.child.signal(signal.SIGKILL)\n", "                pass\n"
    ),
    "nothing stops the wheels when a script has ended": Mutation(
        f"{_MANAGER}.runner", "            self._surroundings.halt_repeatedly(run.number)\n", ""
    ),
    "every command starts a script": Mutation(
        f"{_MANAGER}.service",
        "begin = True if word in _START else False if word in STOP_WORDS else command.enabled",
        "begin = True if word else command.enabled",
    ),
    # -- the script API
    "a zero waits for its turn": Mutation(
        _SENDER,
        "        if not signed.moves and not self._zero_is_last:\n",
        "        if not signed.moves and not self._zero_is_last and now >= self._turn:\n",
    ),
    "a script's rate has no limit": Mutation(_SENDER, "        if now >= self._turn:\n", "        if now >= 0:\n"),
    "what waits survives a zero": Mutation(
        _SENDER,
        "        self._pending = None\n        if not signed.moves and not",
        "        if not signed.moves and not",
        schedule=193,
    ),
    "a script ignores that its run is barred": Mutation(
        _SENDER, "        elif barring and self._barred_at is None:\n", "        elif now < 0:\n"
    ),
    # -- the gate
    "the gate signs without the run": Mutation(
        f"{_GATE}.drive_outlet", '{"source": SCRIPT, "run": run}', '{"source": "page", "run": run}'
    ),
    "the gate lets the script sign": Mutation(
        f"{_GATE}.drive_outlet", "else plain | signature", "else signature | plain"
    ),
    "the gate passes commands after the stop": Mutation(
        f"{_GATE}.gate",
        "            self._halted = True\n        if self._server is not None:\n",
        "            pass\n        if self._server is None:\n",
    ),
}
