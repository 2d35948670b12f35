"""What processes of the bench do in tests; at the top of a module, so that they find it."""

import os
import subprocess
import sys
import time


def add(say, a, b=0):
    say(0.5, "half")
    return a + b


def whoami(say):
    return os.getpid()


def wait(say, seconds=60.0):
    say(None, str(os.getpid()))
    time.sleep(seconds)
    return os.getpid()


def with_child(say):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    say(None, str(child.pid))
    time.sleep(60)


def die(say):
    os._exit(3)


def refuse(say):
    from pam_ocp import InputError

    raise InputError("mass = -1 kg must be > 0 kg")


def fault(say):
    return 1 / 0


def no_plain_value(say):
    return lambda: 1


def endless_loop(say):
    while True:
        pass
