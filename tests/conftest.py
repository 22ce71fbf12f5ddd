"""What holds for every test."""

import signal

# Started in the background of a shell or by nohup, this process ignores signals, and so would every program it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
