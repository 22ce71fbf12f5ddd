"""The recorder, which writes the messages of a connection into files."""
