"""Hardware that is not there: robots run, and are tested, without any."""
