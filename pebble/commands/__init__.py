"""The commands of ``pebble``: one module per group, imported only when its command is asked for.

A module's ``register(app)`` adds its command. What is heavy (rich, a client library) is imported where it is used.
"""
