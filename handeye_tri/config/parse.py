"""From what a YAML file holds to a cell, or to one sentence on what is wrong there."""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING, TypeVar

from pydantic import BaseModel, ValidationError

from handeye_tri.config.cell import (
    ArmConfig,
    BoxConfig,
    CameraConfig,
    Cell,
    CellToCalibrate,
    EstimateConfig,
    ImagingConfig,
    LensConfig,
    MeasuredCell,
    PlanConfig,
)
from handeye_tri.config.rig import MountConfig, RigConfig
from handeye_tri.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic_core import ErrorDetails

_Kind = TypeVar("_Kind", bound=BaseModel)
_MEASURED = "handeye_tri.measured_cell/1"


def parse_cell(data: Mapping[str, object], source: str) -> Cell:
    """Check the description of a cell that can be planned and simulated.

    Args:
        data: What the YAML file holds.
        source: The file's name, for messages.

    Raises:
        InputError: unknown key, missing unit, impossible value; names each key.
    """
    if data.get("schema") == _MEASURED:
        raise InputError(
            f"{source}: this describes a cell that was measured ({_MEASURED}), which "
            "can be imported into but neither planned nor simulated; for that write "
            "schema: handeye_tri.cell/1 and its keys, see scenes/README.md"
        )
    return _validated(Cell, data, source)


def parse_any_cell(data: Mapping[str, object], source: str) -> CellToCalibrate:
    """Check a cell description of either kind (``schema``), as :func:`parse_cell`."""
    if data.get("schema") == _MEASURED:
        return _validated(MeasuredCell, data, source)
    return _validated(Cell, data, source)


def _validated(kind: type[_Kind], data: Mapping[str, object], source: str) -> _Kind:
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        problems = _problems(error.errors(include_url=False))
        text = "; ".join(f"{key or 'the cell'}: {what}" for key, what in problems)
        raise InputError(f"{source}: {text}") from None


_SECTIONS: dict[str, type[BaseModel]] = {
    "arm": ArmConfig,
    "rig": RigConfig,
    "second_mount": MountConfig,
    "cameras": CameraConfig,
    "lens": LensConfig,
    "estimate": EstimateConfig,
    "imaging": ImagingConfig,
    "surroundings": BoxConfig,
    "plan": PlanConfig,
}


def _problems(errors: list[ErrorDetails]) -> list[tuple[str, str]]:
    """Dotted keys with what is wrong there, each cause once."""
    found = {".".join(str(part) for part in error["loc"]): error for error in errors}
    spoken_for = set()
    for key, error in found.items():
        if error["type"] == "extra_forbidden":
            # The key that was meant is reported missing too.
            place = key.rpartition(".")[0]
            spoken_for.add(f"{place}.{_meant(error['loc'])}".lstrip("."))
        elif error["type"] == "too_short" and any(
            k.startswith(f"{key}.") for k in found
        ):
            # Entries that were refused are not counted.
            spoken_for.add(key)
    return [(k, _explain(error)) for k, error in found.items() if k not in spoken_for]


def _meant(location: tuple[int | str, ...]) -> str:
    """The known key nearest to the unknown one at ``location``, or ""."""
    names = [part for part in location[:-1] if isinstance(part, str)]
    section = _SECTIONS[names[-1]] if names else Cell
    known = [field.alias or name for name, field in section.model_fields.items()]
    # What the other kind of cell would have there was not meant.
    known = [name for name in known if name != location[-1]]
    return next(iter(get_close_matches(str(location[-1]), known, n=1)), "")


def _explain(error: ErrorDetails) -> str:
    kind, text = error["type"], error["msg"].removeprefix("Value error, ")
    if kind == "missing":
        return "this key is missing; add it"
    if kind == "value_error":
        return text
    if kind == "extra_forbidden":
        key, meant = str(error["loc"][-1]), _meant(error["loc"])
        if not meant:
            return "this key is not known here; remove it"
        if key.rpartition("_")[0] == meant.rpartition("_")[0] != "":
            return f"this key is not known here; convert the value and call it {meant}"
        return f"this key is not known here; did you mean {meant}?"
    value = repr(error["input"])
    value = value if len(value) <= 60 else f"{value[:57]}..."
    if kind == "too_short":
        least = error["ctx"]["min_length"]
        verb = "is" if least == 1 else "are"
        return f"at least {least} {verb} needed, got {error['ctx']['actual_length']}"
    if kind in ("model_type", "dict_type"):
        return f"this must be a mapping of keys, got {value}"
    return f"{text[0].lower()}{text[1:]}, got {value}"
