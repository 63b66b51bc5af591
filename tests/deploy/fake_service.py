"""A stand-in for a service: ``fake_service.py NAME RUN_DIR BEHAVIOUR``. Only the standard library, so it starts fast.

It writes a part, as services do, and lives until the bridge says that the run is over (the file ``finished``; with
``hears`` the mirrored part of a bridge on another computer does as well), or until a signal. What ends it is a line of
``ends.log``.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

name, run_dir, behaviour = sys.argv[1], Path(sys.argv[2]), sys.argv[3]
incarnation = time.time_ns()
counters = {"steps": 100, "acted_steps": 100, "episodes": 1, "produced": 5, "cycles": 100}


def write_part(state: str, failure: str | None = None) -> None:
    part = {
        "service": name,
        "incarnation": incarnation,
        "pid": os.getpid(),
        "state": state,
        "failure": failure,
        "wall_s": 1.0,
        "counters": counters if name == "robot_bridge" else {},
        "has_goal": True,
        "persisted": {},
    }
    path = run_dir / "parts" / f"{name}-{incarnation}.json"
    path.parent.mkdir(exist_ok=True)
    temporary = path.with_suffix(".new")
    temporary.write_text(json.dumps(part), encoding="utf-8")
    temporary.replace(path)


def end(reason: str) -> None:
    write_part("stopped")
    with (run_dir / "ends.log").open("a", encoding="utf-8") as log:
        log.write(f"{name} {reason}\n")
    if name == "robot_bridge":
        (run_dir / "finished").touch()
    os._exit(0)


signal.signal(signal.SIGTERM, lambda *_: end("SIGTERM"))
if behaviour == "stubborn":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
else:
    signal.signal(signal.SIGINT, lambda *_: end("SIGINT"))
if behaviour == "cannot start":
    counters["steps"] = 0
print(f"{name} says hello", flush=True)
write_part("running")
if behaviour in ("fail", "crash") and name != "robot_bridge":
    # In the middle of a run: whoever fails before the bridge has made a step has failed to start.
    patience_s = time.monotonic() + 30.0
    # The bridge of a run on two computers is known by the copy of its part.
    while time.monotonic() < patience_s and not list(run_dir.glob("**/parts/robot_bridge-*.json")):
        time.sleep(0.01)
if behaviour in ("fail", "cannot start"):
    write_part("stopped", failure="the disk is full")
    sys.exit(3)
if behaviour == "crash":
    sys.exit("Traceback: something unexpected")
if behaviour == "done":
    end("done")


def bridge_has_stopped_there() -> bool:
    parts = (run_dir / "hosts").glob("*/parts/robot_bridge-*.json")
    return any(json.loads(part.read_text(encoding="utf-8"))["state"] == "stopped" for part in parts)


while True:
    if behaviour != "deaf" and (run_dir / "finished").exists():
        end("finished")
    if behaviour == "hears" and bridge_has_stopped_there():
        end("heard")
    time.sleep(0.01)
