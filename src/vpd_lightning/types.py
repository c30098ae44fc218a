"""What crosses a stage border: cameras, RGB-D frames, particles, rays, rendered rays and training batches."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import ArrayLike
from torch import Tensor

from vpd_lightning.finite import is_traced
from vpd_lightning.randomness import RandomKeys

NUM_CONTEXT_FRAMES = 2
"""Observed frames that a model of particles starts from: two give each particle a position and a velocity."""

OTHER_AXES = ("scenery", "occluders", "hidden_side", "driven", "pictures")
"""Fields of particles that have an axis of their own in place of that of the particles."""

Border = TypeVar("Border", bound="_Border")


def _moved(value: Any, *args: Any, **kwargs: Any) -> Any:
    """Move tensors and border dataclasses; leave plain values alone. A dtype touches floating tensors only."""
    return value.to(*args, **kwargs) if isinstance(value, (Tensor, _Border)) else value


def mapped_tensors(function: Callable[..., Tensor], tree: Any, *others: Any) -> Any:
    """Apply a function to each tensor of dataclasses and tuples, however deep, with those of others at its place."""
    if isinstance(tree, Tensor):
        return function(tree, *others)
    if isinstance(tree, tuple):
        return tuple(mapped_tensors(function, *parts) for parts in zip(tree, *others, strict=True))
    if not is_dataclass(tree) or isinstance(tree, type):
        return tree
    names = [item.name for item in fields(tree)]
    parts = {name: mapped_tensors(function, *(getattr(one, name) for one in (tree, *others))) for name in names}
    return replace(tree, **parts)


# None may be given; readers always find a tensor (see Particles.__post_init__), and the annotations say so.
_Mask: TypeAlias = Tensor if TYPE_CHECKING else Bool[Tensor, "*batch particle"] | None  # type: ignore[valid-type]


class _Border:
    """Mixin of the frozen dataclasses below: ``.to(device)`` or ``.to(dtype)``, field by field."""

    def to(self: Border, *args: Any, **kwargs: Any) -> Border:
        moved = {}
        for item in fields(self):  # type: ignore[arg-type]
            value = getattr(self, item.name)
            if isinstance(value, Tensor) and not value.is_floating_point():
                device_args = [a for a in args if not isinstance(a, torch.dtype)]
                device_kwargs = {k: v for k, v in kwargs.items() if k != "dtype"}
                moved[item.name] = value.to(*device_args, **device_kwargs) if device_args or device_kwargs else value
            else:
                moved[item.name] = _moved(value, *args, **kwargs)
        return replace(self, **moved)  # type: ignore[type-var]


@dataclass(frozen=True)
class Cameras(_Border):
    """Pinhole cameras, OpenCV axes (x right, y down, z forward), pixel centres at +0.5.

    ``intrinsics`` are in pixels; ``cam_to_world`` maps camera to world coordinates in metres.
    """

    intrinsics: Float[Tensor, "*shape 3 3"]
    cam_to_world: Float[Tensor, "*shape 4 4"]
    height: int
    width: int

    @classmethod
    def from_arrays(cls, intrinsics: ArrayLike, cam_to_world: ArrayLike, height: int, width: int) -> "Cameras":
        """Return cameras of NumPy arrays, nested lists or tensors, as float32.

        Raises:
            ValueError: shapes other than (..., 3, 3) and (..., 4, 4), or leading axes that differ.
        """
        matrices = [torch.as_tensor(part, dtype=torch.float32) for part in (intrinsics, cam_to_world)]
        shapes = [tuple(part.shape) for part in matrices]
        if shapes[0][-2:] != (3, 3) or shapes[1][-2:] != (4, 4) or shapes[0][:-2] != shapes[1][:-2]:
            raise ValueError(
                f"intrinsics must be (view, 3, 3) and cam_to_world (view, 4, 4), got {shapes[0]} and {shapes[1]}"
            )
        return cls(matrices[0], matrices[1], height, width)

    def __getitem__(self, index: Any) -> "Cameras":
        return Cameras(self.intrinsics[index], self.cam_to_world[index], self.height, self.width)

    @property
    def shape(self) -> torch.Size:
        """Leading axes (for example ``batch view``)."""
        return self.intrinsics.shape[:-2]


@dataclass(frozen=True)
class Driven(_Border):
    """Points on what is driven, such as a robot's surface, whose motion is given: an action.

    World frame, metres; ``normals`` are outward and of unit length. ``groups`` counts the rigid parts from 0, ``mask``
    is false for padding. Leading axes are those of the particles or frames that they come with, or ``batch step`` for
    a motion. ``features`` (how each point looks, from an encoder) and where the points are one step later
    (``next_positions``, ``next_normals``, for a dynamics) are there once they are known.
    """

    positions: Float[Tensor, "*shape driven 3"]
    normals: Float[Tensor, "*shape driven 3"]
    groups: Int[Tensor, "*shape driven"]
    mask: _Mask = None  # type: ignore[assignment]
    features: Float[Tensor, "*shape driven feature"] | None = None
    next_positions: Float[Tensor, "*shape driven 3"] | None = None
    next_normals: Float[Tensor, "*shape driven 3"] | None = None

    def __post_init__(self) -> None:
        if self.mask is None:
            object.__setattr__(self, "mask", torch.ones_like(self.groups, dtype=torch.bool))

    @classmethod
    def from_arrays(cls, points: ArrayLike, normals: ArrayLike, groups: ArrayLike | None = None) -> "Driven":
        """Return a motion of NumPy arrays, nested lists or tensors: points and normals (..., step, point, 3) in metres.

        ``groups`` (point) says which rigid part a point belongs to; None: all belong to one.

        Raises:
            ValueError: shapes that do not fit each other.
        """
        places, facing = (torch.as_tensor(part, dtype=torch.float32) for part in (points, normals))
        if places.dim() < 3 or places.shape != facing.shape or places.shape[-1] != 3:
            raise ValueError(
                "points and normals of what is driven must both be (step, point, 3), "
                f"got {tuple(places.shape)} and {tuple(facing.shape)}"
            )
        parts = torch.zeros(places.shape[-2]) if groups is None else torch.as_tensor(groups)
        if parts.shape != places.shape[-2:-1]:
            raise ValueError(
                f"groups must name the part of each of {places.shape[-2]} points, got {tuple(parts.shape)}"
            )
        return cls(places, facing, parts.long().expand(places.shape[:-1]))

    def __getitem__(self, index: Any) -> "Driven":
        return self.mapped(lambda values: values[index])

    def mapped(self, function: Callable[[Tensor], Tensor]) -> "Driven":
        """Apply a function to every tensor."""
        known = {item.name: value for item in fields(self) if (value := getattr(self, item.name)) is not None}
        return Driven(**{name: function(value) for name, value in known.items()})

    def towards(self, following: "Driven") -> "Driven":
        """Return the same points with where they are one step later; see ``next_positions``."""
        return replace(self, next_positions=following.positions, next_normals=following.normals)

    def advanced(self) -> "Driven":
        """Return the points one step later, where that is known; otherwise as they are."""
        if self.next_positions is None or self.next_normals is None:
            return self
        moved = replace(self, positions=self.next_positions, normals=self.next_normals)
        return replace(moved, next_positions=None, next_normals=None)


@dataclass(frozen=True)
class RGBDFrames(_Border):
    """RGB-D images of one or more time steps; ``rgb`` is uint8, or float in [0, 1].

    ``depth`` is z-depth in metres, 0 or non-finite where there is no measurement. ``driven`` is where what is driven
    was at each of the time steps; it has no view axis.
    """

    rgb: Float[Tensor, "*shape height width 3"] | UInt8[Tensor, "*shape height width 3"]
    depth: Float[Tensor, "*shape height width"]
    cameras: Cameras
    driven: Driven | None = None

    def __getitem__(self, index: Any) -> "RGBDFrames":
        driven = self.driven
        if driven is not None:
            each = index if isinstance(index, tuple) else (index,)
            driven = driven[each[: driven.mask.dim() - 1]]
        return RGBDFrames(self.rgb[index], self.depth[index], self.cameras[index], driven)


@dataclass(frozen=True)
class Scenery(_Border):
    """What stands still in a clip: one point for almost every pixel that saw it, for the renderer alone.

    ``colors`` are as observed (in [0, 1]), shadows included; ``occluders`` are points of what moved at that time, which
    cast them. ``normals`` have unit length, zero where unknown. ``sizes`` is the width of the pixel at the point's
    distance (metres), ``views`` the unit direction in which it was seen. Pixels in ``far_mask`` measured no distance
    (the sky, what is beyond a sensor's reach): they are no points, ``views`` is the direction in which they were seen
    and ``sizes`` their width at a metre (radians).
    """

    positions: Float[Tensor, "*batch point 3"]
    colors: Float[Tensor, "*batch point 3"]
    normals: Float[Tensor, "*batch point 3"]
    views: Float[Tensor, "*batch point 3"]
    sizes: Float[Tensor, "*batch point"]
    mask: Bool[Tensor, "*batch point"]
    occluders: Float[Tensor, "*batch occluder 3"]
    occluder_mask: Bool[Tensor, "*batch occluder"]
    far_mask: _Mask = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.far_mask is None:
            object.__setattr__(self, "far_mask", torch.zeros_like(self.mask))

    def __getitem__(self, index: Any) -> "Scenery":
        return Scenery(**{item.name: getattr(self, item.name)[index] for item in fields(self)})


@dataclass(frozen=True)
class Occluders(_Border):
    """Points (metres) that cast shadows on the scenery; ``mask`` is false for padding."""

    positions: Float[Tensor, "*batch occluder 3"]
    mask: Bool[Tensor, "*batch occluder"]


@dataclass(frozen=True)
class HiddenSide(_Border):
    """Particles of moving bodies that no camera saw: guesses of a dynamics, for the renderer alone."""

    positions: Float[Tensor, "*batch hidden 3"]
    features: Float[Tensor, "*batch hidden feature"]
    normals: Float[Tensor, "*batch hidden 3"]
    mask: Bool[Tensor, "*batch hidden"]


@dataclass(frozen=True)
class Pictures(_Border):
    """The images (in [0, 1]) in which particles were observed, with the depth that placed them (metres; 0: none)."""

    rgb: Float[Tensor, "*shape height width 3"]
    depth: Float[Tensor, "*shape height width"]
    cameras: Cameras


@dataclass(frozen=True)
class Particles(_Border):
    """Latent particles, dense and padded; ``mask`` is false for padding. The batch axis may be absent.

    ``colors`` (observed RGB in [0, 1]), ``moving`` (may belong to something that moves) and ``normals`` (unit, zero
    where unknown) are observations carried along for a dynamics that uses them; the paper's does not. With ``scenery``
    particles that are not ``moving`` are for the dynamics alone: a renderer draws the scenery in their place.
    ``occluders`` cast the shadows in place of moving particles: in training, what was seen to move at that time.
    ``hidden_side`` is what a dynamics guesses of them beyond what was seen. ``driven`` are points whose motion is
    given, such as a robot's; they are no particles and have an axis of their own. ``pixels`` says which pixel of
    ``pictures`` a particle is (counted over ``view height width``; -1: none, it was put or moved there by hand).
    """

    positions: Float[Tensor, "*batch particle 3"]
    features: Float[Tensor, "*batch particle feature"]
    mask: _Mask = None  # type: ignore[assignment]
    colors: Float[Tensor, "*batch particle 3"] | None = None
    moving: Bool[Tensor, "*batch particle"] | None = None
    normals: Float[Tensor, "*batch particle 3"] | None = None
    scenery: Scenery | None = None
    occluders: Occluders | None = None
    hidden_side: HiddenSide | None = None
    driven: Driven | None = None
    pixels: Int[Tensor, "*batch particle"] | None = None
    pictures: Pictures | None = None

    def __post_init__(self) -> None:
        if self.mask is None:
            valid = torch.ones(self.positions.shape[:-1], dtype=torch.bool, device=self.positions.device)
            object.__setattr__(self, "mask", valid)

    @property
    def num_particles(self) -> int:
        return self.positions.shape[-2]

    def mapped(self, function: Callable[[Tensor], Tensor]) -> "Particles":
        """Apply a function to every tensor with a particle axis; what has other axes stays."""
        names = [item.name for item in fields(self) if item.name not in OTHER_AXES]
        known = {name: value for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **{name: function(value) for name, value in known.items()})

    def with_hidden_side(self) -> "Particles":
        """Return what is drawn of the particles and of what is guessed beside them, as one set."""
        hidden = self.hidden_side
        if hidden is None:
            return self
        return self._drawn_with(hidden.positions, hidden.features, hidden.normals, hidden.mask, self.driven)

    def with_driven(self) -> "Particles":
        """Return what is drawn of the particles and of what is driven, as one set."""
        driven = self.driven
        if driven is None or driven.features is None:
            return self
        return self._drawn_with(driven.positions, driven.features, driven.normals, driven.mask, None)

    def _drawn_with(
        self, positions: Tensor, features: Tensor, normals: Tensor, mask: Tensor, driven: Driven | None
    ) -> "Particles":
        return Particles(
            positions=torch.cat([self.positions, positions], dim=-2),
            features=torch.cat([self.features, features], dim=-2),
            mask=torch.cat([self.mask, mask], dim=-1),
            normals=None if self.normals is None else torch.cat([self.normals, normals], dim=-2),
            driven=driven,
        )

    def without_padding(self) -> "Particles":
        """Return the same particles with zeros in padding: NaN there would survive a product with zero."""
        if self.mask.device.type == "cpu" and not is_traced() and bool(self.mask.all()):
            return self
        names = ("positions", "features", "colors", "normals")
        known = {name: value for name in names if (value := getattr(self, name)) is not None}
        return replace(self, **{name: torch.where(self.mask[..., None], value, 0.0) for name, value in known.items()})


@dataclass(frozen=True)
class Rays(_Border):
    """Rays in the world frame; ``directions`` have unit length, so that ``t`` along them is a distance in metres."""

    origins: Float[Tensor, "*shape 3"]
    directions: Float[Tensor, "*shape 3"]


@dataclass(frozen=True)
class RenderedRays(_Border):
    """A renderer's output for each ray: colour in [0, 1], expected distance along the ray (metres), opacity in [0, 1].

    ``coarse_rgbs`` is the coarse tier's colour where a renderer has one and it is supervised.
    """

    rgbs: Float[Tensor, "*shape 3"]
    depths: Float[Tensor, "*shape"]
    opacities: Float[Tensor, "*shape"]
    coarse_rgbs: Float[Tensor, "*shape 3"] | None = None


@dataclass(frozen=True)
class VideoBatch(_Border):
    """One training batch: two context frames and the rays to predict.

    ``context`` has axes ``batch time=2 view ...``; ``rays`` and ``rgbs`` have axes ``batch time ray 3``, where time
    counts predicted steps. ``clips`` names each member (``file@start``) for messages. ``future`` are the frames of the
    input views at the predicted steps (axes ``batch time view``), for trainings that encode them. ``driven`` is the
    given motion at the predicted steps (axes ``batch time``), where the recordings have one.
    """

    context: RGBDFrames
    rays: Rays
    rgbs: Float[Tensor, "batch time ray 3"]
    keys: RandomKeys
    clips: Sequence[str] = field(default=())
    future: RGBDFrames | None = None
    driven: Driven | None = None


@dataclass(frozen=True)
class ViewBatch(_Border):
    """One training batch of single camera views, for systems that have no particles: whole images, no cameras.

    ``images`` are uint8 at the resolution of the system. ``slots`` are stored codes of the same frames, where a system
    is trained on such; then the frames before ``num_history`` are given and the others are to be predicted.
    """

    images: UInt8[Tensor, "batch time height width 3"]
    slots: Float[Tensor, "batch time slot dim"] | None
    num_history: int
    keys: RandomKeys
    clips: Sequence[str] = field(default=())

    @property
    def rgbs(self) -> Float[Tensor, "batch time pixel 3"]:
        """Colours in [0, 1] of the frames that supervise: all of them, or with slots those behind the history."""
        shown = self.images if self.slots is None else self.images[:, self.num_history :]
        return shown.flatten(2, 3).float() / 255.0


@dataclass(frozen=True)
class SimulatorOutput(_Border):
    """What one forward pass of a system gives to the losses.

    ``rendered`` has axes ``batch time ray`` and is None where no loss looks at colours; ``states`` are the predicted
    particles, one per step; ``auxiliary`` holds what a stage offers beside that (for example predicted depth).
    """

    rendered: RenderedRays | None
    states: Sequence[Particles]
    auxiliary: dict[str, Tensor] = field(default_factory=dict)
