"""What a report compares, and where an evaluation keeps it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

REFERENCES = ("copy_last", "train_mean")


@dataclass(frozen=True)
class Measure:
    """One column of the tables.

    ``better`` is ``higher``, ``lower`` or ``one`` (the closer to 1 the better: half is as far as twice); printed values
    are ``scale`` times the stored ones. ``places`` are the paths of its summary in ``metrics.json`` and ``arrays`` its
    names in ``arrays.npz``, of which the first that exists counts. References have their own value where ``is_image``.
    """

    name: str
    title: str
    better: str
    digits: int
    scale: float
    places: tuple[str, ...]
    arrays: tuple[str, ...]
    is_image: bool

    def summary(self, metrics: Mapping[str, Any], source: str = "model") -> Mapping[str, Any] | None:
        """Return the object with ``mean``, ``ci95``, ``per_step``; None where this evaluation has none."""
        if source != "model":
            metrics = _section(metrics, f"references.{source}") or {}
        for place in self.places if source == "model" or self.is_image else ():
            found = _section(metrics, place)
            if found is not None and found.get("mean") is not None:
                return found
        return None

    def array_names(self, source: str = "model") -> tuple[str, ...]:
        """Return the names to look for in ``arrays.npz``."""
        if source == "model":
            return self.arrays
        return (f"{source}/{self.name}",) if self.is_image else ()

    def distance(self, value: float) -> float:
        """How far a value is from what one wishes; the smaller the better."""
        return {"higher": -value, "lower": value, "one": abs(math.log(max(value, 1e-6)))}[self.better]

    def shown(self, value: float | None) -> str:
        """The value as tables print it."""
        return "-" if value is None else f"{self.scale * value:.{self.digits}f}"


def _section(content: Mapping[str, Any], place: str) -> Mapping[str, Any] | None:
    found: Any = content
    for key in place.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found if isinstance(found, Mapping) else None


def _image(name: str, title: str, better: str, digits: int) -> Measure:
    return Measure(name, title, better, digits, 1.0, (name,), (f"model/{name}",), True)


def _motion(name: str, title: str) -> Measure:
    return Measure(
        name, title, "lower", 2, 100.0, (f"motion.{name}", name), (f"motion/{name}", f"{name}/mean", name), False
    )


MEASURES = (
    _image("psnr", "PSNR (dB)", "higher", 2),
    _image("psnr_moving", "PSNR moving (dB)", "higher", 2),
    _image("ssim", "SSIM", "higher", 3),
    _image("sharpness", "sharpness ratio", "one", 3),
    Measure("chamfer", "Chamfer (cm)", "lower", 2, 100.0, ("chamfer",), ("chamfer/mean",), False),
    _motion("centroid_error", "centroid error (cm)"),
    _motion("rigidity_error", "rigidity error (cm)"),
    _motion("body_chamfer", "distance to true surface (cm)"),
    _motion("penetration", "deepest particle (cm)"),
)
BY_NAME = {measure.name: measure for measure in MEASURES}
