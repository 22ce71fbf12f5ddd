"""MicroPython's tls, as far as the sample uses it."""

PROTOCOL_TLS_CLIENT, CERT_REQUIRED = 0, 2


class SSLContext:
    def __init__(self, protocol):
        self.verify_mode, self._ca = 0, ""

    def load_verify_locations(self, ca):
        self._ca = ca

    def wrap_socket(self, socket, server_hostname):
        socket.dial(self._ca)
        return socket
