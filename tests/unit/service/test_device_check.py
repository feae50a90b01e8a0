"""Opening every device: how long that may take."""

from __future__ import annotations

import time
from pathlib import Path

from service.config import load
from service.device_check import check_devices


def test_ports_that_are_not_there_are_not_waited_for(tmp_path: Path) -> None:
    file = tmp_path / "umfeld.toml"
    file.write_text(f'[lasers.front]\ndriver = "hokuyo"\nport = "{tmp_path}/none"\n[store]\nenabled = false\n')
    passed_s = 0.0

    def sleep(seconds: float) -> None:
        nonlocal passed_s
        passed_s += seconds
        time.sleep(seconds / 10.0)  # for the thread that tries the port

    (found,) = check_devices(
        load(file, environment={}).config, seconds=1000.0, now_ns=lambda: round(passed_s * 1e9), sleep=sleep
    )
    assert not found.is_well
    assert found.trouble
    assert passed_s < 900.0, "a second, or as long as it takes until the port is tried"
