"""Access to the server: which requests are accepted, and who has logged in."""
