"""Checks of robots' payloads: the page's cards rely on some of their fields, and need not check them again. Pure.

Each class lists the fields of a payload that cards read. Each function ``_NAME(payload)`` returns what pages get: the
payload itself if all its fields are valid, else a copy without the invalid parts.
"""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct, ValidationError, convert

from pebble import contract as c
from pebble.extensions.operator.client import forms

_Name = Annotated[str, Meta(min_length=1, max_length=255)]


class _Clips(Struct):
    files: list[str] = []


class _Clip(Struct):
    playing: bool = False
    file: str | None = None
    error: str | None = None


class _Dependency(Struct):
    file: str
    running: bool = False


class _Running(_Clip):
    running: bool = False
    overridden: bool = False
    label: str = ""
    since: float = 0
    drives: bool = True
    stopped: bool = False
    dependencies: list[_Dependency] = []
    config: dict[str, Any] | None = None


class _Scripts(Struct):
    files: list[Any]


class _Script(Struct):
    file: _Name
    label: str = ""
    summary: str = ""
    main: list[str] = []
    configs: list[Any] = []


class _Medium(Struct):
    running: bool = False
    doing: str | None = None
    problem: str | None = None
    last_error: str | None = None


class _Neighbours(Struct):
    receives: dict[str, bool] = {}
    driven_by: str = ""


class _Switch(Struct):
    on: bool | None = None
    bound: bool | None = None
    reachable: bool | None = None


class _Outlet(Struct):
    value: _Switch
    label: str = ""


class _Identity(Struct):
    name: str = ""
    description: str = ""
    colour: str = ""
    picture: str = ""
    battery_cells: int = 0


class _OutletOffer(Struct):
    name: _Name
    controls: bool = False


class _OutletOffers(Struct):
    outlets: list[_OutletOffer] = []


class _Field(Struct):
    name: _Name
    type: str = ""
    scale: float = 1
    offset: float = 0
    unit: str = ""


class _Fields(Struct):
    fields: list[_Field]


class _Texts(Struct):
    model: str = ""
    firmware_version: str = ""


class _Interface(Struct):
    name: _Name
    dir: Literal["in", "out"]
    encoding: _Fields
    kind: str = ""
    channel: str = ""
    profile: str = ""
    rate_hz: float = 0
    local_only: bool = False


class _Wrapped(Struct):
    value: msgspec.Raw


_INSIDE = msgspec.json.Decoder(_Wrapped)


def shown(channel: c.Channel | None, raw: bytes, payload: Any) -> bytes:
    """Return the JSON of ``payload`` for pages: ``raw`` itself if no card relies on its fields, or all are valid."""
    show = None if channel is None else _SHOWN.get(channel.metric)
    checked = payload if show is None else show(payload)
    if checked is payload:
        return raw
    if isinstance(payload, dict) and checked is payload.get("value"):
        return bytes(_INSIDE.decode(raw).value)  # as it was written: cheaper than to write it anew
    return msgspec.json.encode(checked)


def with_name(raw: bytes, name: str) -> bytes:
    """Return the capabilities with this name if the robot has none; ``raw`` is from ``shown``."""
    value = _inner(msgspec.json.decode(raw))
    if not isinstance(value, dict):
        return raw
    identity = value.get("identity", {})
    if identity.get("name"):
        return raw
    return msgspec.json.encode({"value": {**value, "identity": {**identity, "name": name}}})


def _inner(payload: Any) -> Any:
    """Return the value inside ``{"t": …, "value": …}``, or a payload of another form as it is."""
    return payload["value"] if isinstance(payload, dict) and "value" in payload else payload


def _is(kind: Any, payload: object) -> bool:
    """True if the value can be converted to this type."""
    try:
        convert(payload, kind)
    except ValidationError:
        return False
    return True


def _object(kind: Any, payload: Any) -> Any:
    """Return the object if it is of this type, else an empty object."""
    return payload if _is(kind, payload) else {}


def _inner_object(kind: Any, payload: Any) -> Any:
    return _object(kind, _inner(payload))


def _readable(kind: Any, entries: object) -> list[Any]:
    """Return the entries of a list that are of this type."""
    return [entry for entry in entries if _is(kind, entry)] if isinstance(entries, list) else []


def _media(payload: Any) -> Any:
    """Return the programs' reports if all are valid.

    Each is checked separately, because for the type of the whole dict msgspec would build a decoder at each call.
    """
    reports = _inner(payload)
    return reports if isinstance(reports, dict) and all(_is(_Medium, report) for report in reports.values()) else {}


def _scripts(payload: Any) -> Any:
    """Return the valid scripts, with their valid settings."""
    listed = _object(_Scripts, _inner(payload))
    if not listed:
        return {}
    scripts = []
    for script in _readable(_Script, listed["files"]):
        settings = forms.listed(script.get("configs"))[: forms.MAX_SETTINGS]
        scripts.append({**script, "configs": [setting.entry() for setting in settings]})
    return {**listed, "files": scripts}


def _manifest(payload: Any) -> Any:
    """Return the manifest with only its valid interfaces."""
    manifest = _object(dict[str, Any], _inner(payload))
    texts = _object(_Texts, manifest)
    return {
        **manifest,
        "model": texts.get("model", ""),
        "firmware_version": texts.get("firmware_version", ""),
        "interfaces": _readable(_Interface, manifest.get("interfaces")),
    }


_OFFERS = "drive", "video", "audio", "soundboard", "autonomy", "lights", "system", "telemetry", "transport"
_SECTIONS: dict[str, Any] = dict.fromkeys(_OFFERS, dict[str, Any]) | {"identity": _Identity, "outlets": _OutletOffers}


def _capabilities(payload: Any) -> Any:
    """Return the capabilities with only their valid sections."""
    value = _inner(payload)
    if not isinstance(value, dict):
        return {}
    valid = {name: section for name, section in value.items() if _is(_SECTIONS.get(name, Any), section)}
    is_wrapped = value is not payload
    return payload if is_wrapped and valid == value else {"value": valid}  # pages always get it as "value"


_SHOWN: dict[str, Callable[[Any], Any]] = {
    c.CAPABILITIES.metric: _capabilities,
    c.SOUNDBOARD_FILES.metric: partial(_inner_object, _Clips),
    c.SOUNDBOARD_STATUS.metric: partial(_inner_object, _Clip),
    c.AUTONOMY_FILES.metric: _scripts,
    c.AUTONOMY_STATUS.metric: partial(_inner_object, _Running),
    c.MEDIA_STATUS.metric: _media,
    c.NEIGHBOURS.metric: partial(_inner_object, _Neighbours),
    c.OUTLET_STATUS.metric: partial(_object, _Outlet),
    c.MCU_DESCRIBE.metric: _manifest,
}
