"""Bytes on the wire: what the encoders of pictures and sound make, without sending it."""
