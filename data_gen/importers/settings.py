"""Settings of ``vpd-data import``: what may be given, with which defaults, and what each value may be."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from omegaconf import OmegaConf

from data_gen.importers.conventions import UP_CHOICES
from data_gen.settings import checked_settings
from vpd_lightning.data.schema import COMPRESSIONS, DEPTH_ENCODINGS

AUTO = "auto"
_CHOICES = {
    "depth": (AUTO, "z", "distance"),
    "axes": (AUTO, "opencv", "opengl"),
    "pixel_center": (AUTO, "0.5", "0.0"),
    "up": UP_CHOICES,
    "compression": COMPRESSIONS,
    "depth_encoding": DEPTH_ENCODINGS,
}
_ALIASES = {"pixel_center": {"0": "0.0", ".5": "0.5"}}


@dataclass
class SplitFractions:
    """Shares of the recordings; they need not add up to 1."""

    train: float = 0.8
    validation: float = 0.1
    test: float = 0.1


@dataclass
class ImportSettings:
    """How a source is read and what is made of it. ``auto`` and ``None`` take what the source says."""

    format: str = AUTO
    # Which frames
    max_recordings: int | None = None  # the first so many
    frame_time: float | None = None  # s between the source's frames (before ``every``)
    every: int = 1  # keep every n-th frame
    clip_frames: int | None = None  # cut each recording into trajectories of so many frames
    max_time_difference: float = 0.02  # s, between images (and poses) that count as taken together
    moving_camera: bool = False  # images without times are consecutive frames of one camera (transforms.json)
    # Images
    crop: list[int] | None = None  # left, top, width, height in pixels, after undistortion
    height: int | None = None  # of the result, after the crop; one of the two gives the other
    width: int | None = None
    # Depth as cameras measure it: what to clean before it is scaled
    flying_pixels: float | None = None  # remove pixels in the air between surfaces: jumps of this share of depth (0.02)
    smooth: float | None = None  # pixels of the source: radius of an edge-preserving filter
    fill_holes: int | None = None  # frames back from which a fixed camera's holes may be filled
    # Poses of cameras that stand still: lay what they see onto each other (ICP); the first view stays
    refine_poses: bool = False
    # Conventions of the source, where it does not say or says it wrongly
    depth: str = AUTO  # z (along the optical axis) | distance (to the camera centre)
    depth_scale: float | None = None  # metres per unit of the depth images
    axes: str = AUTO  # opencv (x right, y down, z forward) | opengl (x right, y up, z back)
    pixel_center: str = AUTO  # where the centre of the first pixel lies: 0.5 | 0.0
    up: str = "z"  # axis of the source's world that points up: z, y, -y, ...; the world is turned so that it is z
    undo_applied_transform: bool = False  # transforms.json: return to the world before nerfstudio turned it
    # The scene
    scale: float | None = None  # metres per unit of the source: multiplies camera positions and depths
    recenter: bool = False  # put the origin at the median of all points
    near: float | None = None  # m along rays; null: estimated from the points
    far: float | None = None
    workspace_min: list[float] | None = None  # m, world
    workspace_max: list[float] | None = None
    # The data set
    splits: SplitFractions = field(default_factory=SplitFractions)
    seed: int = 0  # of the division into splits
    workers: int | None = None  # processes; null: all cores; never changes the data
    compression: str = "gzip"
    depth_encoding: str = "float32"
    mapping: str | None = None  # YAML file that names features or topics (LeRobot, ROS)

    def __post_init__(self) -> None:
        for name, aliases in _ALIASES.items():
            setattr(self, name, aliases.get(getattr(self, name), getattr(self, name)))
        for name, choices in _CHOICES.items():
            _require(getattr(self, name) in choices, name, getattr(self, name), ", ".join(choices))
        for name in ("max_recordings", "every", "workers", "fill_holes"):
            _require(_at_least(getattr(self, name), 1), name, getattr(self, name), "a whole number from 1 on")
        _require(_at_least(self.clip_frames, 3), "clip_frames", self.clip_frames, "3 or more (two seen, one predicted)")
        for name in ("frame_time", "depth_scale", "scale", "far"):
            _require(_is_positive(getattr(self, name)), name, getattr(self, name), "above 0")
        for name, highest, unit in (("flying_pixels", 0.5, "share of depth"), ("smooth", 20, "pixels")):
            value = getattr(self, name)
            _require(value is None or 0 < value <= highest, name, value, f"above 0, to {highest:g} ({unit})")
        _require(0 <= self.max_time_difference <= 10, "max_time_difference", self.max_time_difference, "0 to 10 s")
        _require(self.near is None or 0 <= self.near < float("inf"), "near", self.near, "0 or more")
        if self.near is not None and self.far is not None:
            _require(self.near < self.far, "near, far", (self.near, self.far), "near < far")
        for name in ("height", "width"):
            value = getattr(self, name)
            _require(value is None or 8 <= value <= 16384, name, value, "8 to 16384 pixels")
        self._check_boxes()
        fractions = (self.splits.train, self.splits.validation, self.splits.test)
        _require(
            all(0 <= value < float("inf") for value in fractions) and sum(fractions) > 0,
            "splits",
            list(fractions),
            "shares of 0 or more, not all 0",
        )
        _require(0 <= self.seed < 2**63, "seed", self.seed, "0 to 2^63 - 1")

    def _check_boxes(self) -> None:
        if self.crop is not None:
            allowed = "[left, top, width, height] with left, top >= 0 and sides of 8 pixels or more"
            is_good = len(self.crop) == 4 and min(self.crop[:2]) >= 0 and min(self.crop[2:]) >= 8
            _require(is_good, "crop", list(self.crop), allowed)
        for name in ("workspace_min", "workspace_max"):
            value = getattr(self, name)
            is_good = value is None or (len(value) == 3 and all(abs(x) < float("inf") for x in value))
            _require(is_good, name, value, "three numbers [x, y, z] in metres")
        if self.workspace_min is not None and self.workspace_max is not None:
            is_good = all(a < b for a, b in zip(self.workspace_min, self.workspace_max, strict=True))
            _require(is_good, "workspace_min, workspace_max", (self.workspace_min, self.workspace_max), "min below max")


def chosen(setting: str, found: str) -> str:
    """Return the setting, or what the source says where the setting is ``auto``."""
    return found if setting == AUTO else setting


def load_import_settings(overrides: Mapping[str, Any]) -> ImportSettings:
    """Check names (with the nearest one), types and ranges of settings given by (dotted) name.

    Raises:
        ConfigError: unknown names, wrong types, values out of range.
    """
    base = OmegaConf.create(asdict(ImportSettings()))
    return checked_settings(ImportSettings, base, overrides, "import")


def _at_least(value: int | None, lowest: int) -> bool:
    return value is None or value >= lowest


def _is_positive(value: float | None) -> bool:
    return value is None or 0 < value < float("inf")


def _require(is_allowed: bool, name: str, given: Any, allowed: str) -> None:
    if not is_allowed:
        raise ValueError(f"{name} is {given}; allowed: {allowed}")
