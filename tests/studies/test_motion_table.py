import json

import pytest

from docs.results.studies.motion_table import main, numbers_of, read_runs, table


def metrics(psnr, errors):
    reference = {"psnr": {"mean": 20.0}, "psnr_moving": {"mean": None}}
    motion = {"size_ratio": {"per_step": [1.0] * 31 + [1.25]}}
    motion |= {f"centroid_error{kind}": {"per_step": list(errors)} for kind in ("", "_constant", "_velocity")}
    return {
        "step": 100,
        "training": {"seconds": 45.0},
        "ssim": {"mean": 0.75},
        "psnr": {"mean": psnr},
        "psnr_moving": {"mean": psnr - 5},
        "chamfer": {"mean": 0.031},
        "motion": motion,
        "events": {"rest": {"share_within_5_cm": 0.75, "count": 20}},
        "references": {"copy_last": reference, "train_mean": reference},
    }


@pytest.fixture
def runs(tmp_path):
    for seed, psnr in enumerate((22.0, 24.0)):
        folder = tmp_path / "block" / f"inertial_gnn_{seed}" / "evaluation"
        folder.mkdir(parents=True)
        errors = [0.01 * (step + seed) for step in range(1, 33)]
        (folder / "metrics.json").write_text(json.dumps(metrics(psnr, errors)))
    return tmp_path


def test_a_cell_is_the_mean_over_seeds_with_its_range(runs):
    row = next(line for line in table(read_runs(runs)).splitlines() if "inertial_gnn" in line)

    assert (
        "| block | inertial_gnn | 100 [100, 100] | 23.00 [22.00, 24.00] | 18.00 [17.00, 19.00] | 1.5 [1.0, 2.0] |"
        in row
    )
    assert row.endswith("| 3.1 [3.1, 3.1] | 1.25 [1.25, 1.25] | 75% [75%, 75%] |")


def test_columns_can_be_chosen(runs, capsys):
    main([str(runs), "--columns", "seconds", "SSIM", "step 32"])

    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "| data set | system | seconds | SSIM | step 32 |"
    assert lines[2] == "| block | inertial_gnn | 0.45 [0.45, 0.45] | 0.750 [0.750, 0.750] | 32.5 [32.0, 33.0] |"


def test_what_was_not_measured_is_left_open():
    found = metrics(22.0, range(32))
    del found["motion"]["size_ratio"], found["ssim"]
    found["training"]["seconds"] = None
    found["events"]["rest"]["count"] = 1

    numbers = numbers_of(found)

    assert [numbers[name] for name in ("size 32", "rest", "SSIM", "seconds")] == [None] * 4


def test_references_and_numbers_of_every_run_are_kept(runs, tmp_path, capsys):
    main([str(runs), "--out", str(tmp_path / "table.json")])

    printed = capsys.readouterr().out
    assert "| | *mean image* |  | 20.00 | - |" in printed
    kept = json.loads((tmp_path / "table.json").read_text())
    assert kept["block"]["inertial_gnn"]["1"]["step 4"] == pytest.approx(5.0)
    assert kept["block"]["references"]["*best constant*"]["step 1"] == pytest.approx(1.0)


def test_an_empty_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no"):
        read_runs(tmp_path)
