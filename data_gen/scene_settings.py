"""What all generated scenes have in common: counts, times, cameras, limits and storage.

No value stands here; all of them stand in ``conf/data_gen/<scene>/<preset>.yaml``.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

from omegaconf import MISSING

from vpd_lightning.data import schema


@dataclass
class SplitSettings:
    """Number of trajectories per split."""

    train: int = MISSING
    validation: int = MISSING
    test: int = MISSING


@dataclass
class CameraSettings:
    """Cameras on an upper half sphere around ``target``, all looking at it."""

    num_views: int = MISSING
    height: int = MISSING
    width: int = MISSING
    field_of_view: float = MISSING  # vertical, degrees
    radius: float = MISSING  # m
    elevation_min: float = MISSING  # degrees above the horizon
    elevation_max: float = MISSING
    target: list[float] = MISSING  # m


@dataclass
class StorageSettings:
    """How files are written."""

    compression: str = MISSING
    depth_encoding: str = MISSING


@dataclass
class SceneSettings:
    """Everything that decides what is in a data set (with the seed); scenes add their own fields.

    Subclasses that check their fields call ``super().__post_init__()`` first.
    """

    RENDERERS: ClassVar[tuple[str, ...]] = ("auto", "egl", "osmesa", "blender")
    PLACES: ClassVar[tuple[tuple[str, str], ...]] = ()  # (group, name) of settings that say where something lies here

    splits: SplitSettings = MISSING
    num_frames: int = MISSING
    frame_time: float = MISSING  # s
    timestep: float = MISSING  # s, of the physics
    near: float = MISSING  # m along rays
    far: float = MISSING
    workspace_min: list[float] = MISSING
    workspace_max: list[float] = MISSING
    renderer: str = MISSING  # auto (EGL, then OSMesa), or one of RENDERERS
    supersampling: int = MISSING  # rays per pixel side (ray cast); MSAA samples are its square (GL)
    blender_samples: int = MISSING  # paths per pixel (Blender)
    camera: CameraSettings = MISSING
    storage: StorageSettings = MISSING

    def __post_init__(self) -> None:
        camera = self.camera
        counts = {f"splits.{name}": getattr(self.splits, name) for name in ("train", "validation", "test")}
        for name, value in counts.items():
            require(0 <= value <= 1_000_000, name, value, "0 to 1,000,000")
        require(sum(counts.values()) > 0, "splits", counts, "at least one trajectory")
        require(1 <= self.num_frames <= 10_000, "num_frames", self.num_frames, "1 to 10,000")
        require(0 < self.timestep <= 0.02, "timestep", self.timestep, "above 0, at most 0.02 s")
        require(0 < self.frame_time <= 10, "frame_time", self.frame_time, "above 0, at most 10 s")
        steps = self.frame_time / self.timestep
        is_multiple = abs(steps - round(steps)) < 1e-6 and steps > 0.5
        require(is_multiple, "frame_time", self.frame_time, f"a multiple of timestep ({self.timestep})")
        require(0 < self.near < self.far, "near, far", (self.near, self.far), "0 < near < far")
        for name in ("workspace_min", "workspace_max"):
            require(len(getattr(self, name)) == 3, name, getattr(self, name), "three numbers")
        require(
            all(low < high for low, high in zip(self.workspace_min, self.workspace_max, strict=True)),
            "workspace_min, workspace_max",
            (list(self.workspace_min), list(self.workspace_max)),
            "min below max on every axis",
        )
        require(1 <= camera.num_views <= 256, "camera.num_views", camera.num_views, "1 to 256")
        for name in ("height", "width"):
            require(8 <= getattr(camera, name) <= 2048, f"camera.{name}", getattr(camera, name), "8 to 2048")
        require(1 <= camera.field_of_view <= 150, "camera.field_of_view", camera.field_of_view, "1 to 150 degrees")
        require(camera.radius > 0, "camera.radius", camera.radius, "above 0")
        elevations = (camera.elevation_min, camera.elevation_max)
        require(0 < elevations[0] <= elevations[1] < 90, "camera.elevation", elevations, "0 < min <= max < 90 degrees")
        require(len(camera.target) == 3, "camera.target", camera.target, "three numbers")
        require(1 <= self.supersampling <= 4, "supersampling", self.supersampling, "1 to 4")
        require(1 <= self.blender_samples <= 65_536, "blender_samples", self.blender_samples, "1 to 65,536")
        require(self.renderer in self.RENDERERS, "renderer", self.renderer, ", ".join(self.RENDERERS))
        storage = self.storage
        for name, choices in (("compression", schema.COMPRESSIONS), ("depth_encoding", schema.DEPTH_ENCODINGS)):
            require(getattr(storage, name) in choices, f"storage.{name}", getattr(storage, name), ", ".join(choices))

    @property
    def substeps(self) -> int:
        """Physics steps per frame."""
        return round(self.frame_time / self.timestep)

    @property
    def num_multisamples(self) -> int:
        """Samples per pixel of the antialiased GL picture; 0 switches antialiasing off."""
        return self.supersampling**2 if self.supersampling > 1 else 0


def require(is_allowed: bool, name: str, given: Any, allowed: str) -> None:
    """Raise ``ValueError`` that says what was given and what is allowed."""
    if not is_allowed:
        raise ValueError(f"{name} is {given}; allowed: {allowed}")
