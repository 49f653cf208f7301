"""Fuzz every reader of foreign files with many cases.

    python scripts/check_readers.py --cases 1000

Whatever a file holds, a reader must raise one clear error or give the same numbers.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

REPO = Path(__file__).resolve().parent.parent

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--cases", type=int, default=1000, help="cases of each reader")
arguments = parser.parse_args()
done = subprocess.run(
    [sys.executable, "-m", "pytest", "-q", "tests/exchange/test_fuzz.py"],
    cwd=REPO,
    env={**os.environ, "HANDEYE_FUZZ": str(arguments.cases)},
    check=False,
)
sys.exit(done.returncode)
