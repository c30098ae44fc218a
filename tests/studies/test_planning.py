"""The study of planning: intervals, worlds, and a file that runs share."""

import json
from pathlib import Path

import pytest

from data_gen.pushing.settings import PushingSettings
from data_gen.pushing.world import PushingWorld
from data_gen.settings import load_settings
from docs.results.studies import planning


def test_rates_come_with_wilson_intervals() -> None:
    rate, low, high = planning.rate([True] * 8 + [False] * 2)
    assert rate == 0.8 and low == pytest.approx(0.4902, abs=1e-3) and high == pytest.approx(0.9433, abs=1e-3)


def test_bodies_that_roll_have_no_place_to_stay_at() -> None:
    settings = load_settings(PushingSettings, "pushing", "tiny", {})
    assert planning.seeds_of("off_table", 3, settings) == [2000, 2001, 2002]
    seeds = planning.seeds_of("place", 6, settings)
    shapes = {PushingWorld(settings, seed, None).bodies[0].shape for seed in seeds}
    assert len(set(seeds)) == 6 and shapes <= {"box", "cylinder"}


def test_results_are_added_to_those_of_other_runs(tmp_path: Path) -> None:
    path = tmp_path / "planning.json"
    for key, solved in (("model/place/2000", True), ("model/place/2001", False), ("truth/place/2000", True)):
        planning._add(path, "m", key, {"solved": solved, "seconds_per_decision": 2.0}, {"hold": 4})
    found = json.loads(path.read_text())
    assert len(found["tasks"]) == 3 and found["settings"] == {"hold": 4} and found["model"] == "m"
    assert found["rates"]["model/place"]["rate"][0] == 0.5 and found["rates"]["truth/place"]["tasks"] == 1
