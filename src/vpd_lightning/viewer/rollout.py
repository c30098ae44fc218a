"""An edited scene and what becomes of it, simulated once for all who look at it."""

import itertools
import threading

from jaxtyping import UInt8
from numpy.typing import NDArray

from vpd_lightning.editing.scene_editor import SceneEditor
from vpd_lightning.simulator import Rollout as SimulatedRollout
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Driven, Particles

_numbers = itertools.count()


class Rollout:
    """``states[0]`` is the last input frame, as edited; later ones are there as far as ``reach`` was called.

    ``number`` is unlike that of every other rollout. ``motion`` is that of what is driven (axis ``step``), which stays
    where it is afterwards; ``acts`` says what it does, in words, empty: as recorded. Methods
    may be called from any thread.
    """

    def __init__(self, simulator: Simulator, editor: SceneEditor, motion: Driven | None, acts: str = ""):
        self.simulator, self.editor, self.motion, self.acts = simulator, editor, motion, acts
        self.states: list[Particles] = [editor.scene.current]
        self.colors: dict[int, UInt8[NDArray, "particle 3"]] = {}
        self.figures: dict[tuple[int, int], dict[str, float]] = {}  # by step and recorded camera
        self.number = next(_numbers)
        # What the generator's own simulation shows after the same edits: pictures of the recorded cameras.
        self.true_pictures: UInt8[NDArray, "step view height width 3"] | None = None
        self._last: SimulatedRollout | None = None
        self._lock = threading.Lock()

    @property
    def num_steps(self) -> int:
        """How many steps were simulated."""
        return len(self.states) - 1

    @property
    def is_edited(self) -> bool:
        """Whether it differs from the recording: by edits, or by what the tool does."""
        return bool(self.editor.operations or self.acts)

    def _driven_to(self, step: int) -> Driven | None:
        if self.motion is None or step >= len(self.motion.mask):
            return None
        return self.motion[step : step + 1]

    def reach(self, step: int) -> None:
        """Simulate as far as ``step``; what was simulated before is not simulated again."""
        with self._lock:
            while self.num_steps < step:
                last = self._last or self.simulator.start(self.editor.scene)
                self._last = last.step(self._driven_to(self.num_steps))
                self.states.append(self._last.particles)
