"""The sender's account in a topic: ``incoming/by/{account}/{metric}``, where only that account can publish.

A robot whose capabilities have ``named`` reads such topics. Of those without a name it takes stops, zeros, and what
its config lets strangers do. Nothing is retained there.
"""

import re
from typing import NamedTuple

from pebble.contract.channels import INCOMING

BY = "by"
NAME = re.compile(r"[a-z0-9_][a-z0-9_-]{0,31}")  # of an account
NO_ACCOUNT = "-"  # in place of an account: the topic has no name
_PLAIN = re.compile(rf"((?:[^/]+/){{3}}{INCOMING}/)(.+)", re.DOTALL)
_NAMED = re.compile(rf"((?:[^/]+/){{3}}{INCOMING}/){BY}/({NAME.pattern})/(?!{BY}/)(.+)", re.DOTALL)


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
    """The parts of a topic with a name; None: it has none, or more than one, or one that no account can have."""
    found = _NAMED.fullmatch(topic)
    return None if found is None else Named(found[2], found[1] + found[3])
