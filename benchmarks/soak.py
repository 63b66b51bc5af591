"""``python -m benchmarks.soak``: does a long run's memory stay what it is? Used by ``make soak``.

Runs the four services in real time and samples each process's anonymous memory (mapped file pages are the ring's, not
the process's) and open files. Fails if memory grows by more than 5 % between the two marks, or files at all.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

from common.record import read_parts
from common.topics import SERVICES

MAX_GROWTH = 0.05


def main() -> int:
    """Run, sample, judge; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.add_argument("--task", default="visual_dot_reacher")
    parser.add_argument("--mode", default="local_only")
    parser.add_argument("--from-minute", type=float, default=3.0, help="first mark (default: 3)")
    parser.add_argument("--to-minute", type=float, default=20.0, help="second mark (default: 20)")
    parser.add_argument("--run-dir", type=Path, default=Path("runs") / time.strftime("%Y%m%d-%H%M%S-soak"))
    options = parser.parse_args()
    command = [sys.executable, "-m", "deploy.launch", options.mode, "--task", options.task]
    command += ["--steps", "100000000", "--run-dir", str(options.run_dir)]
    with subprocess.Popen(command) as launcher:
        try:
            ok = _watch(options.run_dir, options.from_minute, options.to_minute, launcher)
        finally:
            launcher.terminate()
    summary = json.loads((options.run_dir / "summary.json").read_text(encoding="utf-8"))
    print(f"experience {summary['experience']}")
    return 0 if ok else 1


def _watch(run_dir: Path, from_minute: float, to_minute: float, launcher: subprocess.Popen[bytes]) -> bool:
    begun = time.monotonic()
    first: dict[str, tuple[int, int]] = {}
    last: dict[str, tuple[int, int]] = {}
    while (minute := (time.monotonic() - begun) / 60) < to_minute:
        if launcher.poll() is not None:
            print(f"the run ended after {minute:.1f} minutes")
            return False
        time.sleep(min(15.0, to_minute * 60))
        last = {part["service"]: _measure(part["pid"]) for part in read_parts(run_dir)}
        if minute >= from_minute and not first:
            first = last
    print(f"\n{'service':14}{'RssAnon MiB':>14}{'then':>10}{'growth':>9}{'files':>8}{'then':>8}  ok")
    good = True
    for service in SERVICES:
        (kib, files), (kib_then, files_then) = first[service], last[service]
        growth = kib_then / kib - 1
        ok = growth <= MAX_GROWTH and files_then <= files
        good &= ok
        print(f"{service:14}{kib / 1024:14.1f}{kib_then / 1024:10.1f}{growth:9.1%}{files:8}{files_then:8}  {_word(ok)}")
    return good


def _measure(pid: int) -> tuple[int, int]:
    """Anonymous memory in KiB and the number of open files of a process."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    kib = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("RssAnon"))
    return kib, len(list(Path(f"/proc/{pid}/fd").iterdir()))


def _word(ok: bool) -> str:
    return "yes" if ok else "NO"


if __name__ == "__main__":
    sys.exit(main())
