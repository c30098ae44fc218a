"""The time of first visits is taken of real steps, by both masks."""

import json
from pathlib import Path

import pytest

from docs.results.studies import first_visits
from vpd_lightning.config import compose


def test_all_data_sets_and_masks_are_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, ...]] = []

    def seconds(scene: str, folder: Path, mask: str, num_batches: int) -> dict[str, float]:
        asked.append((scene, str(folder), mask, str(num_batches)))
        return {"first visit": 2.0, "later": 1.0}

    monkeypatch.setattr(first_visits, "seconds", seconds)
    out = tmp_path / "found.json"
    assert first_visits.main([str(out), "movi_a", "exact=a", "noisy=b", "--batches", "2"]) == 0
    found = json.loads(out.read_text())["processor seconds of a step"]
    assert list(found) == ["exact", "noisy"] and set(found["noisy"]) == set(first_visits.MASKS)
    assert asked[-1] == ("movi_a", "b", "noise looked for", "2")


def test_masks_differ_by_what_they_take_noise_for() -> None:
    floors = []
    for change in first_visits.MASKS.values():
        words = ["experiment=movi_a", "model=inertial", "budget=minutes", "run.folder=unused", *filter(None, [change])]
        floors.append(compose("train", words)["encoder"]["background"]["noise_floor"])
    assert floors[0] is None and floors[1] > 0
