"""Finds which tests execute the line of which fault: ``python -m tests.bugs.record --out HITS.jsonl [PYTEST WORDS]``.

Runs the tests once, in a copy of the repository whose source notes when it comes by one of the places of ``bugs.toml``.
Nothing is traced, so it takes no longer than the tests do, and subprocesses count, too. Where a place is compiled by
numba, the call from Python counts. Without words: all tests that may come by one, but for slow ones; give
``-m slow tests/...`` and another file for those. It must be done anew whenever tests or source changed.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.bugs.apply import load_bugs
from tests.bugs.trees import copy_of_the_tree, put_in_probe, run_pytest

USUAL = ("-m", "not slow and not exhaustive", "tests")
ELSEWHERE = ("data_gen", "benchmarks", "viewer", "reliability", "test_site.py", "test_packaging.py")
"""What is left out: no fault is in what these test."""


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    known, words = parser.parse_known_args()
    known.out.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="vpd-bugs-") as name:
        tree = copy_of_the_tree(Path(name))
        for bug in load_bugs():
            put_in_probe(bug, tree)
        status, said = run_pytest(
            Path(name),
            ["--tb=line", *(words or [*USUAL, *(f"--ignore=tests/{name}" for name in ELSEWHERE)])],
            known.out.resolve(),
        )
    print(said)
    print(f"pytest ended with {status}")
    sys.exit(0 if known.out.exists() else 1)


if __name__ == "__main__":
    main()
