"""The suites of ``vpd-bench``, one module each: ``run(options)`` measures, ``draw(result, path)`` plots."""

from difflib import get_close_matches
from importlib import import_module
from typing import Any

from vpd_lightning.errors import ConfigError

SUITES = ("neighbors", "renderer", "dynamics", "train_step", "rollout", "accuracy", "scaling", "scenery", "data")


def chosen(names: list[str]) -> list[str]:
    """Return the suites to run, in the order of ``SUITES``; ``all`` means all of them.

    Raises:
        ConfigError: a name that is no suite.
    """
    for name in names:
        if name not in (*SUITES, "all"):
            near = get_close_matches(name, (*SUITES, "all"), n=1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise ConfigError(f"there is no suite {name!r}.{hint}\nSuites: {', '.join(SUITES)}, all.")
    if not names:
        raise ConfigError(f"no suite was named.\nSuites: {', '.join(SUITES)}, all.")
    return [name for name in SUITES if name in names or "all" in names]


def load(name: str) -> Any:
    """Return the module of a suite."""
    return import_module(f"benchmarks.suites.{name}")
