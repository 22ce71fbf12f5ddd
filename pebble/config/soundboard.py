"""The config section of the soundboard."""

from typing import Annotated

from msgspec import Meta

from pebble.config.types import EMPTY, Command, File, HandlerTopics, Seconds, Section, ServiceSection, Variables, doc


class Playback(Section, frozen=True, kw_only=True):
    """Where sounds are and what plays them; decoded ones are played by the audio receiver's command."""

    directory: Annotated[File | None, doc("Folder of the sounds; unset: `~/sounds`.")] = None
    player_command: Annotated[Command, doc("Plays wav files; `{file}` stands for the sound, else it comes last.")] = (
        "aplay",
    )
    stop_timeout: Annotated[Seconds, doc("How long the player may take to stop before it is killed.")] = 5.0
    scan_interval: Annotated[float, Meta(ge=1, le=86_400, description="Seconds between scans of the folder.")] = 10.0
    cwd: Annotated[File | None, doc("Folder to run the player in.")] = None
    env: Annotated[Variables, doc("Environment variables to add.")] = EMPTY
    volume: Annotated[float, Meta(ge=0, le=1, description="1: as recorded; less: wav files are decoded, too.")] = 1.0


class SoundboardHandler(ServiceSection, frozen=True, kw_only=True):
    """Plays sounds on the robot."""

    topics: Annotated[HandlerTopics, doc("Other names for topics.")] = HandlerTopics()
    playback: Annotated[Playback, doc("Sounds and player.")] = Playback()
