"""The Triton column of the matrix on a CPU: the same cases, in Triton's interpreter."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


FILES = ("test_neighbors_stability.py", "test_features_stability.py")


@pytest.mark.slow
@pytest.mark.kernels
def test_triton_kernels_pass_the_matrix_in_the_interpreter(request: pytest.FixtureRequest, record_property):
    pytest.importorskip("triton")
    # Triton decides when it is imported, so this needs a process of its own: one, because starting it takes long, too.
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    files = [f"tests/stability/{name}" for name in FILES]
    command = [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", "-p", "no:xdist", *files]
    if "not exhaustive" in request.config.getoption("markexpr"):
        # An interpreter runs one program after the other: it repeats itself, and the order of points tells it nothing
        # that the comparison with float64 does not.
        command += ["-m", "not exhaustive", "-k", "not repeats_bit_for_bit and not order_of_points"]

    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)

    assert result.returncode == 0, result.stdout[-4000:] + result.stderr[-1000:]
    for name in FILES:
        assert len(re.findall(rf"{name}::\S+ PASSED", result.stdout)) > 50
    record_property("cases", result.stdout.count(" PASSED"))
