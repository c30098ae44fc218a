"""The list of all metrics. To add one, write its function and its line here (CONTRIBUTING.md): all else reads the list.

Evaluation measures every line and writes it into ``metrics.json``, ``metrics.csv`` and ``arrays.npz``; summaries, web
pages, plots, model cards and comparisons of systems show it, in the order of the list.
"""

from vpd_lightning.metrics.metric_info import MetricInfo

PSNR, CHAMFER = "psnr", "chamfer"
HEADLINE = PSNR
"""The one number by which checkpoints are kept and models are listed."""
SOURCES = ("model", "copy_last", "train_mean")
"""Whose images are judged: the model's, and those of two references in its place."""
REFERENCES = SOURCES[1:]
NOTHING_MOVES, TRUE_VELOCITY, TRUE_MOTION = "nothing_moves", "constant_velocity", "true_motion"
DRAWN = {
    NOTHING_MOVES: "nothing moves",
    TRUE_VELOCITY: "true velocity kept",
    TRUE_MOTION: "true motion",
}
"""Motions that the model's own renderer draws, where ``protocol.draw_references`` asks for them; and their titles."""
_BODY = "vpd_lightning.metrics.body_metrics"

METRICS: tuple[MetricInfo, ...] = (
    MetricInfo(
        name=PSNR, title="PSNR", unit="dB", better="higher", digits=2, subject="image",
        function="vpd_lightning.metrics.psnr.psnr_of_images", parts=(PSNR, "mse"), pooled_part="mse",
        description="peak signal-to-noise ratio of every image",
    ),
    MetricInfo(
        name="psnr_moving", title="PSNR of moving pixels", unit="dB", better="higher", digits=2, subject="image",
        function="vpd_lightning.metrics.psnr.psnr_of_moving_pixels", parts=("psnr_moving", "moving_mse"),
        pooled_part="moving_mse", needs_motion=True, description="PSNR over the moving pixels of an image",
    ),
    MetricInfo(
        name="ssim", title="SSIM", unit="", better="higher", digits=3, subject="image",
        function="vpd_lightning.metrics.ssim.ssim_of_images", description="structural similarity of every image",
    ),
    MetricInfo(
        name="flip", title="FLIP", unit="", better="lower", digits=3, subject="image",
        function="vpd_lightning.metrics.flip.flip_of_images",
        why_missing="the package flip-evaluator was not installed",
        description="how different an image looks from the truth when the two alternate (LDR-FLIP), from 0 to 1, at "
        "67 pixels per degree; measured where the package flip-evaluator is installed",
    ),
    MetricInfo(
        name="lpips", title="LPIPS", unit="", better="lower", digits=3, subject="image",
        function="vpd_lightning.metrics.lpips.lpips_of_images",
        why_missing="it needs torchvision, its AlexNet weights, and 31 pixels a side",
        description="distance of an image from the truth in the features of AlexNet, weighted as people judged; "
        "measured where torchvision and its weights are on the machine",
    ),
    MetricInfo(
        name="moving_iou", title="IoU of changed pixels", unit="", better="higher", digits=3, subject="image",
        function="vpd_lightning.metrics.moving.iou_of_changed_pixels", needs_motion=True,
        description="intersection over union of the pixels that differ from the last input frame, as predicted and in "
        "truth: bodies and shadows where they should be; cameras that stand still",
    ),
    MetricInfo(
        name="sharpness", title="sharpness", unit="", better="one", digits=2, subject="image",
        function="vpd_lightning.metrics.sharpness.sharpness_of_images",
        description="mean gradient length of the prediction over that of the truth: below 1 is blurred; where most of "
        "a picture does not move, the background dominates it",
    ),
    MetricInfo(
        name=CHAMFER, title="Chamfer distance", unit="m", better="lower", digits=2, subject="particles",
        function="vpd_lightning.metrics.chamfer.chamfer_by_step", parts=("mean", "accuracy", "completeness"),
        description="Chamfer-L1 distance between particles and measured points",
    ),
    MetricInfo(
        name="penetration", title="deepest particle in floor or bodies", unit="m", better="lower", digits=2,
        subject="body", function="vpd_lightning.metrics.penetration.penetration_by_step",
        parts=("mean", "floor", "bodies", "true_motion"),
        description="depth below the floor or in another body's true box; small also where nothing moves",
    ),
    MetricInfo(
        name="centroid_error", title="centroid error of bodies", unit="m", better="lower", digits=1, subject="body",
        function=f"{_BODY}.centroid_error", description="distance of a body's centroid from its true one",
    ),
    MetricInfo(
        name="centroid_error_copy", title="no motion", unit="m", better="lower", digits=1, subject="body",
        function=f"{_BODY}.centroid_error_copy", in_tables=False, reference_of="centroid_error",
        description="centroid error if nothing moved",
    ),
    MetricInfo(
        name="centroid_error_constant", title="the best constant displacement", unit="m", better="lower", digits=1,
        subject="body", function=f"{_BODY}.centroid_error_constant", in_tables=False, reference_of="centroid_error",
        description="centroid error of the training set's median displacement",
    ),
    MetricInfo(
        name="centroid_error_velocity", title="the first true velocity kept", unit="m", better="lower", digits=1,
        subject="body", function=f"{_BODY}.centroid_error_velocity", in_tables=False, reference_of="centroid_error",
        sees_input=True, description="centroid error if the true velocity between the input frames went on",
    ),
    MetricInfo(
        name="particle_error", title="particle error", unit="m", better="lower", digits=1, subject="body",
        function=f"{_BODY}.particle_error", in_tables=False,
        description="mean distance between corresponding particles",
    ),
    MetricInfo(
        name="particle_error_copy", title="no motion", unit="m", better="lower", digits=1, subject="body",
        function=f"{_BODY}.particle_error_copy", in_tables=False, in_summary=False, reference_of="particle_error",
        description="particle error if nothing moved",
    ),
    MetricInfo(
        name="orientation_error", title="orientation error", unit="deg", better="lower", digits=1, subject="body",
        function=f"{_BODY}.orientation_error", in_tables=False,
        description="angle between the best rigid rotations of predicted and true particles; rigid bodies",
    ),
    MetricInfo(
        name="velocity_error", title="velocity error", unit="m/s", better="lower", digits=1, subject="body",
        function=f"{_BODY}.velocity_error", in_tables=False,
        description="difference of the centroid's velocity over a step",
    ),
    MetricInfo(
        name="energy_error", title="energy error", unit="J/kg", better="lower", digits=2, subject="body",
        function=f"{_BODY}.energy_error", in_tables=False, in_summary=False,
        description="difference of the centroid's kinetic and potential energy",
    ),
    MetricInfo(
        name="height_error", title="height error", unit="m", better="lower", digits=1, subject="body",
        function=f"{_BODY}.height_error", in_tables=False, in_summary=False,
        description="difference of the lowest particle's height",
    ),
    MetricInfo(
        name="rigidity_error", title="rigidity error", unit="m", better="lower", digits=2, subject="body",
        function=f"{_BODY}.rigidity_error", in_summary=False,
        description="what is left of a rigid body's error after the best rigid motion; small also where nothing moves",
    ),
    MetricInfo(
        name="size_ratio", title="size / start", unit="", better="one", digits=2, subject="body",
        function=f"{_BODY}.size_ratio", in_tables=False, has_extremes=True,
        description="root mean square radius over that at the start; rigid bodies",
    ),
    MetricInfo(
        name="lowest_point", title="lowest point", unit="m", better="none", digits=1, subject="body",
        function=f"{_BODY}.lowest_point", in_tables=False, in_summary=False,
        description="height of a body's lowest particle",
    ),
    MetricInfo(
        name="body_chamfer", title="distance to true surface", unit="m", better="lower", digits=2, subject="body",
        function=f"{_BODY}.body_chamfer",
        description="mean distance of a soft body's particles to its true surface",
    ),
    MetricInfo(
        name="speed", title="speed", unit="m/s", better="none", digits=1, subject="body",
        function=f"{_BODY}.speed", in_tables=False, in_summary=False, description="speed of the centroid",
    ),
    MetricInfo(
        name="vertical_velocity", title="vertical velocity", unit="m/s", better="none", digits=1, subject="body",
        function=f"{_BODY}.vertical_velocity", in_tables=False, in_summary=False,
        description="vertical velocity of the centroid",
    ),
    MetricInfo(
        name="true_speed", title="true speed", unit="m/s", better="none", digits=1, subject="body",
        function=f"{_BODY}.true_speed", in_tables=False, in_summary=False, description="true speed of the centroid",
    ),
    MetricInfo(
        name="true_vertical_velocity", title="true vertical velocity", unit="m/s", better="none", digits=1,
        subject="body", function=f"{_BODY}.true_vertical_velocity", in_tables=False, in_summary=False,
        description="true vertical velocity of the centroid",
    ),
)  # fmt: skip


def metric(name: str) -> MetricInfo:
    """Return the line of a metric.

    Raises:
        KeyError: there is no such metric.
    """
    found = next((info for info in METRICS if info.name == name), None)
    if found is None:
        raise KeyError(f"There is no metric {name!r}; the list has {', '.join(info.name for info in METRICS)}.")
    return found


def image_metrics() -> tuple[MetricInfo, ...]:
    """The metrics of images."""
    return tuple(info for info in METRICS if info.subject == "image")


def scores() -> tuple[MetricInfo, ...]:
    """The metrics of images by which predictions are ranked."""
    return tuple(info for info in METRICS if info.is_score)


def still_scores() -> tuple[MetricInfo, ...]:
    """The scores of whole images, moving or not."""
    return tuple(info for info in scores() if not info.needs_motion)


def particle_metrics() -> tuple[MetricInfo, ...]:
    """The metrics of all particles together."""
    return tuple(info for info in METRICS if info.subject == "particles")


def body_metrics() -> tuple[MetricInfo, ...]:
    """The metrics of single bodies."""
    return tuple(info for info in METRICS if info.subject == "body")


def motion_metrics() -> tuple[MetricInfo, ...]:
    """The metrics of single bodies that stand together under ``motion``."""
    return tuple(info for info in body_metrics() if not info.has_block)


def blocks() -> tuple[MetricInfo, ...]:
    """The metrics that stand by themselves in ``metrics.json``, with their parts."""
    return tuple(info for info in METRICS if info.has_block)


def compared() -> tuple[MetricInfo, ...]:
    """The metrics by which systems are compared."""
    return tuple(info for info in METRICS if info.in_tables)


def references_of(info: MetricInfo) -> tuple[MetricInfo, ...]:
    """What predictions that need no model reach in a metric of bodies."""
    return tuple(other for other in METRICS if other.reference_of == info.name)


def referenced() -> tuple[MetricInfo, ...]:
    """The compared metrics of bodies that have such references."""
    return tuple(info for info in motion_metrics() if info.in_tables and references_of(info))


def paired() -> tuple[MetricInfo, ...]:
    """The metrics whose differences between two systems are taken clip by clip."""
    return (*scores(), *referenced())
