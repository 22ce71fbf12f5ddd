"""Who moves and who stops a robot. The files are those of the boards' firmware: they are MicroPython as well.

Their links lead to ``firmware/common``, so a rule that is changed there changes on boards and on Linux robots.
"""
