"""The Triton column of the matrix on a CPU: the same cases, in Triton's interpreter."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["test_neighbors_stability.py", "test_features_stability.py"])
def test_triton_kernels_pass_the_matrix_in_the_interpreter(name: str, record_property):
    pytest.importorskip("triton")
    # Triton decides when it is imported, so this needs a process of its own.
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"tests/stability/{name}"]

    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)

    assert result.returncode == 0, result.stdout[-4000:] + result.stderr[-1000:]
    passed = re.search(r"(\d+) passed", result.stdout)
    assert passed and int(passed[1]) > 50
    record_property("cases", int(passed[1]))
