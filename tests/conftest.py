"""What every test runs under: small thread pools, off-screen GL, the same examples."""

from __future__ import annotations

import os

# Before numpy and the engines are imported.
for name, value in {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MUJOCO_GL": "egl",
    # rerun only warns of what it could not log, unless it is told otherwise.
    "RERUN_STRICT": "1",
}.items():
    os.environ.setdefault(name, value)

from hypothesis import settings  # noqa: E402

# The same examples in every run, however slow the machine.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")
