"""Kernels that were loaded from the cache take little memory, and others can still be built on them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

_KERNELS = """
from numba import njit

@njit(cache=True)
def half(x):
    return 0.5 * x

@njit(cache=True)
def below(x):
    return half(x) - 1.0

def built_on(x):
    return below(x) + half(x)
"""

_TRY = """
import sys
sys.path.insert(0, sys.argv[1])
if sys.argv[2] == "packed":
    from service.loaded_kernels import keep_loaded_kernels_packed
    keep_loaded_kernels_packed()
    keep_loaded_kernels_packed()  # again does nothing
import kernels
from numba import njit
assert kernels.below(4.0) == 1.0
(loaded,) = kernels.below.overloads.values()
hits = sum(kernels.below.stats.cache_hits.values())
has_form = loaded.library._shared_module is not None
assert njit(kernels.built_on)(4.0) == 3.0  # the linker gets the forms of both
print(hits, has_form, loaded.type_annotation != "")
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("kernels")
    (made / "kernels.py").write_text(_KERNELS)
    _run(made, "as numba has them")  # fills the cache
    return made


def _run(folder: Path, how: str) -> list[str]:
    """How often the cache was hit, whether the form and the print of the types were there."""
    ran = subprocess.run(
        [sys.executable, "-c", _TRY, str(folder), how], capture_output=True, text=True, timeout=300, check=True
    )
    return ran.stdout.split()


def test_what_is_loaded_keeps_no_tree_in_memory_and_is_linked_all_the_same(folder: Path) -> None:
    assert _run(folder, "as numba has them") == ["1", "True", "True"], "what is packed, as numba keeps it"
    assert _run(folder, "packed") == ["1", "False", "False"]


def test_what_is_compiled_here_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(_KERNELS)
    hits, _, has_print = _run(tmp_path, "packed")
    assert (hits, has_print) == ("0", "True")
