"""Values that the original Pebble accepts and our keys do not: other forms, and numbers beyond the limits. Pure."""

import math
from typing import Any, Literal, NamedTuple, get_origin

import msgspec
from msgspec import NODEFAULT, Meta

_SWITCHES = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False, "no": False, "off": False}


class Reading(NamedTuple):
    """A value to use in place of an unexpected one; ``differs``: the two differ in meaning, and not only in form."""

    value: Any
    differs: bool = True


def switch(raw: Any) -> bool | None:
    """Return the state that a number or a word such as "on" means; None if it means none."""
    return _SWITCHES.get(str(raw).lower()) if isinstance(raw, str | int) else None


def reading_of(annotation: Any, kind: Any, metas: list[Meta], raw: Any, default: Any) -> Reading | None:
    """Return the value to use in place of ``raw``, which is not valid for this key; None if there is none to use.

    ``kind`` and ``metas`` are the parts of ``annotation``; ``default`` is that of the key, perhaps NODEFAULT. An empty
    value, 0 or a mere true means the default, and numbers are brought within their limits; a 0 in quotes is a
    mistake where no number is wanted. Entries in the ``extra`` of ``metas`` change that: ``exact`` (only 0 means the
    default, and no number is changed), ``synonyms`` (other names of values), ``circle`` (the number at which a count
    starts again at 0), ``unlike`` (the value for any other ``raw``).
    """
    extra = {key: value for meta in metas for key, value in (meta.extra or {}).items()}
    number, wants_number = _number(raw), kind in (int, float)
    for form in _forms(kind, extra, raw, number):
        try:
            value = msgspec.convert(form, annotation, strict=False)
        except (msgspec.ValidationError, TypeError):
            continue
        if not isinstance(value, float) or math.isfinite(value):
            return Reading(value, differs=False)  # its meaning is the same
    if "unlike" in extra:
        return Reading(extra["unlike"])
    if raw and isinstance(raw, str) and not wants_number:  # a text that is no form of a value is a mistake
        return None
    is_empty = not raw or (raw is True and not wants_number)  # where a number is wanted, true is a mistake
    means_default = number == 0 or (is_empty and "exact" not in extra)  # with "exact" only a 0 does
    if means_default and default is not NODEFAULT:
        return Reading(default)
    if not wants_number or number is None or "exact" in extra:
        return None
    for meta in metas:
        if meta.gt is not None and number <= meta.gt:  # ``gt`` itself is not valid, so no valid number is the nearest
            return None if default is NODEFAULT else Reading(default)
        if meta.ge is not None:
            number = max(meta.ge, number)
        if meta.le is not None:
            number = min(meta.le, number)
    return Reading(int(number) if kind is int else number)


def _forms(kind: Any, extra: dict[str, Any], raw: Any, number: float | None) -> list[Any]:
    """Return the forms of ``raw`` to try for ``kind``; ``number``: its value, if any; ``extra``: see `reading_of`."""
    if kind is bool:
        state = switch(raw)
        return [] if state is None else [state]
    forms = [raw] if isinstance(raw, str | int | float) else []  # msgspec itself reads numbers in texts
    if isinstance(raw, int) and number is not None and (kind is str or get_origin(kind) is Literal):
        forms.append(str(raw))
    if number is not None and "circle" in extra and number.is_integer():
        forms.append(int(number % extra["circle"]))
    synonym = extra.get("synonyms", {}).get(str(raw).upper())
    return forms if synonym is None else [*forms, synonym]


def _number(raw: Any) -> float | None:
    try:
        number = math.nan if isinstance(raw, bool) else float(raw)
    except (TypeError, ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None
