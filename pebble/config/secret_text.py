"""Finds and hides secrets in texts: logins in addresses, passwords and tokens."""

import re

HIDDEN = "***"
_NAMES = "pass|secret|token|credential|(?:api|access|private|auth).?key"
_KEY = re.compile(_NAMES, re.IGNORECASE).search
_NAME = rf"[\w-]{{0,40}}(?:{_NAMES}|pwd|psk|jwt)[\w-]{{0,40}}"
_END = r"(?<![_-]file)(?<![_-]env)"  # of a name; what is in a file or a variable stays there
_REST = r"""(?=["'\w\\])[^&\s]*"""  # a shell goes on with the same word after a closing quote
#: In quotes it may have blanks.
_VALUE = rf"""(?:(?<=")[^"\n]+(?:"{_REST})?|(?<=')[^'\n]+(?:'{_REST})?|(?<!["'])[^&\s]+)"""
_NEXT = r"""(?:["'],\s*|[= \t][ \t]*)\\?["']?"""  # from an option to its value, on a command line or in a list
#: A pair of a query, an option or a variable.
_PAIR = re.compile(
    rf"""((?:\b(?:{_NAME}|[\w-]{{0,40}}\bsig(?:nature)?)|[?&](?:key|code|auth))=\\?["']?){_VALUE}""", re.IGNORECASE
)
#: An option whose name says it, and the login of `curl -u`.
_OPTION = re.compile(
    rf"""((?<![\w-])(?!--no-)--?(?i:{_NAME}){_END}{_NEXT}(?!-)"""
    rf"""|(?<![\w-])(?:-u|--(?:proxy-)?user)(?:["'],\s*["']?|[= \t]*(?:\\["'])?)(?!\d+:\d+\b)"""
    rf"""[^\s:"'/=]{{1,64}}:(?!//)){_VALUE}"""
)
#: The same login in quotes, in which its password may have blanks.
_QUOTED_LOGIN = re.compile(
    r"""((?<![\w-])(?:-u|--(?:proxy-)?user)[= \t]*(["'])(?!\d+:\d+\b)[^\s:"'/=]{1,64}:)(?:(?!\2)[^\n])+"""
)
#: Programs that are often in scripts, and what stands before a secret on their command lines.
_PROGRAMS = tuple(
    (program, re.compile(rf"""({program}[^\n]{{0,400}}?[\s"'.](?:{before})(?:{_NEXT})?){_VALUE}"""))
    for program, before in (
        ("mosquitto_", "-P"),
        ("zip", "-P"),
        ("sshpass", "-p"),
        ("mysql", "-p"),
        ("docker login", "-p"),
        ("mongo", "-p"),
        ("7z", "-p"),
        ("redis-cli", "-a"),
        ("ldap", "-w"),
        ("curl", "-b|--cookie|--oauth2-bearer"),
        ("smbclient", r"""(?:-U|--user)[= ]?["']?[^\s%"']{1,64}%"""),
        ("nmcli", r"""(?:password|psk)(?=[\s"'])"""),
        ("iwconfig", r"key(?=\s)"),
        ("wpa_passphrase", r"""(?:"[^"\n]+"|'[^'\n]+'|[^\s"']+)(?=\s)"""),
        ("passwd", r"-\w*b\w*(?: [^\s-]\S*){1,2}(?= )"),
        ("vault", "login(?= [^-])"),
    )
)
_SUDO = re.compile(r"(\becho\s)[^\n|]{1,200}(?=\|\s*sudo\s[^\n|]{0,200}-S\b)")  # it reads a password
_HEADER = re.compile(
    r"""(\b(?:authorization|cookie|x-[\w-]{0,40}(?:key|auth|token|secret))\\?["']?\s*:\s*\\?["']?)"""
    r"""[^\s\\"'](?:[^\\"'\n]|(?<==)\\?"[^"\n]*")*""",  # a Digest has values in quotes
    re.IGNORECASE,
)
#: A member of an object in JSON, in JSON that is itself a text there, and in Python's writing.
_MEMBER = re.compile(
    rf'("{_NAME}{_END}"\s*:\s*")(?:[^"\\]|\\.)+'
    rf'|(\\"{_NAME}{_END}\\"\s*:\s*\\")[^"\\]+'
    rf"|('{_NAME}{_END}'\s*:\s*b?')(?:[^'\\]|\\.)+"
    rf"|('{_NAME}{_END}'\s*:\s*b?\")(?:[^\"\\]|\\.)+",
    re.IGNORECASE,
)
is_secret_option = re.compile(rf"--?{_NAME}", re.IGNORECASE).fullmatch
# URLs in a URL are percent-encoded: %3A is a colon, %2F a slash, %40 an @.
_AT = re.compile("@|%40")
_SLASHES = re.compile("://|%3A%2F%2F", re.IGNORECASE)
_COLON = re.compile("(?<=[^\"'/]):(?![\"'])|^:|%3A", re.IGNORECASE)
_BEFORE_USER = re.compile("[/\"'=,;(\\[{<]|%2F", re.IGNORECASE)
_LOGIN_WITH_BLANKS = re.compile(r"(://)[^\s/@:]{0,100}:(?!\d{1,5}(?:[\s/?#\"',;]|$))[^@\n]{0,200}@")


def is_secret(key: str) -> bool:
    """True if a key's name says that the value is a secret, or names a file or a variable with a secret in it."""
    return bool(_KEY(key))


def without_secrets(text: str) -> str:
    """Return ``text`` with stars in place of logins in URLs, and of secrets in queries, options and HTTP headers.

    It rather hides too much: in a word with ``://``, or a colon before an @, everything before the last @.
    """
    if _AT.search(text):
        text = re.sub(r"\S+", _without_login, _LOGIN_WITH_BLANKS.sub(rf"\1{HIDDEN}@", text))
    text = _PAIR.sub(rf"\1{HIDDEN}", text) if "=" in text else text  # only if it can match: to save time
    if "-" in text:
        text = _OPTION.sub(rf"\1{HIDDEN}", _QUOTED_LOGIN.sub(rf"\1{HIDDEN}", text))
    for program, pattern in (*_PROGRAMS, ("sudo", _SUDO)):
        text = pattern.sub(rf"\1{HIDDEN}", text) if program in text else text
    text = _HEADER.sub(rf"\1{HIDDEN}", text) if ":" in text else text
    return _MEMBER.sub(rf"\1\2\3\4{HIDDEN}", text) if ":" in text else text  # a match has one of the groups


def _without_login(match: re.Match[str]) -> str:
    """Return a word with stars before its last @: after ``://``, or in a word without ``://`` for ``NAME:PASSWORD``."""
    word = match[0]
    ats = [at.start() for at in _AT.finditer(word)]
    if not ats:
        return word
    end = ats[-1]
    slashes = _SLASHES.search(word)
    # The first colon that does not end directly before the last @: what is between them is taken for the password.
    colon = next((colon for colon in _COLON.finditer(word, 0, end) if colon.end() < end), None)
    if slashes and slashes.end() <= end:  # SCHEME://LOGIN@
        start = slashes.end()
    elif colon:  # NAME:PASSWORD@; NAME begins after a sign such as a quote
        start = max((sign.end() for sign in _BEFORE_USER.finditer(word, 0, colon.start())), default=0)
    else:
        return word
    return f"{word[:start]}{HIDDEN}{word[end:]}"


def shown_user(name: str) -> str:
    """Return a user name for messages, with a password after it hidden."""
    user, colon, _ = without_secrets(name).partition(":")
    return f"{user}:{HIDDEN}" if colon else user
