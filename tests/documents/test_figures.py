"""No figure of README, docs or a card is typed by hand: it is what a committed result file says, or the test fails."""

import json
import re
import shutil
import tomllib
from pathlib import Path

import pytest

from benchmarks import figures, page
from benchmarks.figures import FIGURE, value_of, with_figures
from benchmarks.results_files import default_folder
from tests.documents.numbers import unmarked

ROOT = Path(__file__).resolve().parents[2]
ALLOWED = tomllib.loads((Path(__file__).parent / "not_measured.toml").read_text())
NAMES = [path.relative_to(ROOT).as_posix() for path in page.pages()]
RESULTS = ("docs/results", "benchmarks/results", "released")


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Pages, cards and result files, to be changed."""
    for name in (*NAMES, *RESULTS):
        source, target = ROOT / name, tmp_path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("*.png", "*.webm"))
        else:
            shutil.copy(source, target)
    monkeypatch.setattr(page, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    return tmp_path


def test_pages_and_cards_say_what_the_result_files_say() -> None:
    assert not [path.relative_to(ROOT).as_posix() for path in page.out_of_date(default_folder())]


# In running text, in a table made of a result file, in a card's table, in a card's words.
@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("README.md", r"(\d)<!-- figure: neighbors_cpu"),
        ("README.md", r"\| 90 minutes of one core \| 23\.8(\d) "),
        ("docs/experiments.md", r"(\d)<!-- figure: recipes_validation"),
        ("docs/experiments.md", r"\| movi_a \| inertial \| 3 \| 37(\d) "),
        ("docs/results.md", r"\| PSNR \(dB\) \| \d\d\.\d(\d) "),
        ("docs/benchmarks.md", r"\| train_step/fast \| \d+\.\d(\d) "),
        ("released/movi_a_vpd/README.md", r"\| PSNR of moving pixels \(dB\) \| 16\.1(\d) "),
        (
            "released/deformable_collision_sequential/README.md",
            r"of these, the first training and what it prepared: 6\.(\d)",
        ),
    ],
)
def test_a_digit_changed_by_hand_is_found_and_set_right(copy: Path, name: str, pattern: str) -> None:
    path = copy / name
    right = path.read_text()
    match = re.search(pattern, right)
    assert match, "the page has no such figure any more"
    place = match.start(1)
    path.write_text(right[:place] + str((int(right[place]) + 1) % 10) + right[place + 1 :])

    assert list(page.out_of_date(copy / "benchmarks" / "results")) == [path]
    assert page.main([str(copy / "benchmarks" / "results"), "--check"]) == 1
    assert page.main([str(copy / "benchmarks" / "results")]) == 0
    assert path.read_text() == right


def test_another_result_changes_every_page_that_shows_it(copy: Path) -> None:
    path = copy / "released" / "movi_a_vpd" / "metrics.json"
    text = path.read_text()
    path.write_text(text.replace(str(json.loads(text)["psnr_moving"]["mean"]), "21.5"))

    changed = {path.relative_to(copy).as_posix() for path in page.out_of_date(copy / "benchmarks" / "results")}

    assert changed == {"README.md", "released/movi_a_vpd/README.md"}


@pytest.mark.parametrize("name", NAMES)
def test_a_number_that_may_be_measured_has_a_source(name: str) -> None:
    allowed = ALLOWED.get(name, {})
    if "*" not in allowed:
        assert not unmarked((ROOT / name).read_text(), tuple(allowed))


def test_what_is_allowed_without_a_source_still_stands_there() -> None:
    assert set(ALLOWED) <= set(NAMES)
    for name, allowed in ALLOWED.items():
        text = " ".join((ROOT / name).read_text().split())
        assert not [words for words in allowed if words != "*" and words not in text], name


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("It is 2.5 dB better.", ["2.5 dB"]),
        ("It is 2.5<!-- figure: neighbors_cpu > rows > 0 > ratio --> dB better, or 3 dB.", ["3 dB"]),
        ("half\nof 12 % and 4\ncm", ["12 %", "4 cm"]),
        ("18 to 20 ms, 8x, 1.5-fold, 3 times", ["18 to 20 ms", "8x", "1.5-fold", "3 times"]),
        ("64 x 64 pixels, `lr=2 %`, 8 steps", []),
        ("```\n3 dB\n```\n", []),
        ("| system | PSNR |\n|---|---:|\n| a | 20.5 |\n", ["20.5"]),
        ("| system | version |\n|---|---:|\n| a | 20.5 |\n", []),
        ("<!-- results: a b -->\n3 dB\n<!-- end of results -->", []),
    ],
)
def test_numbers_that_may_be_measured_are_found(text: str, found: list[str]) -> None:
    assert unmarked(text) == found


def test_a_source_is_a_path_and_what_is_done_with_it() -> None:
    motion = figures.content_of(ROOT / "docs" / "results" / "motion_test.json")["movi_a"]
    mean = sum(run["PSNR"] for run in motion["inertial"].values()) / 3
    reference = motion["references"]["*mean image*"]["PSNR"]

    assert value_of("motion_test > movi_a > inertial > * > PSNR") == pytest.approx(mean)
    against = "> movi_a > references > *mean image* > PSNR"
    assert value_of(f"motion_test > movi_a > inertial > * > PSNR minus {against}") == pytest.approx(mean - reference)
    released = json.loads((ROOT / "released/movi_a_sequential/metrics.json").read_text())
    other = "movi_a_sequential > references > train_mean > psnr > mean"
    ratio = mean / released["references"]["train_mean"]["psnr"]["mean"]
    assert value_of(f"motion_test > movi_a > inertial > * > PSNR divided by {other}") == pytest.approx(ratio)
    last = released["motion"]["centroid_error"]["per_step"][-1]
    assert value_of("movi_a_sequential > motion > centroid_error > per_step > -1 in cm") == pytest.approx(100 * last)
    assert value_of("movi_a_15_minutes > vpd > steps") == 954
    assert value_of("neighbors_cpu > rows > knn/numba > ratio") > 1


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("nothing > psnr", "no file of results is called 'nothing'"),
        ("motion_test > movi_z > PSNR", "there is no 'movi_z'"),
        ("motion_test > movi_a > inertial", "is no number"),
        ("neighbors_cpu > rows > knn/none > ratio", "there is no 'knn/none'"),
        ("neighbors_cpu > rows > knn/auto > ratio in furlongs", "unknown unit 'furlongs'"),
    ],
)
def test_a_source_that_is_not_there_is_named(source: str, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        value_of(source)


def test_a_source_without_a_number_is_refused() -> None:
    with pytest.raises(ValueError, match="must follow a number"):
        with_figures("about ten<!-- figure: neighbors_cpu > rows > 0 > ratio --> times")


def test_digits_and_thousands_stay_as_they_are_printed() -> None:
    text = "9,762,155<!-- figure: paper_size_step_cpu > parameters > total --> and **5.1**<!-- figure: x -->"
    assert len(FIGURE.findall(text)) == 2
    assert with_figures(text.replace("x -->", "paper_size_step_cpu > peak_bytes in GiB -->").replace("155", "000")) == (
        text.replace("x -->", "paper_size_step_cpu > peak_bytes in GiB -->")
    )


def test_numbers_with_an_exponent_are_written_anew_with_it() -> None:
    source = "<!-- figure: gpu_knn_cuda > rows > knn/auto > error --> m"
    assert with_figures(f"off by 9.9e-3{source}") == f"off by 1.5e-7{source}"
