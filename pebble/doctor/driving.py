"""Whether a robot that runs on this machine can be driven, as its own status says."""

from pebble.check_result import CheckResult, State
from pebble.client.connection import Target, connected, wait_for
from pebble.client.driveable import Driveable, driveable_of
from pebble.config import Config
from pebble.contract import STATUS
from pebble.doctor import fail, warn
from pebble.errors import PebbleError
from pebble.runtime.parent import launcher_runs
from pebble.transports import Message

_ANSWER_S = 2.0
_STATES = {"yes": State.OK, "unknown": State.WARN, "no": State.FAILED}


def driving(config: Config) -> CheckResult | None:
    """Read it on the robot's own side; None: it has no motors, or does not run."""
    if not config.motor_lines() or not launcher_runs(config.run_dir()):
        return None
    found: list[Driveable | None] = []

    def receive(message: Message) -> None:
        found.append(driveable_of(message.payload))

    try:
        with connected(Target(config=config.path, program="doctor")) as (transport, names):
            transport.subscribe(STATUS.filter(names.base), receive)
            wait_for(lambda: found, _ANSWER_S)
    except PebbleError as error:
        return fail("driving", f"nothing reaches the running robot: {error}")
    if not found or found[-1] is None:
        return warn("driving", "the running robot does not say whether it can be driven")
    state, why = found[-1]
    text = "commands reach the motors" if state == "yes" else f"{'not possible' if state == 'no' else state}: {why}"
    return CheckResult(_STATES[state], "driving", text)
