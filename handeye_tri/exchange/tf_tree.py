"""A tree of frames as ROS publishes it, link by link."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from handeye_tri.records import Floats
from handeye_tri.se3 import se3_inverse

_MAX_DEPTH = 200


class Frames:
    """The newest pose of every frame in its parent, and the way from base to flange."""

    def __init__(self, base: str, flange: str) -> None:
        self.base = base.lstrip("/")
        self.flange = flange.lstrip("/")
        self._links: dict[str, tuple[str, Floats]] = {}
        self._way: frozenset[str] = frozenset()

    def update(self, links: Iterable[tuple[str, str, Floats]]) -> bool:
        """Take links (parent, child, parent_from_child of shape (4, 4)).

        Returns:
            Whether the way from base to flange changed, or is not known yet.
        """
        changed = not self._way
        for parent, child, pose in links:
            name = child.lstrip("/")
            changed |= name in self._way
            self._links[name] = (parent.lstrip("/"), pose)
        return changed

    @property
    def known(self) -> str:
        """Names of all frames, for messages."""
        names = {*self._links, *(parent for parent, _ in self._links.values())}
        return ", ".join(sorted(names))

    def pose(self) -> Floats | None:
        """``base_from_flange``, shape (4, 4), metres; None where no way leads there."""
        up_flange, up_base = self._upward(self.flange), self._upward(self.base)
        common = [name for name in up_flange if name in up_base]
        if not common:
            return None
        below_flange = list(up_flange)[: list(up_flange).index(common[0])]
        below_base = list(up_base)[: list(up_base).index(common[0])]
        self._way = frozenset([*below_flange, *below_base])
        return se3_inverse(self._chain(below_base)) @ self._chain(below_flange)

    def _upward(self, name: str) -> dict[str, None]:
        """Frames from one to its root, in order; a circle ends where it closes."""
        path: dict[str, None] = {}
        while name not in path and len(path) < _MAX_DEPTH:
            path[name] = None
            if name not in self._links:
                break
            name = self._links[name][0]
        return path

    def _chain(self, names: list[str]) -> Floats:
        result = np.eye(4)
        for name in names:
            result = self._links[name][1] @ result
        return result
