"""The stages of VPD taken apart on balls in free flight, in very small."""

import json
from pathlib import Path

import pytest
from matplotlib import pyplot

from docs.results.studies import free_flight, free_flight_figure
from vpd_lightning.testing.free_flight import FreeFlight


@pytest.mark.slow
@pytest.mark.exhaustive
def test_rows_are_trained_once_and_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(free_flight, "SCENE", FreeFlight(image_size=16, num_cameras=2))
    monkeypatch.setattr(free_flight, "NUM_TEST", 2)
    monkeypatch.setattr(free_flight, "HORIZONS", (1, 4))
    monkeypatch.setattr(
        free_flight,
        "ROWS",
        {
            name: free_flight.Row(name, batch_size=2, rays_per_step=16, message_passing_steps=1)
            for name in ("targets", "ready", "stills")
        },
    )
    out = tmp_path / "rows.json"

    assert free_flight.main([str(out), "--updates", "3", "--rows", "targets", "ready", "stills"]) == 0
    written = out.read_bytes()
    assert free_flight.main([str(out), "--updates", "3", "--rows", "targets", "ready", "stills"]) == 0

    assert out.read_bytes() == written
    rows = json.loads(written)
    assert list(rows) == ["targets", "ready", "stills"]
    for name, row in rows.items():
        first, last = row["curve"]["0"], row["curve"]["3"]
        references = first["step_4_cm"]
        assert references["constant_velocity"] < references["nothing_moves"]
        assert last["step_1_cm"]["centre"] != first["step_1_cm"]["centre"]
        assert ("psnr_truly_moved" in last) == (name != "targets")


def test_each_row_has_a_bar_with_its_last_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows are sorted by link; bars are of the last measurement, not of the first."""
    found = {"centre": 3.0, "nothing_moves": 4.5, "constant_velocity": 0.4}
    rows = {
        name: {
            "row": {"link": link},
            "curve": {"0": {f"step_{step}_cm": {**found, "centre": 9.0} for step in free_flight_figure.STEPS},
                      "600": {f"step_{step}_cm": {**found, "centre": error} for step in free_flight_figure.STEPS}},
        }
        for name, link, error in (("all", "own", 4.8), ("alone", "targets", 2.2))
    }  # fmt: skip
    drawn = []
    monkeypatch.setattr(pyplot, "close", drawn.append)
    free_flight_figure.draw({**rows, "gradients": {}}, tmp_path / "figure.png")
    axis = drawn[0].axes[0]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["alone", "all"]
    assert [bar.get_width() for bar in axis.patches] == [2.2, 4.8]
    assert (tmp_path / "figure.png").stat().st_size > 0
