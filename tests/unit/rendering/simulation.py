"""Cases of a test module, run in numba's simulator of a GPU."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

__all__ = ["ROOT", "simulate"]

ROOT = Path(__file__).parents[3]


def simulate(module: str) -> dict[str, Any]:
    """What a module prints as its last line, as JSON; in a process of its own: numba reads the choice first."""
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", module]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])
