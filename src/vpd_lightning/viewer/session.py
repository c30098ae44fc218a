"""What one person does in the viewer, without the browser: select, edit, simulate, compare, measure."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.editing.operations import Operation, find
from vpd_lightning.editing.scene_editor import SceneEditor
from vpd_lightning.editing.selectors import AnyOf, Cluster, Everything, Not, Selector
from vpd_lightning.errors import EditError
from vpd_lightning.metrics.chamfer import chamfer
from vpd_lightning.metrics.psnr import psnr
from vpd_lightning.metrics.registry import CHAMFER, PSNR
from vpd_lightning.types import Cameras, Driven, Particles
from vpd_lightning.viewer.body_names import body_names
from vpd_lightning.viewer.opened_scene import OpenedScene
from vpd_lightning.viewer.rollout import Rollout

COMBINATIONS = ("replace", "add", "subtract", "intersect")
_MOVES = 0.002  # metres a step


class Session:
    """One client's editor, selection and rollouts. Methods may be called from any thread."""

    def __init__(self, opened: OpenedScene):
        self.opened = opened
        self.lock = threading.RLock()
        self.now = opened.rollout
        self._editor = self.now.editor  # holds the undo history; that of the unedited scene is shared by all
        self.kept: Rollout | None = None
        self.selector: Selector | None = None
        self._generation = 0
        self._labels: list[tuple[Operation, str]] = []

    def _fresh(self, editor: SceneEditor, motion: Driven | None, acts: str) -> Rollout:
        opened = self.opened
        return Rollout(opened.simulator, editor, motion, acts) if editor.operations or acts else opened.rollout

    @property
    def other(self) -> Rollout | None:
        """What the edited scene is compared with: the kept one, or else the unedited one; None where that is it."""
        with self.lock:
            other = self.kept or self.opened.rollout
            return None if other is self.now else other

    def label(self, rollout: Rollout) -> str:
        """Return what was done to a scene, in words."""
        with self.lock:
            done = rollout.editor.operations
            words = [label for operation in done for known, label in self._labels if known is operation]
        edits = words if len(words) == len(done) <= 2 else [f"{len(done)} edits"]
        return ", ".join([*edits, *([rollout.acts] if rollout.acts else [])]) or "as recorded"

    # Selecting

    @property
    def selected(self) -> Bool[Tensor, " particle"]:
        """Which particles of the edited scene are selected."""
        with self.lock:
            state = self.now.editor.state
            return torch.zeros_like(state.mask) if self.selector is None else self.selector.select(state)

    def select(self, selector: Selector | None, how: str = "replace") -> int:
        """Select, combined with what is selected by one of ``COMBINATIONS``; returns how many particles are."""
        with self.lock:
            if selector is not None:
                self.now.editor.select(selector)  # refuses what means nothing here
            if selector is None or self.selector is None or how == "replace":
                self.selector = selector if how in ("replace", "add") or selector is None else None
            else:
                old = self.selector
                self.selector = {"add": old | selector, "subtract": old - selector, "intersect": old & selector}[how]
            return int(self.selected.sum())

    def cluster_sizes(self) -> list[int]:
        """Return the number of particles of each object-like cluster."""
        with self.lock:
            state = self.now.editor.state
            labels = state.clusters[state.mask & (state.clusters >= 0)]
            return torch.bincount(labels).tolist() if len(labels) else []

    def body_names(self) -> list[str]:
        """Return what a person calls each object-like cluster, in the order of their numbers."""
        return body_names(self.opened.kind, *self._clusters_and_colors())

    def body_colors(self) -> list[tuple[int, int, int]]:
        """Return the colour of each object-like cluster, in the order of their numbers."""
        clusters, colors = self._clusters_and_colors()
        found = []
        for number in range(len(self.cluster_sizes())):
            red, green, blue = (255 * np.median(colors[clusters == number], axis=0)).round().astype(int).tolist()
            found.append((red, green, blue))
        return found

    def _clusters_and_colors(self) -> tuple[Int64[NDArray, " particle"], Float[NDArray, "particle 3"]]:
        with self.lock:
            state = self.now.editor.state
        clusters = torch.where(state.mask, state.clusters, -1).cpu().numpy()
        colors = np.full((len(clusters), 3), 0.5) if state.colors is None else state.colors.float().cpu().numpy()
        return clusters, colors

    @property
    def selected_body(self) -> int | None:
        """The number of the object-like cluster that is selected; None where something else is, or nothing."""
        with self.lock:
            index = self.selector.index if isinstance(self.selector, Cluster) else None
            return index if isinstance(index, int) and index < len(self.cluster_sizes()) else None

    def bodies(self) -> Selector | None:
        """Return the selector of all object-like clusters; None where there are none."""
        clusters = tuple(Cluster(number) for number in range(len(self.cluster_sizes())))
        return AnyOf(clusters) if clusters else None

    def surroundings(self) -> Selector:
        """Return the selector of what is no object-like cluster: floor, walls, what stands still."""
        bodies = self.bodies()
        return Everything() if bodies is None else Not(bodies)

    def velocity(self, selector: Selector) -> tuple[float, float, float]:
        """Return the mean velocity (metres a step) of what is selected between the two input frames; 0 where unknown.

        Raises:
            EditError: nothing is selected.
        """
        with self.lock:
            state = self.now.editor.state
        now, before = find(state, selector)
        if not bool(before.any()):
            return (0.0, 0.0, 0.0)
        previous, current = state.scene.previous.positions[0], state.scene.current.positions[0]
        x, y, z = (current[now].mean(dim=0) - previous[before].mean(dim=0)).tolist()
        return (x, y, z)

    # Editing

    def apply(self, operation: Operation, label: str = "edited") -> None:
        """Edit the scene; ``label`` says what was done, in words."""
        with self.lock:
            self._edit(lambda editor: editor.apply(operation))
            self._labels.append((operation, label))

    def apply_all(self, operations: Sequence[Operation]) -> None:
        """Make several edits, or none where one of them is refused."""
        with self.lock:
            editor = self._editor
            for operation in operations:
                editor = editor.apply(operation)
            self._edit(lambda _: editor)

    def start_over(self) -> None:
        """Forget all edits, the selection and what was kept."""
        with self.lock:
            self.now, self.kept, self.selector = self.opened.rollout, None, None
            self._editor = self.now.editor
            self._labels = []
            self._generation += 1

    def undo(self) -> None:
        """Take the last edit back."""
        self._edit(lambda editor: editor.undo())

    def redo(self) -> None:
        """Do again what was taken back."""
        self._edit(lambda editor: editor.redo())

    def need_selection(self) -> Selector:
        """Return the selector of what is selected.

        Raises:
            EditError: nothing is.
        """
        with self.lock:
            if self.selector is None or not bool(self.selected.any()):
                raise EditError("Nothing is selected.\nSelect a cluster or a rectangle first.")
            return self.selector

    def _edit(self, act: Callable[[SceneEditor], SceneEditor]) -> None:
        with self.lock:
            self._editor = act(self._editor)
            self.now = self._fresh(self._editor, self.now.motion, self.now.acts)
            self.selector = None
            self._generation += 1

    # Acting

    @property
    def tool(self) -> Driven | None:
        """What is driven, at the last input frame (batch axis of 1); None where the model takes no actions."""
        with self.lock:
            return None if self.opened.rollout.motion is None else self.now.editor.scene.current.driven

    def drive(self, motion: Driven | None, acts: str) -> None:
        """Let the tool move so (axis ``step``), and say what it does; None: as recorded."""
        with self.lock:
            if motion is None:
                motion, acts = self.opened.rollout.motion, ""
            self.now = self._fresh(self._editor, motion, acts)
            self._generation += 1

    # Simulating

    def simulate(
        self,
        num_steps: int,
        on_step: Callable[[int], Any] = lambda _: None,
        is_left: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Predict the next steps of what is shown, until nobody looks; False where an edit came in between."""
        with self.lock:
            generation, rollout, other = self._generation, self.now, self.other
        for shown in [rollout] if other is None else [other, rollout]:
            for step in range(1, num_steps + 1):
                if is_left():
                    return True
                shown.reach(step)
                with self.lock:
                    if generation != self._generation:
                        return False
                if shown is rollout:
                    on_step(step)
        return True

    # Comparing and measuring

    def keep(self) -> None:
        """Keep the edited scene and its rollout for comparison."""
        with self.lock:
            self.kept = self.now

    def swap(self) -> None:
        """Exchange what is edited and what is kept."""
        with self.lock:
            if self.kept is None:
                raise EditError("Nothing is kept for comparison.\nKeep a scene first.")
            self.now, self.kept = self.kept, self.now
            self._editor = self.now.editor
            self.selector = None
            self._generation += 1

    def shown_state(self, step: int, of_kept: bool = False) -> Particles:
        """Return the state of a step; the last one, if that step was not simulated so far."""
        with self.lock:
            rollout, step = self._at(step, of_kept)
            return rollout.states[step]

    def shown(self, step: int, of_kept: bool = False) -> tuple[Particles, UInt8[NDArray, "particle 3"]]:
        """Return the state of a step, as ``shown_state`` does, and the colours of its particles."""
        with self.lock:
            rollout, step = self._at(step, of_kept)
            state = rollout.states[step]
            if step in rollout.colors:
                return state, rollout.colors[step]
        is_as_recorded = step == 0 and not rollout.editor.operations
        colors = self.opened.first_colors if is_as_recorded else self.opened.colors(state)
        with self.lock:
            rollout.colors[step] = colors
        return state, colors

    def motion(
        self, step: int, most: int
    ) -> tuple[Float[NDArray, "step particle 3"], UInt8[NDArray, "particle 3"]] | None:
        """Return where moving particles (``most`` of them at most) were from step 0 to a step, and their colours.

        None where nothing moves, or the step is not simulated.
        """
        with self.lock:
            rollout = self.now
        if not 1 <= step <= rollout.num_steps:
            return None
        positions = torch.stack([state.positions[0] for state in rollout.states[: step + 1]]).float().cpu().numpy()
        there = rollout.states[step].mask[0].cpu().numpy()
        moved = np.linalg.norm(np.diff(positions, axis=0), axis=-1).max(axis=0, initial=0.0)
        chosen = np.flatnonzero(there & (moved > _MOVES))
        chosen = chosen[:: max(1, -(-len(chosen) // most))]
        if not len(chosen):
            return None
        return positions[:, chosen], self.shown(0)[1][chosen]

    def _at(self, step: int, of_kept: bool) -> tuple[Rollout, int]:
        rollout = self.kept if of_kept and self.kept is not None else self.now
        return rollout, min(max(step, 0), rollout.num_steps)

    def render(self, step: int, cameras: Cameras, of_kept: bool = False) -> UInt8[NDArray, "view height width 3"]:
        """Render a state from cameras (axis ``view``)."""
        state = self.shown_state(step, of_kept)
        return to_uint8(self.opened.simulator.render([state], cameras)[0])

    def has_truth(self, step: int) -> bool:
        """Whether a step can be compared with the recording: nothing was edited, and the recording goes so far."""
        with self.lock:
            return not self.now.is_edited and step <= self.opened.num_true_steps

    def measure(self, step: int, view: int, image: UInt8[NDArray, "height width 3"]) -> dict[str, float]:
        """Return figures of a step: ``psnr`` (dB) of an image of a camera, ``chamfer`` (metres) to what was measured.

        What lies behind the recording has no truth and gives none, nor does an edited scene.
        """
        with self.lock:
            rollout, step = self._at(step, False)
        state = rollout.states[step]
        figures = {"particles": float(state.mask.sum())}
        if not self.has_truth(step):
            return figures
        figures[PSNR] = picture_psnr(image, self.opened.truth[step, view])
        points, _ = self.opened.seen_points(step)
        figures[CHAMFER] = chamfer(state.positions[0][state.mask[0]], torch.from_numpy(points)).mean
        return figures

    def operations(self) -> Sequence[Operation]:
        """Return the edits made so far."""
        with self.lock:
            return self.now.editor.operations


def picture_psnr(image: UInt8[NDArray, "height width 3"], truth: UInt8[NDArray, "height width 3"]) -> float:
    """Return the PSNR (dB) of a picture."""
    pair = (torch.from_numpy(np.array(part)).float() / 255 for part in (image, truth))  # copies: some are read-only
    return float(psnr(*pair))


def to_uint8(image: Tensor) -> NDArray[np.uint8]:
    """Return colours in [0, 1] as bytes."""
    return (image.float().nan_to_num(0.0).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
