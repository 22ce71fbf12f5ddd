"""The sender's account in a topic: ``incoming/by/{account}/{metric}``, where only that account can publish.

A robot whose capabilities have ``named`` reads such topics, but no retained messages there. Elsewhere it takes only
stops, zeros, and what its config allows to strangers. A stop with an invalid account counts as one without account.
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
_UNCHECKED, _LONGEST = "?", 32  # after a name that no broker has checked; characters of a stop's sender


class Named(NamedTuple):
    """A topic without the sender's account, and the account."""

    account: str
    topic: str


def with_name(topic: str, account: str) -> str:
    """Return an ``incoming/`` topic with the sender's account in it; ``+``: any account."""
    match = _PLAIN.fullmatch(topic)
    if match is None or not (account == "+" or NAME.fullmatch(account)):
        raise ValueError(f"{topic!r} takes no name {account!r}")
    return f"{match[1]}{BY}/{account}/{match[2]}"


def without_name(topic: str) -> Named | None:
    """Return the topic without the account, and the account; None for no account, several, or an invalid one."""
    match = _NAMED.fullmatch(topic)
    return None if match is None else Named(match[2], match[1] + match[3])


def stop_topic(topic: str) -> str | None:
    """Return a stop's topic without its accounts, even if they are invalid; None for a topic of any other form."""
    match = _STOP.fullmatch(topic)
    return None if match is None else match[1] + match[2]


def unchecked(claim: str) -> str:
    """Return the claimed sender of a stop with a "?" after it, which no account's name contains."""
    return claim[: _LONGEST - 1].rstrip(_UNCHECKED) + _UNCHECKED
