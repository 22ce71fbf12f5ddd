"""A launcher in a process of its own: ``run_launcher.py ROOT CONFIG TABLE RECORD [option…]``, with fakes around it.

TABLE is JSON: a list of [name, module, arguments, stage], perhaps with an object of a program's other properties.
Messages are written to RECORD. Options: those of fake_announcer, ``hasty`` (2 s without a sign of life is stuck),
``signal`` (a stop signal comes while the first child is being started), ``tireless`` (nothing is a crash loop),
``forgetful`` (requests of an ended program expire after 1 s),
``deny CALL ERRNO`` (the kernel refuses this system call, as in a container).
"""

import json
import os
import signal
import sys

root, config_path, table_json, record, *options = sys.argv[1:]
sys.path.insert(0, root)

from pebble.config import load  # noqa: E402
from pebble.errors import PebbleError  # noqa: E402
from pebble.extension import Program, Stage  # noqa: E402
from pebble.launcher import launcher, on_demand, restart_policy  # noqa: E402
from pebble.launcher.child import Child  # noqa: E402
from tests.fakes.seccomp import deny  # noqa: E402


class SignalledChild(Child):
    def __init__(self, *arguments: object, **named: object) -> None:
        sys.stderr.write("spawned a child\n")
        os.kill(os.getpid(), signal.SIGTERM)
        super().__init__(*arguments, **named)  # type: ignore[arg-type]


table = [
    Program(name, module, tuple(args), Stage(stage), **(more[0] if more else {}))
    for name, module, args, stage, *more in json.loads(table_json)
]
table.append(Program("announcer", "fake_announcer", (record, *options), Stage.ANNOUNCER, reads_announcer_pipe=True))
if "hasty" in options:
    restart_policy.ALIVE_LIMIT_S = 2.0
if "tireless" in options:
    restart_policy.LOOP_WINDOW_S = 0.0
if "forgetful" in options:
    on_demand.OUTLIVE_S = 1.0
for option in options:
    if option.startswith("deny "):
        deny(*option.split()[1:])
if "signal" in options:
    launcher.Child = SignalledChild  # type: ignore[misc]
try:
    sys.exit(launcher.Launcher(load(config_path), table=table).run())
except PebbleError as error:
    sys.exit(f"refused: {error}")
