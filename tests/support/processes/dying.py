"""Jobs that end badly; they import nothing, as each is done in a new process."""

import os
import signal
import time


def crash(path):
    """End as a library does that writes where it must not."""
    os.kill(os.getpid(), signal.SIGSEGV)


def hang(path):
    """Take longer than any limit."""
    time.sleep(60.0)
