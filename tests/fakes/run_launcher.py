"""A launcher in a process of its own: ``run_launcher.py ROOT CONFIG TABLE RECORD [option…]``, with fakes around it.

TABLE is JSON: a list of [name, module, arguments, stage]; what is published goes to RECORD. Options: those of
fake_announcer, ``hasty`` (0.5 s without a sign of life is stuck), ``signal`` (a stop signal comes while the first child
is being started), ``tireless`` (nothing is a crash loop), ``missing`` (one more program, which does not exist).
"""

import json
import os
import signal
import sys

root, config_path, table_json, record, *options = sys.argv[1:]
sys.path.insert(0, root)

from pebble.config import load  # noqa: E402
from pebble.errors import PebbleError  # noqa: E402
from pebble.launcher import launcher, supervisor  # noqa: E402
from pebble.launcher.child import Child  # noqa: E402
from pebble.launcher.program import Program, Stage  # noqa: E402


class SignalledChild(Child):
    def __init__(self, *arguments: object, **named: object) -> None:
        sys.stderr.write("spawned a child\n")
        os.kill(os.getpid(), signal.SIGTERM)
        super().__init__(*arguments, **named)  # type: ignore[arg-type]


table = [Program(name, module, tuple(args), Stage(stage)) for name, module, args, stage in json.loads(table_json)]
table.append(Program("announcer", "fake_announcer", (record, *options), Stage.NEWS, told=True))
if "hasty" in options:
    supervisor.ALIVE_LIMIT_S = 0.5
if "tireless" in options:
    supervisor.LOOP_WINDOW_S = 0.0
if "missing" in options:
    table.append(Program("missing", "no_such_module", (), Stage.LINK))
if "signal" in options:
    launcher.Child = SignalledChild  # type: ignore[misc]
try:
    sys.exit(launcher.Launcher(load(config_path), table=table).run())
except PebbleError as error:
    sys.exit(f"refused: {error}")
