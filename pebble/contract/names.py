"""The sender's account in a topic: ``incoming/by/{account}/{metric}``, where only that account can publish.

A robot whose capabilities have ``named`` reads such topics. Of those without a name it takes stops, zeros, and what
its config lets strangers do. Nothing is retained there. A stop behind what is no name is a stop without one.
"""

import re
from typing import NamedTuple

from pebble.contract.channels import ESTOP, INCOMING

BY = "by"
NAME = re.compile(r"[a-z0-9_][a-z0-9_-]{0,31}")  # of an account
NO_ACCOUNT = "-"  # in place of an account: the topic has no name
_PLAIN = re.compile(rf"((?:[^/]+/){{3}}{INCOMING}/)(.+)", re.DOTALL)
_NAMED = re.compile(rf"((?:[^/]+/){{3}}{INCOMING}/){BY}/({NAME.pattern})/(?!{BY}/)(.+)", re.DOTALL)
_STOP = re.compile(rf"((?:[^/]+/){{3}}{INCOMING}/)(?:{BY}/[^/]*/)+({ESTOP.metric})", re.DOTALL)
_UNCHECKED, _LONGEST = "?", 32  # behind a name that no broker has checked; characters of the sender of a stop


class Named(NamedTuple):
    """A topic without its name, and the name."""

    account: str
    topic: str


def with_name(topic: str, account: str) -> str:
    """``topic``, which is one of a component's ``incoming/``, with the name of the sender; ``+``: of any."""
    found = _PLAIN.fullmatch(topic)
    if found is None or not (account == "+" or NAME.fullmatch(account)):
        raise ValueError(f"{topic!r} takes no name {account!r}")
    return f"{found[1]}{BY}/{account}/{found[2]}"


def without_name(topic: str) -> Named | None:
    """Return the parts of a topic with a name; None: it has none, or more than one, or one that no account can have."""
    found = _NAMED.fullmatch(topic)
    return None if found is None else Named(found[2], found[1] + found[3])


def stop_topic(topic: str) -> str | None:
    """Return the topic of stops, if this one is that behind any names, also such as no account can have."""
    found = _STOP.fullmatch(topic)
    return None if found is None else found[1] + found[2]


def unchecked(claim: str) -> str:
    """Return what is shown of the sender of a stop that claims to be this one. No account's name has the mark."""
    return claim[: _LONGEST - 1].rstrip(_UNCHECKED) + _UNCHECKED
