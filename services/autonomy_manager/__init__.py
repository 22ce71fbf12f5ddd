"""The manager of autonomy scripts, which runs one at a time."""

from pebble.extension import Extension, Program

_MODULE = "pebble.services.autonomy_manager"

EXTENSION = Extension(
    name="autonomy_manager",
    needs=("scripts",),
    sections={"services.autonomy_manager": "pebble.extensions.scripts.config:AutonomyManager"},
    program=Program("autonomy_manager", f"{_MODULE}.service:AutonomyManager", runs_scripts=True),
    offers=f"{_MODULE}.facts:offers",
    facts=f"{_MODULE}.facts:facts",
    completions={"SCRIPT": f"{_MODULE}.facts:complete_scripts"},
    page="docs/ext/autonomy.md",
)
