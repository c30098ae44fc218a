"""What a tab of the viewer needs of the panel that it stands in."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import viser

from vpd_lightning.viewer.exports import ExportFolder
from vpd_lightning.viewer.opened_scene import OpenedScene
from vpd_lightning.viewer.progressive_view import Viewpoint
from vpd_lightning.viewer.session import Session


@runtime_checkable
class TabHost(Protocol):
    """One client's panel, as its tabs see it; ``Panel`` is the one there is."""

    client: viser.ClientHandle
    opened: OpenedScene
    folder: ExportFolder
    session: Session
    # Handles of viser's inputs; a tab reads or sets their ``value``.
    step: Any
    fps: Any
    rows: Any
    point_size: Any

    def act(self, action: Callable[[], Any]) -> None:
        """Do what a button asks for; what cannot be done is shown in the browser."""
        ...

    def notify(self, title: str, text: str, color: Any = "green") -> None:
        """Show a message in the browser."""
        ...

    def edited(self) -> None:
        """Show a scene that was just edited."""
        ...

    def redraw(self) -> None:
        """Draw the current step."""
        ...

    def viewpoint(self) -> Viewpoint:
        """Return the browser's camera."""
        ...
