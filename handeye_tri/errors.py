"""Typed errors. Each message names what is wrong, the value, and what to do."""

from __future__ import annotations


class HandEyeError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(HandEyeError, ValueError):
    """An argument, a file or a key cannot be used; the message names it."""


class DegenerateMotionError(HandEyeError):
    """The motions or views leave an asked-for quantity undetermined."""


class ConvergenceError(HandEyeError):
    """An iteration ended without reaching its stated tolerance."""


class DetectionError(HandEyeError):
    """An image does not show what was looked for."""


class NoPlanError(HandEyeError):
    """No station sequence satisfies the cell; carries the rejections by check.

    Attributes:
        rejected: number of rejected candidates by name of the check.
    """

    def __init__(self, message: str, rejected: dict[str, int]) -> None:
        super().__init__(message)
        self.rejected = dict(rejected)

    def __reduce__(self) -> tuple[type[NoPlanError], tuple[str, dict[str, int]]]:
        # Exceptions pickle by their args alone; workers send both parts home.
        return type(self), (str(self), self.rejected)


class MissingDependencyError(HandEyeError, ImportError):
    """A system library or an optional package is absent; says how to get it."""


class StorageError(HandEyeError):
    """A session folder or one of its files cannot be read or written."""


class WorkerLostError(HandEyeError):
    """Processes that were given work died, and trying again did not help."""
