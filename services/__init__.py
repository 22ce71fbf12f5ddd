"""The programs a robot is made of: one process each, owning one thing each."""
