"""The XML-RPC of ROS 1: calls of a master or a node, bounded in time, and the API that every node has."""

from __future__ import annotations

import os
import threading
import time
import xmlrpc.client
from collections.abc import Callable
from contextlib import suppress
from http.client import HTTPConnection
from socket import SHUT_RDWR
from socketserver import ThreadingMixIn
from typing import Any, Protocol
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from pebble.services.ros1_bridge.wire import MOST_HEADER, RosError

CALL_S = 2.0  # longest wait of a call for the master or another node
_MOST_CALLS = 16  # calls of others that are answered at once; more are hung up on
_OLD_S = 2 * CALL_S  # a call of others that takes longer makes room for a new one


class _Timed(xmlrpc.client.Transport):
    """A transport of XML-RPC with a time limit."""

    def make_connection(self, host: Any) -> HTTPConnection:
        return HTTPConnection(self.get_host_info(host)[0], timeout=CALL_S)


def call(uri: str, method: str, *arguments: Any) -> Any:
    """Call a method of a ROS API; return the value in the answer. Raises RosError."""
    try:
        with xmlrpc.client.ServerProxy(uri, transport=_Timed()) as proxy:
            answer = getattr(proxy, method)(*arguments)
    except (OSError, xmlrpc.client.Error, ValueError, SyntaxError) as error:  # xml's errors are SyntaxErrors
        raise RosError(f"{uri} does not answer {method}: {error}") from error
    except Exception as error:  # another kind of server: its answer is no HTTP, or no XML
        raise RosError(f"{uri} does not answer {method}: {type(error).__name__}") from error
    if not isinstance(answer, (list, tuple)) or len(answer) != 3 or answer[0] != 1:
        raise RosError(f"{uri} answers {method} by {answer!r:.200}")
    return answer[2]


def lives(uri: str) -> bool:
    """True if a node answers at that address."""
    try:
        return call(uri, "getPid", "/pebble") is not None
    except RosError:
        return False


class _Handler(SimpleXMLRPCRequestHandler):
    rpc_paths = ()
    timeout = CALL_S

    def do_POST(self) -> None:  # noqa: N802 - the library's name
        length = self.headers.get("content-length", "")
        if not length.isdecimal() or int(length) > MOST_HEADER or "content-encoding" in self.headers:
            self.send_error(413)
            return
        super().do_POST()


class ApiServer(ThreadingMixIn, SimpleXMLRPCServer):
    """A server that answers a limited number of calls at once."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 16

    def __init__(self, host: str, on_refused: Callable[[], object]) -> None:
        super().__init__((host, 0), _Handler, logRequests=False, allow_none=True)
        self._on_refused = on_refused
        self._lock = threading.Lock()
        self._began: dict[Any, float] = {}  # the sockets of calls, the oldest first

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a call on a thread of its own. If there are too many, refuse it, and end the oldest if that one hangs.

        The next call then finds room: callers that hang do not keep others out.
        """
        now = time.monotonic()
        with self._lock:
            refused = len(self._began) >= _MOST_CALLS
            if refused:
                oldest, began = next(iter(self._began.items()))
                if now - began > _OLD_S:
                    with suppress(OSError):
                        oldest.shutdown(SHUT_RDWR)  # its thread ends by it
            else:
                self._began[request] = now
        if refused:
            self._on_refused()
            self.shutdown_request(request)
        else:
            super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._began.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log nothing: a caller may hang up at any time."""


class Answers(Protocol):
    """The node's answers to calls of its API."""

    master: str

    def publishers_are(self, topic: str, uris: list[str]) -> None: ...
    def address_of(self, topic: str) -> tuple[str, int] | None: ...
    def evict(self, why: str) -> None: ...
    def published(self) -> list[list[str]]: ...
    def subscribed(self) -> list[list[str]]: ...


def serve(node: Answers, host: str, on_refused: Callable[[], object]) -> ApiServer:
    """Return a server of the API of ``node``, on a free port of ``host``, not yet running.

    Each answer has the form of ROS: 1 (0: it failed), a message for people, and the value.
    """
    server = ApiServer(host, on_refused)

    def publisher_update(_caller: str, topic: str, uris: list[str]) -> list[Any]:
        node.publishers_are(str(topic), [str(uri) for uri in uris])
        return [1, "", 0]

    def request_topic(_caller: str, topic: str, protocols: list[Any]) -> list[Any]:
        address = node.address_of(str(topic))
        if address is None or not any(protocol and protocol[0] == "TCPROS" for protocol in protocols):
            return [0, "it does not publish this topic over TCPROS", []]
        return [1, "", ["TCPROS", *address]]

    def shutdown(_caller: str, why: str = "") -> list[Any]:
        node.evict(str(why))
        return [1, "", 0]

    api: dict[str, Any] = {
        "publisherUpdate": publisher_update,
        "requestTopic": request_topic,
        "shutdown": shutdown,
        "getPid": lambda _caller: [1, "", os.getpid()],
        "getMasterUri": lambda _caller: [1, "", node.master],
        "getPublications": lambda _caller: [1, "", node.published()],
        "getSubscriptions": lambda _caller: [1, "", node.subscribed()],
        "getBusStats": lambda _caller: [1, "", [[], [], []]],
        "getBusInfo": lambda _caller: [1, "", []],
        "paramUpdate": lambda _caller, _key, _value: [1, "", 0],
    }
    for name, function in api.items():
        server.register_function(function, name)
    return server
