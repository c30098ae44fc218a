"""What a tab of the viewer needs of the panel that it stands in."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import viser

from vpd_lightning.viewer.exports import ExportFolder
from vpd_lightning.viewer.opened_scene import OpenedScene
from vpd_lightning.viewer.progressive_view import Viewpoint
from vpd_lightning.viewer.session import Session


class TabHost(ABC):
    """One client's panel, as its tabs see it; ``Panel`` extends it."""

    client: viser.ClientHandle
    opened: OpenedScene
    folder: ExportFolder
    session: Session
    # Handles of viser's inputs; a tab reads or sets their ``value``.
    step: Any
    fps: Any
    rows: Any
    point_size: Any

    @abstractmethod
    def act(self, action: Callable[[], Any]) -> None:
        """Do what a button asks for; what cannot be done is shown in the browser."""

    @abstractmethod
    def notify(self, title: str, text: str, color: Any = "green") -> None:
        """Show a message in the browser."""

    @abstractmethod
    def edited(self) -> None:
        """Show a scene that was just edited."""

    @abstractmethod
    def redraw(self) -> None:
        """Draw the current step."""

    @abstractmethod
    def viewpoint(self) -> Viewpoint:
        """Return the browser's camera."""
