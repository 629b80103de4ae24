"""Memory that a server frees goes back to the system."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

# Count the heaps of glibc while six threads hold memory.
PROGRAM = """
import ctypes, sys, threading
from bevviz.support.freed_memory import return_freed_memory

if sys.argv[1] == "returned":
    return_freed_memory()
library = ctypes.CDLL(None)
library.malloc.restype, library.fopen.restype = ctypes.c_void_p, ctypes.c_void_p
everybody = threading.Barrier(6)

def hold():
    library.malloc(100_000)
    everybody.wait()

threads = [threading.Thread(target=hold) for _ in range(6)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
output = ctypes.c_void_p(library.fopen(b"/dev/stdout", b"w"))
library.malloc_info(0, output)
library.fclose(output)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library stays as it is")
def test_threads_share_two_heaps() -> None:
    def heaps(how: str) -> int:
        command = [sys.executable, "-c", PROGRAM, how]
        return subprocess.run(command, capture_output=True, check=True, text=True).stdout.count("<heap nr=")

    assert heaps("kept") == 7
    assert heaps("returned") == 2


# Print by how much the bytes in mappings of their own, mallinfo2's fifth number, grow with a buffer of 3 MB.
MAPPED = """
import ctypes
from bevviz.support.freed_memory import return_freed_memory

class Counts(ctypes.Structure):
    _fields_ = [(f"n{number}", ctypes.c_size_t) for number in range(10)]

library = ctypes.CDLL(None)
library.mallinfo2.restype = Counts
return_freed_memory()
bytearray(30_000_000)  # By default glibc raises its threshold when a mapping is freed.
before = library.mallinfo2().n4
kept = bytearray(3_000_000)
print(library.mallinfo2().n4 - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library stays as it is")
def test_large_buffers_leave_no_gaps_in_the_heap() -> None:
    command = [sys.executable, "-c", MAPPED]
    assert int(subprocess.run(command, capture_output=True, check=True, text=True).stdout) >= 3_000_000
