"""What one person does in the viewer, without the browser: select, edit, simulate, compare, measure."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.editing.colored_editor import colored_editor
from vpd_lightning.editing.operations import Operation
from vpd_lightning.editing.scene_editor import SceneEditor
from vpd_lightning.editing.selectors import Selector
from vpd_lightning.errors import EditError
from vpd_lightning.metrics.chamfer import chamfer
from vpd_lightning.metrics.psnr import psnr
from vpd_lightning.metrics.registry import CHAMFER, PSNR
from vpd_lightning.types import Cameras, Particles
from vpd_lightning.viewer.opened_scene import OpenedScene

COMBINATIONS = ("replace", "add", "subtract", "intersect")


@dataclass
class Rollout:
    """An edited scene and what became of it; ``states[0]`` is the last input frame, as edited."""

    editor: SceneEditor
    states: list[Particles]
    colors: dict[int, UInt8[NDArray, "particle 3"]] = field(default_factory=dict)

    @property
    def num_steps(self) -> int:
        """How many steps were simulated."""
        return len(self.states) - 1


class Session:
    """One client's editor, selection and rollouts. Methods may be called from any thread."""

    def __init__(self, opened: OpenedScene):
        self.opened = opened
        self.lock = threading.RLock()
        self.now = self._fresh(colored_editor(opened.simulator, opened.scene, opened.viewpoint))
        self.kept: Rollout | None = None
        self.selector: Selector | None = None
        self._generation = 0

    @staticmethod
    def _fresh(editor: SceneEditor) -> Rollout:
        return Rollout(editor, [editor.scene.current])

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

    # Editing

    def apply(self, operation: Operation) -> None:
        """Edit the scene; what was simulated of the old one is forgotten."""
        self._edit(lambda editor: editor.apply(operation))

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
            self.now = self._fresh(act(self.now.editor))
            self.selector = None
            self._generation += 1

    # Simulating

    def simulate(self, num_steps: int, on_step: Callable[[int], None] | None = None) -> bool:
        """Predict the next steps of the edited scene; False where an edit came in between."""
        with self.lock:
            generation, rollout = self._generation, self.now
            scene = rollout.editor.scene
        prediction = self.opened.simulator.start(scene)
        for step in range(1, num_steps + 1):
            prediction = prediction.step()
            with self.lock:
                if generation != self._generation:
                    return False
                if step > rollout.num_steps:
                    rollout.states.append(prediction.particles)
            if on_step is not None:
                on_step(step)
        return True

    # Comparing and measuring

    def keep(self) -> None:
        """Keep the edited scene and its rollout for comparison."""
        with self.lock:
            self.kept = Rollout(self.now.editor, list(self.now.states), dict(self.now.colors))

    def swap(self) -> None:
        """Exchange what is edited and what is kept."""
        with self.lock:
            if self.kept is None:
                raise EditError("Nothing is kept for comparison.\nKeep a scene first.")
            self.now, self.kept = self.kept, self.now
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

    def _at(self, step: int, of_kept: bool) -> tuple[Rollout, int]:
        rollout = self.kept if of_kept and self.kept is not None else self.now
        return rollout, min(max(step, 0), rollout.num_steps)

    def render(self, step: int, cameras: Cameras, of_kept: bool = False) -> UInt8[NDArray, "view height width 3"]:
        """Render a state from cameras (axis ``view``)."""
        state = self.shown_state(step, of_kept)
        return to_uint8(self.opened.simulator.render([state], cameras)[0])

    def measure(self, step: int, view: int, image: UInt8[NDArray, "height width 3"]) -> dict[str, float]:
        """Return figures of a step: ``psnr`` (dB) of an image of a camera, ``chamfer`` (metres) to what was measured.

        What lies behind the recording has no truth and gives none; an edited scene is held against the unedited truth.
        """
        state = self.shown_state(step)
        figures = {"particles": float(state.mask.sum())}
        if step <= self.opened.num_true_steps:
            pair = (
                torch.from_numpy(np.ascontiguousarray(part)).float() / 255
                for part in (image, self.opened.truth[step, view])
            )
            figures[PSNR] = float(psnr(*pair))
            points, _ = self.opened.seen_points(step)
            figures[CHAMFER] = chamfer(state.positions[0][state.mask[0]], torch.from_numpy(points)).mean
        return figures

    def operations(self) -> Sequence[Operation]:
        """Return the edits made so far."""
        with self.lock:
            return self.now.editor.operations


def to_uint8(image: Tensor) -> NDArray[np.uint8]:
    """Return colours in [0, 1] as bytes."""
    return (image.float().nan_to_num(0.0).clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
