"""Laws through the points of trainings, and how far they can be believed."""

import json
from pathlib import Path
from typing import Any

import pytest

from docs.results.studies import motion_law

CLIPS = [250, 500, 1000, 2000, 4000, 8000, 16000]


def _error(clips: float) -> float:
    return 0.8 * (clips / 1000) ** -0.7


def test_the_law_that_made_the_points_is_found() -> None:
    law = motion_law.described(CLIPS, [_error(clips) for clips in CLIPS])
    assert law is not None
    assert [law[name] for name in ("scale", "exponent")] == pytest.approx([0.8, 0.7], rel=1e-6)
    assert law["at_paper_clips"] == pytest.approx(_error(6.4e6), rel=1e-3)
    assert law["range"] == pytest.approx([_error(6.4e6)] * 2, rel=1e-3)
    assert law["relative_residual"] < 1e-4
    assert law["held_out"]["predicted"] == pytest.approx(_error(16000), rel=1e-3)
    assert law["held_out"]["measured"] == _error(16000)


def test_few_points_have_no_law() -> None:
    assert motion_law.described(CLIPS[:3], [3.0, 2.0, 1.0]) is None
    four = motion_law.described(CLIPS[:4], [4.0, 3.0, 2.5, 2.4])
    assert four is not None and "range" not in four and "held_out" not in four


def test_one_wrong_point_widens_the_range() -> None:
    errors = [_error(clips) for clips in CLIPS]
    errors[-1] *= 1.5
    law = motion_law.described(CLIPS, errors)
    assert law is not None
    low, high = law["range"]
    assert high > 2 * low


def test_a_file_of_points_becomes_laws_and_a_picture(tmp_path: Path) -> None:
    def point(updates: int) -> dict[str, Any]:
        errors = {str(step): _error(4 * updates) * step for step in motion_law.STEPS}
        return {
            "updates": updates,
            "clips_per_update": 4,
            "parameters_of_dynamics": 7,
            "seconds": 2.0 * updates,
            "centroid_error_cm": {"model": errors, "nothing_moves": errors, "best_constant": errors},
        }

    points = {str(updates): point(updates) for updates in (800, 50, 100, 200, 400)}
    curve = tmp_path / "curve.json"
    curve.write_text(json.dumps({"trainings": {"small": {"points": points}}}))

    assert motion_law.main([str(curve), str(tmp_path / "law.json"), str(tmp_path / "law.png")]) == 0

    found = json.loads((tmp_path / "law.json").read_text())["small"]
    assert found["updates"] == 800 and found["parameters_of_dynamics"] == 7
    assert found["laws"]["8"]["exponent"] == pytest.approx(0.7, rel=1e-3)
    assert found["laws"]["8"]["scale"] == pytest.approx(6.4, rel=1e-3)
    assert (tmp_path / "law.png").read_bytes().startswith(b"\x89PNG")
