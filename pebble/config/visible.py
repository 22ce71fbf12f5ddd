"""Finds invisible characters, which make texts differ that look the same."""

import re

_HIDDEN_CATEGORIES = ("Cc", "Cf", "Cs", "Zl", "Zp", "Zs")
#: Of other categories, and yet not drawn (Unicode's Default_Ignorable_Code_Point), and the empty Braille pattern.
_NOT_DRAWN = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2065\u2800\u3164\ufe00-\ufe0f\uffa0\ufff0-\ufff8\U000e0000-\U000e0fff]"
)
_JOINERS = re.compile("[\u200c\u200d\ufe00-\ufe0f]")  # parts of emoji and of Persian or Indian words


def hidden(text: str, *, words: bool = False) -> str:
    """Return what is wrong with ``text``: an invisible character, or a blank at an end; "" if nothing is.

    ``words``: a blank, a tab and a new line may stand anywhere.
    """
    may_hide = not (text.isprintable() and text.isascii())  # printable ASCII hides nothing
    for place, char in enumerate(text if may_hide else ""):
        is_allowed = words and char in "\t\n\r"
        if not is_allowed and _is_hidden(char) and not _joins(text, place):  # joiners may stay: emoji have them
            return f"holds U+{ord(char):04X}, which is not shown: remove it"
    return "" if words or text == text.strip() else "starts or ends with a blank: remove it"


def is_text(text: str) -> bool:
    """True if ``text``, perhaps the name of a file, can be written as UTF-8."""
    return re.search("[\ud800-\udfff]", text) is None


def shown(text: str) -> str:
    """Return ``text`` for a terminal or a log, with invisible and control characters as codes: ``\\u202e``.

    Tabs, line ends and blanks of all kinds stay, and the joiners in emoji and in Persian words.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(_coded(char) if _needs_code(text, place) else char for place, char in enumerate(text))


def _needs_code(text: str, place: int) -> bool:
    """True if the character at ``place``, invisible and no blank, might reorder text or control a terminal."""
    import unicodedata

    char = text[place]
    if char in "\t\n" or not _is_hidden(char) or _joins(text, place):
        return False
    return unicodedata.category(char) != "Zs"  # a blank


def _coded(char: str) -> str:
    return f"\\u{ord(char):04x}" if ord(char) < 0x10000 else f"\\U{ord(char):08x}"


def _is_hidden(char: str) -> bool:
    if char.isascii():
        return not char.isprintable()
    import unicodedata  # only a text with other letters pays for this import

    return unicodedata.category(char) in _HIDDEN_CATEGORIES or _NOT_DRAWN.match(char) is not None


def _joins(text: str, place: int) -> bool:
    """True if the character at ``place`` joins its neighbours, or changes the look of the one before it."""
    if place == 0 or not _JOINERS.match(text[place]) or text[place - 1].isascii() or _is_hidden(text[place - 1]):
        return False
    return "\ufe00" <= text[place] <= "\ufe0f" or (place + 1 < len(text) and not text[place + 1].isascii())
