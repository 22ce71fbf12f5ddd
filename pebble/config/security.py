"""The config section of who may do what."""

from typing import Annotated, Literal

from pebble.config.types import Section, doc


class Security(Section, frozen=True, kw_only=True):
    """Who may drive the robot; see docs/control.md."""

    level: Annotated[
        Literal["open", "login", "named"],
        doc("`open`: whoever may publish at the broker. `login`: with a login there. `named`: with a checked name."),
    ] = "open"
    strangers: Annotated[
        Literal["drive", "free", "refuse"] | None,
        doc("Drive commands without a key of control: obeyed, only while nobody has control, or never. "
            "Unset: `drive`, at `named` `refuse`."),
    ] = None  # fmt: skip

    @property
    def unnamed(self) -> Literal["drive", "free", "refuse"]:
        """What becomes of drive commands without a key of control."""
        return self.strangers or ("refuse" if self.level == "named" else "drive")

    @property
    def named(self) -> bool:
        """Whether the names of senders are checked."""
        return self.level == "named"
