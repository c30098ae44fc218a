"""Buttons that do one thing at a click, named from what is there: take the ball away, throw it harder."""

from functools import partial
from typing import Any

import numpy as np

from vpd_lightning.editing.operations import Delete, SetVelocity
from vpd_lightning.editing.selectors import Cluster
from vpd_lightning.viewer.tab_host import TabHost

_MOST_BODIES = 3
_HARDER = 1.5
_DARK = 0.42  # luminance
_MOVES = 0.001  # metres a step


def readable(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return a body's colour, as dark as white letters need."""
    luminance = (0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]) / 255
    red, green, blue = (round(channel * min(1.0, _DARK / max(luminance, 1e-6))) for channel in color)
    return red, green, blue


class PresetButtons:
    """Edits of the scene as it is now, each followed by its film; made anew after each edit."""

    def __init__(self, panel: TabHost):
        self.panel, self.session = panel, panel.session
        self._folder: Any = panel.client.gui.add_folder("What if ...")
        self._buttons: list[Any] = []

    def refresh(self) -> None:
        """Name the buttons from the bodies that are there."""
        for button in self._buttons:
            button.remove()
        self._buttons = []
        names, colors = self.session.body_names(), self.session.body_colors()
        with self._folder:
            for number, name in enumerate(names[:_MOST_BODIES]):
                self._add(f"Take the {name} away", partial(self._take, number, name), readable(colors[number]))
            if names:
                self._add("Take the floor away", self._take_floor)
            fastest = self._fastest(len(names))
            if fastest is not None:
                self._add(f"Throw the {names[fastest]} harder", lambda: self._throw(fastest, names[fastest]))

    def _add(self, label: str, action: Any, color: Any = "blue") -> None:
        button = self.panel.client.gui.add_button(label, color=color)
        button.on_click(lambda _: self.panel.act(action))
        self._buttons.append(button)

    def _take(self, number: int, name: str) -> None:
        operation = Delete(Cluster(number))
        self.panel.edit(lambda: self.session.apply(operation, f"without the {name}"))

    def _take_floor(self) -> None:
        operation = Delete(self.session.surroundings())
        self.panel.edit(lambda: self.session.apply(operation, "without the floor"))

    def _throw(self, number: int, name: str) -> None:
        selector = Cluster(number)
        velocity = tuple(_HARDER * value for value in self.session.velocity(selector))
        operation = SetVelocity(selector, velocity)
        self.panel.edit(lambda: self.session.apply(operation, f"the {name} thrown harder"))

    def _fastest(self, count: int) -> int | None:
        speeds = [float(np.linalg.norm(self.session.velocity(Cluster(number)))) for number in range(count)]
        return int(np.argmax(speeds)) if speeds and max(speeds) > _MOVES else None
