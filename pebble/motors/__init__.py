"""What stands between a command and the motors: its inbox, the latch and the arbiter, and the file that outlives us."""
