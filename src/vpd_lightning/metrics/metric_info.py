"""What is known of one metric: what it is called, what is better, how it is printed, and which function measures it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

Subject = Literal["image", "particles", "body"]
Better = Literal["higher", "lower", "one", "none"]
_PRINTED = {"m": (100.0, "cm"), "m/s": (100.0, "cm/s")}  # what is stored in metres is read in centimetres


@dataclass(frozen=True, kw_only=True)
class MetricInfo:
    """One line of the list of metrics. Nothing is imported before ``load`` is called.

    ``better`` is ``higher``, ``lower``, ``one`` (the closer to 1 the better: half is as far as twice), or ``none`` for
    what describes a motion without judging it. ``unit`` is that of the stored values. ``function`` is a dotted name; by
    ``subject`` it is called with

    - ``image``: predicted images and ``TrueImages``, and returns ``step view``;
    - ``particles``: predicted positions ``step particle 3`` and the true points of each step, and returns ``step``;
    - ``body``: the ``BodyTrack`` of one body, and returns ``step``.

    ``parts`` names several arrays that it measures at once, as keys of a dictionary; the first of them is the metric.
    ``pooled_part`` is the part whose mean over all images is converted to decibels beside the mean of the images'.

    A metric is shown wherever it exists, unless ``in_tables`` (comparisons of systems) or ``in_summary`` say otherwise.
    ``needs_motion``: it counts moving pixels only. ``has_extremes``: its smallest and largest value are kept, too.
    ``why_missing``: its values are NaN where something is not installed, and summaries then say this.
    ``reference_of`` names the metric of which this one is the value of a prediction that needs no model;
    ``sees_input`` is whether that prediction uses the input.
    """

    name: str
    title: str
    unit: str
    better: Better
    digits: int
    subject: Subject
    function: str
    description: str
    parts: tuple[str, ...] = ()
    pooled_part: str | None = None
    in_tables: bool = True
    in_summary: bool = True
    needs_motion: bool = False
    has_extremes: bool = False
    why_missing: str | None = None
    reference_of: str | None = None
    sees_input: bool = False

    def load(self) -> Callable[..., Any]:
        """Import the function."""
        module, _, name = self.function.rpartition(".")
        found: Callable[..., Any] = getattr(import_module(module), name)
        return found

    @property
    def part_names(self) -> tuple[str, ...]:
        """The names of all arrays; the first is that of the metric."""
        return self.parts or (self.name if self.subject == "image" else "mean",)

    def as_parts(self, values: Any) -> dict[str, Any]:
        """Name what the function returned.

        Raises:
            ValueError: it returned other parts than the list says.
        """
        named = values if isinstance(values, dict) else {self.part_names[0]: values}
        if set(named) != set(self.part_names):
            raise ValueError(f"{self.function} returns {sorted(named)}, and the list of metrics {self.part_names}")
        return named

    # -- how it is printed -----------------------------------------------------------------------------------------

    @property
    def scale(self) -> float:
        """Printed values are this many times the stored ones."""
        return _PRINTED.get(self.unit, (1.0, ""))[0]

    @property
    def printed_unit(self) -> str:
        """The unit of printed values."""
        return _PRINTED.get(self.unit, (1.0, self.unit))[1]

    @property
    def label(self) -> str:
        """The title with what a reader of a number needs: its unit, or which value is the best one."""
        if self.better == "one":
            return f"{self.title} (truth: 1)"
        return f"{self.title} ({self.printed_unit})" if self.unit else self.title

    def shown(self, value: float | None) -> str:
        """The number as it is printed, without its unit."""
        return "-" if value is None else f"{self.scale * value:.{self.digits}f}"

    def spoken(self, value: float | None) -> str:
        """Title, number and unit."""
        return f"{self.title} {self.shown(value)}{f' {self.printed_unit}' if self.unit else ''}"

    # -- how it is compared ----------------------------------------------------------------------------------------

    @property
    def is_score(self) -> bool:
        """Whether it ranks predicted images."""
        return self.subject == "image" and self.better in ("higher", "lower")

    def distance(self, value: float) -> float:
        """How far a value is from what one wishes; the smaller the better."""
        if self.better == "one":
            return abs(math.log(max(value, 1e-6)))
        return -value if self.better == "higher" else value

    # -- where evaluations keep it -----------------------------------------------------------------------------------

    @property
    def has_block(self) -> bool:
        """Whether it stands by itself in ``metrics.json``, with its parts; images and motion have a place in common."""
        return self.subject == "particles" or (self.subject == "body" and bool(self.parts))

    @property
    def place(self) -> str:
        """Where its summary stands in ``metrics.json``; keys are joined by dots."""
        return self.name if self.subject == "image" or self.has_block else f"motion.{self.name}"

    def array_names(self, source: str = "model") -> tuple[str, ...]:
        """Return its names in ``arrays.npz``, of which the first that is there counts (older files had others)."""
        if self.subject == "image":
            return (f"{source}/{self.name}",)
        if source != "model":
            return ()
        block = f"{self.name}/{self.part_names[0]}"
        return (block, f"motion/{self.name}") if self.has_block else (f"motion/{self.name}", block)

    def summary(self, metrics: Mapping[str, Any], source: str = "model") -> Mapping[str, Any] | None:
        """Return the object with ``mean``, ``ci95``, ``per_step``; None where this evaluation has none."""
        if source != "model":
            metrics = section(metrics, f"references.{source}") or {}
            if self.subject != "image":
                return None
        for place in dict.fromkeys((self.place, f"motion.{self.name}", self.name)):
            found = section(metrics, place)
            if found is not None and found.get("mean") is not None:
                return found
        return None


def section(content: Mapping[str, Any], place: str) -> Mapping[str, Any] | None:
    """Return the object at a place (keys joined by dots); None where there is none."""
    found: Any = content
    for key in place.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found if isinstance(found, Mapping) else None
