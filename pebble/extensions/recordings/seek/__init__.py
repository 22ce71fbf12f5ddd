"""Random access to recordings: messages of a time, the state before it, pictures, days."""
