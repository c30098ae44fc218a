"""``auto``: a fixed rule that the committed measurements support."""

import pytest
import torch

from vpd_lightning.graph.neighbors import automatic, automatic_backend

CPU, CUDA = torch.device("cpu"), torch.device("cuda")


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """The packages that the rule believes to be there; empty at first."""
    packages: set[str] = set()
    monkeypatch.setattr(automatic, "_is_installed", packages.__contains__)
    return packages


def test_the_rule_with_and_without_optional_packages(installed: set[str]) -> None:
    assert automatic_backend(CPU, 10) == "torch"
    assert automatic_backend(CPU, 16384) == "scipy"
    assert automatic_backend(CPU, 1024, is_radius=True) == "torch"
    assert automatic_backend(CPU, 100000, is_radius=True) == "scipy"
    assert automatic_backend(CUDA, 16384) == "torch"
    installed |= {"numba", "triton"}
    assert automatic_backend(CPU, 10) == "torch"
    assert automatic_backend(CPU, 16384) == "numba"
    assert automatic_backend(CPU, 1024, is_radius=True) == "numba"
    assert automatic_backend(CUDA, 16384) == "triton"
    assert automatic_backend(CUDA, 16384, is_radius=True) == "torch"


def test_the_graph_takes_torch_cluster_where_it_is_installed_and_the_renderer_does_not(installed: set[str]) -> None:
    installed |= {"numba", "triton", "torch_cluster"}
    for device in (CPU, CUDA):
        assert automatic_backend(device, 1024, is_graph=True) == "torch_cluster"
        assert automatic_backend(device, 16384) != "torch_cluster"


def test_no_row_of_the_committed_table_has_a_backend_far_ahead_of_the_rule(installed: set[str]) -> None:
    rows = automatic.measurements()
    assert {row["search"] for row in rows} == {"knn", "radius"} and len(rows) >= 20
    for others in (set(), {"numba"}):
        installed.clear()
        installed |= others
        for row in rows:
            chosen = automatic_backend(torch.device(row["device"]), row["points"], is_radius=row["search"] == "radius")
            seconds = {name: value for name, value in row["seconds"].items() if name in {"torch", "scipy", *others}}
            # Twice as long as the best is allowed, and so is a difference that nobody notices.
            assert seconds[chosen] <= max(2 * min(seconds.values()), min(seconds.values()) + 1e-3), row
