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


def test_missing_result_is_said_and_an_unknown_view_refused(results: Path):
    assert "Not measured" in filled(PART.format("table").replace("neighbors", "renderer"), results)
    with pytest.raises(ValueError, match="no view"):
        filled(PART.format("dance"), results)


def test_blocks_of_the_page_can_be_filled(results: Path):
    assert PAGE.read_text().count("<!-- results: ") == PAGE.read_text().count("<!-- end of results -->") > 0
    filled(PAGE.read_text(), results)
