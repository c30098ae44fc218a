"""``SceneEditor``: reach into a scene, and take it back."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.editing.operations import (
    Delete,
    Duplicate,
    Insert,
    InsertPoints,
    Move,
    Operation,
    Scale,
    SetVelocity,
)
from vpd_lightning.editing.rotation import NO_ROTATION, Quaternion, quaternion_of
from vpd_lightning.editing.selectors import Selector, selector_of
from vpd_lightning.editing.state import EditState, start_state
from vpd_lightning.errors import EditError
from vpd_lightning.simulator import Scene

Mask = Bool[Tensor, "*batch particle"]


@dataclass(frozen=True)
class _Past:
    """One state and how it came about; the chain of these is the undo stack."""

    state: EditState
    operation: Operation | None
    before: "_Past | None"


class SceneEditor:
    """Edits of an encoded scene; every method returns a new editor, and no scene or tensor is ever changed.

    ``what`` is a selector (``editing.selectors``), or a mask (particle,) of the current frame. What is selected there
    is taken with its history: the particles of the previous frame that stand for the same (``editing.matching``), so
    that a moved body keeps its velocity. Lengths are metres in the world frame, velocities metres a step.

    ``previous_colors`` and ``colors`` (particle, 3) in [0, 1] are for selecting by colour where the encoder observed
    none.

    Raises:
        EditError: see each operation.
    """

    def __init__(
        self,
        scene: Scene,
        previous_colors: Float[Tensor, "previous_particle 3"] | None = None,
        colors: Float[Tensor, "particle 3"] | None = None,
    ):
        self._now = _Past(start_state(scene, previous_colors, colors), None, None)
        self._undone: tuple[_Past, ...] = ()

    @property
    def scene(self) -> Scene:
        """The scene as edited."""
        return self._now.state.scene

    @property
    def state(self) -> EditState:
        """The scene with what editing stores about it."""
        return self._now.state

    @property
    def operations(self) -> list[Operation]:
        """All edits that led here, the first one first."""
        found, past = [], self._now
        while past.operation is not None and past.before is not None:
            found.append(past.operation)
            past = past.before
        return found[::-1]

    def select(self, what: Selector | Mask) -> Bool[Tensor, " particle"]:
        """Return which particles of the current frame are meant."""
        return selector_of(what).select(self.state)

    def num_clusters(self) -> int:
        """Return how many object-like clusters there are."""
        return int(torch.where(self.state.mask, self.state.clusters, -1).max()) + 1 if len(self.state.mask) else 0

    def apply(self, operation: Operation) -> "SceneEditor":
        """Return the editor behind any operation; what was undone before is forgotten."""
        return self._at(_Past(operation.apply(self.state), operation, self._now), ())

    def delete(self, what: Selector | Mask) -> "SceneEditor":
        """Take particles out."""
        return self.apply(Delete(selector_of(what)))

    def move(
        self,
        what: Selector | Mask,
        translation: Sequence[float] = (0.0, 0.0, 0.0),
        rotation: Quaternion | Tensor = NO_ROTATION,
        about: Sequence[float] | None = None,
    ) -> "SceneEditor":
        """Turn particles about a point (default: their centroid), then shift them, with their history.

        ``rotation`` is a quaternion (w, x, y, z), for example of ``about_axis``, or a matrix (3, 3).
        """
        turn = quaternion_of(rotation, "rotation")
        return self.apply(Move(selector_of(what), translation, turn, about))

    def scale(self, what: Selector | Mask, factor: float, about: Sequence[float] | None = None) -> "SceneEditor":
        """Make their shape larger or smaller; their velocity stays."""
        return self.apply(Scale(selector_of(what), factor, about))

    def duplicate(
        self,
        what: Selector | Mask,
        translation: Sequence[float] = (0.0, 0.0, 0.0),
        rotation: Quaternion | Tensor = NO_ROTATION,
    ) -> "SceneEditor":
        """Add a copy, turned about its centroid and shifted, that moves as the original does."""
        return self.apply(Duplicate(selector_of(what), translation, quaternion_of(rotation, "rotation")))

    def insert(
        self, scene: Scene, what: Selector | None = None, translation: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> "SceneEditor":
        """Add particles of another scene that the same model encoded (default: all of them)."""
        return self.apply(Insert(scene, what, translation))

    def insert_points(
        self,
        positions: Float[Tensor, "point 3"],
        colors: Float[Tensor, "point 3"],
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> "SceneEditor":
        """Add coloured points, for example of a PLY file (``edit_files.read_points``); features by nearest colour."""
        return self.apply(InsertPoints(positions, colors, velocity))

    def set_velocity(
        self,
        what: Selector | Mask,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        spin: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> "SceneEditor":
        """Give particles a velocity (metres a step) and a spin (axis times radians a step)."""
        return self.apply(SetVelocity(selector_of(what), velocity, spin))

    @property
    def can_undo(self) -> bool:
        """Whether there is an edit to take back."""
        return self._now.before is not None

    @property
    def can_redo(self) -> bool:
        """Whether an edit was taken back and none made since."""
        return bool(self._undone)

    def undo(self) -> "SceneEditor":
        """Return the editor before the last edit: the same scene, bit for bit.

        Raises:
            EditError: nothing was edited.
        """
        if self._now.before is None:
            raise EditError("There is nothing to undo.")
        return self._at(self._now.before, (*self._undone, self._now))

    def redo(self) -> "SceneEditor":
        """Return the editor with the edit that was taken back last.

        Raises:
            EditError: nothing was taken back.
        """
        if not self._undone:
            raise EditError("There is nothing to redo.")
        return self._at(self._undone[-1], self._undone[:-1])

    def _at(self, past: _Past, undone: tuple[_Past, ...]) -> "SceneEditor":
        editor = object.__new__(SceneEditor)
        editor._now, editor._undone = past, undone
        return editor
