"""The knobs of trained stages: which settings to try, and the setting that counts as the truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Settings = Mapping[str, Any]


@dataclass(frozen=True)
class Knob:
    """One thing to turn. ``keys`` are the settings that it sets; ``values`` are numbers, or factors of the default.

    A knob without keys is turned outside the stage (precision, number of particles). ``allowed`` looks at the stage's
    settings and the value.
    """

    name: str
    keys: Sequence[str]
    values: Sequence[Any]
    is_factor: bool = False
    allowed: Callable[[Settings, Any], bool] = lambda settings, value: True

    def values_for(self, settings: Settings) -> list[Any]:
        """Return the values to try; factors become tuples with one value per key."""
        if not self.is_factor:
            return list(self.values)
        found = [tuple(max(1, round(settings[key] * factor)) for key in self.keys) for factor in self.values]
        return [value for value in dict.fromkeys(found) if value != tuple(settings[key] for key in self.keys)]

    def changes(self, value: Any) -> dict[str, Any]:
        """Return the settings to change."""
        values = value if self.is_factor else [value] * len(self.keys)
        return dict(zip(self.keys, values, strict=True))

    def label(self, value: Any) -> str:
        """Name a value in a plot."""
        return "+".join(map(str, value)) if isinstance(value, tuple) else str(value)

    def is_allowed(self, settings: Settings, value: Any) -> bool:
        """Whether the stage would take the value beside its other settings."""
        return self.allowed(settings, value)


def _more_than_uniform(settings: Settings, value: Any) -> bool:
    return value[0] > settings["num_uniform_samples"]


def _enough_candidates(settings: Settings, value: Any) -> bool:
    return value[0] >= settings["num_neighbors"]


PARTICLES = Knob("particles kept", (), (0.125, 0.25, 0.5, 0.75))
PRECISION = Knob("precision", (), ("bf16",))
RENDERER_KNOBS: dict[str, Sequence[Knob]] = {
    "point_nerf": (
        Knob(
            "samples, coarse + fine", ("num_coarse_samples", "num_fine_samples"), (0.25, 0.5, 0.75, 1.5), True,
            allowed=lambda settings, value: value[0] >= 3,
        ),
        Knob("num_neighbors", ("num_neighbors",), (0.25, 0.5, 2.0), True),
        Knob("max_radius", ("max_radius",), (0.2, 0.4, 0.8, 1.6)),
        PARTICLES,
        PRECISION,
    ),
    "surface": (
        Knob("num_samples", ("num_samples",), (0.5, 0.67, 1.5, 2.0, 3.0), True, allowed=_more_than_uniform),
        Knob("num_uniform_samples", ("num_uniform_samples",), (0.5, 1.5), True),
        Knob("num_candidates", ("num_candidates",), (0.67, 1.33, 2.0, 3.0), True, allowed=_enough_candidates),
        Knob("num_neighbors", ("num_neighbors",), (0.25, 0.5, 0.75), True),
        Knob("hint_spread", ("hint_spread",), (1.0, 2.0)),
        PARTICLES,
        PRECISION,
    ),
    "splat": (
        Knob("num_candidates", ("num_candidates",), (0.25, 0.5, 0.75, 1.5, 2.0), True),
        PARTICLES,
        PRECISION,
    ),
}  # fmt: skip
DYNAMICS_KNOBS: dict[str, Sequence[Knob]] = {
    "hierarchical_gnn": (
        Knob("num_abstract_nodes", ("num_abstract_nodes",), (0.25, 0.5, 2.0), True),
        Knob("max_abstract_neighbors", ("max_abstract_neighbors",), (0.5, 2.0), True),
    ),
    "inertial": (
        Knob("num_probes", ("num_probes",), (0.25, 0.5, 2.0), True),
        Knob("num_contact_iterations", ("num_contact_iterations",), (0.5, 2.0), True),
    ),
}
# Off: what leaves something out, and what could differ from the plain formula.
_EXACT = {"max_radius": None, "features_backend": "torch"}
# The dense reference has this many times the samples, and candidates where a renderer looks at a few particles only.
# What a field was trained to sum over (num_neighbors, the candidates of splat) defines it and stays.
_MORE = {
    "point_nerf": {"num_coarse_samples": 2, "num_fine_samples": 2},
    "surface": {"num_samples": 4, "num_uniform_samples": 4, "num_candidates": 4},
}


def reference_changes(kind: str, settings: Settings) -> dict[str, Any]:
    """Return the settings of the dense reference of a renderer: nothing left out, more samples, the trained weights."""
    changes = {key: value for key, value in _EXACT.items() if key in settings}
    return changes | {key: settings[key] * factor for key, factor in _MORE.get(kind, {}).items()}
