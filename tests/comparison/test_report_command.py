"""``vpd-report`` from the command line to the files."""

import csv
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.comparison.made_runs import write_rollouts, write_run
from vpd_lightning.commands.report import main
from vpd_lightning.comparison import comparison_video as films
from vpd_lightning.comparison.rollout_grid import strip_steps
from vpd_lightning.comparison.web_page import web_page
from vpd_lightning.errors import ConfigError


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds of vpd, one of slotformer without particles, a small sweep, a second data set; reported."""
    folder = tmp_path_factory.mktemp("report") / "runs"
    for seed in (0, 1):
        run = write_run(folder / f"vpd{seed}", seed=seed, psnr=30.0 + seed)
        write_rollouts(run, 100)
    write_run(folder / "few", num_trajectories=16, psnr=25.0, settings={"sweep_name": "data"})
    slots = write_run(folder / "slots", system="slotformer", psnr=12.0, has_particles=False)
    write_rollouts(slots, 200, clips=("test/000000.h5@4", "test/000007.h5@4"), side=8)
    write_run(folder / "movi", experiment="movi_a", data_sha256="b" * 64)
    assert main([str(folder), "title=A trial"]) == 0
    return folder


def test_the_report_prints_what_the_evaluations_say(runs: Path):
    out = runs / "report"
    text = (out / "report.md").read_text()
    assert text.startswith("# A trial\n")
    means = [json.loads((runs / f"vpd{i}/evaluation/metrics.json").read_text())["psnr"]["mean"] for i in (0, 1)]
    row = next(line for line in text.splitlines() if line.startswith("| vpd |") and "60 min cpu" in line)
    assert row.startswith(f"| vpd | **{np.mean(means):.2f}** [")
    # 0.14 s for encoding and rollout, 0.60 and 0.62 s of rendering, over 4 steps from 2 cameras.
    assert row.endswith("| 60 min cpu | 60.0 | cpu | 500 | 12,345 | 93.8 | 2 |")
    assert re.search(r"\| slotformer \| 10\.8\d \[", text)
    assert "vpd (data.num_trajectories=16)" in text and "copy last input frame" in text
    assert "PSNR (dB): vpd" in text and "no other system's interval reaches its own" in text
    pictures = re.findall(r"\]\((.*?)\)", text)
    assert len(pictures) >= 6 and all((out / name).stat().st_size > 1000 for name in pictures)
    assert {path.name for path in out.iterdir() if path.suffix in (".png", ".webm")} == set(pictures)
    assert not list(runs.glob(".report*"))


def test_steps_stand_beside_what_needs_no_learning(runs: Path):
    text = (runs / "report" / "report.md").read_text()
    table = text[text.index("| centroid error of bodies (cm) after | 1 | 4 |") :].split("\n\n")[0]
    rows = {row.split(" | ")[0]: [cell.split()[0] for cell in row.split(" | ")[1:]] for row in table.splitlines()}
    # Errors are 5 cm on the hardest of six trajectories and in proportion on the others; without motion step times it.
    assert rows["| vpd"] == ["2.9", "2.9"] and rows["| *no motion*"] == ["2.9", "11.7"]
    assert rows["| vpd less no motion"] == ["+0.0", "-8.7"] or rows["| vpd less no motion"] == ["+0.0", "-8.8"]
    assert "| *no motion* | - |" in text  # beside the systems, in the column of the centroid error alone


def test_the_page_shows_films_first_and_all_that_the_report_says(runs: Path):
    folder = runs / "report"
    page, text = (folder / "index.html").read_text(), (folder / "report.md").read_text()
    assert "<h1>A trial</h1>" in page and page.index("<video") < page.index("How to read the tables")
    shown = re.findall(r'src="([^"]+)"', page)
    assert set(shown) == set(re.findall(r"\]\((.*?)\)", text)) and all((folder / name).is_file() for name in shown)
    assert page.count("<table>") == len(re.findall(r"^\|[-| :]+\|$", text, re.MULTILINE)) > 2
    assert "://" not in page


def test_names_from_outside_are_text_in_the_page():
    page = web_page("<b>x", "# t\n\n<script>alert(1)</script>\n\na <i>name</i>, `<u>`\n", [Path("film_<s>.webm")])
    for tag in ("<script", "<b>", "<i>", "<u>", "<s>"):
        assert tag not in page


def test_the_spreadsheet_has_a_row_per_run(runs: Path):
    with (runs / "report" / "report.csv").open() as stream:
        rows = {Path(row["folder"]).name: row for row in csv.DictReader(stream)}

    assert set(rows) == {"vpd0", "vpd1", "few", "slots", "movi"}
    metrics = json.loads((runs / "few" / "evaluation" / "metrics.json").read_text())
    assert float(rows["few"]["psnr"]) == metrics["psnr"]["mean"]
    assert float(rows["few"]["psnr_low"]) == metrics["psnr"]["ci95"][0]
    assert float(rows["few"]["centroid_error"]) == metrics["motion"]["centroid_error"]["mean"]
    assert float(rows["few"]["milliseconds_per_frame"]) == pytest.approx(1000 * (0.04 + 0.1 + 0.5) / (4 * 2))
    assert rows["few"]["settings"] == "data.num_trajectories=16" and rows["few"]["is_main"] == "False"
    assert rows["slots"]["centroid_error"] == "" and rows["slots"]["minutes"] == "60.0"


def test_time_against_error_is_drawn_where_evaluations_say_both(runs: Path, tmp_path: Path):
    assert (runs / "report" / "time_error_mujoco_block.png").stat().st_size > 1000
    run = write_run(tmp_path / "run")
    path = run / "evaluation" / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"seconds": {"total": 1.0}}))  # of an older version
    assert main([str(run), f"out={tmp_path / 'report'}"]) == 0
    assert not list((tmp_path / "report").glob("time_error_*"))
    assert "| 12,345 | - | 1 |" in (tmp_path / "report" / "report.md").read_text()


def test_strips_show_the_same_rollout_of_every_system(runs: Path):
    names = sorted(path.name for path in (runs / "report").glob("strips_*"))
    assert names == [f"strips_mujoco_block_test_{number}_start4.png" for number in ("000000", "000007")]
    both, one = (cv2.imread(str(runs / "report" / name)) for name in names)
    assert both is not None and one is not None
    # Two cameras with truth, slotformer and vpd, against two with truth and slotformer.
    assert both.shape[0] - one.shape[0] == 2 * (96 + 2) and both.shape[1] == one.shape[1]
    # 100 is the shade that vpd predicted, in two rows of four images of 96 x 96 pixels with 3 colours.
    assert int((both == 100).sum()) >= 2 * 4 * 96 * 96 * 3 > 10 * int((one == 100).sum())


def test_films_show_every_system_beside_the_truth_for_all_steps(runs: Path):
    names = sorted(path.name for path in (runs / "report").glob("film_*"))
    assert names == [f"film_mujoco_block_test_{number}_start4.webm" for number in ("000000", "000007")]
    assert all(f"({name})" in (runs / "report/report.md").read_text() for name in names)
    both, one = (film_frames(runs / "report" / name) for name in names)
    # Panels of 128 pixels in a frame of one: truth, slotformer and vpd, against truth and slotformer.
    assert both.shape[2] - one.shape[2] == 128 + 2 and both.shape[1] == one.shape[1] == 2 * (22 + 22 + 128 + 2)
    assert len(both) == len(one) == 4
    vpd = both[:, 60:150, -120:-10].astype(int)
    assert abs(vpd - 100).max() <= 8  # 100 is the shade that vpd predicted, and compression loses little of it


def test_without_vp9_there_is_a_report_without_films(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def refuse(*_: object) -> None:
        raise ConfigError("This OpenCV cannot write VP9.\nInstall another.")

    monkeypatch.setattr(films, "write_video", refuse)
    assert main([str(runs / "vpd0"), f"out={tmp_path / 'report'}"]) == 0

    text = (tmp_path / "report/report.md").read_text()
    assert "not shown: `films` (This OpenCV cannot write VP9.)" in text and list((tmp_path / "report").glob("strips_*"))
    capsys.readouterr()


def film_frames(path: Path) -> NDArray[np.uint8]:
    """Read a film's frames (time, height, width, 3)."""
    film = cv2.VideoCapture(str(path))
    frames = []
    while (read := film.read())[0]:
        frames.append(read[1])
    return np.stack(frames)


def test_strip_steps_reach_from_the_first_to_the_last():
    assert strip_steps(4) == [1, 2, 3, 4]
    steps = strip_steps(32)
    assert steps[0] == 1 and steps[-1] == 32 and len(steps) == 8


def test_nothing_is_overwritten_and_a_damaged_rollout_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = write_run(tmp_path / "run")
    (run / "evaluation" / "rollouts.npz").write_bytes(b"PK")
    (run / "report").mkdir()

    assert main([str(run)]) == 0
    printed = capsys.readouterr().out.strip().splitlines()
    assert printed[-1] == str(run / "report_2" / "report.md") and "1 run reported, 0 left out" in printed
    assert "not shown" in (run / "report_2" / "report.md").read_text()
    assert not list((run / "report").iterdir())

    assert main([str(run), f"out={run / 'report'}"]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ([], 2, ""),
        (["nowhere"], 2, "no folder nowhere"),
        (["out=x"], 2, "No folder is given"),
        (["{folder}", "otu=x"], 2, "no setting 'otu'"),
        (["{folder}", "--out=x"], 2, "no setting '--out'"),
        (["{folder}", "-v"], 2, "Unknown option"),
        (["{folder}", "split=tset"], 2, "Allowed: test"),
        (["{folder}", "title=a", "title=b"], 2, "given twice"),
        (["{folder}"], 3, "vpd-eval ckpt="),
    ],
)
def test_mistakes_are_named(
    words: list[str], code: int, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main([word.format(folder=tmp_path) for word in words]) == code
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) <= 5
    assert not (tmp_path / "report").exists()


def test_help_gives_examples(capsys: pytest.CaptureFixture[str]):
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    assert "vpd-report runs/mujoco_block" in printed and "Exit codes" in printed
