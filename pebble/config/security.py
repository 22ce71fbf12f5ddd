"""The config section of who may do what: how strictly names and roles are checked."""

from typing import Annotated, Literal

from pebble.config.types import Section, doc

SecurityLevel = Literal["open", "login", "named"]
Strangers = Literal["drive", "free", "refuse"]


class Security(Section, frozen=True, kw_only=True):
    """Who may do what to this robot; `docs/fleet.md` explains the levels."""

    level: Annotated[
        SecurityLevel,
        doc(
            "`open`: whoever reaches the broker may do everything. `login`: the broker asks for a name and knows its "
            "roles, so every connection beyond loopback must be encrypted and log in. `named`: the name is in the "
            "topics, too, and the robot checks who has control."
        ),
    ] = "open"
    strangers: Annotated[
        Strangers | None,
        doc(
            "Drive commands of those who do not have control: `drive`, they move the robot; `free`, as long as nobody "
            "has control; `refuse`, never. Unset: `refuse` at level `named`, else `drive`."
        ),
    ] = None

    @property
    def admits(self) -> Strangers:
        """``strangers``, or what it is where it is not set."""
        return self.strangers or ("refuse" if self.level == "named" else "drive")
