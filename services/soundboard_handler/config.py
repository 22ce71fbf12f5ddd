"""The config section of sounds."""

from typing import Annotated, ClassVar

from msgspec.structs import replace

from pebble.config import Config
from pebble.config.types import COMMAND, ONE_VALUE, Command, File, Section, ServiceSection, doc
from pebble.contract import SOUNDBOARD_COMMAND, SOUNDBOARD_FILES, SOUNDBOARD_STATUS
from pebble.contract.capabilities import CapabilitiesValue
from pebble.extensions.media.config import HandlerTopics


class Playback(Section, frozen=True, kw_only=True):
    """Sounds and their player. Sounds that are no wav files are decoded, and played by the audio receiver's player."""

    retired: ClassVar = {
        **dict.fromkeys(("stop_timeout", "scan_interval"), ONE_VALUE),
        **dict.fromkeys(("cwd", "env"), COMMAND),
        "volume": "clips are played as recorded: set the loudspeaker's volume, or the player's",
    }

    directory: Annotated[File | None, doc("Folder of the sounds; unset: `~/sounds`.")] = None
    player_command: Annotated[Command, doc("Plays wav files; `{file}` stands for the sound, else it comes last.")] = (
        "aplay",
    )


class SoundboardHandler(ServiceSection, frozen=True, kw_only=True):
    """Plays sounds on the robot."""

    topics: Annotated[HandlerTopics, doc("Other names for topics.")] = HandlerTopics()
    playback: Annotated[Playback, doc("Sounds and player.")] = Playback()


def offers(config: Config, value: CapabilitiesValue) -> CapabilitiesValue:
    """Return ``value`` with the robot's sounds."""
    from pebble.extensions.media.offers import files_offer  # only the launcher needs it

    enabled = config.section(SoundboardHandler).enabled
    sounds = files_offer(config, SOUNDBOARD_COMMAND, SOUNDBOARD_FILES, SOUNDBOARD_STATUS, enabled)
    return replace(value, soundboard=sounds)
