"""Who has control of one motor owner. Pure; boards and Linux robots share it."""

SHORTEST_MS = 1000
USUAL_MS = 3000
LONGEST_MS = 10_000
BY = 40  # characters
DEVICE = 20


_LETTERS = "abcdefghijklmnopqrstuvwxyz0123456789_-/"


def shown(text: object, limit: int) -> str:
    """``text`` in the letters of names; "/" separates a server and its person."""
    if not isinstance(text, str):
        return ""
    small = [char.lower() if "A" <= char <= "Z" else char for char in text[:limit]]
    return "".join([char if char in _LETTERS else "_" for char in small])
