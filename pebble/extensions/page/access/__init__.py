"""Access to the server: which requests are looked at, and who has logged in."""
