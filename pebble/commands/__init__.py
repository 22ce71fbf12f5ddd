"""The commands of ``pebble``: one module per group, imported only when one of its commands runs.

A module's ``register(app)`` adds its commands. Heavy libraries (rich, MQTT, Zenoh) are imported where they
are used.
"""
