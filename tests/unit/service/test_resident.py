"""Code that is not needed any more leaves the memory, and comes back when it is."""

from __future__ import annotations

import subprocess
import sys

import pytest

from service.resident import _code_of_files

_TRY = """
import numba, numpy as np
from service.resident import give_back_code
def resident():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1]) * 1024
@numba.njit
def total(x):
    s = 0.0
    for v in x:
        s += v * v
    return s
x = np.arange(1000.0)
before = total(x)
full = resident()
given = give_back_code()
left = resident()
matrix = np.random.default_rng(1).random((200, 200))
assert total(x) == before
assert np.allclose(np.linalg.inv(matrix) @ matrix, np.eye(200))
@numba.njit
def again(x):  # the compiler still works, too
    return x.sum() + 1.0
assert again(x) == x.sum() + 1.0
assert give_back_code(1 << 60) == 0
print(given, full - left)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells its mappings")
def test_the_compiler_is_given_back_and_everything_goes_on() -> None:
    ran = subprocess.run([sys.executable, "-c", _TRY], capture_output=True, text=True, timeout=300, check=True)
    given, less = map(int, ran.stdout.split())
    assert given > 20e6
    assert less > 0.7 * given


def test_only_code_and_constants_of_files_are_looked_at() -> None:
    lines = [
        "00400000-00500000 r-xp 00000000 08:01 42 /usr/lib/libx y.so",
        "Rss:                 512 kB",
        "Private_Dirty:         0 kB",
        "VmFlags: rd ex mr mw me",
        "00500000-00580000 r--p 00000000 08:01 42 /usr/lib/libx y.so",
        "Rss:                 200 kB",
        "00580000-00600000 rw-p 00000000 08:01 42 /usr/lib/libx y.so",
        "Rss:                 100 kB",
        "00600000-00700000 r-xp 00000000 00:00 0 [vdso]",
        "Rss:                   4 kB",
        "00700000-00800000 r-xp 00000000 00:00 0",
        "Rss:                   8 kB",
    ]
    assert _code_of_files(lines) == [
        (0x400000, 0x500000, {"Rss": 512, "Private_Dirty": 0}),
        (0x500000, 0x580000, {"Rss": 200}),
    ]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells its peak apart from that of the program before")
def test_the_peak_is_this_programs_own() -> None:
    large = "x = bytearray(400 << 20); import subprocess, sys; "
    own = "import service.resident as r; print(r.peak_bytes() >> 20)"
    run = f"subprocess.run([sys.executable, '-c', {own!r}], check=True)"
    mebibytes = int(subprocess.run([sys.executable, "-c", large + run], capture_output=True, check=True).stdout)
    assert 5 < mebibytes < 200  # an interpreter, not the 400 of its parent


_GROW = """
import sys
import numpy as np
from service.resident import keep_heap_small
def resident():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1]) / 1024
if sys.argv[1] == "small":
    assert keep_heap_small()
np.ones(3_000_000)  # a large block that was freed: others come from the heap from now on
before = resident()
pins = []
for size in range(1, 60):  # an array that grows, and little things that stay between
    grown = np.ones(size * 8192)
    pins.append(np.ones(200))
del grown
print(round(resident() - before))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's heap")
def test_what_grew_leaves_no_holes_in_the_heap() -> None:
    def megabytes_left(how: str) -> int:
        ran = subprocess.run(
            [sys.executable, "-c", _GROW, how], capture_output=True, text=True, timeout=300, check=True
        )
        return int(ran.stdout)

    assert megabytes_left("as it is") > 10  # what is mended, where it is not
    assert megabytes_left("small") < 3
