"""Generates docs/web-messages.md and the page's messages.d.ts from messages.py.

Program: ``python -m pebble.web.messages_docs`` writes both; a test checks that they are current.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import msgspec
from msgspec import inspect as types

from pebble.web import messages

_ROOT = Path(__file__).parents[2]
DOCS = _ROOT / "docs" / "web-messages.md"
DECLARATIONS = Path(__file__).parent / "static" / "messages.d.ts"

_INTRODUCTION = """# Messages of the operator page

Generated from `pebble/web/messages.py` by `python -m pebble.web.messages_docs`; edit that file, not this one.

{about}
"""
_MEDIA = """## Media socket

`/ws/media?ref=REF&can=ENCODING,…` carries the pictures of one component, in binary messages; numbers are big-endian.

| from | message |
|---|---|
| server | `u32 number`, `u8 kind`, then kind 0: the payload as it came from the robot; \
kind 1: a JPEG of the server's own, after `u64` epoch milliseconds of its capture, 0 if unknown |
| page | `u32 number`, `u8 what`: 0 the frame is drawn, 1 a key frame is needed, 2 this browser cannot decode it |
"""
_SOUND = """## Sound socket

`/ws/sound?ref=REF&can=opus,pcm&name=NAME&device=DEVICE` carries the sound of one component, and a person's voice to \
it. `can` empty: this page only talks. `name` and `device` are those of `hello`. Numbers are big-endian; `talk` \
numbers the talks of this connection, each greater than the last.

| from | message |
|---|---|
| server | binary: a PBAT packet as it came from the robot |
| server | text: a TalkAnswer |
| page | `u8 0`, `u32 count`: so many packets have been received; at most 32 are under way |
| page | `u8 1`, `u32 talk`, `u32 number`, 640 bytes: 20 ms of the voice, 16 kHz mono s16le, numbered from 0; \
the first one begins the talk |
| page | `u8 2`, `u32 talk`: it ends |
"""

_RECORDINGS = """## Recordings

Over HTTP, where the server has a folder of recordings; `robot` is `system/type/id`, times are epoch \
milliseconds. Nothing \
is sent to a robot. What is wrong is answered with one line of text: 400 a parameter, 401 without a session, \
404 without \
a folder, 409 too much at once, 422 what recordings cannot answer.

| request | answer |
|---|---|
| `GET /archive/days` | JSON, the newest first: `day` (of UTC), `robots`, `bytes`, `first`, `last`, `gaps`, `unread` \
(lines about files that cannot be read completely, on the day when each was written last) |
| `GET /archive/timeline?day=&robot=` | JSON: `from`, `step`, for each step `activity`, `video`, `audio`, \
`rest` (kbit/s); \
`gaps`, `outages`, `sessions` with `since` and `until`. 202 with `indexing`, a share, while the day is indexed: \
ask again |
| `GET /archive/segment?robot=&at=&for=[&seek=1][&media=0]` | messages of at most ten seconds, see below; \
`X-Next`: where \
to go on, after a gap the robot's next message, empty at the end; `X-Complete: 0`: pictures were left out, \
beyond 8 MB |
| `GET /archive/frame?robot=&at=[&w=]` | JPEG of the picture at that time, `X-Captured-Ms`; 404 if none is ten \
seconds old or less |
| `GET /archive/strip?robot=&since=&step=&count=&w=` | one JPEG of thumbnails side by side, 16:9 |
| `POST /archive/exports` | body `{"robot", "since", "until", "as"}`, `as`: mkv, mp4 or mcap; 202 with `id`. \
One at a time, \
of at most an hour |
| `GET /archive/exports/ID` | `state` (running, ready, failed), `done`, `why` (it failed, or what could not be \
read), `name`, `bytes`; `…/file` is the file |
| `POST /archive/exports/ID/end` | ends or removes it |

`activity` is a sum: 1 online, 2 driven, 4 lights, 8 a sound was played, 16 a script was started, 32 a warning \
in the log, \
64 pictures, 128 sound.

A segment is a row of messages, in big-endian numbers: `u32` length of what follows, `f64` when it was \
received, `u8` \
flags, `u16` length of the metric, the metric, the payload as it came. Flags: 1 from before the segment, the \
newest value \
of its metric (an empty one: it was removed) or a line of the log; 2 a picture from before the segment, from \
the last key \
frame on; 4 it was sent to the robot; 8 a picture; 16 sound. Those with 1 and 2 come only with `seek=1`, and \
first.
"""


def markdown() -> str:
    """docs/web-messages.md."""
    about = (messages.__doc__ or "").partition("\n")[2].strip().partition("docs/web-messages.md")[0].strip()
    parts = [_INTRODUCTION.format(about=f"{_summary(messages)} {about}".replace("``", "`"))]
    parts += ["## From the page\n", *map(_section, get_args(messages.FromPage))]
    parts += ["## From the server\n", *map(_section, get_args(messages.ToPage))]
    parts += ["## Metrics of the server\n", *map(_section, _views())]
    return "\n".join([*parts, _MEDIA, _SOUND, _section(messages.TalkAnswer), _RECORDINGS])


def declarations() -> str:
    """messages.d.ts: one interface for each struct."""
    parts = ["// Generated from pebble/web/messages.py by python -m pebble.web.messages_docs.\n"]
    for struct in (
        *get_args(messages.FromPage),
        *get_args(messages.ToPage),
        messages.ShownOwner,
        messages.TalkAnswer,
        *_views(),
    ):
        info: Any = types.type_info(struct)
        tag = [f'  op: "{info.tag}";'] if info.tag is not None else []
        fields = [f"  {one.name}{'' if one.required else '?'}: {_script(one.type)};" for one in info.fields]
        parts.append("\n".join([f"export interface {struct.__name__} {{", *tag, *fields, "}\n"]))
    metrics = [f'  "{name}": {view.__name__};' for name, view in messages.SERVER_METRICS.items()]
    parts.append("\n".join(["export interface Metrics {", *metrics, "}\n"]))
    for name in ("FromPage", "ToPage"):
        members = " | ".join(one.__name__ for one in get_args(getattr(messages, name)))
        parts.append(f"export type {name} = {members};\n")
    return "\n".join(parts)


def _views() -> Iterator[type]:
    """The values of the server's metrics, each after what it consists of."""
    yield messages.OwnerState
    yield from messages.SERVER_METRICS.values()


def _section(struct: type) -> str:
    info: Any = types.type_info(struct)
    title = f"`{info.tag}`" if info.tag is not None else struct.__name__
    rows = [f"| `{one.name}` | {_words(one.type)} | {'' if one.required else _default(one)} |" for one in info.fields]
    table = ["| field | type | default |", "|---|---|---|", *rows, ""] if rows else []
    return "\n".join([f"### {title}\n", inspect.cleandoc(struct.__doc__ or "").replace("``", "`"), "", *table])


def _default(field: Any) -> str:
    value = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
    return f"`{json.dumps(value)}`"


def _summary(thing: object) -> str:
    return (inspect.getdoc(thing) or "").partition("\n")[0]


def _words(kind: Any) -> str:
    return _script(kind).replace("|", "or")


def _script(kind: Any) -> str:
    match kind:
        case types.Metadata():
            return _script(kind.type)
        case types.StrType():
            return "string"
        case types.IntType() | types.FloatType():
            return "number"
        case types.BoolType():
            return "boolean"
        case types.NoneType():
            return "null"
        case types.UnionType():
            return " | ".join(map(_script, kind.types))
        case types.StructType():
            return str(kind.cls.__name__)
        case types.LiteralType():
            return " | ".join(json.dumps(value) for value in kind.values)
        case types.DictType():
            return f"Record<{_script(kind.key_type)}, {_script(kind.value_type)}>"
        case types.VarTupleType():
            item = _script(kind.item_type)
            return f"({item})[]" if "|" in item else f"{item}[]"
        case types.TupleType():
            return f"[{', '.join(map(_script, kind.item_types))}]"
    return "any"


def main() -> None:
    """Write both files."""
    DOCS.write_text(re.sub(r"\n{3,}", "\n\n", markdown()), encoding="utf-8")
    DECLARATIONS.write_text(declarations(), encoding="utf-8")


if __name__ == "__main__":
    main()
