"""Starts the process that reads damaged files, again behind each file that ends it, and gathers what went wrong.

`python parent.py COUNT [SEED] [FORMAT ...]` reads so many damaged files of each format; `make fuzz` calls it.
"""

import json
import queue
import subprocess
import sys
import threading
from pathlib import Path

HERE = Path(__file__).parent
# Longer than any file may take, on a machine that has much else to do.
PATIENCE = 60


def findings(names: list[str], count: int, number: int = 0) -> dict[str, list[str]]:
    """What went wrong, by format: each entry names the mutation and its fault."""
    found: dict[str, list[str]] = {name: [] for name in names}
    jobs = [(name, 0) for name in names]
    while jobs:
        jobs = _one_life(jobs, count, number, found)
    return found


def _one_life(jobs: list[tuple[str, int]], count: int, number: int, found: dict[str, list[str]]) -> list[tuple[str, int]]:
    """Runs one process; what remains to be done behind the file that ended it."""
    words = [word for name, first in jobs for word in (name, str(first))]
    command = [sys.executable, str(HERE / "child.py"), str(number), str(count), *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        lines: queue.Queue[str] = queue.Queue()
        errors: list[str] = []
        threading.Thread(target=lambda: [*map(lines.put, child.stdout), lines.put("")], daemon=True).start()
        threading.Thread(target=lambda: errors.extend(child.stderr), daemon=True).start()
        at, fault = None, ""
        while True:
            try:
                line = lines.get(timeout=PATIENCE)
            except queue.Empty:
                fault = f"did not end in {PATIENCE} s"
                child.kill()
                break
            said = json.loads(line) if line else {}
            if said.get("done"):
                return []
            if "problem" in said:
                found[said["format"]].append(f"{said['k']}: {said['problem']}")
            elif said:
                at = (said["format"], said["k"])
            else:
                fault = f"ended the process with {child.wait()}: {''.join(errors)[-600:]}"
                break
    if at is None:
        raise RuntimeError(f"the whole files were not read: {fault}")
    found[at[0]].append(f"{at[1]}: {fault}")
    behind = [name for name, _ in jobs].index(at[0])
    return [(at[0], at[1] + 1), *jobs[behind + 1 :]]


if __name__ == "__main__":
    import tempfile

    from seeds import all_seeds

    with tempfile.TemporaryDirectory() as folder:
        known = list(all_seeds(Path(folder)))
    result = findings(sys.argv[3:] or known, int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    for name, faults in result.items():
        print(f"{name}: {len(faults)} faults", *faults[:20], sep="\n    ")
    sys.exit(any(result.values()))
