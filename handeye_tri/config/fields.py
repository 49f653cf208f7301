"""Types of the values in a cell description."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

# Strict: neither "0.03" nor true is a number.
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Unit = Annotated[Number, Field(ge=0, le=1)]
Count = Annotated[int, Field(strict=True, ge=1)]
Switch = Annotated[bool, Field(strict=True)]
Point = tuple[Number, Number, Number]


class Model(BaseModel):
    """Part of a description: unknown keys are refused, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True)
