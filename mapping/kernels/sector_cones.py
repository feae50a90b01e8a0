"""What one sonar says of the sectors of a polar map, in one compiled pass (S35); see mapping.kernels.sectors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from mapping.kernels.sectors import arc_in_sectors, free_from_origin, free_reach, in_star, star_border

SAME_PLACE_M = 1e-9
EDGE_RAD = 1e-9


@njit(cache=True)
def cone_in_sectors(
    x: float, y: float, yaw: float, half: float, free_m: float, near_m: float, echo_m: float, lo: Any, hi: Any,
    ahead: Any, off_axis: Any, cos_off: Any, sin_off: Any, edges: Any, width: float, range_max: float, border: Any,
    begins: Any, body: Any, reach: float,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """Nearest obstacle, its bearing and up to where all is free, (N,) each; inf, NaN and 0 where there is nothing.

    x, y, yaw: the transducer, virtual sensor frame.  half: of its opening angle.  free_m: how far its cone is free.
    near_m: how far its whole front is, 0 if it is not.  echo_m: where the echo came from, inf if there was none.
    lo, hi, ahead: (M,) thin sectors of the cone (ahead) and of the front.  off_axis, cos_off, sin_off: (K,) directions
    along the arc of an echo.  border, begins: (N,) and (N, 2) where the vehicle's outline ends in each sector, at most
    and at its middle.  body, reach: that outline, and how far it reaches.
    """
    cos, sin = math.cos(yaw), math.sin(yaw)
    points = np.empty((len(off_axis) if echo_m < math.inf else 0, 2))
    for k in range(len(points)):
        along, across = echo_m * cos_off[k], echo_m * sin_off[k]
        points[k, 0] = x + cos * along - sin * across
        points[k, 1] = y + sin * along + cos * across
    nearest, at = arc_in_sectors(points, off_axis, edges, width, range_max)
    seen_lo, seen_hi, length = np.empty(len(lo)), np.empty(len(lo)), np.empty(len(lo))
    sees = 0
    for k in range(len(lo)):
        far = max(free_m, near_m) if ahead[k] else near_m
        if 0.0 < far < math.inf:
            seen_lo[sees], seen_hi[sees], length[sees] = lo[k], hi[k], far
            sees += 1
    seen_lo, seen_hi, length = seen_lo[:sees], seen_hi[:sees], length[:sees]
    if math.hypot(x, y) < SAME_PLACE_M:
        free = free_from_origin(seen_lo + yaw, seen_hi + yaw, length, edges, width, range_max)
    else:
        free = free_reach(star_border(seen_lo, seen_hi, length, x, y, yaw), edges, width, body, reach, range_max)
        begins_seen = in_star(begins, x, y, yaw, seen_lo, seen_hi, length, False)
        for sector in range(len(free)):
            if free[sector] <= border[sector] or not begins_seen[sector]:
                free[sector] = 0.0
    for sector in range(len(free)):  # the far corners of a free sector lie within the cone
        for edge in range(sector, sector + 2):
            if free[sector] > 0.0:
                to_x = free[sector] * math.cos(edges[edge]) - x
                to_y = free[sector] * math.sin(edges[edge]) - y
                if abs(math.atan2(cos * to_y - sin * to_x, cos * to_x + sin * to_y)) > half + EDGE_RAD:
                    free[sector] = 0.0
    return nearest, at, free
