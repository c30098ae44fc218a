"""Copies of the repository to make faults in, and how pytest runs there."""

import ast
import importlib.util
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.bugs.apply import Bug, find

os.environ["OMP_NUM_THREADS"] = "1"  # before NumPy and torch are loaded
ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = (
    "lightning.pytorch", "torch_geometric", "torch_geometric.utils", "numba", "scipy.spatial", "scipy.ndimage",
    "scipy.sparse.csgraph", "hydra", "omegaconf", "h5py", "cv2", "matplotlib.figure", "torchmetrics", "sklearn.cluster",
    "trimesh", "PIL.Image", "rich.console", "safetensors.torch", "torch.utils.tensorboard", "isal.igzip",
    "jaxtyping", "beartype", "pytest",
)  # fmt: skip


def copy_of_the_tree(folder: Path) -> Path:
    """Copy what git knows or would take in; times stay, so that what numba has compiled stays valid."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT,
        capture_output=True,
        check=True,
        text=True,
    ).stdout
    tree = folder / "tree"
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
    # Inside of src, which tests put on the path of their subprocesses even where they replace the whole path.
    shutil.copy2(Path(__file__).with_name("probes.py"), tree / "src" / "bug_probes.py")
    return tree


def put_in_probe(bug: Bug, tree: Path) -> None:
    """Have the statement that holds the fault's text say so whenever it is executed; nothing else changes."""
    path, place = find(bug, tree)
    text = path.read_text()
    if bug.called_as is not None:
        name = bug.called_as
        path.write_text(f'{text}\n\n{name} = __import__("bug_probes").probed({bug.id}, {name})\n')
        return
    row = text.count("\n", 0, place.start()) + 1
    around = [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.stmt) and node.lineno <= row <= (node.end_lineno or 0)
    ]
    statement = max(around, key=lambda node: (node.lineno, node.col_offset))
    lines = text.splitlines(keepends=True)
    # A compiler that traces the code must not meet the file that hits are written to.
    guard = "if not torch.compiler.is_compiling(): " if "\nimport torch\n" in text else ""
    probe = f'{" " * statement.col_offset}{guard}__import__("bug_probes").hit({bug.id})\n'
    lines.insert(statement.lineno - 1, probe)
    path.write_text("".join(lines))


def load_libraries() -> None:
    """Import what tests import, but nothing of ours: ``run_pytest`` forks, and importing takes longer than most tests.

    Under the shape checks, what is imported first by a module of ours is even compiled anew in each process.
    """
    import torch

    torch.set_num_threads(1)
    for name in LIBRARIES:
        if importlib.util.find_spec(name.partition(".")[0]) is not None:
            importlib.import_module(name)


def run_pytest(
    folder: Path, words: Sequence[str], results: Path, *, cpu_seconds: int | None = None
) -> tuple[int | None, str]:
    """Run pytest in a copy, with the plugin; return its exit status (None: out of time) and what it said."""
    said = folder / "said"
    child = os.fork()
    if child == 0:
        status = 70
        try:
            status = _as_a_child(folder / "tree", words, results.resolve(), said, cpu_seconds)
        finally:
            os._exit(status)
    _, ended = os.waitpid(child, 0)
    return (os.WEXITSTATUS(ended) if os.WIFEXITED(ended) else None), said.read_text()


def _as_a_child(tree: Path, words: Sequence[str], results: Path, said: Path, cpu_seconds: int | None) -> int:
    with said.open("w") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    if cpu_seconds is not None:
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_seconds, cpu_seconds))
    os.chdir(tree)
    paths = [str(tree / "src"), str(tree)]
    os.environ |= {"PYTHONPATH": os.pathsep.join(paths), "BUG_PROBES_FILE": str(results)}
    # The tree that this program runs from must not answer for the copy.
    own = {str(ROOT), str(ROOT / "src"), ""}
    sys.path[:] = [*paths, *(path for path in sys.path if path not in own)]
    for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
        del sys.modules[name]
    import pytest

    status = int(pytest.main(["-p", "bug_probes", "-p", "no:cacheprovider", "-q", *words]))
    sys.stdout.flush()
    return status
