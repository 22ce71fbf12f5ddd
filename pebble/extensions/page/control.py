"""The control socket of one page: its commands, and the states that it is sent."""

import asyncio
import secrets
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec
from msgspec.structs import replace
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from pebble.extensions.fleet.database import DatabaseError
from pebble.extensions.fleet.roles import Session, page_rights
from pebble.extensions.operator.client.drive_reasons import WORDS, person
from pebble.extensions.operator.client.robot_estop import Reset
from pebble.extensions.page import messages as m
from pebble.extensions.page import robot_commands
from pebble.extensions.page.access.login import address_of, named, printable
from pebble.extensions.page.drive.driven_robot import Tab
from pebble.extensions.page.log_lines import LogReader
from pebble.extensions.page.pace import STOP_WAITS_S, Pace
from pebble.extensions.page.page_clock import PING_S, ClockJumpError
from pebble.extensions.page.robots import Interest
from pebble.extensions.page.server import Server, encode
from pebble.transports import Message
from pebble.transports.clock import since_boot as clock

FLUSH_S = 0.05  # between two states
HELLO_S = 5.0  # to begin with
CHECK_S = 5.0  # between two looks at whether the session still exists, while no person and no session changes
_WATCH_COST = 20  # of opening a component's page, as requests: it subscribes to so many topics
_WAITING = 64  # messages that wait to be sent, besides the state
_NOT_NOTED = ("op", "ref", "n", "config")  # settings of a script may be secret

_decoder = msgspec.json.Decoder(m.FromPage)


class Leave(Exception):  # noqa: N818 - not an error
    """An exception: the server ends the connection; the page may connect again."""


class Control:
    """An accepted connection with a session; ``serve`` returns at its end."""

    def __init__(
        self, server: Server, websocket: WebSocket, session: Session, check: Callable[[], Session | None]
    ) -> None:
        """Store the connection. ``check`` returns the present session; None: it was revoked."""
        self._server, self._websocket, self._session, self._check = server, websocket, session, check
        self._tab = Tab(secrets.token_urlsafe(12), session.user, "")
        self._wake = asyncio.Event()  # there is something to send
        self._interest = Interest(self._wake.set)
        self._pace = Pace(time.monotonic())
        self._waiting: deque[m.ToPage] = deque(maxlen=_WAITING)
        self._why_not = ""  # why this page may not drive at all
        self._logs = LogReader()
        self._may_send_large = False  # the page has received the last large value
        self._moved: set[str] = set()  # robots moved since this page has control, for the audit

    async def serve(self) -> None:
        """Serve until the page or the server ends the connection; then the motion that the page caused is stopped."""
        sender: asyncio.Task[None] | None = None
        try:
            self._begin(await asyncio.wait_for(self._receive(), HELLO_S))
            sender = asyncio.ensure_future(self._send_all())
            while not sender.done():
                op = await self._receive()
                await self._wait_for_pace(op)
                try:
                    self._handle(op)
                except DatabaseError as error:
                    self._refuse(op, f"The server cannot store this: {error.why}")
        except (Leave, ClockJumpError) as error:
            await self._leave(str(error))
        except TimeoutError:
            await self._leave("no hello")
        except (WebSocketDisconnect, RuntimeError):
            pass  # the page has gone
        finally:
            try:
                self._end()
            finally:
                if sender is not None:
                    sender.cancel()
                    await asyncio.gather(sender, return_exceptions=True)

    async def _wait_for_pace(self, op: Any) -> None:
        """Wait before a request of a page that has sent too many; a stop waits hardly at all."""
        wait_s = self._pace.take(_WATCH_COST if isinstance(op, m.Watch) else 1, time.monotonic())
        if isinstance(op, m.EstopOp | m.StopOp):
            wait_s = min(wait_s, STOP_WAITS_S)
        if wait_s:
            await asyncio.sleep(wait_s)

    # -- begin and end

    def _begin(self, hello: Any) -> None:
        """Answer the page's first message, restore its control, and let it be sent all states."""
        if not isinstance(hello, m.Hello):
            raise Leave("the first message must be hello")
        server, settings = self._server, self._server.settings
        self._tab.device = printable(hello.device)
        if not settings.login:
            self._session = named(self._session, hello.name)
            self._tab.user = self._session.user
        drives = settings.plain_http_drive or self._is_secure()
        version = self._websocket.app.state.version
        if not drives:
            self._why_not = WORDS["plain"]
        elif hello.version != version:
            self._why_not = WORDS["reload"]
        self._post(
            m.Welcome(
                server=settings.name,
                version=version,
                user=self._session.user,
                role=self._session.role,
                rights=tuple(sorted(self._rights())),
                named_rights=tuple(sorted(page_rights(self._session.role, "named"))),
                login=settings.login,
                token=self._tab.token,
                now=1000 * time.time(),
                drives=drives,
                words=WORDS,
                recordings=settings.recordings is not None,
            )
        )
        if "drive" in self._rights():
            server.drivers.restore(hello.token, self._tab)
        server.robots.join(self._interest)
        self._interest.dirty |= {(ref, "web/driver") for ref in server.robots.components}  # `join` leaves these out
        self._post(self._ping())

    def _end(self) -> None:
        self._server.robots.leave(self._interest)
        try:
            self._server.drivers.closed(self._tab)
        finally:
            if self._interest.watched:
                self._server.unwatch(self._interest.watched)

    async def _leave(self, why: str) -> None:
        self._end_control()
        with suppress(WebSocketDisconnect, RuntimeError):  # it has gone already
            await self._websocket.send_text(encode(m.Bye(why=why, again=True)))
            await self._websocket.close(4000)

    def _end_control(self) -> None:
        self._server.drivers.closed(self._tab, for_good=True)

    def _is_secure(self) -> bool:
        client = self._websocket.client
        return self._websocket.url.scheme == "wss" or (client is not None and client.host in ("127.0.0.1", "::1"))

    # -- from the page

    async def _receive(self) -> Any:
        text = await self._receive_text()
        try:
            return _decoder.decode(text)
        except (msgspec.MsgspecError, RecursionError) as error:
            raise Leave(f"not understood: {error}"[:200]) from None

    async def _receive_text(self) -> str:
        message = await self._websocket.receive()
        if message["type"] != "websocket.receive":
            raise WebSocketDisconnect
        text = message.get("text")
        if text is None:
            raise Leave("messages on this connection are text")
        if len(text) > m.MAX_OP_BYTES:
            raise Leave(f"a message is longer than {m.MAX_OP_BYTES} characters")
        return str(text)

    def _handle(self, op: Any) -> None:
        match op:
            case m.Echo():
                self._tab.clock.echo(op.n, op.t, clock())
                self._logs.echoed()
                self._may_send_large = True
            case m.DriveOp():
                self._drive(op)
            case m.StopOp():
                self._server.drivers.stop(op.ref, self._session.user)
            case m.EstopOp():
                self._server.stop(op.ref, op.stop, self._session, self._tab.device, op.why, self._address())
            case m.EstopEndOp():
                self._end_stop(op)
            case m.EstopResetOp():
                self._reset(op)
            case m.Watch():
                self._watch(op.ref)
            case m.ReadLogs():
                if op.ref == self._interest.watched:
                    self._logs.begin(op.origin, op.after, on=op.on)
            case m.Lease():
                self._control(op)
            case m.PictureFromOp():
                if self._may("drive", op):
                    self._server.choose_picture(op.ref, op.source)
            case m.BoardOp():
                self._board(op)
            case m.Hello():
                raise Leave("hello comes only once")
            case _:
                self._command(op)
        self._wake.set()

    def _command(self, op: m.RobotOp) -> None:
        """Publish a command to a robot, once. It is not repeated; the robot's states show its effect."""
        if not self._may(robot_commands.right(op), op):
            return
        why_not = self._why_not if robot_commands.moves(op) else ""  # which forbids driving alone
        if why := why_not or self._server.drivers.refusals.of_op(op):
            self._refuse(op, why)
            return
        if not self._publish(op, robot_commands.publication(op, self._server.robots.capabilities(op.ref))):
            self._refuse(op, "The server cannot reach the broker")
            return
        self._post(m.Done(cmd=_tag(op), ref=op.ref, n=op.n))
        self._audit(_tag(op), op.ref, detail=_detail(op))

    def _publish(self, op: m.RobotOp, message: Message) -> bool:
        """Publish a command, or keep lights for the next drive command; return False if it was not accepted."""
        if isinstance(op, m.LightsOp):
            channel = robot_commands.channel_for(op)
            if self._server.drivers.accompany(self._tab, op.ref, channel, message):
                return True
        return self._server.broker.publish(
            message.topic,
            message.payload,
            retain=message.retain,
            remember=False,
            qos=message.qos,
            by=self._session.user,
        )

    def _drive(self, op: m.DriveOp) -> None:
        if not self._may("drive", op):
            return
        server = self._server
        if op.ref not in server.robots.components:
            self._refuse(op, "unknown component")
            return
        moves, why = server.drivers.drive(self._tab, op, self._why_not)
        if why:
            self._refuse(op, why)
        elif moves and op.ref not in self._moved:
            self._moved.add(op.ref)
            self._audit("drive", op.ref)

    def _end_stop(self, op: m.EstopEndOp) -> None:
        """End a stop of this person or, for a person who may reset, any stop: a viewer must not end another's."""
        user = self._server.stops.user(op.stop)
        if user is not None and (user == self._session.user or self._may("reset", op)):
            self._server.stops.end(op.stop)

    def _reset(self, op: m.EstopResetOp) -> None:
        """Publish a reset of the stops that the page has shown to the person, although newer ones may be known here."""
        robot = self._server.robots.view(op.ref)
        if not self._may("reset", op) or robot is None:
            return
        reset = Reset(robot.estop, self._session.user)
        newest = reset.shown  # by owner: the stops that are known here
        reset.shown = {}  # and those that are reset: the same, with boot and count as the page has shown them
        for shown in op.owners:
            if shown.owner in newest:
                reset.shown[shown.owner] = replace(newest[shown.owner], boot=shown.boot, count=shown.count)
        for message in reset.messages():
            self._server.broker.publish(message.topic, message.payload, qos=message.qos)
        self._audit("reset", op.ref)

    def _board(self, op: m.BoardOp) -> None:
        """Allow or end the driving of a board that does not say what it can do, or clear its retained command."""
        if not self._may("drive" if op.do == "clear" else "system", op):  # to clear changes no permission
            return
        if why := self._server.boards.ask(op, self._session.user):
            self._refuse(op, why)
            return
        self._post(m.Done(cmd=_tag(op), ref=op.ref, n=op.n))
        self._audit(f"{op.do} driving", op.ref)

    def _watch(self, ref: str) -> None:
        """Note that the page has opened this component in place of another; "": it has none open."""
        before = self._interest.watched
        if ref == before:
            return
        self._server.robots.watch(self._interest, ref)
        self._logs.end()
        if ref:
            self._server.watch(ref)
        if before:
            self._server.unwatch(before)

    def _control(self, op: m.Lease) -> None:
        """Request control of a robot for this page, or release it."""
        server = self._server
        self._moved.discard(op.ref)  # the audit notes the next motion again
        if not op.take:
            if server.drivers.release(self._tab, op.ref):
                self._audit("release", op.ref)
            return
        robot, driven = server.robots.view(op.ref), server.drivers.robot(op.ref)
        # To take over a robot that itself decides who drives it needs a right of its own. Where only this server
        # decides, all pages that may drive may take control from each other.
        right = "take" if op.over and driven.keeps_control else "drive"
        if not self._may(right, op):
            return
        if self._why_not or robot is None:
            self._refuse(op, self._why_not or "unknown component")
            return

        def granted() -> None:
            self._audit("take over" if op.over else "take", op.ref)

        state = driven.published  # of control, by the robot itself
        is_held = state is not None and state.id != ""
        if is_held and not op.over:  # the holder may go on: so the request is noted as well as its success
            self._audit("ask", op.ref)
        server.drivers.take(self._tab, robot, granted, lambda why: self._refuse(op, why), over=op.over)

    def _rights(self, ref: str = "") -> frozenset[str]:
        return page_rights(self._session.role, self._server.level(ref))

    def _may(self, right: str, op: m.FromPage) -> bool:
        if right in self._rights(getattr(op, "ref", "")):
            return True
        self._refuse(op, f"The role {self._session.role} may not do this")
        return False

    def _refuse(self, op: m.FromPage, why: str) -> None:
        g = op.g if isinstance(op, m.DriveOp) else -1  # lights have a g, too
        self._post(m.Refused(cmd=_tag(op), ref=getattr(op, "ref", ""), why=why, g=g, n=getattr(op, "n", 0)))

    def _audit(self, what: str, ref: str, detail: str = "") -> None:
        session, device, address = self._session, self._tab.device, self._address()
        self._server.audit.write(what, ref=ref, user=session.user, device=device, address=address, detail=detail)

    def _address(self) -> str:
        return address_of(self._websocket)

    # -- to the page

    def _post(self, message: m.ToPage) -> None:
        self._waiting.append(message)
        self._wake.set()

    async def _send_all(self) -> None:
        """Send changed states at most every 50 ms, and pings twice a second."""
        ping_at, check_at = time.monotonic() + PING_S, time.monotonic() + CHECK_S
        checked_version = self._server.people_version
        while self._websocket.application_state is WebSocketState.CONNECTED:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), max(0.0, min(ping_at, check_at) - time.monotonic()))
            self._wake.clear()
            now = time.monotonic()
            if now >= ping_at:
                ping_at = now + PING_S
                self._waiting.append(self._ping())
            if now >= check_at or checked_version != self._server.people_version:
                check_at, checked_version = now + CHECK_S, self._server.people_version
                await self._check_session()
            await self._flush(now)
            await asyncio.sleep(FLUSH_S if not self._waiting else 0)

    async def _flush(self, now: float) -> None:
        """Send the waiting messages, then the changed states, then log lines."""
        while self._waiting:
            await self._websocket.send_text(encode(self._waiting.popleft()))
        # Each page is shown the driver in another way, so the table of robots does not have this value.
        driven = [ref for ref, metric in self._interest.dirty if metric == "web/driver"]
        self._interest.dirty -= {(ref, "web/driver") for ref in driven}
        changed, has_large = self._server.robots.take(self._interest, now, large=self._may_send_large)
        if has_large:
            self._may_send_large = False
        if self._interest.more:
            self._wake.set()
        values = changed + tuple((ref, "web/driver", self._driver(ref), 0.0) for ref in driven)  # 0.0: their age
        removed, self._interest.gone = tuple(self._interest.gone), set()
        if values or removed:
            await self._websocket.send_text(encode(m.State(now=1000 * time.time(), set=values, gone=removed)))
        await self._send_logs()

    def _driver(self, ref: str) -> m.DriverView:
        """Return the robot's driver as this page shows it; a user without a login is described in words."""
        view, login = self._server.drivers.robot(ref).shown(self._tab, clock()), self._server.settings.login
        by = person(view.by, login=login)
        device = view.device if by == view.by else ""  # the words say it already
        return replace(view, by=by, device=device, asks=person(view.asks, login=login))

    async def _send_logs(self) -> None:
        """Send the next part of the log, once the page has answered a ping.

        So on a slow connection at most one part is ahead of the next ping, and delays it.
        """
        ref = self._interest.watched
        log = self._server.robots.logs.get(ref)
        if log is not None and (run := self._logs.take(log)) is not None:
            message = m.Logs(ref=ref, origin=log.origin, first=run.first, lines=run.lines)
            await self._websocket.send_text(encode(message))

    async def _check_session(self) -> None:
        session = await asyncio.to_thread(self._check)
        if session is None or session.role != self._session.role:
            self._end_control()
            await self._websocket.send_text(encode(m.Bye(why="logged out", again=False)))
            await self._websocket.close(4001)

    def _ping(self) -> m.Ping:
        round_trip = self._tab.clock.shown_round_trip_s
        number = self._tab.clock.ping(clock())
        return m.Ping(n=number, now=1000 * time.time(), round_trip_ms=-1 if round_trip is None else 1000 * round_trip)


def _tag(op: m.FromPage) -> str:
    return str(op.__struct_config__.tag)


def _detail(op: m.RobotOp) -> str:
    if isinstance(op, m.LightsOp):  # not each colour of a slider
        return "off" if robot_commands.ends(op) else "on"
    fields = msgspec.to_builtins(op)
    return ", ".join(f"{key} {value}" for key, value in fields.items() if key not in _NOT_NOTED)[:200]
