"""What runs inside the tests: notes which test comes by which fault, and how each test ends.

``trees.py`` copies this file to a folder of its own as ``bug_probes``; it is a plugin of pytest, and what the probes in
the instrumented source call. Subprocesses of a test inherit the environment, so that their hits count for that test. A
fixture that several tests share belongs to all tests that use it, whichever asked for it first.
"""

import json
import os
from collections.abc import Callable, Generator
from typing import Any

import pytest

FILE, PLACE = "BUG_PROBES_FILE", "BUG_PROBES_PLACE"
_seen: set[tuple[int, str]] = set()
_shared: dict[str, list[str]] = {}
_seconds: dict[str, float] = {}
_outcomes: dict[str, set[str]] = {}


def hit(bug: int) -> None:
    """Note that the line of a fault is about to be executed."""
    key = bug, os.environ.get(PLACE, "")
    if key not in _seen:
        _seen.add(key)
        _write({"bug": bug, "place": key[1]})


def probed(bug: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a compiled function that notes when Python calls it."""

    def call(*arguments: Any) -> Any:
        hit(bug)
        return function(*arguments)

    return call


def _write(line: dict[str, Any]) -> None:
    if FILE in os.environ:
        with open(os.environ[FILE], "a") as stream:
            stream.write(json.dumps(line) + "\n")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    os.environ[PLACE] = item.nodeid
    fixtures = getattr(item, "_fixtureinfo", None)
    known = [found for named in fixtures.name2fixturedefs.values() for found in named] if fixtures else []
    _shared[item.nodeid] = sorted({_name(found) for found in known if found.scope != "function"})
    try:
        return (yield)
    finally:
        os.environ[PLACE] = ""


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: Any) -> Generator[None, Any, Any]:
    before = os.environ.get(PLACE, "")
    if fixturedef.scope != "function":
        os.environ[PLACE] = _name(fixturedef)
    try:
        return (yield)
    finally:
        os.environ[PLACE] = before


def _name(fixturedef: Any) -> str:
    return f"fixture {fixturedef.baseid}::{fixturedef.argname}"


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration
    _outcomes.setdefault(report.nodeid, set()).add(report.outcome)


def pytest_runtest_logfinish(nodeid: str) -> None:
    outcomes = _outcomes.get(nodeid, set())
    outcome = next((one for one in ("failed", "skipped") if one in outcomes), "passed")
    seconds = round(_seconds.get(nodeid, 0.0), 4)
    _write({"test": nodeid, "outcome": outcome, "seconds": seconds, "fixtures": _shared.get(nodeid, [])})
