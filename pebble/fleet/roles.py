"""What a person may do: roles, the rights of each, and sessions. Every role may stop a robot."""

from dataclasses import dataclass
from enum import StrEnum


class Role(StrEnum):
    """One role of a person. SAFETY drives and resets as DRIVER does; from level ``fleet`` on, only SAFETY resets."""

    VIEWER = "viewer"
    DRIVER = "driver"
    MAINTAINER = "maintainer"
    SAFETY = "safety"
    ADMIN = "admin"


_DRIVING = frozenset({"drive", "reset"})
_RIGHTS: dict[Role, frozenset[str]] = {
    Role.VIEWER: frozenset(),
    Role.DRIVER: _DRIVING,
    Role.MAINTAINER: _DRIVING | {"take", "system"},
    Role.SAFETY: _DRIVING | {"take"},
    Role.ADMIN: _DRIVING | {"take", "system", "people"},
}


def rights(role: Role) -> frozenset[str]:
    """Those of ``drive``, ``reset``, ``take`` (control from who drives), ``system`` (restart, reboot, update) and
    ``people`` that the role has."""
    return _RIGHTS[role]


@dataclass(frozen=True, slots=True)
class Session:
    """One login. ``id`` names it in the audit log; it cannot be used to log in."""

    id: str
    user: str
    role: Role


#: What a browser on the same machine gets where there is no login.
LOCAL = Session("local", "local", Role.ADMIN)
