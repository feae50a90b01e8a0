"""What `umfeld demo` says beside the address of its page."""

from __future__ import annotations

import sys
from pathlib import Path

from service.commands import demo
from service.processes import Family


def told_of(folder: Path, script: str) -> list[str]:
    """What is told within a second, of a daemon that is this script."""
    told: list[str] = []
    with Family(folder) as family:
        family.start("run", [sys.executable, "-c", f"{script}; import time; time.sleep(60)"])
        demo._watch(family, 2.0, tell=told.append)
    return told


def test_a_page_that_stays_empty_while_kernels_are_compiled_is_explained_once(tmp_path: Path) -> None:
    (line,) = told_of(tmp_path, f"print('INFO service.warm_up: {demo.COMPILING}, as after', flush=True)")
    assert "about a minute" in line
    assert told_of(tmp_path, "print('the map goes on', flush=True)") == []


def test_warm_up_still_says_so_in_these_words() -> None:
    assert demo.COMPILING in (Path(demo.__file__).parents[1] / "warm_up.py").read_text()
