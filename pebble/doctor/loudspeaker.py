"""Checks the loudspeaker by playing silence: once, and by two programs at the same time."""

import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from pebble.check_result import CheckResult
from pebble.config import Config
from pebble.doctor import ok, warn
from pebble.media.sound_file import write_wav
from pebble.services.soundboard_handler.playback import Players

SILENCE_S = 0.2
_END_S = 5.0  # for a player of so much silence to end
_RATE = 16_000
_WHAT = "loudspeaker"
_DMIX = "echo 'pcm.!default { type plug slave.pcm dmix }' | sudo tee -a /etc/asound.conf"


def loudspeaker(config: Config, silence_s: float = SILENCE_S) -> Iterator[CheckResult]:
    """No findings for a robot that plays neither sounds nor an operator's voice."""
    services, players = config.services, Players.of(config)
    talk_back = services.av_daemon.enabled and services.av_daemon.audio.enabled
    commands = [players.wav] * services.soundboard_handler.enabled + [players.raw] * talk_back
    names = dict.fromkeys(words[0] for words in commands)
    missing = [name for name in names if "/" not in name and shutil.which(name) is None]
    for name in missing:
        yield warn(_WHAT, f"{name} is not installed: nothing can be played", _installation(name))
    if commands and not missing:
        with tempfile.TemporaryDirectory(prefix="pebble-doctor-") as folder:
            wav = Path(folder) / "silence.wav"
            write_wav(wav, _silence(silence_s), _RATE)
            yield _played(players, wav if services.soundboard_handler.enabled else None, silence_s)


def _installation(name: str) -> str:
    return "sudo apt install alsa-utils" if name == "aplay" else f"install {name}, or name another player in the config"


def _played(players: Players, wav: Path | None, silence_s: float) -> CheckResult:
    """Two players at the same time; of ``wav``, or else of raw sound."""
    words = players.command(wav) if wav is not None else players.raw_command(_RATE, 1)
    running: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(2):
            running.append(_start(players, words, b"" if wav is not None else _silence(silence_s)))
        problems = [problem for process in running if (problem := _problem(process, silence_s))]
    except OSError as error:
        return warn(_WHAT, f"{words[0]} cannot be started: {error}", "correct the player's command")
    finally:
        for process in running:
            _end(process)
    name = Path(words[0]).name
    if not problems:
        return ok(_WHAT, f"{name} plays, for two programs at the same time, too")
    if len(problems) == 1:
        text = f"{name} plays for one program at a time ({problems[0]}): sounds and talk-back exclude each other"
        return warn(_WHAT, text, _DMIX)
    return warn(_WHAT, f"{name} cannot play: {problems[0]}", "aplay -l; is it in use by another program?")


def _start(players: Players, words: list[str], sound: bytes) -> subprocess.Popen[bytes]:
    with tempfile.TemporaryFile() as source:
        source.write(sound)
        source.seek(0)
        return players.started(words, source, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def _problem(process: subprocess.Popen[bytes], silence_s: float) -> str:
    """Why it did not play; empty if it did."""
    try:
        _, errors = process.communicate(timeout=silence_s + _END_S)
    except subprocess.TimeoutExpired:
        return f"did not end within {silence_s + _END_S:g} s"
    lines = errors.decode("utf-8", "replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), f"exit code {process.returncode}")
    return last if process.returncode != 0 else ""


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _silence(seconds: float) -> bytes:
    return bytes(2 * round(seconds * _RATE))
