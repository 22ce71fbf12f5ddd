"""Messages between two services, and between two machines: one-way times and round trips."""
