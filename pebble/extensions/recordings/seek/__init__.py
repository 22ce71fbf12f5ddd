"""Random access to recordings: messages of a period, the state before it, pictures, days."""
