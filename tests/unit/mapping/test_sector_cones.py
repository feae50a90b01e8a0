"""What a sonar says of the sectors, in one compiled pass: against its parts, put together one after the other."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.kernels import sectors as kernels
from mapping.sectors.footprint import Outline
from mapping.sectors.inputs import echo_and_free, see_cone
from mapping.sectors.polar import _points, _Wedges, sector_edges

F64 = NDArray[np.float64]
BODY = np.array([[0.45, 0.30], [-0.45, 0.30], [-0.45, -0.30], [0.45, -0.30]])
WIDTH = math.radians(5.0)
EDGES = sector_edges(start_rad=math.radians(-120.0), stop_rad=math.radians(120.0), sector_rad=WIDTH)


def part_by_part(
    frame: _Wedges, pose: Pose2, cone_rad: float, range_m: float, range_min_m: float, range_max_m: float
) -> tuple[F64, F64, F64, NDArray[np.bool_]]:
    """The last: sectors with a corner on the border of the cone, or in its tip, which may be judged either way."""
    sight, arc, off_axis = see_cone(
        range_m, cone_rad=cone_rad, range_min_m=range_min_m, range_max_m=range_max_m, free_share=0.5,
        virtual_from_transducer=pose,
    )  # fmt: skip
    nearest, at = kernels.arc_in_sectors(np.ascontiguousarray(arc), off_axis, EDGES, WIDTH, 5.0)
    free = frame.free(sight)
    unsure = np.zeros(len(free), dtype=bool)
    for sector in range(len(free)):
        corners = _points(np.full(2, free[sector]), EDGES[sector : sector + 2])
        seen = pose.inverse().apply(corners)
        off = np.abs(np.arctan2(seen[:, 1], seen[:, 0])) - 0.5 * cone_rad
        unsure[sector] = (np.abs(off) < 1e-6).any() or (np.hypot(seen[:, 0], seen[:, 1]) < 1e-6).any()
        if (off > 1e-9).any():
            free[sector] = 0.0
    return nearest, at, free, unsure


@given(
    st.one_of(st.just((0.0, 0.0)), st.tuples(st.floats(-0.6, 0.6), st.floats(-0.4, 0.4))),
    st.floats(-math.pi, math.pi),
    st.sampled_from([math.radians(30.0), math.radians(60.0), math.radians(210.0)]),
    st.one_of(st.floats(0.0, 4.0), st.sampled_from([math.inf, -math.inf, 0.2, 3.0])),
    st.sampled_from([0.0, 0.2]),
    st.booleans(),
)
@settings(max_examples=200, deadline=None)
def test_one_pass_says_what_its_parts_say(
    place: tuple[float, float], yaw_rad: float, cone_rad: float, range_m: float, range_min_m: float, has_body: bool
) -> None:
    frame = _Wedges(EDGES, WIDTH, 5.0, Outline(BODY if has_body else None, Pose2()))
    pose = Pose2(*place, yaw_rad)
    *wanted, unsure = part_by_part(frame, pose, cone_rad, range_m, range_min_m, 3.0)
    echo_m, free_m = echo_and_free(range_m, range_min_m, 3.0, 0.5)
    found = frame.of_cone(pose, cone_rad, echo_m, free_m, range_min_m)
    for name, ours, theirs in zip(("nearest", "at", "free"), found, wanted):
        sure = ~unsure if name == "free" else slice(None)
        np.testing.assert_allclose(ours[sure], theirs[sure], rtol=0.0, atol=1e-12, err_msg=name)
