"""The senders of commands at a broker that checks names. Loaded only there, because it takes memory. Pure.

There topics are subscribed to with the account of the sender, ``by/{account}/{topic}``; the first ones without, too.
"""

from common.latch import fields
from common.lease import shown

ANY = b"by/+/"


def sender(data: memoryview, at: int, stop: int) -> tuple[str, int]:
    """Return ``(account, place of the topic)`` after the "by/" that ends at ``at``; "": there is no account.

    An account is up to 32 of a-z, 0-9, _ and -, and does not begin with a hyphen.
    """
    first = at  # then the end of the account: a-z, 0-9, - and _
    while first < stop and (96 < data[first] < 123 or 47 < data[first] < 58 or data[first] in (45, 95)):
        first += 1
    if first < stop and data[first] == 47 and at < first <= at + 32 and data[at] != 45:  # a "/" follows; no "-" first
        return bytes(data[at:first]).decode(), first + 1
    while first < stop and data[first] != 47:
        first += 1
    return "", first + 1


def sign(body: object, by: str) -> None:
    """Write the account ``by`` into a command, in place of the command's ``by`` or in front of it; "-": a stranger."""
    command = fields(body)
    person = command.get("by")
    command["by"] = shown(by + "/" + person, 40) if isinstance(person, str) and person and by != "-" else by


def claimed(by: str) -> str:
    """Return a name that was not checked, in the form that Linux robots show."""
    return by and by[:31].rstrip("?") + "?"
