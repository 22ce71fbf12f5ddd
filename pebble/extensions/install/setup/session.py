"""A run of ``pebble setup``: it completes the answers, shows and does the steps, and says what to do next."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import typer
from rich.console import Console

from pebble.config.visible import shown
from pebble.extensions.checks.broker.login_attempt import attempt
from pebble.extensions.fleet import certificates
from pebble.extensions.install.setup import detect
from pebble.extensions.install.setup.answers import HERE, NONE, Answers, AnswersError, Secrets, read_file
from pebble.extensions.install.setup.questions import asked, say
from pebble.extensions.install.setup.restore import restore
from pebble.extensions.install.setup.robot_config import PAGE_PORT, answers_of
from pebble.extensions.install.setup.steps import Job, load_config
from pebble.extensions.install.setup.system import ROBOTS, System
from pebble.extensions.lab.demo.phone import show_qr
from pebble.extensions.operator.places import Places
from pebble.runtime.connections import REMOTE_RECONNECT_S, mqtt_settings

_SUDO = "sudo pebble setup"


def set_up(system: System, answers_file: Path | None, backup_file: Path | None) -> int:
    """Set up the machine from a backup, from a file of answers, or from a person's answers; return the exit code.

    Raises SetupError, and AnswersError before anything is written.
    """
    places = system.places
    system.owner(ROBOTS)  # raises at once if this is not root, or the user `pebble` is missing
    given, secrets = ({}, Secrets()) if answers_file is None else read_file(answers_file)
    if backup_file is not None:
        name = restore(system, backup_file, _agree)
        say(f"The files of {name} are in their places.")
    config = load_config(places)
    answers = Answers() if config is None else answers_of(config, places)
    job = Job(system, config, answers, secrets).with_answers(given)
    asks = answers_file is None and backup_file is None
    if asks:
        if not sys.stdin.isatty():
            raise AnswersError("standard input is no terminal, so nothing can be asked: --answers FILE")
        job = asked(job)
    job.require()
    steps = job.left()
    typer.echo(f"\nThis {'will be' if asks else 'is'} done:" if steps else "\nAll is so already.")
    for step in steps:
        say(step.what, 2)
    if asks and steps:
        typer.confirm("Go ahead?", default=True, abort=True)
    is_started = job.do(steps)
    failures = [*_failures(job, is_started=is_started)]
    for line in failures:
        say(f"Failed: {line}")
    for line in detect.lacks(places):
        say(f"Note: {line}")
    typer.echo("\nNext")
    for line in _next(job):
        say(line, 2)
    if _has_page(job):
        typer.echo()
        show_qr(_url(places), Console())
    return 1 if failures else 0


def _agree(lines: Sequence[str]) -> None:
    """Show the programs and files that a restored config names, and ask. Raises Abort."""
    say("The robot of this backup runs programs, or names what is not its own:")
    for line in lines:
        say(shown(line), 2)
    typer.confirm("Shall the robot have these?", default=False, abort=True)


def _failures(job: Job, *, is_started: bool) -> Iterator[str]:
    """Yield the problems that keep the robot from being driven. If it was started, its self-test runs, too."""
    places = job.places
    if not job.system.has_systemd:
        yield f"systemd does not run here, so nothing starts the robot: pebble up {places.config}"
    if job.answers.remote is not None and (why := _refusal(places)):
        yield f"the broker {job.answers.broker} does not let the robot in: {why}; the robot tries it again and again"
    if is_started:
        command = [sys.executable, "-Pm", "pebble", "doctor", str(places.config), "--running"]
        if code := subprocess.run(command, check=False).returncode:
            yield f"the self-test ended with {code}: pebble doctor {places.config} --running"


def _refusal(places: Places) -> str:
    """Return why the broker refuses the robot; empty if it accepts it."""
    config = load_config(places)
    assert config is not None  # noqa: S101 - it has just been written
    remote = config.services.mqtt_bridge.remote_mqtt
    return attempt(mqtt_settings(remote, reconnect_max_s=REMOTE_RECONNECT_S, program="setup"), login=True).refusal


def _has_page(job: Job) -> bool:
    """True if phones can open the page with the certificate that setup made."""
    return bool(job.answers.page) and (job.places.tls / certificates.SERVER_CERT).is_file()


def _next(job: Job) -> Iterator[str]:
    """Yield what the person may do next."""
    answers, places = job.answers, job.places
    if _has_page(job):
        url = _url(places)
        yield f"Open {url} on a phone, and log in{f' as {answers.user}' if answers.user else ''}."
        sha256 = certificates.show(places.tls / certificates.CA_CERT).sha256.replace(":", " ")
        yield f"The phone trusts the robot once it has {url}ca.pem; compare its SHA-256: {sha256}"
    if answers.broker == HERE:
        yield f"Accounts for others: sudo pebble fleet add NAME --role driver --folder {places.broker_folder}"
    if answers.broker == NONE:
        yield "The robot has no broker yet, so nobody can drive it."
    yield f"Another answer: {_SUDO} again. To remove the robot from this machine: sudo apt purge pebble-robot"


def _url(places: Places) -> str:
    names = certificates.show(places.tls / certificates.SERVER_CERT).names
    host = f"[{names[0]}]" if ":" in names[0] else names[0]
    return f"https://{host}:{PAGE_PORT}/"
