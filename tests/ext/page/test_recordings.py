"""Recordings as the server offers them to pages: over HTTP, read in another process, and only read."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import av
import httpx
import pytest

from pebble.errors import PebbleError
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.roles import Role
from pebble.extensions.page.recordings import archive_process, routes
from pebble.extensions.recordings.seek import questions
from pebble.extensions.recordings.traffic.index import index_path
from tests.ext.page import failing_jobs
from tests.ext.page.served import Served
from tests.ext.recordings.playing import GOOB, ms
from tests.ext.recordings.seek.filming import film
from tests.support import Broker, gone, until

SECONDS = 40
DAY = "2023-11-14"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return film(tmp_path_factory.mktemp("recordings"), "h264", SECONDS)


@pytest.fixture(scope="module")
def archive(broker: Broker, folder: Path) -> Iterator[Served]:
    """A server with recordings; the process that reads them ends with it."""
    with Served(broker.port, recordings=folder) as running:
        yield running
        pids = running.app.state.recordings.process.pids
    assert until(lambda: all(map(gone, pids)), 5)


def get(served: Served, path: str, **parameters: Any) -> httpx.Response:
    return httpx.get(f"{served.origin}/archive/{path}", params=parameters, timeout=30)


def post(served: Served, path: str, body: Any) -> httpx.Response:
    return httpx.post(f"{served.origin}/archive/{path}", json=body, headers={"origin": served.origin}, timeout=30)


def test_days_and_their_robots(archive: Served) -> None:
    (day,) = get(archive, "days").json()
    assert (day["day"], day["robots"], day["gaps"]) == (DAY, [GOOB], 0)
    assert (day["first"], day["last"]) == (ms(0), ms(SECONDS - 0.02))


def test_a_timeline_that_failed_stays_so_until_a_person_tries_again_and_is_indexed_once(
    archive: Served, folder: Path
) -> None:
    pytest.importorskip("duckdb")
    Path(archive.app.state.recordings.scratch).rmdir()  # as systems do with what is temporary
    for path in folder.rglob("*.mcap"):
        index_path(path).mkdir()
    asked = partial(get, archive, "timeline", day=DAY, robot=GOOB)

    def ended() -> httpx.Response:
        answers = [asked()]
        while answers[-1].status_code == 202:
            time.sleep(0.1)
            answers.append(asked())
        return answers[-1]

    failed = [(answer.status_code, answer.text) for answer in (ended(), asked(), asked())]
    assert [(code, "Is a directory; move it away" in text) for code, text in failed] == 3 * [(422, True)]
    for path in folder.rglob("*.parquet"):
        path.rmdir()
    assert asked().status_code == 422
    assert until(lambda: asked(again=1).status_code == 202)  # once the process of the job that failed has ended
    found = ended().json()
    assert found["from"] == ms(0) // 10_000 * 10_000
    assert found["step"] == 10_000
    online, driven, pictures, sound = 1, 2, 64, 128
    assert [step & (online | driven | pictures | sound) for step in found["activity"]] == [
        online | driven | pictures | sound
    ] * len(found["activity"])
    assert len(found["activity"]) == 4
    assert [round(one["until"] - one["since"]) // 1000 for one in found["sessions"]] == [SECONDS + 10]
    assert len(list(folder.rglob("*.parquet"))) == 2
    began = time.monotonic()
    assert asked().status_code == 200
    assert time.monotonic() - began < 2.0


def test_a_stretch_is_exported_and_fetched(archive: Served, tmp_path: Path) -> None:
    answer = post(archive, "exports", {"robot": GOOB, "since": ms(5), "until": ms(15), "as": "mkv"})
    assert answer.status_code == 202, answer.text
    place = f"exports/{answer.json()['id']}"
    assert until(lambda: get(archive, place).json()["state"] != "running", 60, step=0.1)
    state = get(archive, place).json()
    assert (state["state"], state["why"], state["done"]) == ("ready", "", pytest.approx(1.0, abs=0.02))
    fetched = get(archive, f"{place}/file")
    assert "goob-20231114T221325Z.mkv" in fetched.headers["content-disposition"]
    assert len(fetched.content) == state["bytes"]
    target = tmp_path / "x.mkv"
    target.write_bytes(fetched.content)
    assert av.open(str(target)).duration / 1e6 == pytest.approx(10, abs=0.2)
    assert post(archive, f"{place}/end", {}).status_code == 200
    assert get(archive, place).status_code == 404


def test_one_export_at_a_time_it_can_be_ended_and_one_that_failed_has_a_reason(
    archive: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = {"robot": GOOB, "since": ms(0), "until": ms(SECONDS), "as": "mp4"}
    first = post(archive, "exports", wanted).json()["id"]
    assert post(archive, "exports", wanted).status_code == 409
    post(archive, f"exports/{first}/end", {})
    with monkeypatch.context() as patched:
        patched.setattr(questions, "export_job", failing_jobs.ended)
        second = post(archive, "exports", wanted)
    assert second.status_code == 202
    place = f"exports/{second.json()['id']}"
    assert until(lambda: get(archive, place).json()["state"] != "running", 30, step=0.1)
    shown = get(archive, place).json()
    assert (shown["state"], shown["why"]) == ("failed", "its process has ended (3): the log of the server says why")
    third = post(archive, "exports", wanted)
    assert third.status_code == 202
    post(archive, f"exports/{third.json()['id']}/end", {})


@pytest.mark.parametrize(
    ("parameters", "line"),
    [
        ({"robot": "goob", "day": DAY}, 'robot: "goob" is none: write system/type/id'),
        ({"robot": "a/b/#", "day": DAY}, 'robot: "a/b/#" is none'),
        ({"robot": GOOB, "day": "../../etc"}, 'day: "../../etc" is none: write 2026-11-20'),
    ],
)
def test_a_bad_question_gets_one_line(archive: Served, parameters: dict[str, Any], line: str) -> None:
    answer = get(archive, "timeline", **parameters)
    assert answer.status_code == 400
    assert line in answer.text
    assert "\n" not in answer.text


def test_without_a_folder_and_without_a_session(broker: Broker, folder: Path, tmp_path: Path) -> None:
    with Served(broker.port) as plain:
        answer = get(plain, "days")
        assert (answer.status_code, answer.text) == (
            404,
            "this server has no recordings: start it with --recordings DIR",
        )
        with plain.page() as page:
            assert page.welcome["recordings"] is False
    people = People(tmp_path / "people.sqlite")
    people.add("ann", "a long password", Role.VIEWER)
    people.close()
    with Served(broker.port, recordings=folder, login=True, people=tmp_path / "people.sqlite") as closed:
        paths = [route.path.replace("{id}", "1") for route in routes.routes() if "POST" not in (route.methods or ())]
        assert {httpx.get(closed.origin + path).status_code for path in paths} == {401}
        assert post(closed, "exports", {}).status_code == 401


def test_the_process_that_reads_is_replaced_if_it_dies(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "multiprocessing.py").write_text("raise SystemExit('of the folder that it was started in')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)

    async def run() -> None:
        process = archive_process.ArchiveProcess(folder)
        first = await process.ask(os.getpid)
        assert process.pids == [first]
        os.kill(first, signal.SIGKILL)
        with pytest.raises(PebbleError, match="the process that reads recordings has ended: try again"):
            await process.ask(os.getpid)
        assert await process.ask(os.getpid) != first
        process.close()

    asyncio.run(run())


# -- jobs that fail


def whys(functions: Iterable[Callable[..., None]]) -> list[str]:
    """Why jobs failed, each in a process of its own."""

    async def run() -> list[str]:
        jobs = [archive_process.Job(function) for function in functions]
        while any(job.running for job in jobs):
            await asyncio.sleep(0.02)
        return [job.why for job in jobs]

    return asyncio.run(run())


def test_a_job_that_is_killed_or_gives_no_sign_of_life_has_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    killed = "its process was killed, as it is where memory runs out: end other programs, or choose less"
    assert whys([failing_jobs.killed]) == [killed]
    monkeypatch.setattr(archive_process, "SILENT_S", 1.0)
    silent = "it did nothing for 1 s and was ended: look at the disk, then try again"
    assert whys([failing_jobs.silent, failing_jobs.stopped]) == [silent, silent]
