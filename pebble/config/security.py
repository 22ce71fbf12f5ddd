"""The config section of security: how strictly names and roles are checked."""

from typing import Annotated, Literal

from pebble.config.types import EXACT, Section, doc

SecurityLevel = Literal["open", "login", "named"]
Strangers = Literal["drive", "free", "refuse"]


class Security(Section, frozen=True, kw_only=True):
    """Rules of who may do what to this robot; docs/ext/fleet.md explains the levels."""

    level: Annotated[
        SecurityLevel,
        EXACT,
        doc(
            "`open`: whoever may publish at the broker does everything. `login`: every connection beyond this machine "
            "is encrypted and logs in, and the broker knows roles. `named`: with a checked name in the topics, too."
        ),
    ] = "open"
    strangers: Annotated[
        Strangers | None,
        EXACT,
        doc(
            "Drive commands without a key of control: always obeyed, only while nobody has control, or never. "
            "Unset: `free`, at `named` `refuse`."
        ),
    ] = None

    @property
    def unnamed(self) -> Strangers:
        """Rule for drive commands without a key of control: ``strangers``, or else the default of the level."""
        return self.strangers or ("refuse" if self.level == "named" else "free")

    def on_board(self) -> dict[str, str]:
        """Return the section `security` of a board's private_config.json; empty if the board's default applies."""
        if self.level == "open" and self.unnamed == "free":
            return {}
        return {"level": self.level, "strangers": self.unnamed}

    @property
    def named(self) -> bool:
        """True if the names of senders are checked."""
        return self.level == "named"
