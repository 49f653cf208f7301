"""JSON and YAML that somebody else wrote: plain data only, its size bounded."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from handeye_tri.errors import InputError, StorageError
from handeye_tri.storage.files import read_bytes

# More values than any file of poses has; an anchor that is repeated ten times ten
# times over unfolds to more than any memory.
_MAX_VALUES = 2_000_000


def read_structured(path: Path) -> Any:
    """Plain data of a JSON file (by its suffix) or a YAML file.

    Raises:
        StorageError: missing, or not readable.
        InputError: it unfolds to more than it should.
    """
    from ruamel.yaml import YAML, YAMLError

    kind = "JSON" if path.suffix == ".json" else "YAML"
    try:
        # Editors of some systems put a byte order mark first.
        text = read_bytes(path).decode("utf-8-sig")
        if not text.strip():
            raise StorageError(f"{path}: this file is empty")
        if kind == "JSON":
            data = json.loads(text)
        else:
            data = YAML(typ="safe", pure=True).load(text)
        count = _unfolded(data, {})
    except (YAMLError, RecursionError, LookupError, *_WRONG) as error:
        first = (str(error).splitlines() or ["it is nested too deeply"])[0]
        raise StorageError(f"{path}: this is not readable {kind} ({first})") from None
    if count > _MAX_VALUES:
        raise InputError(f"{path}: this unfolds to more than {_MAX_VALUES} values")
    return data


def _unfolded(node: Any, known: dict[int, float]) -> float:
    """Number of values when every alias is written out; inf for what holds itself."""
    if not isinstance(node, Mapping | list):
        return 1
    if id(node) not in known:
        known[id(node)] = math.inf
        parts = list(node.values()) if isinstance(node, Mapping) else node
        known[id(node)] = 1 + sum(_unfolded(part, known) for part in parts)
    return known[id(node)]


# What the parsers raise, beyond their own, for text, dates and keys that cannot be.
_WRONG = (ValueError, TypeError, AttributeError, AssertionError, ArithmeticError)
