"""Room decomposition where maps lie otherwise, have other cells, noise or gaps: how much it hangs on that.

    UMFELD_DATA=... python bench/rooms_forms.py [--half dev|held|both] [--form NAME ...] [--maps]

The labelled maps of bench/rooms.py in the forms below, free cells and true rooms alike, judged with the same measure
and the same rules. The buildings are split in two halves for ever: how rooms are found is worked out on `dev`, `held`
tells what it is worth. The forms that come last were not looked at in that work either. Each is drawn with a fixed
seed.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from bench.rooms import FREE_FROM, PIXEL_M, Grey, labelled_maps, overlap_scores
from mapping.hybrid.rooms import find_rooms

Bools = NDArray[np.bool_]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

HELD: Final = frozenset({"Freiburg79_scan", "lab_intel", "office_d", "office_h", "intel", "freiburg79"})
WITHIN: Final = (0.85, 1.2)
_FINE: Final = 4  # samples of a pixel along each side, where shares of it are taken
_SALT: Final = 0.003
_CRACKED: Final = 1.0 / 75.0  # of the cells of walls
_THICK: Final = 6  # cells, of walls that get cracks


@dataclass(frozen=True, slots=True)
class Form:
    """One way to draw a map. turn_deg: about its middle.  mirrored: left for right.  cell_m: of the new cells, where
    the picture's are 0.05 m.  told_m: what find_rooms is told that they are.  share: of a new cell that has to be free,
    0 for what its middle says.  spoil: what is done to the free cells then.
    """

    turn_deg: float = 0.0
    mirrored: bool = False
    cell_m: float = PIXEL_M
    told_m: float | None = None
    share: float = 0.0
    spoil: Callable[[Bools, np.random.Generator], Bools] | None = None


def salted(free: Bools, rng: np.random.Generator) -> Bools:
    """Single cells turned over: free ones everywhere, others beside free ones."""
    at = rng.random(free.shape) < _SALT
    return np.asarray(free ^ (at & (free | _beside(free))))


def gaps(free: Bools, rng: np.random.Generator) -> Bools:
    """Cracks of a cell through thin walls along rows and columns."""
    out = np.pad(free, _THICK + 1)
    wall = np.argwhere(~free & _beside(free))
    for row, col in wall[rng.random(len(wall)) < _CRACKED] + _THICK + 1:
        for step in ((0, 1), (1, 0)):
            cells = [(row + k * step[0], col + k * step[1]) for k in range(-1, _THICK + 1)]
            through = next((k for k, cell in enumerate(cells[1:], 1) if out[cell]), None)
            if out[cells[0]] and through is not None:
                for cell in cells[1:through]:
                    out[cell] = True
                break
    return np.ascontiguousarray(out[_THICK + 1 : -_THICK - 1, _THICK + 1 : -_THICK - 1])


def smoothed(free: Bools, rng: np.random.Generator) -> Bools:
    """Obstacle cells with free ones on three sides or all are free: bumps of a cell on walls, and single cells."""
    around = np.pad(free, 1)
    sides = around[:-2, 1:-1].astype(int) + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]
    return np.asarray(free | (sides >= 3))


def _beside(free: Bools) -> Bools:
    padded = np.pad(free, 1)
    return np.asarray(padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:])


FORMS: Final[dict[str, Form]] = {
    "as it is": Form(),
    "mirrored": Form(mirrored=True),
    "turned 17, half": Form(turn_deg=17.0, share=0.5),
    "turned 30, middle": Form(turn_deg=30.0),
    "turned 45, strict": Form(turn_deg=45.0, share=0.8),
    "cells 2.5 cm": Form(cell_m=0.025),
    "cells 3 cm": Form(cell_m=0.03),
    "cells 4 cm, half": Form(cell_m=0.04, share=0.5),
    "cells 4 cm, strict": Form(cell_m=0.04, share=0.8),
    "cells 6 cm": Form(cell_m=0.06, share=0.7),
    "cells 8 cm": Form(cell_m=0.08, share=0.7),
    "cells 10 cm": Form(cell_m=0.1, share=0.7),
    "noise": Form(spoil=salted),
    "gaps": Form(spoil=gaps),
    "0.8 of the size": Form(told_m=0.04),
    "1.25 of the size": Form(told_m=0.0625),
}
LATER: Final[dict[str, Form]] = {
    "turned 62, strict": Form(turn_deg=62.0, share=0.8),
    "turned -11, half, noise": Form(turn_deg=-11.0, share=0.5, spoil=salted),
    "mirrored, turned 38": Form(turn_deg=38.0, mirrored=True, share=0.5),
    "cells 3.5 cm": Form(cell_m=0.035, share=0.5),
    "cells 4.5 cm": Form(cell_m=0.045),
    "cells 5.5 cm": Form(cell_m=0.055, share=0.5),
    "cells 7 cm, turned 17": Form(turn_deg=17.0, cell_m=0.07, share=0.7),
    "cells 3 cm, turned 25": Form(turn_deg=25.0, cell_m=0.03, share=0.5),
    "smoothed": Form(spoil=smoothed),
}
"""Not looked at before the rules were final."""


def drawn_as(form: Form, free: Bools, truth: I32, seed: int) -> tuple[Bools, I32]:
    """Free cells and true rooms of a map in that form."""
    shown, rooms = _resampled(form, free, truth)
    if form.spoil is not None:
        shown = form.spoil(shown, np.random.default_rng(seed))
    return shown, rooms


def _resampled(form: Form, free: Bools, truth: I32) -> tuple[Bools, I32]:
    if form.mirrored:
        free, truth = free[:, ::-1], truth[:, ::-1]
    scale = form.cell_m / PIXEL_M
    if form.turn_deg == 0.0 and scale == 1.0:
        return free.copy(), truth.copy()
    turn = math.radians(form.turn_deg)
    c, s = math.cos(turn), math.sin(turn)
    size = np.array(free.shape, dtype=np.float64)
    new = np.ceil((np.array(((abs(c), abs(s)), (abs(s), abs(c)))) @ size) / scale - 1e-9).astype(int)
    row, col = ((np.arange(n) + 0.5 - 0.5 * n) * scale for n in new)

    def at(down: float, right: float) -> tuple[Bools, tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Which pixels lie so far from the middles of the new cells, and which of them are in the picture."""
        r, q = row[:, None] + down * scale, col[None, :] + right * scale
        rr, cc = np.floor(c * r - s * q + 0.5 * size[0]), np.floor(s * r + c * q + 0.5 * size[1])
        inside = (rr >= 0) & (rr < size[0]) & (cc >= 0) & (cc < size[1])
        return inside, (np.where(inside, rr, 0).astype(int), np.where(inside, cc, 0).astype(int))

    inside, cell = at(0.0, 0.0)
    rooms = np.where(inside, truth[cell], 0).astype(np.int32)
    if form.share == 0.0:
        return inside & free[cell], rooms
    n = math.ceil(_FINE * scale)
    count = np.zeros(new, dtype=np.float64)
    for down in (np.arange(n) + 0.5) / n - 0.5:
        for right in (np.arange(n) + 0.5) / n - 0.5:
            inside, cell = at(float(down), float(right))
            count += inside & free[cell]
    return count >= form.share * n * n - 1e-9, rooms


@dataclass(frozen=True)
class Row:
    """Of one map in one form."""

    group: str
    name: str
    recall: float
    precision: float
    rooms: int
    found: int

    @property
    def ratio(self) -> float:
        return self.found / self.rooms


def chosen(data: Path, half: str) -> Iterator[tuple[str, str, Grey, I32]]:
    for group, name, grey, truth in labelled_maps(data):
        if "bins" not in group and half in ("both", "held" if name in HELD else "dev"):
            yield group, name, grey, truth


def judge(form: Form, group: str, name: str, grey: Grey, truth: I32) -> Row:
    free, rooms = drawn_as(form, grey >= FREE_FROM, truth, seed=len(name))
    found = find_rooms(free, form.told_m or form.cell_m).labels
    return Row(group, name, *overlap_scores(rooms, found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=("dev", "held", "both"), default="both")
    parser.add_argument("--form", action="append", help="only this one; may be given more than once")
    parser.add_argument("--maps", action="store_true", help="a line for each map outside of 0.85 to 1.2, too")
    arguments = parser.parse_args()
    if not os.environ.get("UMFELD_DATA"):
        parser.exit(2, "UMFELD_DATA is not set: name the folder of the recorded data there\n")
    forms = {**FORMS, **LATER}
    maps = list(chosen(Path(os.environ["UMFELD_DATA"]), arguments.half))
    groups = list(dict.fromkeys(each[0] for each in maps))
    print(f"{'':26}" + "".join(f"{group:>34}" for group in groups) + "   outside")
    for name in arguments.form or forms:
        rows = [judge(forms[name], *each) for each in maps]
        line = f"{name:26}"
        for group in groups:
            own = [row for row in rows if row.group == group]
            line += (
                f"  {np.mean([e.recall for e in own]):.3f} / {np.mean([e.precision for e in own]):.3f}"
                f" ({min(e.ratio for e in own):.2f}, {max(e.ratio for e in own):.2f})  "
            )
        outside = [row for row in rows if not WITHIN[0] <= row.ratio <= WITHIN[1]]
        print(f"{line}   {len(outside)} of {len(rows)}", flush=True)
        if arguments.maps:
            for row in outside:
                print(f"    {row.group} {row.name}: {row.recall:.3f} / {row.precision:.3f}, {row.found}/{row.rooms}")


if __name__ == "__main__":
    main()
