"""Which faults of ``bugs.toml`` the tests find: ``python -m tests.bugs.judge --hits HITS.jsonl --out RESULT.json``.

How to judge a changed suite (``tests/bugs/before.json`` is what the suite found before it was reworked):

1. Enter in ``moved.json`` where files went (old path: new path); ``python -m tests.bugs.apply`` says whether each fault
   still has its place. Files that kept their name are found without an entry.
2. ``python -m tests.bugs.record --out hits.jsonl`` finds anew which tests execute which fault's line. Old recordings
   say nothing about changed tests.
3. ``python -m tests.bugs.judge --hits hits.jsonl --out tests/bugs/after.json``
4. For what is not caught: ``python -m tests.bugs.record --out slow.jsonl -m "slow and not exhaustive" FILES`` and
   ``python -m tests.bugs.judge --bugs 3,17 --hits hits.jsonl slow.jsonl --out tests/bugs/after.json``: slow tests are
   part of the suite as well. Results of other faults stay in the file.

``tests/bugs/after.json`` was made in the short way: each fault that was found before was given to the test that found
it then, in the reworked suite. The six that were not found before (10, 14, 15, 17, 26, 30) got tests of their own and
were given to the files of these; what they say of numbers of tests counts these files alone. Fault 14 moves nothing:
counts matter for those awake alone, and the count of one asleep is 0 when it wakes, by the fault or by the line. Only
the memory's count of steps at rest is wrong.

Each fault is put into a copy of the repository, never into the repository itself. The tests that execute its line
(those that passed when they were recorded) run until one fails, the cheapest files first; then the other tests of the
same files, which may see the line's work through something that an earlier test left behind (``executes`` is false
where it took one of these). A test that fails without the fault, too, proves nothing. A fault has ``--seconds`` of
processor time.
"""

import argparse
import json
import re
import resource
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.bugs.apply import Bug, find, load_bugs, put_in
from tests.bugs.trees import ROOT, copy_of_the_tree, load_libraries, run_pytest


class Recording:
    """What ``tests.bugs.record`` wrote: how tests ended and which of them execute which fault's line."""

    def __init__(self, files: Sequence[Path]) -> None:
        self.seconds: dict[str, float] = {}
        self.files: dict[str, list[str]] = defaultdict(list)
        places: dict[int, set[str]] = defaultdict(set)
        users: dict[str, list[str]] = defaultdict(list)
        for line in (json.loads(line) for file in files for line in file.read_text().splitlines()):
            if "bug" in line:
                places[line["bug"]].add(line["place"])
            elif line["outcome"] == "passed" and line["test"] not in self.seconds:
                self.seconds[line["test"]] = line["seconds"]
                self.files[_file(line["test"])].append(line["test"])
                for fixture in line["fixtures"]:
                    users[fixture].append(line["test"])
        self.executing = {
            bug: {test for place in found for test in [place, *users[place]] if test in self.seconds}
            for bug, found in places.items()
        }

    def rounds(self, bug: int) -> list[list[str]]:
        """Return the tests to run for a fault, in parts.

        Those that execute its line come first, in rounds of 1, 2, 4 ... files, the cheapest first: what comes later
        need not even be collected where an early one fails. The last round are the other tests of the same files.
        """
        executing = self.executing.get(bug, set())
        cost: dict[str, float] = defaultdict(float)
        for test in executing:
            cost[_file(test)] += self.seconds[test]
        files = sorted(cost, key=lambda file: (cost[file], file))
        rounds, start, size = [], 0, 1
        while start < len(files):
            rounds.append([test for file in files[start : start + size] for test in self.files[file]])
            start, size = start + size, 2 * size
        others = [test for found in rounds for test in found if test not in executing]
        return [*([test for test in found if test in executing] for found in rounds), *([others] if others else [])]


def _file(test: str) -> str:
    return test.partition("::")[0]


def judge(bug: Bug, recording: Recording, folder: Path, cpu_seconds: int) -> dict[str, Any]:
    """Put a fault in, run the tests, take it out again."""
    executing = recording.executing.get(bug.id, set())
    result: dict[str, Any] = {"kind": bug.kind, "wrong": bug.wrong, "caught": False, "executed_by": len(executing)}
    if not executing:
        return result | {"tests_run": 0, "note": "no recorded test executes it"}
    return result | _run(bug, recording.rounds(bug.id), executing, folder, cpu_seconds)


@contextmanager
def _with_bug(bug: Bug, folder: Path) -> Iterator[None]:
    path = find(bug, folder / "tree")[0]
    put_in(bug, folder / "tree")
    try:
        yield
    finally:
        shutil.copy2(ROOT / path.relative_to(folder / "tree"), path)


def _run(bug: Bug, rounds: list[list[str]], executing: set[str], folder: Path, cpu_seconds: int) -> dict[str, Any]:
    start, tests_run, late = _children_seconds(), 0, f"out of time ({cpu_seconds} s of processor time)"
    waiting = list(rounds)
    while waiting:
        tests = waiting.pop(0)
        left = int(cpu_seconds - (_children_seconds() - start))
        if left < 1:
            return {"tests_run": tests_run, "note": late}
        with _with_bug(bug, folder):
            status, ran, said = _tests(tests, folder, left)
        tests_run += len(ran)
        failed = next((line["test"] for line in ran if line["outcome"] == "failed"), None)
        if failed is not None:
            _, again, _ = _tests([failed], folder, cpu_seconds)
            if any(line["outcome"] == "failed" for line in again):  # a busy machine, say: it proves nothing
                done = {line["test"] for line in ran}
                waiting.insert(0, [test for test in tests if test not in done])
                continue
            told = re.search(r"^(?:E  |/).*", said, re.MULTILINE)
            why = re.sub(r"^\S*?/(tests|src|site-packages)/", r"\1/", told.group()) if told else ""
            by = {"by": failed, "executes": failed in executing, "why": why[:160]}
            return {"caught": True, "tests_run": tests_run, **by}
        if status is None:
            return {"tests_run": tests_run, "note": late}
        if status != 0:
            return {"tests_run": tests_run, "note": f"pytest ended with {status}: {said[-300:]}"}
    return {"tests_run": tests_run}


def _tests(tests: list[str], folder: Path, cpu_seconds: int) -> tuple[int | None, list[dict[str, Any]], str]:
    """Run tests until one fails; return how pytest ended, those that ran, and what was said."""
    if not tests:
        return 0, [], ""
    words, outcomes = folder / "words", folder / "outcomes.jsonl"
    words.write_text("\n".join(tests) + "\n")
    outcomes.unlink(missing_ok=True)
    status, said = run_pytest(folder, ["-x", "--tb=line", f"@{words}"], outcomes, cpu_seconds=cpu_seconds)
    lines = [json.loads(line) for line in outcomes.read_text().splitlines()] if outcomes.exists() else []
    return status, [line for line in lines if "test" in line and line["outcome"] != "skipped"], said


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Judge all faults, or some."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hits", type=Path, nargs="+", required=True, help="what tests.bugs.record wrote")
    parser.add_argument("--bugs", type=lambda text: [int(part) for part in text.split(",")], help="numbers, e.g. 1,2")
    parser.add_argument("--out", type=Path, help="JSON file; results of faults that are not judged now stay in it")
    parser.add_argument("--seconds", type=int, default=120, help="processor time for each fault (%(default)s)")
    given = parser.parse_args()
    load_libraries()
    recording = Recording(given.hits)
    results = json.loads(given.out.read_text()) if given.out and given.out.exists() else {}
    with tempfile.TemporaryDirectory(prefix="vpd-bugs-") as name:
        copy_of_the_tree(Path(name))
        for bug in load_bugs():
            if given.bugs is None or bug.id in given.bugs:
                found = results[str(bug.id)] = judge(bug, recording, Path(name), given.seconds)
                print(bug.id, "caught by " + found["by"] if found["caught"] else found.get("note", "NOT CAUGHT"))
                if given.out:
                    ordered = dict(sorted(results.items(), key=lambda item: int(item[0])))
                    given.out.write_text(json.dumps(ordered, indent=1) + "\n")
    print(f"{sum(found['caught'] for found in results.values())} of {len(results)} caught")


if __name__ == "__main__":
    main()
