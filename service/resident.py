"""What start-up touched and running does not need is given back: code of libraries that only compiled or loaded.

Loading kernels walks through most of LLVM: some 70 MB of its code stay resident, to no use, and 16 MB of its tables.
Such pages are clean copies of the file; dropped, those that are needed again come back from the page cache, a fault
each.

What maps that grow leave behind in the heap stays with the process as well, unless it is told otherwise: glibc takes
ever larger blocks from the heap once it has seen one freed, and a thread each gets a heap of its own. A flat mapped for
seven minutes took 350 MB so, 85 of them free.
"""

from __future__ import annotations

import ctypes
import re
import resource
from pathlib import Path

_LEAST_BYTES = 1 << 20
_MADV_DONTNEED = 4
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # as in malloc.h
_OWN_MAPPING_BYTES = 256 * 1024
_HEAPS = 4
_RANGE = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) (\S{4}) \S+ \S+ \d+ +(/.*)$")


def give_back_code(least_bytes: int = _LEAST_BYTES) -> int:
    """Drop the resident pages of large, unwritten code and constants of files; how many bytes were resident there.

    0 where the system does not tell its mappings.
    """
    try:
        lines = Path("/proc/self/smaps").read_text().splitlines()
        advise = ctypes.CDLL(None, use_errno=True).madvise
    except (OSError, AttributeError):
        return 0
    advise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    given = 0
    for start, stop, fields in _code_of_files(lines):
        is_clean = fields["Private_Dirty"] == 0 and fields["Shared_Dirty"] == 0
        if stop - start >= least_bytes and is_clean and advise(start, stop - start, _MADV_DONTNEED) == 0:
            given += fields["Rss"] * 1024
    return given


def keep_heap_small() -> bool:
    """Blocks from 256 KB on get mappings of their own, which go when they are freed, and few heaps are made.

    Before threads begin. Whether the C library can; on others nothing happens.
    """
    try:
        tune = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(tune(_M_MMAP_THRESHOLD, _OWN_MAPPING_BYTES)) and bool(tune(_M_ARENA_MAX, _HEAPS))


def give_back_heap() -> None:
    """Return freed memory to the system, where the C library can; else nothing happens."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return
    trim(0)


def peak_bytes() -> int:
    """The most memory this program had resident since it began.

    Not what getrusage says where /proc tells better: that counts what the program which started this one had."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _code_of_files(lines: list[str]) -> list[tuple[int, int, dict[str, int]]]:
    """Private mappings of files that nobody may write to: start, stop, and their figures in kB."""
    found: list[tuple[int, int, dict[str, int]]] = []
    wanted = False
    for line in lines:
        if line.endswith(" kB"):  # nine of ten lines, and most of them of others
            if wanted:
                name, _, rest = line.partition(":")
                found[-1][2][name] = int(rest.split()[0])
        else:
            head = _RANGE.match(line)
            wanted = head is not None and head[3] in ("r-xp", "r--p")
            if head is not None and wanted:
                found.append((int(head[1], 16), int(head[2], 16), {}))
    return found
