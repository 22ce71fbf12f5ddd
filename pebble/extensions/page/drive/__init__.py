"""Driving from one server: the pages that have control, those that ask for it, and why it is refused."""
