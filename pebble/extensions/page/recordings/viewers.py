"""The pages that show recordings. Each has a process that plays for it and ends with its socket."""

import asyncio
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from pebble.extensions.page import messages as m
from pebble.extensions.page.recordings import playing

MOST: Final = 8  # pages that replay at once
_decoder = msgspec.json.Decoder(m.FromReplay)


class Viewers:
    """All pages that show recordings of one folder. Used on the event loop only."""

    def __init__(self, folder: Path) -> None:
        self.processes: set[subprocess.Popen[bytes]] = set()
        self._folder = folder

    async def serve(self, websocket: WebSocket, ref: str, at_ms: float) -> None:
        """Play the recording of ``ref`` until the page closes the socket, or sends an invalid request."""
        if len(self.processes) >= MOST:
            await _close(websocket, f"{MOST} pages look at recordings already: close one, then reload")
            return
        ours, theirs = socket.socketpair()
        command = [sys.executable, "-Pm", playing.__name__, str(theirs.fileno()), str(self._folder), ref, str(at_ms)]
        try:
            with theirs:
                process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()])
        except OSError as error:
            ours.close()
            await _close(websocket, f"no process could be started: {error.strerror or error}")
            return
        self.processes.add(process)
        try:
            await _relay(websocket, ours)
        finally:
            process.kill()
            await asyncio.to_thread(process.wait)
            self.processes.discard(process)


async def _relay(websocket: WebSocket, link: socket.socket) -> None:
    """Pass messages on in both directions until one side ends."""
    reader, writer = await asyncio.open_unix_connection(sock=link)
    tasks = {asyncio.create_task(_send(websocket, reader)), asyncio.create_task(_receive(websocket, writer))}
    try:
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        await _close(websocket, next(iter(ended)).result())
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        writer.transport.abort()  # closes the link


async def _send(websocket: WebSocket, reader: asyncio.StreamReader) -> str:
    """Pass on the player's messages; return why they ended."""
    with suppress(WebSocketDisconnect, RuntimeError):
        try:
            while True:
                size, what = playing.HEAD.unpack(await reader.readexactly(playing.HEAD.size))
                data = await reader.readexactly(size)
                if what == playing.TEXT:
                    await websocket.send_text(data.decode())
                else:
                    await websocket.send_bytes(data)
        except (asyncio.IncompleteReadError, ConnectionError):
            return "the process that plays has ended: reload; the log of the server says why"
    return ""


async def _receive(websocket: WebSocket, writer: asyncio.StreamWriter) -> str:
    """Pass on the page's requests; return why one is refused, or "" once the page is gone."""
    while True:
        message = await websocket.receive()
        if message["type"] != "websocket.receive":
            return ""
        text = (message.get("text") or "").encode()
        try:
            _decoder.decode(text)
        except (msgspec.MsgspecError, RecursionError) as error:
            return f"a recording takes seek, play and speed only: {error}"[:200]
        writer.write(playing.HEAD.pack(len(text), playing.TEXT) + text)
        with suppress(ConnectionError):  # the process has ended, which is said where its messages end
            await writer.drain()


async def _close(websocket: WebSocket, why: str) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):  # it has gone already
        if why:
            await websocket.send_text(msgspec.json.encode(m.Bye(why=why, again=False)).decode())
        await websocket.close(4000)
