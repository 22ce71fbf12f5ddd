"""What the page of one robot is set to, and what of it this machine can serve."""
