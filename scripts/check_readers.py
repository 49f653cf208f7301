"""Fuzz every reader of foreign files, and flip bits in every file of a session.

    python scripts/check_readers.py --cases 1000

Whatever a file holds, a reader must raise one clear error or give the same numbers.
Of a session, as many bits are flipped one at a time, half of them in session.json.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

TESTS = ("tests/exchange/test_fuzz.py", "tests/pipeline/test_damaged.py")
REPO = Path(__file__).resolve().parent.parent

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--cases", type=int, default=1000, help="cases of each reader")
arguments = parser.parse_args()
done = subprocess.run(
    [sys.executable, "-m", "pytest", "-q", *TESTS],
    cwd=REPO,
    env={**os.environ, "HANDEYE_FUZZ": str(arguments.cases)},
    check=False,
)
sys.exit(done.returncode)
