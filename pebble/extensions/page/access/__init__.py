"""Who gets to the server: which requests are looked at, how many connections there are, and who has logged in."""
