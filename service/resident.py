"""What start-up touched and running does not need is given back: code of libraries that only compiled or loaded.

Loading kernels walks through most of LLVM: some 70 MB of its code stay resident, to no use, and 16 MB of its tables.
Such pages are clean copies of the file; dropped, those that are needed again come back from the page cache, a fault
each.
"""

from __future__ import annotations

import ctypes
import re
import resource
from pathlib import Path

_LEAST_BYTES = 1 << 20
_MADV_DONTNEED = 4
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
        if head := _RANGE.match(line):
            wanted = head[3] in ("r-xp", "r--p")
            if wanted:
                found.append((int(head[1], 16), int(head[2], 16), {}))
        elif re.match(r"^[0-9a-f]+-[0-9a-f]+ ", line):
            wanted = False
        elif wanted and line.endswith(" kB"):
            name, _, rest = line.partition(":")
            found[-1][2][name] = int(rest.split()[0])
    return found
