"""Captures camera and microphone while there are readers, for any number of them."""
