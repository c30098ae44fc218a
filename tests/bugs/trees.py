"""Copies of the repository to make faults in, and how pytest runs there."""

import ast
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.bugs.apply import Bug, find

ROOT = Path(__file__).resolve().parents[2]


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


def run_pytest(
    folder: Path, words: Sequence[str], results: Path, *, cpu_seconds: int | None = None, timeout: float | None = None
) -> tuple[int | None, str]:
    """Run pytest in a copy, with the plugin; return its exit status (None: out of time) and what it said."""
    tree = folder / "tree"
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, (tree / "src", tree))),
        "BUG_PROBES_FILE": str(results),
        "OMP_NUM_THREADS": "1",
    }

    def limited() -> None:
        if cpu_seconds is not None:
            resource.setrlimit(resource.RLIMIT_CPU, (cpu_seconds, cpu_seconds))

    command = [sys.executable, "-m", "pytest", "-p", "bug_probes", "-p", "no:cacheprovider", "-q", *words]
    try:
        done = subprocess.run(
            command,
            cwd=tree,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=timeout,
            preexec_fn=limited,
        )
    except subprocess.TimeoutExpired:
        return None, ""
    return (None if done.returncode < 0 else done.returncode), done.stdout
