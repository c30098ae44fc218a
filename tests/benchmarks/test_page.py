"""The page of figures is made from result files."""

from pathlib import Path

import pytest
import torch

from benchmarks.measuring import Result, row
from benchmarks.page import PAGE, filled
from benchmarks.results_files import write

PART = "before\n<!-- results: neighbors_cpu {} -->\nold figures\n<!-- end of results -->\nafter\n"


@pytest.fixture
def results(tmp_path: Path) -> Path:
    rows = [
        row("knn/ours", [0.5], "SciPy", [1.0], note="k = 16"),
        row("knn/other", [0.7], "SciPy", [1.0], note="k = 16"),
    ]
    write("neighbors", torch.device("cpu"), Result(rows, {"share": 0.125}), tmp_path)
    return tmp_path


def test_block_is_replaced_and_the_rest_stays(results: Path):
    made = filled(PART.format("table"), results)

    assert made.startswith("before\n<!-- results: neighbors_cpu table -->\n")
    assert made.endswith("<!-- end of results -->\nafter\n")
    assert "| knn/ours | 500.00 | 1000.00 | 2.00x | SciPy |" in made
    assert made.count("k = 16") == 1  # shared by all rows, so it stands once
    assert "old figures" not in made
    assert filled(made, results) == made
    assert "| share | 0.125 |" in filled(PART.format("facts"), results)
    assert "neighbors_cpu.png" in filled(PART.format("plot"), results)


def test_making_of_data_gets_a_line_per_set(tmp_path: Path):
    rows = [
        row("read/lzf", [0.004], "image by image", [0.008]),
        row("make/movi_a/simulate", [0.5]),
        row("make/movi_a/render", [2.0]),
        row("make/movi_a/write", [0.25]),
        row("make/movi_a/whole", [2.75], note="96 views of 8x8"),
    ]
    facts = {"views per CPU second, movi_a": 35.0, "CPU minutes, movi_a": 17.4}
    write("data", torch.device("cpu"), Result(rows, facts), tmp_path)

    made = filled("<!-- results: data_cpu making -->\n<!-- end of results -->", tmp_path)
    read = filled("<!-- results: data_cpu reading -->\n<!-- end of results -->", tmp_path)

    assert "| movi_a | 0.50 | 2.00 | 0.25 | 2.75 | 35 | 17 | 96 views of 8x8 |" in made
    assert "read/lzf" not in made
    assert "| read/lzf | 4.00 | 8.00 | 2.00x |" in read
    assert "movi_a" not in read


def test_missing_result_is_said_and_an_unknown_view_refused(results: Path):
    assert "Not measured" in filled(PART.format("table").replace("neighbors", "renderer"), results)
    with pytest.raises(ValueError, match="no view"):
        filled(PART.format("dance"), results)


def test_blocks_of_the_page_can_be_filled(results: Path):
    assert PAGE.read_text().count("<!-- results: ") == PAGE.read_text().count("<!-- end of results -->") > 0
    filled(PAGE.read_text(), results)
