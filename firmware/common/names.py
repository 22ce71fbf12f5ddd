"""The senders of commands at a broker that checks names. Loaded only there, because it takes memory. Pure.

Such a broker passes a command on at ``by/{account}/{topic}``, with the account of its sender. Stops, and what clients
without an account may send, also come at the topic alone.
"""

from common.latch import fields
from common.lease import shown

ANY = b"by/+/"


def sender(data: memoryview, at: int, stop: int) -> tuple[str, int]:
    """Return the account behind the "by/" that ends at ``at``, and where the topic begins. "": it is no account.

    An account is up to 32 of a-z, 0-9, _ and -, and does not begin with a hyphen.
    """
    end = at
    while end < stop and (96 < data[end] < 123 or 47 < data[end] < 58 or data[end] in (45, 95)):  # a-z, 0-9, - and _
        end += 1
    if end < stop and data[end] == 47 and at < end <= at + 32 and data[at] != 45:  # a "/" follows; no "-" first
        return bytes(data[at:end]).decode(), end + 1
    while end < stop and data[end] != 47:
        end += 1
    return "", end + 1


def sign(body: object, by: str) -> None:
    """Write the account ``by`` into a command, before the person named there: ``page-1/ann``. "-" takes no person."""
    command = fields(body)
    person = command.get("by")
    command["by"] = shown(by + "/" + person, 40) if isinstance(person, str) and person and by != "-" else by


def claimed(by: str) -> str:
    """Return a name that was not checked, in the form that Linux robots show: ``ann?``."""
    return by and by[:31].rstrip("?") + "?"
