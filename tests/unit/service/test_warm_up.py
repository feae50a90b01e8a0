"""Kernels ready before the first reading, with a cold cache and a warm one, each in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

_TRY = """
import json, logging, sys
from service import warm_up
from service.config import Config
logging.basicConfig(level=logging.INFO)
config, stop, told = Config.model_validate(json.loads(sys.argv[1])), sys.argv[2] == "stop", []
try:
    with warm_up._compilations() as compiled:
        warm_up.warm_up(config, stop_asked=lambda: stop, meanwhile=told.append)
except warm_up.StoppedWhileCompiling:
    print(json.dumps("stopped"))
else:
    pages = next(line for line in open("/proc/self/status") if line.startswith("RssAnon"))
    print(json.dumps({"compiled": len(compiled), "told": told, "mb": int(pages.split()[1]) / 1e3}))
"""
_SMALL = {"lines": {"enabled": False}, "scenes": {"enabled": False}, "grid": {"enabled": False}}


def _warm_up(cache: Path, *, stop: bool = False) -> tuple[object, str]:
    """What came of it, and what was logged."""
    ran = subprocess.run(
        [sys.executable, "-c", _TRY, json.dumps(_SMALL), "stop" if stop else "go"],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)}, capture_output=True, text=True, timeout=800, check=True,
    )  # fmt: skip
    return json.loads(ran.stdout.splitlines()[-1]), ran.stderr


def test_a_cold_cache_is_filled_by_others_and_a_warm_one_is_only_read(tmp_path: Path) -> None:
    cold, log = _warm_up(tmp_path)
    assert isinstance(cold, dict)
    assert cold["compiled"] == 1, "the first kernel told that the cache is cold, and was left to others, too"
    assert any("parts begun" in text for text in cold["told"])
    assert "kernels compiled in" in log
    warm, log = _warm_up(tmp_path)
    assert isinstance(warm, dict)
    assert (warm["compiled"], warm["told"]) == (0, [])
    assert "compil" not in log
    assert cold["mb"] < warm["mb"] + 15, "nothing was compiled here, so that no compiler stays in memory"


def test_compiling_ends_when_stopping_is_asked_for(tmp_path: Path) -> None:
    outcome, log = _warm_up(tmp_path, stop=True)
    assert outcome == "stopped"
    assert "kernels compiled" not in log


def test_what_logs_need_is_known_by_name_and_ready_afterwards() -> None:
    """In a process of its own."""
    script = """
from service import warm_up
warm_up.warm_up_for_logs()
with warm_up._compilations() as compiled:
    warm_up.warm_up_for_logs()
print(len(compiled))
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=800, check=True)
    assert ran.stdout.strip() == "0"
