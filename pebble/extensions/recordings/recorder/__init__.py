"""The recorder: from a connection to files."""
