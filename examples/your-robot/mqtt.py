"""A client of MQTT 3.1.1, as far as a robot in MicroPython needs it.

``open`` waits for the network, for seconds: halt the motors before it. After that only ``messages`` waits, for the
given time; what the network does not accept at once is sent in the next round. (Some boards, such as the Pico W, wait
up to half a second in a write while the network accepts nothing.)
"""

import json
import select
import socket
import struct
import time

from mqtt_packets import CONNACK, CONNECT, LONGEST, PINGREQ, PUBACK, PUBLISH, SUBSCRIBE, Reader, message, packet, text

KEEPALIVE_S = 5
CLEAN_SESSION = 0x02  # else the broker stores commands for later
WILL = 0x2C  # with QoS 1, retained
LOGIN = 0xC0


class Mqtt:
    """A connection to a broker. Sending and receiving raise OSError once it has ended: open it again then."""

    def __init__(self, host, port, client_id, login, will):
        """``login``: user, password and the certificate of the broker's authority; (): without, and without TLS.

        ``will``: topic and text of a message that the broker publishes, retained, when the connection is lost.
        """
        self.address = (host, port)
        self.authority = login[2] if login else None
        flags = CLEAN_SESSION | WILL | (LOGIN if login else 0)
        self.hello = text("MQTT") + bytes((4, flags, 0, KEEPALIVE_S)) + text(client_id) + text(will[0]) + text(will[1])
        if login:
            self.hello += text(login[0]) + text(login[1])
        self.number = 0  # of the newest packet with QoS 1
        self.socket = None
        self.close()

    def close(self):
        if self.socket:
            self.socket.close()
        self.socket = None
        self.reader = Reader()
        self.unsent = b""

    def open(self):
        self.close()
        self.socket = socket.socket()
        self.socket.settimeout(2)
        self.socket.connect(socket.getaddrinfo(*self.address)[0][-1])
        if self.authority:
            import tls

            context = tls.SSLContext(tls.PROTOCOL_TLS_CLIENT)
            context.verify_mode = tls.CERT_REQUIRED
            context.load_verify_locations(self.authority)
            self.socket = context.wrap_socket(self.socket, server_hostname=self.address[0])
        self.socket.setblocking(False)
        self.poller = select.poll()
        self.poller.register(self.socket, select.POLLIN)
        self.received_at = self.pinged_at = time.ticks_ms()
        self.send(CONNECT, self.hello)
        answer = []
        while not answer:
            self.exchange(20)
            answer = list(self.reader.packets())
        first, content = answer[0]
        if first != CONNACK or content[1] != 0:
            raise OSError("the broker refuses the connection")

    def send(self, first, content):
        self.unsent += packet(first, content)

    def subscribe(self, topic):
        self.send(SUBSCRIBE, b"\x00\x01" + text(topic) + b"\x01")

    def publish(self, topic, value, qos):
        """Publish JSON, retained."""
        self.number = self.number % 65535 + 1
        number = struct.pack("!H", self.number) if qos else b""
        self.send(PUBLISH | qos << 1 | 1, text(topic) + number + json.dumps(value).encode())

    def exchange(self, wait_ms):
        """Send waiting bytes, and read what arrives within ``wait_ms``."""
        if not self.socket:
            raise OSError("there is no connection")
        if self.unsent:
            self.unsent = self.unsent[self.socket.write(self.unsent) or 0 :]
        for _ in self.poller.poll(wait_ms):
            more = self.socket.read(LONGEST)  # None: of what TLS needs, only a part is there
            if more == b"":
                raise OSError("the broker has closed the connection")
            self.reader.add(more or b"")
            self.received_at = time.ticks_ms()
        if time.ticks_diff(time.ticks_ms(), self.received_at) > 1000 * KEEPALIVE_S:
            raise OSError("the broker is silent")
        # After 0.4 * KEEPALIVE_S, here in ms: two pings are sent before silence ends the connection.
        if time.ticks_diff(time.ticks_ms(), self.pinged_at) > 400 * KEEPALIVE_S:
            self.pinged_at = time.ticks_ms()
            self.send(PINGREQ, b"")

    def messages(self, wait_ms):
        """Wait up to ``wait_ms``; yield topic, payload and the retain flag of each message that has arrived."""
        self.exchange(wait_ms)
        for first, content in self.reader.packets():
            if first & 0xF0 == PUBLISH:
                topic, number, payload = message(first, content)
                if number:
                    self.send(PUBACK, number)  # also of a message that was cut: else the broker sends no more
                yield topic, payload, bool(first & 1)
