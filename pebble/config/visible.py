"""Finds characters in a text that are not shown: they make two texts differ that look the same."""

import re

_HIDDEN_CATEGORIES = ("Cc", "Cf", "Zl", "Zp", "Zs")
#: Of other categories, and yet not drawn (Unicode's Default_Ignorable_Code_Point), and the empty Braille pattern.
_NOT_DRAWN = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2065\u2800\u3164\ufe00-\ufe0f\uffa0\ufff0-\ufff8\U000e0000-\U000e0fff]"
)
_JOINERS = re.compile("[\u200c\u200d\ufe00-\ufe0f]")  # parts of emoji and of Persian or Indian words
_NAMES = {"\0": "NUL", "\t": "tab", "\n": "line feed", "\r": "carriage return", "\x1b": "escape"}
_SPACES = " \t\n\r"


def hidden(text: str, *, words: bool = False, inside: bool = True) -> str:
    """What is wrong with ``text``, and where; "" where every character is seen and no blank is at an end.

    ``words``: a blank, a tab and a new line may stand anywhere. ``inside`` False: only the ends are checked, and NUL.
    """
    if text.isascii() and text.isprintable() and (words or text == text.strip()):
        return ""
    last = len(text) - 1
    for place, char in enumerate(text):
        at_end = place in (0, last)
        if words and char in _SPACES:
            continue
        if (
            char == "\0"
            or (_is_hidden(char) and (at_end or inside) and not _joins(text, place))
            or (at_end and char == " ")
        ):
            if not at_end:
                return f"holds {code_point(char)} after {place} characters: remove it"
            return f"{'ends' if place else 'starts'} with {code_point(char)}: remove it"
    try:
        text.encode()
    except UnicodeEncodeError:
        return "holds half a character (a lone surrogate)"
    return ""


def without_hidden(text: str) -> str:
    """``text`` as it is seen."""
    return "".join(char for char in text if not _is_hidden(char)).strip()


def shown(text: str) -> str:
    """``text`` for a terminal or a log: what is not seen, or steers what shows it, is its code, such as ``\\u202e``.

    Tabs, line ends and blanks of all kinds stay, and what joins the parts of an emoji or of a Persian word.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(_coded(char) if _steers(text, place) else char for place, char in enumerate(text))


def _steers(text: str, place: int) -> bool:
    import unicodedata

    char = text[place]
    if char in "\t\n" or not _is_hidden(char) or _joins(text, place):
        return "\ud800" <= char <= "\udfff"
    return unicodedata.category(char) != "Zs"


def _coded(char: str) -> str:
    return f"\\u{ord(char):04x}" if ord(char) < 0x10000 else f"\\U{ord(char):08x}"


def code_point(char: str) -> str:
    """Example: ``U+00A0 (no-break space)``."""
    import unicodedata

    name = _NAMES.get(char) or unicodedata.name(char, "a control character").lower()
    return f"U+{ord(char):04X} ({name})"


def _is_hidden(char: str) -> bool:
    if char.isascii():
        return not char.isprintable()
    import unicodedata  # only a text with other letters pays for this import

    return unicodedata.category(char) in _HIDDEN_CATEGORIES or _NOT_DRAWN.match(char) is not None


def _joins(text: str, place: int) -> bool:
    """Whether the character joins or varies what is beside it, which then looks different."""
    if place == 0 or not _JOINERS.match(text[place]) or text[place - 1].isascii() or _is_hidden(text[place - 1]):
        return False
    return "\ufe00" <= text[place] <= "\ufe0f" or (place + 1 < len(text) and not text[place + 1].isascii())
