"""The benchmark runs from a checkout, in its quick form."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "solvers.py"


@pytest.mark.slow
def test_quick_benchmark_runs_and_writes_its_figures(tmp_path):
    out = tmp_path / "figures.json"
    command = [sys.executable, SCRIPT, "--quick", "--no-peers", "--json", out]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert "P2" in done.stdout and json.loads(out.read_text())
