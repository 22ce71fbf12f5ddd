"""The network of this machine in place of Wi-Fi."""

STA_IF = 0


class WLAN:
    def __init__(self, interface):
        pass

    def active(self, is_on):
        pass

    def connect(self, name, password):
        pass
