"""The config section of autonomy: which scripts a robot offers, and how they run."""

from typing import Annotated, Any, ClassVar, Literal

from pebble.config.types import EMPTY, ONE_VALUE, UNIT, File, Seconds, Section, ServiceSection, Variables, doc
from pebble.extensions.media.config import HandlerTopics


class ScriptArgument(Section, frozen=True, kw_only=True):
    """One setting of a script that operators may change."""

    key: Annotated[str, doc("Its name in commands.")]
    label: Annotated[str | None, doc("Its name for operators; unset: the key.")] = None
    type: Annotated[Literal["string", "int", "float", "bool", "enum"], doc("What it holds.")] = "string"
    default: Annotated[str | int | float | bool | None, doc("Its value unless a command sets it.")] = None
    arg: Annotated[str | None, doc("The option of the script's command line.")] = None
    arg_false: Annotated[str | None, doc("The option for false.")] = None
    mode: Annotated[Literal["flag", "value"] | None, doc("Whether the option has a value.")] = None
    required: Annotated[bool, doc("A command must give it.")] = False
    min: Annotated[int | float | None, doc("Smallest value.")] = None
    max: Annotated[int | float | None, doc("Largest value.")] = None
    step: Annotated[int | float | None, doc("Step of an operator's control.")] = None
    options: Annotated[tuple[Any, ...], doc("The values of an enum.")] = ()


class ScriptDependency(Section, frozen=True, kw_only=True):
    """Another script that a script needs."""

    file: Annotated[str, doc("Folder of the other script.")]
    enabled: Annotated[bool, doc("Start it.")] = True
    config: Annotated[dict[str, Any], doc("Its settings.")] = EMPTY


class Script(Section, frozen=True, kw_only=True):
    """One autonomy script: a folder with an entry point."""

    retired: ClassVar = {"arbitrate": "what a script of others drives ranks below a person who has control"}

    enabled: Annotated[bool, doc("Offer it.")] = True
    display_name: Annotated[str | None, doc("Its name for operators; unset: the folder's.")] = None
    entrypoint: Annotated[str, doc("File to run.")] = "run.py"
    python: Annotated[
        str | None,
        doc("Interpreter of a Python entry point; unset: Pebble's for one that imports pebble, else /usr/bin/python3."),
    ] = None
    cwd: Annotated[File | None, doc("Folder to run it in; unset: its own.")] = None
    env: Annotated[Variables, doc("Environment variables to add.")] = EMPTY
    args: Annotated[tuple[ScriptArgument, ...], doc("Its settings.")] = ()
    dependencies: Annotated[tuple[ScriptDependency, ...], doc("Scripts that must run too.")] = ()


class AutonomyManager(ServiceSection, frozen=True, kw_only=True):
    """Runs one autonomy script at a time."""

    retired: ClassVar = {"scan_interval_seconds": ONE_VALUE, "env": UNIT}

    autonomy_root: Annotated[
        str, doc("Folder of scripts. Relative: seen from the config's folder, and Pebble's own are offered, too.")
    ] = "autonomy"
    stop_timeout_seconds: Annotated[Seconds, doc("How long a script may take to stop before it is killed.")] = 8.0
    on_override: Annotated[
        Literal["resume", "stop"],
        doc("When a person drives: `resume` lets the script go on once the person has let go, `stop` ends it."),
    ] = "resume"
    topics: Annotated[HandlerTopics, doc("Other names for topics.")] = HandlerTopics()
    scripts: Annotated[dict[str, Script], doc("Scripts by folder.")] = EMPTY
