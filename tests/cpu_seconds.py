"""Where the processor seconds of the tests go: ``pytest --cpu-seconds=FILE`` writes them by folder and by test.

Seconds of the processor, unlike those of the clock, do not depend on what else the machine does. Processes that a test
starts count with it; what is made once for several tests counts with the first of them.
"""

import json
import os
import platform
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

SLOWEST = 100
_by_commands = 0.0


def add_command(seconds: float) -> None:
    """Count processor seconds of a process that is not a child of this one."""
    global _by_commands
    _by_commands += seconds


def used() -> float:
    """Return the processor seconds of this process and of its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


class CpuSeconds:
    """Measures each phase of each test in the process that runs it; the process that reports adds them up."""

    def __init__(self, config: pytest.Config, path: Path):
        self.config, self.path = config, path
        self.is_worker = hasattr(config, "workerinput")
        self.of_test: Counter[str] = Counter()
        self.outcomes: Counter[str] = Counter()
        self.of_workers: list[float] = []
        self.last = 0.0

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self) -> Any:
        self.last = used() + _by_commands
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Any:
        report = yield
        now = used() + _by_commands
        report.cpu_seconds, self.last = now - self.last, now
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.of_test[report.nodeid] += getattr(report, "cpu_seconds", 0.0)
        if report.when == "call" or report.outcome != "passed":
            self.outcomes[report.outcome] += 1

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        self.of_workers.append(node.workeroutput["cpu_seconds"] if hasattr(node, "workeroutput") else 0.0)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self) -> None:
        if self.is_worker:
            self.config.workeroutput["cpu_seconds"] = used()
            return
        in_tests = sum(self.of_test.values())
        total = used() if not self.of_workers else sum(self.of_workers) + own()
        folders: Counter[str] = Counter()
        files: Counter[str] = Counter()
        for name, seconds in self.of_test.items():
            file = name.partition("::")[0]
            parts = file.split("/")
            folders["/".join(parts[:2]) if len(parts) > 2 else parts[0]] += seconds
            files[file] += seconds
        shown = {
            "machine": f"{platform.machine()}, {os.cpu_count()} cores",
            "python": platform.python_version(),
            "processes": max(len(self.of_workers), 1),
            "outcomes": dict(self.outcomes),
            "total": round(total, 1),
            "imports_and_collection": round(total - in_tests, 1),
            "folders": {name: round(seconds, 1) for name, seconds in folders.most_common()},
            "files": {name: round(seconds, 1) for name, seconds in files.most_common() if seconds >= 1},
            "tests": {name: round(seconds, 1) for name, seconds in self.of_test.most_common(SLOWEST)},
        }
        self.path.write_text(json.dumps(shown, indent=1) + "\n")


def own() -> float:
    """Return the processor seconds of this process alone: the workers report their own."""
    times = os.times()
    return times.user + times.system


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--cpu-seconds", type=Path, metavar="FILE", help="write the processor seconds of each test there")


def pytest_configure(config: pytest.Config) -> None:
    if config.option.cpu_seconds is not None:
        config.pluginmanager.register(CpuSeconds(config, config.option.cpu_seconds))
