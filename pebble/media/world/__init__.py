"""A simulated world as data: its file, where its robots are, and what their cameras see."""
