"""The types of the configuration's roots, and the ranges that no constructor checks.

Every value lives in ``conf/``: fields have no defaults here. A stage's own section is a plain mapping, checked against
the signature of the class it names (see ``building.py``).
"""

import math
from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from vpd_lightning.errors import ConfigError


@dataclass
class SceneConfig:
    """What depends on the data set and is shared by stages (paper table ``vpd_hypers``); lengths in metres."""

    name: str = MISSING
    input_views: list[int] = MISSING
    r_s: float = MISSING
    r_a_s: float = MISSING
    kernel_radii: list[float] = MISSING
    kernel_bandwidths: list[float] = MISSING
    surface_scale: float = MISSING
    location_scale: float = MISSING
    location_noise: float = MISSING
    near: float = MISSING
    far: float = MISSING
    workspace_min: list[float] = MISSING
    workspace_max: list[float] = MISSING
    # Extra settings of our inertial dynamics; null in older runs.
    force_scale: float | None = None
    contact_range: float | None = None
    max_contact_depth: float | None = None
    shadow_scales: list[float] | None = None


@dataclass
class RunConfig:
    """Where a run writes: ``folder``, or a new one below ``root``."""

    root: str = MISSING
    folder: str | None = None


@dataclass
class GenerateConfig:
    """The call of ``vpd-data generate`` that makes the data set; done only where ``when_missing`` says so.

    ``scene`` None: nothing makes it, it was recorded.
    """

    scene: str | None = None
    preset: str = MISSING
    seed: int = MISSING
    when_missing: bool = MISSING


@dataclass
class PretrainingConfig:
    """A training that comes first and hands its weights on; ``settings`` replace those of the main one.

    ``ckpt`` names one that is done already; ``share`` is its share of the time budget.
    """

    ckpt: str | None = None
    share: float = MISSING
    settings: Any = MISSING


@dataclass
class LightFitConfig:
    """A fit of the renderer's lights before training, to ``num_pairs`` pairs of frames (0: no fit)."""

    num_pairs: int = MISSING
    num_updates: int = MISSING


@dataclass
class TrainConfig:
    """Root of ``vpd-train``."""

    experiment: str = MISSING
    system: str = MISSING
    size: str = MISSING
    evaluate: bool = MISSING
    sweep_name: str | None = None
    pretraining: PretrainingConfig | None = None
    seed: int = MISSING
    feature_dim: int = MISSING
    color_features: bool = MISSING
    scenery: bool = MISSING
    actions: bool = MISSING
    light_fit: LightFitConfig = MISSING
    checkpoint_dynamics: bool = MISSING
    float32_matmul_precision: str = MISSING
    deterministic: bool = MISSING
    num_threads: int | None = None
    debug: bool = MISSING
    force: bool = MISSING
    resume: str | None = None
    run: RunConfig = MISSING
    model: Any = MISSING
    scene: SceneConfig = MISSING
    data: Any = MISSING
    encoder: Any = None
    dynamics: Any = None
    renderer: Any = None
    loss: Any = MISSING
    optimizer: Any = MISSING
    trainer: Any = MISSING
    callbacks: Any = MISSING
    logger: Any = MISSING
    protocol: Any = MISSING
    generate: GenerateConfig | None = None


@dataclass
class ProtocolConfig:
    """What an evaluation predicts and counts; None: as the run says."""

    split: str | None = None
    start_frames: list[int] | None = None
    num_steps: int | None = None
    num_trajectories: int | None = None
    num_long_steps: int | None = None
    long_start_frame: int | None = None
    moving_threshold: float | None = None
    min_moving_pixels: int | None = None
    body_margin: float | None = None
    num_chamfer_points: int | None = None
    num_bootstrap: int | None = None
    draw_references: bool | None = None


@dataclass
class DataChoice:
    """Which data set to use; None: the one that the run was trained on."""

    folder: str | None = None


@dataclass
class TrainedModelConfig:
    """What the roots below ask for alike: a trained model, its data, and where it runs."""

    ckpt: str = MISSING
    change: Any = None
    sleeping: bool = MISSING
    data: DataChoice = MISSING
    device: str = MISSING
    num_threads: int | None = None
    debug: bool = MISSING


@dataclass
class EvalConfig(TrainedModelConfig):
    """Root of ``vpd-eval``."""

    hide_depth: bool = MISSING
    force: bool = MISSING
    out: str | None = None
    num_videos: int = MISSING
    protocol: ProtocolConfig = MISSING


@dataclass
class RecordingConfig(TrainedModelConfig):
    """Which moment of which recording a model starts from, and for how long."""

    split: str = MISSING
    trajectory: int = MISSING
    start_frame: int = MISSING
    num_steps: int = MISSING


@dataclass
class RenderConfig(RecordingConfig):
    """Root of ``vpd-render``."""

    edit: str | None = None
    freeze_step: int | None = None
    camera: Any = MISSING
    num_views: int | None = None
    height: int | None = None
    width: int | None = None
    fps: float = MISSING
    out: str | None = None
    save_films: list[str] = MISSING
    save_particles: list[str] = MISSING
    save_maps: list[str] = MISSING
    save_camera_path: bool = MISSING


@dataclass
class ViewConfig(RecordingConfig):
    """Root of ``vpd-view``."""

    port: int = MISSING
    kiosk: float | None = None


@dataclass
class SolverConfig:
    """How a plan is looked for."""

    name: str = MISSING
    num_samples: int = MISSING
    num_iterations: int = MISSING
    num_elites: int = MISSING
    spread: float = MISSING
    temperature: float = MISSING


@dataclass
class ContactConfig:
    """How finely contact is resolved while planning."""

    num_probes: int | None = MISSING
    num_contact_substeps: int | None = MISSING


@dataclass
class PlanConfig(TrainedModelConfig):
    """Root of ``vpd-plan``."""

    task: str = MISSING
    seed: int = MISSING
    preset: str = MISSING
    system: str = MISSING
    solver: SolverConfig = MISSING
    contact: ContactConfig = MISSING
    num_knots: int = MISSING
    hold: int = MISSING
    num_executed: int = MISSING
    num_decisions: int = MISSING
    max_speed: float = MISSING
    backend: str = MISSING
    fps: float = MISSING
    out: str | None = None


@dataclass
class ExportConfig:
    """Root of ``vpd-export``."""

    ckpt: str = MISSING
    out: str = MISSING
    metrics: str | None = None
    max_megabytes: float = MISSING
    renderer_program: int | None = None
    debug: bool = MISSING


@dataclass
class BenchDataChoice(DataChoice):
    """Also of which preset the trajectories are whose making is timed."""

    preset: str = MISSING


@dataclass
class BenchConfig:
    """Root of ``vpd-bench``; ``suite`` is one name or several."""

    suite: Any = MISSING
    device: str = MISSING
    out: str | None = None
    repeats: int = MISSING
    quick: bool = MISSING
    ckpt: list[str] = MISSING
    data: BenchDataChoice = MISSING
    num_threads: int | None = None
    debug: bool = MISSING


def check_scene(scene: dict[str, Any]) -> None:
    """Check the ranges of a scene section.

    Raises:
        ConfigError: a value out of its range; the message says what was given and what is allowed.
    """
    _require_finite(scene)
    for name in ("r_s", "r_a_s", "surface_scale", "location_scale", "near"):
        _require(scene[name] > 0, f"scene.{name}", scene[name], "a number above 0")
    _require(scene["location_noise"] >= 0, "scene.location_noise", scene["location_noise"], "a number from 0 up")
    _require(scene["near"] < scene["far"], "scene.near", scene["near"], f"less than scene.far, which is {scene['far']}")
    radii, bandwidths = scene["kernel_radii"], scene["kernel_bandwidths"]
    _require(
        len(radii) == len(bandwidths) > 0,
        "scene.kernel_radii",
        radii,
        f"one radius per bandwidth; scene.kernel_bandwidths is {bandwidths}",
    )
    _require(min(radii) >= 0, "scene.kernel_radii", radii, "numbers from 0 up")
    _require(min(bandwidths) > 0, "scene.kernel_bandwidths", bandwidths, "numbers above 0")
    views = scene["input_views"]
    _require(
        len(views) > 0 and min(views) >= 0 and len(set(views)) == len(views),
        "scene.input_views",
        views,
        "at least one camera index, from 0 up, none twice",
    )
    low, high = scene["workspace_min"], scene["workspace_max"]
    _require(len(low) == len(high) == 3, "scene.workspace_min", low, "three numbers, as scene.workspace_max")
    inside = all(a < b for a, b in zip(low, high, strict=True))
    _require(inside, "scene.workspace_min", low, f"below scene.workspace_max on every axis, which is {high}")


def check_training(config: dict[str, Any]) -> None:
    """Check the root's own values.

    Raises:
        ConfigError: a value out of its range.
    """
    _require(config["seed"] >= 0, "seed", config["seed"], "a whole number from 0 up")
    _require(config["feature_dim"] >= 1, "feature_dim", config["feature_dim"], "a whole number from 1 up")
    threads = config["num_threads"]
    _require(threads is None or threads >= 1, "num_threads", threads, "a whole number from 1 up, or null")
    precision = config["float32_matmul_precision"]
    _require(
        precision in ("highest", "high", "medium"), "float32_matmul_precision", precision, "highest, high or medium"
    )
    name = config["experiment"]
    pretraining = config["pretraining"]
    if pretraining is not None:
        _require(0 < pretraining["share"] < 1, "pretraining.share", pretraining["share"], "between 0 and 1")
    plain_name = bool(name) and name == name.strip(".") and all(c.isalnum() or c in "_-." for c in name)
    _require(plain_name, "experiment", name, "a name of letters, digits, _ and - (it becomes a folder)")


def _require_finite(section: dict[str, Any]) -> None:
    for name, value in section.items():
        numbers = value if isinstance(value, list) else [value]
        finite = all(math.isfinite(number) for number in numbers if isinstance(number, float))
        _require(finite, f"scene.{name}", value, "finite numbers")


def _require(is_met: bool, key: str, given: object, allowed: str) -> None:
    if not is_met:
        raise ConfigError(f"{key}={given} is out of range.\nAllowed: {allowed}.")
