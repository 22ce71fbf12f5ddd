"""What accounts may try at a broker: one row each, for the live check, and for the table in docs/fleet.md.

Run ``python -m pebble.fleet.attempts`` after a change of roles.
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from pebble.config.security import SecurityLevel
from pebble.contract import channels as c
from pebble.contract.docs import filled
from pebble.contract.identity import SERVERS
from pebble.fleet.roles import CONTROL_TOPIC, Account, ProgramRole, Role, Rule, rules
from pebble.transports.topics import matches


class Form(Enum):
    """How a metric becomes a topic."""

    OWN = "incoming, under the account's own name where names are in topics"
    PLAIN = "incoming, without a name"
    OTHER = "incoming, under another account's name"
    OUTGOING = "outgoing"
    ELSEWHERE = "below the system, or the whole topic"


class Row(NamedTuple):
    """One thing to try, by all of its topics. ``will``, ``retained``: how it is sent."""

    what: str
    form: Form
    metrics: tuple[str, ...]
    will: bool = False
    retained: bool = False


_DRIVE = (c.DRIVE.metric, c.CONTROL.metric)
ROWS = (
    Row("emergency stop", Form.OWN, (c.ESTOP.metric,)),
    Row("emergency stop, without a name", Form.PLAIN, (c.ESTOP.metric,)),
    Row("drive", Form.OWN, _DRIVE),
    Row("drive, without a name", Form.PLAIN, _DRIVE),
    Row("drive, under another's name", Form.OTHER, (*_DRIVE, c.ESTOP_RESET.metric, c.REBOOT.metric)),
    Row("leave a drive command as a will", Form.OWN, (c.DRIVE.metric,), will=True),
    Row("leave a drive command retained", Form.OWN, (c.DRIVE.metric,), retained=True),
    Row("take control over", Form.OWN, (c.CONTROL_TAKE.metric,)),
    Row("reset an emergency stop", Form.OWN, (c.ESTOP_RESET.metric,)),
    Row("start and end scripts", Form.OWN, (c.AUTONOMY_COMMAND.metric,)),
    Row("lights", Form.OWN, (c.LIGHTS_SOLID.metric, c.LIGHTS_FLASH.metric)),
    Row(
        "sounds, outlets, devices",
        Form.OWN,
        (c.SOUNDBOARD_COMMAND.metric, "outlets/a/power", "mcu/u1/led", c.MIP_RAW.metric),
    ),
    Row("ask for pictures", Form.OWN, (c.VIDEO_CONTROL.metric,)),
    Row("listen and speak", Form.OWN, (c.AUDIO_CONTROL.metric, c.AUDIO_STREAM.metric)),
    Row("allow and forbid pictures and sound", Form.OWN, (c.MQTT_VIDEO.metric, c.MQTT_AUDIO.metric)),
    Row(
        "reboot, restart, update, mirror",
        Form.OWN,
        (c.REBOOT.metric, c.SERVICE_RESTART.metric, c.GIT_PULL.metric, c.REMOTE_MIRROR.metric),
    ),
    Row("commands and flags that the contract does not know", Form.OWN, ("junk", "flags/junk")),
    Row("pose as this robot", Form.OUTGOING, ("online", "capabilities", "control/serial", "estop/serial", "junk")),
    Row("pose as another or a new robot", Form.ELSEWHERE, ("robots/fake/outgoing/online", "robots/fake/incoming/junk")),
    Row("probe a broker as a page server", Form.ELSEWHERE, (f"{SERVERS}/x1/outgoing/bridge-probe",)),
    Row("pose as a page server otherwise", Form.ELSEWHERE, (f"{SERVERS}/x1/outgoing/online",)),
    Row("change accounts", Form.ELSEWHERE, (CONTROL_TOPIC,)),
)
READS = (
    ("see what the robot publishes, and its flags", ("outgoing/online", "incoming/flags/x")),
    ("see commands of others", ("incoming/drive-values", "incoming/audio-stream", "incoming/by/otto/drive-values")),
)


def topics(row: Row, base: str, name: str, level: SecurityLevel, other: str = "otto") -> list[str]:
    """The topics of a row, for a robot and the account that tries."""
    system = base.partition("/")[0]
    by = {Form.OWN: f"by/{name}/" if level == "named" else "", Form.PLAIN: "", Form.OTHER: f"by/{other}/"}
    if row.form is Form.ELSEWHERE:
        return [one if one.startswith("$") else f"{system}/{one}" for one in row.metrics]
    if row.form is Form.OUTGOING:
        return [f"{base}/outgoing/{one}" for one in row.metrics]
    return [f"{base}/incoming/{by[row.form]}{one}" for one in row.metrics]


def may(held: Iterable[Rule], access: str, topic: str) -> bool:
    """Whether one of these rules lets an account write or read this topic."""
    return any(rule.access == access and matches(rule.filter, topic) for rule in held)


# -- the table of docs/fleet.md

DOCS = Path(__file__).resolve().parents[2] / "docs" / "fleet.md"
_BASE = "pebble/robots/goob"
_LEVELS: Sequence[SecurityLevel] = ("login", "named")
_COLUMNS: Mapping[str, Account] = {
    **{role.value: Account(roles=(role,)) for role in Role},
    "page": Account(roles=(ProgramRole.PAGE,)),
    "the robot": Account(roles=(ProgramRole.ROBOT,), bases=(_BASE,)),
    "another robot": Account(roles=(ProgramRole.ROBOT,), bases=("pebble/robots/fred",)),
}


def table() -> str:
    """Markdown: what each role may; ``login`` or ``named`` where only at that level."""
    held = {
        level: {column: rules(_account(column), one, level) for column, one in _COLUMNS.items()} for level in _LEVELS
    }
    lines = [f"| to a robot | {' | '.join(_COLUMNS)} |", f"|---|{'---|' * len(_COLUMNS)}"]
    for row in ROWS:
        tried = {level: {one: topics(row, _BASE, _account(one), level) for one in _COLUMNS} for level in _LEVELS}
        lines.append(_line(row.what, {one: _cell("write", one, held, tried) for one in _COLUMNS}))
    for what, suffixes in READS:
        seen = {level: {column: [f"{_BASE}/{one}" for one in suffixes] for column in _COLUMNS} for level in _LEVELS}
        lines.append(_line(what, {one: _cell("read", one, held, seen) for one in _COLUMNS}))
    return "\n".join(lines)


def document() -> str:
    """The whole of docs/fleet.md, with the table in it."""
    return filled(DOCS.read_text(encoding="utf-8"), {"attempts": table()})


def _line(what: str, cells: Mapping[str, str]) -> str:
    return f"| {what} | {' | '.join(cells.values())} |"


def _cell(
    access: str,
    column: str,
    held: Mapping[SecurityLevel, Mapping[str, Iterable[Rule]]],
    tried: Mapping[SecurityLevel, Mapping[str, Sequence[str]]],
) -> str:
    allowed = {
        level: all(may(held[level][column], access, topic) for topic in tried[level][column]) for level in _LEVELS
    }
    return "yes" if all(allowed.values()) else next((level for level, yes in allowed.items() if yes), "–")


def _account(column: str) -> str:
    return column.replace(" ", "-")


if __name__ == "__main__":
    DOCS.write_text(document(), encoding="utf-8")
