"""What a person may do: roles, and the rights of each. Every role may stop a robot."""

from __future__ import annotations

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
    Role.MAINTAINER: _DRIVING | {"system"},
    Role.SAFETY: _DRIVING,
    Role.ADMIN: _DRIVING | {"system", "people"},
}


def rights(role: Role) -> frozenset[str]:
    """Those of ``drive``, ``reset``, ``system`` (restart, reboot, update) and ``people`` that the role has."""
    return _RIGHTS[role]
