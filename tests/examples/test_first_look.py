"""The notebook runs as it stands, in an empty folder, and is committed without outputs."""

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

from tests.waiting import HANG

NOTEBOOK = Path(__file__).parents[2] / "examples" / "first_look.ipynb"


@pytest.fixture
def notebook() -> Any:
    return nbformat.read(NOTEBOOK, as_version=4)


def test_the_notebook_is_committed_without_outputs(notebook: Any) -> None:
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert code and all(not cell.outputs and cell.execution_count is None for cell in code)
    assert all(not line.startswith(("!", "%")) for cell in code for line in cell.source.splitlines())


@pytest.mark.slow
@pytest.mark.documents
def test_the_notebook_runs(notebook: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # `make test` sets it, and no picture would be shown
    place = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=int(HANG), resources=place).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 5, "inputs, prediction, ring, particles, distances"
    assert any("video" in str(output.get("data", {}).get("text/html", ""))[:2000] for output in outputs)
    printed = "".join(output.text for output in outputs if output.output_type == "stream")
    assert "the same particles as rollout's" in printed
    assert (tmp_path / "first_look" / "rollout.webm").stat().st_size > 1000
