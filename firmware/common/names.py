"""The senders of commands at a broker that checks names. Loaded only there, because it takes memory. Pure.

Each topic is subscribed to a second time there, with the account of its sender: ``by/{account}/{topic}``.
"""

from common.latch import fields
from common.lease import shown

ANY = b"by/+/"


def sender(data: memoryview, at: int, stop: int) -> tuple[str, int]:
    """Return ``(account, place of the topic)`` behind the "by/" that ends at ``at``; "": no account is there.

    An account is up to 32 of a-z, 0-9, _ and -, which is none in front.
    """
    first = at
    while first < stop and (96 < data[first] < 123 or 47 < data[first] < 58 or data[first] in (45, 95)):
        first += 1
    if first < stop and data[first] == 47 and at < first <= at + 32 and data[at] != 45:
        return bytes(data[at:first]).decode(), first + 1
    while first < stop and data[first] != 47:
        first += 1
    return "", first + 1


def sign(body: object, by: str) -> None:
    """Put the account ``by`` into a command, instead of its own ``by`` or in front of it; "-": a stranger's."""
    found = fields(body)
    person = found.get("by")
    found["by"] = shown(by + "/" + person, 40) if isinstance(person, str) and person and by != "-" else by


def claimed(by: str) -> str:
    """Return a name that was not checked as Linux robots show it."""
    return by and by[:31].rstrip("?") + "?"
