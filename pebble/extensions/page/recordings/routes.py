"""The routes of recordings: days, timelines, films. They send nothing to a robot."""

from __future__ import annotations

import math
import secrets
import tempfile
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta, Struct
from starlette.requests import HTTPConnection, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from pebble.contract.identity import Identity
from pebble.errors import PebbleError
from pebble.extensions.page.access import login
from pebble.extensions.page.recordings.archive_process import ArchiveProcess, BusyError, Job
from pebble.extensions.page.recordings.viewers import Viewers
from pebble.extensions.recordings.seek import questions
from pebble.transports.clock import since_boot as clock

_NONE: Final = "this server has no recordings: start it with --recordings DIR"
_LONGEST_EXPORT_MS: Final = 3_600_000.0
_ACTIVE_S: Final = 30.0  # a timeline of files that are being written is made anew after this time
_TIMELINES: Final = 16  # that are remembered
_LATEST_MS: Final = 9.0e12  # in the year 2255

_Ref = Annotated[str, Meta(max_length=200)]


class ExportRequest(Struct, frozen=True, rename={"form": "as"}):
    """The body of POST /archive/exports; times in epoch milliseconds."""

    robot: _Ref
    since: float
    until: float
    form: Literal["mkv", "mp4", "mcap"]


_export_decoder = msgspec.json.Decoder(ExportRequest)


@dataclass(slots=True)
class _Timeline:
    """A timeline and the job that makes it."""

    paths: list[str]  # of its recordings
    active: bool  # one of them was still being written
    target: Path
    job: Job
    began_at: float  # seconds since the machine was started
    json_text: bytes | None = None  # while the job runs, that of an earlier job

    def newest(self) -> bytes | None:
        """Return the timeline as JSON, if this or an earlier job has made it."""
        if self.job.ready and self.target.exists():
            self.json_text = self.target.read_bytes()
            self.target.unlink()
        return self.json_text


@dataclass(slots=True)
class _Export:
    """The running or finished export; there is at most one."""

    id: str
    name: str
    target: Path
    job: Job


class BadQuestionError(PebbleError):
    """An error: a parameter is missing or invalid. Example: ``at: a number of milliseconds is needed``."""


class Recordings:
    """A folder of recordings at one server. Used on the event loop only."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process = ArchiveProcess(folder)
        self.viewers = Viewers(folder)
        self._scratch = tempfile.TemporaryDirectory(prefix="pebble-replay-")
        self._timelines: dict[tuple[str, str], _Timeline] = {}  # by day and robot, the last used at the end
        self._export: _Export | None = None

    @property
    def scratch(self) -> Path:
        """Return the folder in which jobs write."""
        return Path(self._scratch.name)

    async def close(self) -> None:
        self.process.close()
        for timeline in self._timelines.values():
            await timeline.job.end()
        await self.end_export()
        self._scratch.cleanup()

    async def timeline(self, day: str, robot: str, *, again: bool = False) -> bytes | float:
        """Return the timeline as JSON or, while none is made yet, the finished share of the work. Raises PebbleError.

        After a failure it is made again only with ``again``, or if the day has other recordings by now.
        """
        key, period = (day, robot), _period_of(day)
        paths, active = await self.process.ask(questions.files, robot, *period)
        timeline = self._timelines.pop(key, None)
        if timeline is None or self._is_old(timeline, paths, active=active, again=again):
            earlier = None if timeline is None else timeline.newest()
            timeline = self._begin(robot, period, paths, active=active, earlier=earlier)
        self._timelines[key] = timeline  # at the end: the first ones are forgotten
        await self._forget()
        if timeline.job.why:
            raise PebbleError(timeline.job.why)
        json_text = timeline.newest()
        return timeline.job.done if json_text is None else json_text

    async def export(self, wanted: ExportRequest) -> str:
        """Start an export; return its id. Raises PebbleError, and BusyError while another one runs."""
        if self._export is not None and self._export.job.running:
            raise BusyError("another export runs: wait for it, or end it")
        if not 0 <= wanted.since < wanted.until <= wanted.since + _LONGEST_EXPORT_MS:
            raise BadQuestionError("an export is of at most one hour, and ends after it begins")
        period = round(wanted.since * 1e6), round(wanted.until * 1e6)
        paths, _ = await self.process.ask(questions.files, wanted.robot, *period)
        if not paths:
            raise PebbleError(f"nothing is recorded of {wanted.robot} in this time")
        await self.end_export()
        number = secrets.token_hex(8)
        target = self._target(f"{number}.{wanted.form}")
        job = Job(questions.export_job, paths, target, wanted.robot, period, wanted.form)
        began = datetime.fromtimestamp(wanted.since / 1000, UTC).strftime("%Y%m%dT%H%M%SZ")
        name = f"{wanted.robot.rpartition('/')[2]}-{began}.{wanted.form}"
        self._export = _Export(number, name, target, job)
        return number

    def export_of(self, number: str) -> _Export | None:
        return self._export if self._export is not None and self._export.id == number else None

    async def end_export(self) -> None:
        export, self._export = self._export, None
        if export is not None:
            await export.job.end()
            export.target.unlink(missing_ok=True)

    def _begin(
        self, robot: str, period: tuple[int, int], paths: list[str], *, active: bool, earlier: bytes | None
    ) -> _Timeline:
        target = self._target(f"{secrets.token_hex(8)}.json")
        job = Job(questions.make_timeline_job, paths, target, robot, period)
        return _Timeline(paths, active, target, job, clock(), earlier)

    def _target(self, name: str) -> Path:
        """Return the path for a job's result, in a new folder if the system has removed the old one."""
        try:
            self.scratch.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise PebbleError(questions.reason(error)) from None
        return self.scratch / name

    def _is_old(self, timeline: _Timeline, paths: list[str], *, active: bool, again: bool) -> bool:
        """True if the timeline must be made again from the present recordings.

        ``active``: one of them is still being written. ``again``: make it again after a failure.
        """
        if timeline.job.running:
            return False
        if timeline.job.why:
            return again or paths != timeline.paths
        changed = paths != timeline.paths or timeline.active or active  # active when it was made, or now
        return changed and clock() - timeline.began_at > _ACTIVE_S

    async def _forget(self) -> None:
        while len(self._timelines) > _TIMELINES:
            old = self._timelines.pop(next(iter(self._timelines)))
            await old.job.end()
            old.target.unlink(missing_ok=True)


def _period_of(day: str) -> tuple[int, int]:
    """Return the begin and end of a day in UTC, in epoch nanoseconds."""
    try:
        begin = datetime.strptime(day, "%Y-%m-%d").replace(tzinfo=UTC)
        end = begin + timedelta(days=1)
    except (ValueError, OverflowError):
        raise BadQuestionError(f'day: "{day[:20]}" is none: write 2026-11-20') from None
    return int(begin.timestamp()) * 10**9, int(end.timestamp()) * 10**9


# -- routes

_Answers = Callable[[Request, Recordings], Awaitable[Response]]


def routes() -> list[Route]:
    return [
        Route("/archive/days", _answered(_days)),
        Route("/archive/timeline", _answered(_timeline)),
        Route("/archive/exports", _answered(_begin_export), methods=["POST"]),
        Route("/archive/exports/{id}", _answered(_export)),
        Route("/archive/exports/{id}/file", _answered(_file)),
        Route("/archive/exports/{id}/end", _answered(_end_export), methods=["POST"]),
    ]


def _answered(answers: _Answers) -> Callable[[Request], Awaitable[Response]]:
    """Return a route that answers only with a session, and answers every error in one line."""

    async def endpoint(request: Request) -> Response:
        if login.session_of(request) is None:
            return PlainTextResponse("log in first", 401)
        recordings: Recordings | None = request.app.state.recordings
        if recordings is None:
            return PlainTextResponse(_NONE, 404)
        try:
            return await answers(request, recordings)
        except BadQuestionError as error:
            return PlainTextResponse(str(error), 400)
        except BusyError as error:
            return PlainTextResponse(str(error), 409)
        except PebbleError as error:
            return PlainTextResponse(str(error), 422)

    return endpoint


async def _days(_: Request, recordings: Recordings) -> Response:
    return _json(await recordings.process.ask(questions.days))


async def _timeline(request: Request, recordings: Recordings) -> Response:
    parameters = request.query_params
    result = await recordings.timeline(parameters.get("day", ""), _robot(request), again=parameters.get("again") == "1")
    return JSONResponse({"indexing": result}, 202) if isinstance(result, float) else _json(result)


async def _begin_export(request: Request, recordings: Recordings) -> Response:
    try:
        wanted = _export_decoder.decode(await request.body())
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadQuestionError(str(error)) from None
    number = await recordings.export(wanted)
    session = login.session_of(request)
    user = "" if session is None else session.user
    detail = f"{wanted.form}, {round((wanted.until - wanted.since) / 1000)} s from {round(wanted.since / 1000)}"
    audit = request.app.state.audit
    audit.write("export", ref=wanted.robot, user=user, address=login.address_of(request), detail=detail)
    return JSONResponse({"id": number}, 202)


async def _export(request: Request, recordings: Recordings) -> Response:
    export = recordings.export_of(request.path_params["id"])
    if export is None:
        return PlainTextResponse("there is no such export", 404)
    state = "ready" if export.job.ready else "failed"
    if export.job.running:
        state = "running"
    size = export.target.stat().st_size if state == "ready" else 0
    why = export.job.why or export.job.unread
    return JSONResponse({"state": state, "done": export.job.done, "why": why, "name": export.name, "bytes": size})


async def _file(request: Request, recordings: Recordings) -> Response:
    export = recordings.export_of(request.path_params["id"])
    if export is None or export.job.running or not export.job.ready:
        return PlainTextResponse("there is no such export, or it is not ready", 404)
    return FileResponse(export.target, filename=export.name, media_type="application/octet-stream")


async def _end_export(request: Request, recordings: Recordings) -> Response:
    if recordings.export_of(request.path_params["id"]) is None:
        return PlainTextResponse("there is no such export", 404)
    await recordings.end_export()
    return JSONResponse({})


def _json(data: bytes) -> Response:
    return Response(data, media_type="application/json")


def robot_and_time(connection: HTTPConnection) -> tuple[str, float]:
    """Return the robot and the time that a page asks for. Raises BadQuestionError."""
    robot = _robot(connection)
    try:
        at_ms = float(connection.query_params.get("at", ""))
    except ValueError:
        at_ms = math.nan
    if not 0 <= at_ms <= _LATEST_MS:
        raise BadQuestionError(f"at: a number from 0 to {_LATEST_MS:g} is needed")
    return robot, at_ms


def _robot(request: HTTPConnection) -> str:
    text = request.query_params.get("robot", "")
    levels = text.split("/")
    try:
        return Identity(*levels).base
    except (TypeError, ValueError, PebbleError):
        raise BadQuestionError(f'robot: "{text[:100]}" is none: write system/type/id') from None
