"""What all tables of the configuration share: their strictness, and the kinds of values that stand in several."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Name = Annotated[str, Field(pattern=r"^[a-z0-9_-]+$", max_length=64)]
Reference = Annotated[str, Field(pattern=r"^((lasers|sonars|contacts)\.)?[a-z0-9_-]+$", max_length=80)]
Positive = Annotated[float, Field(gt=0)]


# Units that were mistaken, by values that nothing real has. They would be believed: an outline of 45 m hides all that
# is nearer.


def _metres_up_to(limit_m: float) -> Callable[[float], float]:
    def check(value: float) -> float:
        if abs(value) > limit_m:
            told = " or ".join(f"{value / each:g}" for each in (100, 1000))
            raise ValueError(f"is {value:g} metres; write {told} if centimetres or millimetres were meant")
        return value

    return check


def _degrees(value: float) -> float:
    for turn in (0.25, 0.5, 1.0):
        if abs(abs(value) - 2.0 * math.pi * turn) < 5e-4:
            raise ValueError(
                f"is {value:g} degrees; write {math.copysign(360.0 * turn, value):g} if radians were meant"
            )
    return value


def _opening(value: float) -> float:
    if value < 2.0:
        raise ValueError(f"is {value:g} degrees; write {math.degrees(value):.0f} if radians were meant")
    return value


Place = Annotated[float, AfterValidator(_metres_up_to(20.0))]
"""A coordinate on the robot."""

Wheel = Annotated[float, Field(gt=0), AfterValidator(_metres_up_to(2.0))]
"""A wheel's radius."""

Track = Annotated[float, Field(gt=0), AfterValidator(_metres_up_to(10.0))]

Heard = Annotated[float, Field(gt=0), AfterValidator(_metres_up_to(30.0))]
"""A distance that ultrasound is heard from."""

Direction = Annotated[float, Field(ge=-360, le=360), AfterValidator(_degrees)]

Opening = Annotated[float, Field(gt=0, le=120), AfterValidator(_opening)]
"""A transducer's cone."""

Point = tuple[Place, Place]


class Section(BaseModel):
    """Settings common to all tables: nothing unknown, nothing converted, nothing changed later."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class PlanePose(Section):
    """The pose of a virtual sensor in the base frame."""

    x_m: float = Field(default=0.0, description="Forward of the base's origin.")
    y_m: float = Field(default=0.0, description="Left of the base's origin.")
    yaw_deg: Direction = Field(default=0.0, description="Its x axis, counter-clockwise from forward.")
