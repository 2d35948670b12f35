"""The process in which the C loop of real_time.py runs: nothing but the standard library.

    python -I -S real_time_server.py LIBRARY MEMORY

It ends with the loop, whose result stands in the memory that it shares with the process that
started it.
"""

from __future__ import annotations

import ctypes
import mmap
import signal
import sys

if __name__ == "__main__":
    for _number in (signal.SIGINT, signal.SIGHUP):  # they are for whoever started it, who stops it
        signal.signal(_number, signal.SIG_IGN)
    with open(sys.argv[2], "r+b") as _file:
        _memory = mmap.mmap(_file.fileno(), 0)
    ctypes.CDLL(sys.argv[1]).pam_real_time((ctypes.c_char * len(_memory)).from_buffer(_memory))
