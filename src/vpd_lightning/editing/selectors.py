"""Selections of particles that can be stored and applied to another scene: regions, colours, clusters, sets."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from vpd_lightning.editing.rotation import Numbers, vector_of
from vpd_lightning.editing.state import EditState
from vpd_lightning.errors import EditError
from vpd_lightning.geometry.cameras import project
from vpd_lightning.types import Cameras


class Selector(ABC):
    """Says which particles of the current frame are meant; ``|``, ``&``, ``-`` and ``~`` are set operations."""

    @abstractmethod
    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        """Return the selected slots; padding may be among them and is left out by ``select``."""

    def select(self, state: EditState) -> Bool[Tensor, " particle"]:
        """Return the selected particles, none of them padding."""
        return self.find(state) & state.mask

    def __or__(self, other: "Selector") -> "Selector":
        return AnyOf((self, other))

    def __and__(self, other: "Selector") -> "Selector":
        return AllOf((self, other))

    def __invert__(self) -> "Selector":
        return Not(self)

    def __sub__(self, other: "Selector") -> "Selector":
        return AllOf((self, Not(other)))


@dataclass(frozen=True)
class Everything(Selector):
    """All particles."""

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        return torch.ones_like(state.mask)


@dataclass(frozen=True)
class Box(Selector):
    """Particles between two corners (metres, world), border included."""

    low: Numbers
    high: Numbers

    def __post_init__(self) -> None:
        low, high = vector_of(self.low, "box.low"), vector_of(self.high, "box.high")
        if any(a > b for a, b in zip(low, high, strict=True)):
            raise EditError(f"A box from {low} to {high} holds nothing.\nbox.low must not lie above box.high.")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        low, high = (torch.tensor(corner).to(state.positions) for corner in (self.low, self.high))
        return ((state.positions >= low) & (state.positions <= high)).all(dim=-1)


@dataclass(frozen=True)
class Sphere(Selector):
    """Particles within ``radius`` of ``center`` (metres, world)."""

    center: Numbers
    radius: Numbers

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", vector_of(self.center, "sphere.center"))
        (radius,) = vector_of([self.radius], "sphere.radius", 1)
        if radius < 0:
            raise EditError(f"sphere.radius is {radius}.\nAllowed: 0 metres or more.")
        object.__setattr__(self, "radius", radius)

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        offsets = state.positions - torch.tensor(self.center).to(state.positions)
        return offsets.square().sum(dim=-1) <= self.radius**2


@dataclass(frozen=True)
class Lasso(Selector):
    """Particles that a pinhole camera sees inside a polygon (pixels, x right, y down), whatever hides them.

    ``intrinsics`` (3, 3) in pixels and ``cam_to_world`` (4, 4) in metres, OpenCV axes. ``max_depth`` (metres along the
    optical axis) leaves out what lies behind; None: nothing does. Even-odd rule where the line crosses itself.
    """

    intrinsics: Numbers
    cam_to_world: Numbers
    polygon: Numbers
    max_depth: Numbers = None

    def __post_init__(self) -> None:
        for name, rows in (("intrinsics", 3), ("cam_to_world", 4)):
            given = getattr(self, name)
            if not isinstance(given, Sequence) or len(given) != rows:
                raise EditError(f"lasso.{name} is {given!r}.\nAllowed: a {rows}x{rows} matrix.")
            matrix = tuple(vector_of(row, f"lasso.{name}", rows) for row in given)
            object.__setattr__(self, name, matrix)
        if not isinstance(self.polygon, Sequence):
            raise EditError(f"lasso.polygon is {self.polygon!r}.\nAllowed: a list of corners.")
        object.__setattr__(self, "polygon", tuple(vector_of(point, "lasso.polygon", 2) for point in self.polygon))
        if len(self.polygon) < 3:
            raise EditError(f"lasso.polygon has {len(self.polygon)} corners.\nAllowed: 3 or more.")
        if self.max_depth is not None and vector_of([self.max_depth], "lasso.max_depth", 1)[0] <= 0:
            raise EditError(f"lasso.max_depth is {self.max_depth}.\nAllowed: above 0 metres, or null.")

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        points = state.positions.double()
        camera = Cameras(torch.tensor(self.intrinsics).to(points), torch.tensor(self.cam_to_world).to(points), 1, 1)
        pixels, depths = project(points, camera)
        inside = _inside_polygon(pixels, torch.tensor(self.polygon).to(points)) & (depths > 0)
        return inside if self.max_depth is None else inside & (depths <= self.max_depth)


@dataclass(frozen=True)
class Color(Selector):
    """Particles whose colour is within ``tolerance`` of ``rgb`` (sRGB in [0, 1], root of summed squares)."""

    rgb: Numbers
    tolerance: Numbers

    def __post_init__(self) -> None:
        rgb = vector_of(self.rgb, "color.rgb")
        if min(rgb) < 0 or max(rgb) > 1:
            raise EditError(f"color.rgb is {rgb}.\nAllowed: numbers from 0 to 1.")
        object.__setattr__(self, "rgb", rgb)
        (tolerance,) = vector_of([self.tolerance], "color.tolerance", 1)
        if tolerance < 0:
            raise EditError(f"color.tolerance is {tolerance}.\nAllowed: 0 or more.")

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        if state.colors is None:
            raise EditError(
                "This scene's particles have no colours.\n"
                "Give SceneEditor colors=..., for example those of vpd_lightning.media.particle_colors."
            )
        difference = state.colors - torch.tensor(self.rgb).to(state.colors)
        return difference.square().sum(dim=-1) <= self.tolerance**2


@dataclass(frozen=True)
class Cluster(Selector):
    """One object-like cluster: by number (0 has most particles), or the one ``nearest`` to a point (metres, world)."""

    index: Numbers = None
    nearest: Numbers = None

    def __post_init__(self) -> None:
        if (self.index is None) == (self.nearest is None):
            raise EditError("A cluster is chosen by its index or by nearest=[x, y, z].\nGive one of both.")
        if self.index is not None and (type(self.index) is not int or self.index < 0):
            raise EditError(f"cluster.index is {self.index!r}.\nAllowed: a whole number from 0 up.")
        if self.nearest is not None:
            object.__setattr__(self, "nearest", vector_of(self.nearest, "cluster.nearest"))

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        labels = torch.where(state.mask, state.clusters, -1)
        if not bool((labels >= 0).any()):
            raise EditError("This scene has no object-like clusters.\nSelect by box, sphere, lasso or colour.")
        index = self.index
        if self.nearest is not None:
            offsets = state.positions - torch.tensor(self.nearest).to(state.positions)
            distances = offsets.square().sum(dim=-1).masked_fill(labels < 0, float("inf"))
            index = int(labels[distances.argmin()])
        elif index > int(labels.max()):
            raise EditError(f"There is no cluster {index}: the scene has {int(labels.max()) + 1}.")
        return labels == index


@dataclass(frozen=True)
class Slots(Selector):
    """Particles by number, of this one scene: a mask. It can neither be stored nor applied to another scene."""

    chosen: Bool[Tensor, " particle"]

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        if self.chosen.shape != state.mask.shape:
            raise EditError(
                f"The mask has shape {tuple(self.chosen.shape)}, the scene's current frame {tuple(state.mask.shape)}."
            )
        return self.chosen.to(state.mask.device)


@dataclass(frozen=True)
class AnyOf(Selector):
    """The union of selections."""

    parts: Sequence[Selector]

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        return torch.stack([part.select(state) for part in self.parts]).any(dim=0)


@dataclass(frozen=True)
class AllOf(Selector):
    """What all selections have in common."""

    parts: Sequence[Selector]

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        return torch.stack([part.select(state) for part in self.parts]).all(dim=0)


@dataclass(frozen=True)
class Not(Selector):
    """All other particles."""

    part: Selector

    def find(self, state: EditState) -> Bool[Tensor, " particle"]:
        return ~self.part.select(state)


def selector_of(what: "Selector | Tensor") -> Selector:
    """Return a selector as it is, or one for a mask (particle,) or (1, particle) of the current frame.

    Raises:
        EditError: it is neither.
    """
    if isinstance(what, Selector):
        return what
    if isinstance(what, Tensor) and what.dtype == torch.bool:
        return Slots(what[0] if what.ndim == 2 and len(what) == 1 else what)
    raise EditError(f"{type(what).__name__} selects nothing.\nGive a selector, or a mask of booleans.")


def _inside_polygon(pixels: Tensor, corners: Tensor) -> Tensor:
    """Even-odd rule: how often does the line from a point to the right cross the polygon?

    Side after side: all at once would be (particle, corner) numbers, which no cache holds.
    """
    x, y = pixels.unbind(-1)
    inside = torch.zeros_like(x, dtype=torch.bool)
    ends = corners.tolist()
    for (x1, y1), (x2, y2) in zip(ends, ends[1:] + ends[:1], strict=True):
        if y1 != y2:
            inside ^= ((y1 <= y) != (y2 <= y)) & (x < x1 + (y - y1) * ((x2 - x1) / (y2 - y1)))
    return inside
