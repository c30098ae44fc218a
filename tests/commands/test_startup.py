"""Commands begin at once: what takes long to import waits until it is used. Modules are counted, not seconds."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.evaluation.tossed_box import write_tossed_boxes
from tests.evaluation.untrained_model import write_untrained
from vpd_lightning.commands import SPIN_COUNT

ROOT = Path(__file__).resolve().parents[2]
# What measures, draws, trains and simulates; each takes from 0.2 to 3 seconds.
HEAVY = {
    "cv2", "lightning", "matplotlib", "mujoco", "numba", "pandas", "sklearn", "sympy", "tensorboard", "torch_geometric",
    "torchmetrics", "trimesh",
}  # fmt: skip


def loaded(script: str, *words: str) -> set[str]:
    """Run a script in a process of its own and return the packages that it has imported where it says LOADED."""
    show = "\ndef show(*_):\n    print('LOADED', *{name.partition('.')[0] for name in sys.modules})\n"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])}
    command = [sys.executable, "-c", f"import sys\n{show}{script}", *words]
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    lines = [line for line in result.stdout.splitlines() if line.startswith("LOADED")]
    assert len(lines) == 1, result.stdout + result.stderr
    return set(lines[0].split()[1:])


def test_info_imports_nothing_to_tell_its_version() -> None:
    script = """
from vpd_lightning.commands import info
info._gl_backends = dict  # tried in processes of their own
info.main([])
show()
"""
    found = loaded(script)
    assert not found & (HEAVY | {"hydra", "omegaconf", "scipy", "h5py"})
    assert "torch" in found, "which knows the devices"


@pytest.mark.parametrize("is_there", [True, False])
def test_evaluation_says_its_first_line_before_it_imports_what_measures(tmp_path: Path, is_there: bool) -> None:
    """Of a checkpoint that is there the line names it; else it is the error."""
    data = write_tossed_boxes(tmp_path / "data", num_train=1, num_test=1)
    checkpoint = write_untrained(tmp_path / "run", data)
    script = """
from vpd_lightning.commands import eval
from vpd_lightning.runs import evaluation_run
class Stop(Exception): pass
def stop(model):
    show()
    raise Stop
evaluation_run._require_predictions = stop  # the first thing behind the first line
try:
    eval.main(sys.argv[1:])
except Stop:
    pass
else:
    show()
"""
    found = loaded(script, f"ckpt={checkpoint if is_there else tmp_path / 'none.ckpt'}")
    assert not found & HEAVY
    assert "torch" in found


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, f"{SPIN_COUNT} None"),
        ({"GOMP_SPINCOUNT": "7"}, "7 None"),
        ({"OMP_WAIT_POLICY": "active"}, "None active"),
    ],
)
def test_threads_that_wait_give_up_their_core_soon(given: dict[str, str], expected: str) -> None:
    """It is decided before PyTorch is imported, which reads it once; who has decided otherwise is obeyed."""
    script = """
import os, sys
import vpd_lightning.commands
print("torch" in sys.modules, os.environ.get("GOMP_SPINCOUNT"), os.environ.get("OMP_WAIT_POLICY"))
"""
    kept = {key: value for key, value in os.environ.items() if key not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    environment = {**kept, **given, "PYTHONPATH": str(ROOT / "src")}
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment, check=True)
    assert result.stdout.split() == ["False", *expected.split()]
