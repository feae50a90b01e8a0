"""What gives no echo frees nothing behind the walls: an emulated Hokuyo's bytes, its driver, fusion and maps.

With `no_echo = "clear"`, its default, a laser that says "nothing there" is believed up to the line between the echoes
beside it (mapping/no_echo.py). The room is square, with the robot in its middle.
"""

from __future__ import annotations

import numpy as np
import pytest

from bench.fault_ledger import robot
from bench.fault_rig import HALF_ROOM_M, Rig
from mapping.sectors.snapshot import SectorState

SCANS_S = 0.6
FARTHEST_M = HALF_ROOM_M * 1.5  # a corner of the room


@pytest.mark.parametrize("model", ["urg-04lx", "utm-30lx"])
@pytest.mark.parametrize(
    "sector", [(-12, 12), (-40, 5), (30, 80), (-80, 80), (95, 135), (-135, -60)], ids=lambda s: f"{s[0]}..{s[1]}"
)
def test_behind_what_is_silent_nothing_becomes_free(model: str, sector: tuple[int, int]) -> None:
    table = robot("front", lasers={"front": {"driver": "hokuyo", "port": "/dev/ttyUSB0"}})
    with Rig(table, model=model) as rig:
        assert rig.run_until(lambda: rig.is_running("front") and len(rig.free_cells()) > 1000, 12.0)
        rig.begin(f"laser:glass=1(from_deg={sector[0]},to_deg={sector[1]})")
        since_ns = rig.now_ns
        rig.run(SCANS_S)
        scans = rig.readings("front", since_ns)
        assert any(np.isposinf(scan.range_m).sum() > 20 for scan in scans), "the laser says that it sees nothing"
        assert [cell for cell in rig.free_cells() if not rig.is_in_room(cell)] == []
        told = [out.snapshot for stamp_ns, out in rig.maps if stamp_ns > since_ns]
        assert told
        for snapshot in told:
            free_m = snapshot.distance_m[snapshot.state == SectorState.FREE]
            assert (free_m <= FARTHEST_M).all()
