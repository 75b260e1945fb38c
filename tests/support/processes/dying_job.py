"""A job whose process dies, in a module that a new process loads at once."""

import os
import signal


def kill_own_process(path):
    """Die on a path that is not there yet, with the file made first; on 'always' every time."""
    if path.name == "always" or not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    print("libraries print what they like")
    return path.name, os.environ["OMP_NUM_THREADS"], os.getpid()
