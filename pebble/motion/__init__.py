"""The decisions about moving and stopping a robot. The files are those of the boards' firmware: MicroPython as well.

Their links lead to ``firmware/common``, so a rule that is changed there changes on boards and on Linux robots.
"""
