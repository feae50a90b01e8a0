"""The path of key scans: what was measured from each to the next, in arrays that only grow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapping.frames import Pose2
from mapping.localise.pose_graph import Edges

F64 = NDArray[np.float64]

LEAST_ROOM = 64


class KeyPath:
    """Step k leads from key scan k to k + 1. What `edges` handed out never changes, so it may go to a thread."""

    def __init__(self, measured: F64 | None = None, information: F64 | None = None) -> None:
        """Of steps (N, 3) and their information (N, 3, 3), or empty."""
        self._measured: F64 = np.zeros((0, 3)) if measured is None else measured.copy()
        self._information: F64 = np.zeros((0, 3, 3)) if information is None else information.copy()
        self._steps = len(self._measured)

    def __len__(self) -> int:
        return self._steps

    def append(self, measured: Pose2, information: F64) -> None:
        """The next step, and its information (3, 3) in the frame of the key scan it starts from."""
        if self._steps == len(self._measured):
            more = max(LEAST_ROOM, self._steps // 2)
            self._measured = np.concatenate((self._measured, np.zeros((more, 3))))
            self._information = np.concatenate((self._information, np.zeros((more, 3, 3))))
        self._measured[self._steps] = (measured.x_m, measured.y_m, measured.yaw_rad)
        self._information[self._steps] = information
        self._steps += 1

    def step(self, k: int) -> tuple[Pose2, F64]:
        """One step and its information (3, 3)."""
        if not 0 <= k < self._steps:
            raise IndexError(k)
        return Pose2(*self._measured[k].tolist()), self._information[k]

    def edges(self) -> Edges:
        """All steps so far."""
        n = self._steps
        return Edges(
            np.arange(n), np.arange(1, n + 1), self._measured[:n], self._information[:n], np.zeros(n, dtype=np.bool_)
        )
