"""The tab that moves the tool: along a path drawn by hand, or as planned towards a goal."""

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.editing.operations import Operation
from vpd_lightning.errors import ActionError
from vpd_lightning.planning.bodies import Body
from vpd_lightning.planning.plan import plan
from vpd_lightning.planning.solvers import CrossEntropy
from vpd_lightning.planning.tasks import place_cost
from vpd_lightning.planning.tool import PlanarTool
from vpd_lightning.viewer.screen import PICTURE
from vpd_lightning.viewer.tab_host import TabHost
from vpd_lightning.viewer.tool_handles import ToolHandles

_HOLD = 4  # steps for which a planned velocity is held
_NUM_ITERATIONS, _ELITE_SHARE, _SPREAD = 2, 0.125, 0.7


class _Superseded(Exception):
    """The page was left or the scene edited while a plan was looked for."""


@dataclass(frozen=True)
class _Aim:
    """The particles that should get to the goal, of a scene that was edited so."""

    chosen: Bool[Tensor, " particle"]
    operations: tuple[Operation, ...]


class ActTab:
    """Stops of the tool, its speed, a goal for the selected body, and a plan that brings it there."""

    def __init__(self, panel: TabHost):
        self.panel, self.session = panel, panel.session
        self.stops: list[NDArray[np.float64]] = []
        self._aim: _Aim | None = None
        self._planning = threading.Lock()
        gui: Any = panel.client.gui
        self.status = gui.add_markdown("")
        self._button("Drag the tool", self._show_in_space)
        self.speed = gui.add_number("speed (cm a step)", 1.6, min=0.1, max=20.0, step=0.1)
        self._button("Take the last stop back", self._back)
        self._button("Stand still", self._stand_still)
        self._button("As recorded", self._as_recorded)
        with gui.add_folder("plan"):
            self._button("Drag a goal", self._show_goal)
            self.candidates = gui.add_slider("futures to try", 8, 256, 8, 32)
            self.knots = gui.add_slider("changes of direction", 1, 12, 1, 6)
            self._button("Plan", self.start_planning)
        self.handles = ToolHandles(panel, self.add_stop, self._goal_moved)
        self._say()

    def _button(self, label: str, action: Any) -> None:
        self.panel.client.gui.add_button(label).on_click(lambda _: self.panel.act(action))

    def _say(self, more: str = "") -> None:
        acts = self.session.now.acts or "moves as recorded"
        self.status.content = f"The tool **{acts}**." + (f"  \n{more}" if more else "")

    def refresh(self) -> None:
        """Show what the tool does in the scene shown now."""
        if not self.session.now.acts:
            self.stops = []
        self.handles.renew()
        self._say()

    def show_handles(self, visible: bool, step: int | None) -> None:
        """Let the tool and the goal be dragged where ``visible``; from ``step`` on, draw where the tool goes."""
        driven = self.session.tool
        if driven is None:
            return
        self.handles.show(visible, driven, self.session.now.motion if step is not None else None, step or 0)

    @property
    def tool(self) -> PlanarTool:
        """The tool's limits: the speed asked for, and the workspace."""
        opened = self.panel.opened
        return PlanarTool(self.speed.value / 100, opened.workspace_min[:2], opened.workspace_max[:2], _HOLD)

    def _show_in_space(self) -> None:
        """Show the scene from the browser's camera at its first step, where the tool can be dragged."""
        self.panel.set_playing(False)
        self.panel.screen.compares = self.panel.view_tab.compares.value = False
        self.panel.set_mode(PICTURE)
        self.panel.go_to(0)
        self._say("Drag the arrows at the tool: each time you let go is a stop.")

    # A path by hand

    def add_stop(self, place: NDArray[np.float64]) -> None:
        """Let the tool go on to a place (2,), metres."""
        self.stops.append(place)
        self._go()

    def _back(self) -> None:
        if not self.stops:
            raise ActionError("There is no stop to take back.\nDrag the tool first.")
        self.stops.pop()
        self._go()

    def _go(self) -> None:
        driven = self._driven()
        stops = torch.from_numpy(np.reshape(self.stops, (-1, 2)))
        count = len(self.stops)
        self._drive(self.tool.along(driven, stops), f"goes to {count} stop{'s' * (count != 1)}" if count else "stays")
        if count:
            self._say("Drag on for the next stop.")

    def _stand_still(self) -> None:
        self.stops = []
        self._go()

    def _as_recorded(self) -> None:
        self.stops = []
        self._drive(None, "")

    def _drive(self, motion: Any, acts: str) -> None:
        self.panel.edit(lambda: self.session.drive(motion, acts))

    def _driven(self) -> Any:
        driven = self.session.tool
        if driven is None:
            raise ActionError("Nothing is driven in this scene.\nTrain with actions=true on recordings with action/.")
        return driven

    # A plan

    def _show_goal(self) -> None:
        self.session.need_selection()
        chosen, name = self.session.selected, self.panel.edit_tab.name
        self._aim = _Aim(chosen, tuple(self.session.operations()))
        middle = self.session.now.states[0].positions[0][chosen].double().mean(dim=0).cpu().numpy()
        self.panel.select_body(None)  # else the arrows of the goal and those of the body would lie over each other
        self._show_in_space()
        self.handles.put_goal(middle)
        self._say(f"Drag the ball to where {name} should be, then press **Plan**.")

    def _goal_moved(self, place: NDArray[np.float64]) -> None:
        self._say(f"The goal is at {100 * place[0]:.0f}, {100 * place[1]:.0f} cm. Press **Plan**.")

    def start_planning(self) -> None:
        """Look for a plan in the background; the film plays it as soon as it is found.

        Raises:
            ActionError: the scene has no goal, or a plan is being looked for already.
        """
        aim, goal = self._aim, self.handles.goal
        if aim is None or goal is None or aim.operations != tuple(self.session.operations()):
            raise ActionError("There is no goal in this scene.\nClick a body, press Drag a goal, and put it there.")
        if not self._planning.acquire(blocking=False):
            raise ActionError("A plan is being looked for already.\nWait until it is found.")

        def work() -> None:
            try:
                self.panel.act(lambda: self._plan(aim.chosen, goal))
            finally:
                self._planning.release()

        threading.Thread(target=work, daemon=True, name="vpd-view plan").start()

    def _plan(self, chosen: Bool[Tensor, " particle"], goal: NDArray[np.float64]) -> None:
        rollout, count, tool = self.session.now, int(self.candidates.value), self.tool

        def progress(done: int, total: int, least: float) -> None:
            if self.panel.is_left or self.session.now is not rollout:
                raise _Superseded
            self._say(f"Planning: {done} of {total} futures tried.")

        body = Body.of(rollout.editor.scene.current, chosen)
        try:
            found = plan(
                self.panel.opened.simulator,
                rollout.editor.scene,
                place_cost(body, torch.from_numpy(goal[:2])),
                tool=tool,
                solver=CrossEntropy(count, _NUM_ITERATIONS, max(1, round(_ELITE_SHARE * count)), _SPREAD),
                num_knots=int(self.knots.value),
                progress=progress,
            )
        except _Superseded:
            return
        away = float(np.hypot(*(body.middles(found.states[-1:])[0, 0].double().cpu().numpy() - goal)[:2]))
        self.stops = []
        self._drive(found.motion, "does what was planned")
        self._say(f"Expected to end {100 * away:.1f} cm from the goal, after {found.num_candidates} futures tried.")
