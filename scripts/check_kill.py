"""Kill `handeye-tri run` at random moments, and let `run` finish what is left.

    python scripts/check_kill.py --moments 30

Each session is killed (SIGKILL) once, at a moment drawn evenly from the processor time
that an undisturbed run takes, and finished by the same command. Every file must then
be the undisturbed run's byte for byte; of the recording, which has identifiers of its
own, the numbers. The exit code is 1 where one is not.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from handeye_tri.replay.recording import read_numbers

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--moments", type=int, default=30, help="sessions to kill")
parser.add_argument("--half-turns", type=int, default=3, help="of each session")
parser.add_argument("--seed", type=int, default=1, help="of the moments")
arguments = parser.parse_args()


def start(folder: Path) -> subprocess.Popen[str]:
    """`run` in a folder of its own; relative paths, so that pages are the same."""
    folder.mkdir(exist_ok=True)
    verb = "run hp3_stereo -o out --seed 1 --half-turns"
    return subprocess.Popen(
        [sys.executable, "-m", "handeye_tri.cli", *verb.split()]
        + [str(arguments.half_turns)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def used(process: subprocess.Popen[str]) -> float:
    """Processor time of a running process, seconds; inf once it is gone."""
    try:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2]
    except (FileNotFoundError, ProcessLookupError):
        return float("inf")
    state, *numbers = fields.split()
    if state == "Z":
        return float("inf")
    return sum(map(int, numbers[10:12])) / os.sysconf("SC_CLK_TCK")


def files(session: Path) -> dict[str, bytes]:
    """Every file of a session by name; the recording by its numbers."""
    found = {
        str(path.relative_to(session)): path.read_bytes()
        for path in session.rglob("*")
        if path.is_file()
    }
    header = json.loads(found["session.json"])
    header["stages"]["report"]["outputs"].pop("replay.rrd")
    header.pop("sha256")
    numbers = read_numbers(session / "replay.rrd")
    found["replay.rrd"] = json.dumps(numbers, sort_keys=True).encode()
    found["session.json"] = json.dumps(header, sort_keys=True).encode()
    return found


with tempfile.TemporaryDirectory() as name:
    parent = Path(name)
    process = start(parent / "undisturbed")
    text, complaint = process.communicate()
    times = resource.getrusage(resource.RUSAGE_CHILDREN)
    whole = times.ru_utime + times.ru_stime
    if process.returncode not in (0, 3, 4):
        sys.exit(complaint)
    code, expected = process.returncode, files(parent / "undisturbed" / "out")
    print(f"undisturbed: {whole:.1f} s, {len(expected)} files, exit code {code}")
    draw = random.Random(arguments.seed)
    killed = missed = 0
    while killed < arguments.moments:
        # Strata, so that a few moments are spread over the run as many are.
        moment = whole * (killed + draw.random()) / arguments.moments
        folder = parent / f"killed-{killed}"
        process = start(folder)
        while used(process) < moment:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        _, progress = process.communicate()
        if process.returncode != -signal.SIGKILL:
            # It was done before its time was up: another moment.
            whole = min(whole, moment)
            for path in sorted(folder.rglob("*"), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()
            continue
        stages = sum("]" in line for line in progress.splitlines())
        finish = start(folder)
        printed, complaint = finish.communicate()
        found = files(folder / "out") if finish.returncode == code else {}
        odd = sorted(
            name
            for name in {*found, *expected}
            if found.get(name) != expected.get(name)
        )
        if printed != text:
            odd.append("stdout")
        killed += 1
        missed += bool(odd)
        print(
            f"killed after {moment:5.1f} s, with {stages} of 7 stages done: exit code "
            f"{finish.returncode}, {', '.join(odd) + ' differ' if odd else 'the same'}"
        )
        if finish.returncode != code:
            print(complaint, file=sys.stderr)
print(f"{killed - missed} of {killed} finished to the same files and words")
sys.exit(1 if missed else 0)
