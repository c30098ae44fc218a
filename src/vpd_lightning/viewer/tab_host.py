"""What a tab of the viewer needs of the panel that it stands in."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import viser

from vpd_lightning.viewer.exports import ExportFolder
from vpd_lightning.viewer.opened_scene import OpenedScene
from vpd_lightning.viewer.progressive_view import ProgressiveView, Request
from vpd_lightning.viewer.screen import Screen
from vpd_lightning.viewer.session import Session


class TabHost(ABC):
    """One client's panel, as its tabs see it; ``Panel`` extends it."""

    client: viser.ClientHandle
    opened: OpenedScene
    folder: ExportFolder
    session: Session
    screen: Screen
    view: ProgressiveView
    # Handle of viser's slider, whose ``value`` is the step shown, and the tab that says what is shown.
    step: Any
    view_tab: Any
    edit_tab: Any

    @abstractmethod
    def act(self, action: Callable[[], Any]) -> None:
        """Do what a button asks for; what cannot be done is shown in the browser."""

    @property
    @abstractmethod
    def is_left(self) -> bool:
        """Whether the browser is gone: what takes long ends then."""

    @abstractmethod
    def notify(self, title: str, text: str, color: Any = "green") -> None:
        """Show a message in the browser."""

    @abstractmethod
    def select_body(self, cluster: int | None) -> None:
        """Select a body, or nothing."""

    @abstractmethod
    def edit(self, action: Callable[[], Any]) -> None:
        """Edit the scene, and show what becomes of it."""

    @abstractmethod
    def go_to(self, step: int) -> None:
        """Show a step."""

    @abstractmethod
    def set_playing(self, plays: bool) -> None:
        """Let the film run, or stop it where it is."""

    @abstractmethod
    def set_mode(self, mode: str) -> None:
        """Show the film, the picture of the browser's camera, or particles."""

    @abstractmethod
    def simulate_again(self) -> None:
        """Simulate in the background, unless that goes on already."""

    @abstractmethod
    def simulate_truth_again(self) -> None:
        """Have the generator's own simulation make the same edits, in the background, where it can."""

    @abstractmethod
    def look_through(self, view: int) -> None:
        """Put the browser's camera where a recorded one is, and show its film."""

    @abstractmethod
    def request(self, step: int) -> Request | None:
        """Return what to draw of a step; None where no picture is shown."""

    @abstractmethod
    def redraw(self) -> None:
        """Draw the current step."""
