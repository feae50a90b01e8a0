"""What all tables of the configuration share: their strictness, and the kinds of values that stand in several."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Name = Annotated[str, Field(pattern=r"^[a-z0-9_-]+$", max_length=64)]
Reference = Annotated[str, Field(pattern=r"^((lasers|sonars|contacts)\.)?[a-z0-9_-]+$", max_length=80)]
Positive = Annotated[float, Field(gt=0)]
Point = tuple[float, float]


class Section(BaseModel):
    """Settings common to all tables: nothing unknown, nothing converted, nothing changed later."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class PlanePose(Section):
    """The pose of a virtual sensor in the base frame."""

    x_m: float = Field(default=0.0, description="Forward of the base's origin.")
    y_m: float = Field(default=0.0, description="Left of the base's origin.")
    yaw_deg: float = Field(default=0.0, ge=-360, le=360, description="Its x axis, counter-clockwise from forward.")
