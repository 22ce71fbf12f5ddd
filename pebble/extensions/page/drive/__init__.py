"""Driving by the pages of one server: who has control, who asks for it, and why driving is refused."""
