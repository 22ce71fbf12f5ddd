"""Offers pictures and sound at GStreamer's local sockets, for programs that read them with ``shmsrc``."""
