"""Carries messages in datagrams between the programs of one machine: the five methods that a transport supplies.

It stores no retained messages and publishes no wills; docs/transports.md numbers what a robot's transport promises.
A package offers it as a kind by an entry point: mykind = "transport:Datagrams".
"""

import socket
import threading
from contextlib import suppress

from pebble.transports import Message, Subscription, Transport, clock

HERE = "127.0.0.1"


class Datagrams(Transport):
    """A client whose settings are a multicast address and a port, such as ("239.1.2.3", 7000)."""

    def __init__(self, client_id: str, settings: tuple[str, int], *, will: Message | None = None) -> None:
        super().__init__(client_id, will=will)
        self._group = settings
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def _open(self, timeout: float) -> None:
        here = socket.inet_aton(HERE)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, here)
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(self._group[0]) + here)
        self._socket.bind(self._group)
        threading.Thread(target=self._receive, daemon=True).start()
        self._renew()  # its subscriptions now belong to a new connection; before the first message is offered
        self._initial_sync(())  # (): no other end stores any, so all retained messages are sent; then it is CONNECTED

    def _close(self, will: Message | None) -> None:
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RD)  # ends the receiving thread
        self._socket.close()

    def _send(self, message: Message, urgent: bool) -> bool:
        try:
            self._socket.sendto(b"\0".join((message.topic.encode(), message.payload)), self._group)
        except OSError:
            return False
        return True

    def _declare(self, subscription: Subscription) -> None:
        """Do nothing: every datagram arrives here anyway."""

    def _undeclare(self, subscription: Subscription) -> None:
        """Do nothing, as _declare."""

    def _receive(self) -> None:
        while data := self._socket.recv(65_535):
            topic, _, payload = data.partition(b"\0")
            message = Message(topic.decode(), payload, waiting_since=clock.since_boot())
            self.count_received()
            for subscription in self._subscriptions.matching(message.topic):
                subscription.offer(message)
