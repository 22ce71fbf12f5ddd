"""The decisions about moving and stopping a robot, shared with the boards: plain MicroPython.

The files are links to ``firmware/common``, so a changed rule changes on boards and on Linux robots.
"""
