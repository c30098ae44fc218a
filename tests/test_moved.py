"""Old module names keep working: plug-ins, notebooks and stored configurations name them."""

import warnings
from importlib import import_module

import pytest

from vpd_lightning.config.migrations import upgraded
from vpd_lightning.moved import MOVED, current_name


@pytest.mark.parametrize("old", sorted({name.rpartition(".")[0] for name in MOVED}))
def test_an_old_name_gives_the_moved_module_itself(old: str) -> None:
    for name in (name for name in MOVED if name.rpartition(".")[0] == old):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            module = import_module(name)
        assert module is import_module(MOVED[name]), name
        assert module.__name__ == module.__spec__.name == MOVED[name]  # type: ignore[union-attr]


def test_an_import_of_an_old_name_warns() -> None:
    import sys

    sys.modules.pop("vpd_lightning.report.sums", None)
    with pytest.warns(DeprecationWarning, match="vpd_lightning.comparison.bootstrap"):
        import_module("vpd_lightning.report.sums")


def test_a_name_that_never_was_is_not_found() -> None:
    with pytest.raises(ModuleNotFoundError):
        import_module("vpd_lightning.report.never")


def test_stored_configurations_name_classes_where_they_are_now() -> None:
    stored = {"dynamics": {"first": {"_target_": "vpd_lightning.dynamics.first_velocity.FirstVelocity"}}}
    assert upgraded(stored)["dynamics"]["first"]["_target_"] == (
        "vpd_lightning.dynamics.inertial.first_velocity.FirstVelocity"
    )
    assert current_name("my_lab.dynamics.Mine") == "my_lab.dynamics.Mine"
