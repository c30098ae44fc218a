"""What stands in a client's 3D scene: particles, the selection, cameras, measured points, the kept scene beside."""

from typing import Any

import numpy as np
import viser

from vpd_lightning.viewer.panes import SELECTED
from vpd_lightning.viewer.session import Session

_MOST_LINES = 400
_ARROW_STEPS = 3
_BESIDE = 1.15  # a kept scene stands so many widths of the workspace to the side


class SceneDrawing:
    """Draws one session into one client; handles are kept and replaced."""

    def __init__(self, client: viser.ClientHandle, session: Session):
        self.client, self.session = client, session
        self._handles: dict[str, Any] = {}
        opened = session.opened
        self.beside = np.array([_BESIDE * (opened.workspace_max[0] - opened.workspace_min[0]), 0.0, 0.0])

    def particles(self, step: int, visible: bool, size: float, compares: bool) -> None:
        """Draw the particles of a step, those of a kept scene beside them, and at step 0 the selection.

        Nothing where they are not ``visible``: their colours cost a rendering.
        """
        if not visible:
            for name in ("now", "kept", "selected"):
                self.remove(name)
            return
        for name, of_kept in (("now", False), ("kept", True)):
            if of_kept and (self.session.kept is None or not compares):
                self.remove("kept")
                continue
            state, colors = self.session.shown(step, of_kept)
            there = state.mask[0].cpu().numpy()
            points = state.positions[0].float().cpu().numpy()[there]
            where = self.beside if of_kept else np.zeros(3)
            self._cloud(name, points, colors[there], size, True, where)
        chosen = self.session.selected.cpu().numpy() if step == 0 else np.zeros(0, bool)
        if not chosen.any():
            self.remove("selected")
            return
        points = self.session.now.states[0].positions[0].float().cpu().numpy()[chosen]
        self._cloud("selected", points, np.array(SELECTED, np.uint8), 1.3 * size, True, np.zeros(3))

    def cameras(self, visible: bool, but: int | None) -> None:
        """Draw the recorded cameras as frustums; not the one ``but``, through which the browser looks."""
        cameras = self.session.opened.cameras
        for view in range(len(cameras.intrinsics)):
            name = f"cameras/{view}"
            if name in self._handles:
                self._handles[name].visible = visible and view != but
                continue
            pose = cameras.cam_to_world[view].double().numpy()
            height, width = cameras.height, cameras.width
            is_input = view in self.session.opened.input_views
            self._handles[name] = self.client.scene.add_camera_frustum(
                f"/{name}",
                fov=float(2 * np.arctan(0.5 * height / cameras.intrinsics[view, 1, 1])),
                aspect=width / height,
                scale=0.05
                * float(
                    np.linalg.norm(
                        np.ptp([self.session.opened.workspace_min, self.session.opened.workspace_max], axis=0)
                    )
                ),
                color=(40, 110, 220) if is_input else (150, 150, 150),
                wxyz=_wxyz(pose[:3, :3]),
                position=pose[:3, 3],
                visible=visible and view != but,
            )

    def measured(self, step: int | None, size: float) -> None:
        """Draw what the input cameras measured at a step; None, or behind the recording: nothing."""
        if step is None or step > self.session.opened.num_true_steps:
            self.remove("measured")
            return
        points, colors = self.session.opened.seen_points(step)
        self._cloud("measured", points, colors, 0.6 * size, True, np.zeros(3))

    def paths(self, step: int | None) -> None:
        """Draw the ways that moving particles took until a step; None draws nothing."""
        found = self.session.motion(step, _MOST_LINES) if step else None
        if found is None or not len(found[0]):
            self.remove("paths")
            return
        ways, colors = found  # (step, particle, 3), (particle, 3)
        segments = np.stack([ways[:-1], ways[1:]], axis=2).reshape(-1, 2, 3)
        shades = np.tile(colors[None, :, None], (len(ways) - 1, 1, 2, 1)).reshape(-1, 2, 3)
        self._handles["paths"] = self.client.scene.add_line_segments(
            "/paths", segments.astype(np.float32), shades, thickness=2.0, thickness_units="screen"
        )

    def velocities(self, step: int | None, size: float) -> None:
        """Draw where moving particles will be in a few steps at the velocity of a step; None draws nothing."""
        found = None if step is None else self.session.motion(max(step, 1), _MOST_LINES // 2)
        if found is None or not len(found[0]):
            self.remove("velocities")
            return
        ways, colors = found
        begin = ways[-1] if step else ways[-2]
        arrows = np.stack([begin, begin + _ARROW_STEPS * (ways[-1] - ways[-2])], axis=1)
        self._handles["velocities"] = self.client.scene.add_arrows(
            "/velocities",
            arrows.astype(np.float32),
            colors,
            shaft_radius=0.1 * size,
            head_radius=0.3 * size,
            head_length=0.6 * size,
        )

    def remove(self, name: str) -> None:
        """Take something out of the scene."""
        handle = self._handles.pop(name, None)
        if handle is not None:
            handle.remove()

    def _cloud(
        self, name: str, points: np.ndarray, colors: np.ndarray, size: float, visible: bool, position: np.ndarray
    ) -> None:
        if not len(points):
            self.remove(name)
            return
        self._handles[name] = self.client.scene.add_point_cloud(
            f"/{name}",
            points,
            colors,
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",  # half a millimetre at a metre is what viser's default keeps
            position=position,
            visible=visible,
        )


def _wxyz(rotation: np.ndarray) -> tuple[float, float, float, float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return (w, x, y, z)
