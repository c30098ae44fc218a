"""The text beside the picture: one sentence about it, and the figures of the step."""

from vpd_lightning.metrics.registry import CHAMFER, PSNR, metric
from vpd_lightning.viewer.screen import PARTICLES, PICTURE, Screen
from vpd_lightning.viewer.session import picture_psnr


def sentence(screen: Screen) -> str:
    """Return what one sees, in a sentence (Markdown)."""
    if screen.mode == PARTICLES:
        return "The particles that the model moves. Drag to look around."
    rollouts = screen.rollouts()
    if len(rollouts) > 1:
        first, second = (screen.session.label(rollout) for rollout in rollouts)
        return f"The same scene twice, as the model predicts it: **{first}**, and **{second}**."
    if screen.mode == PICTURE:
        return "What the model predicts, from any side. Drag to look around."
    said = "The model saw **two frames** and predicts the rest. Bright in the error is wrong."
    return f"{said} Click a body, or take it away."


def figures(screen: Screen, step: int, may_render: bool) -> str:
    """Return how good a step is (Markdown), or why nobody knows.

    ``may_render`` allows a rendering from the recorded camera where the film has no picture of the step yet.
    """
    session = screen.session
    now = session.now
    lines = [f"step **{min(step, now.num_steps)}** of {now.num_steps}"]
    if now.is_edited:
        lines.append("edited: no truth to compare with" + _to_simulated(screen, step))
    elif step > session.opened.num_true_steps:
        lines.append("the recording has ended: no truth to compare with")
    elif (found := _measured(screen, step, may_render)) is not None:
        seen, near = metric(PSNR), metric(CHAMFER)
        lines.append(
            f"{seen.title} **{seen.shown(found[PSNR])} {seen.printed_unit}** in camera {screen.view}, "
            f"**{near.shown(found[CHAMFER])} {near.printed_unit}** to what was measured"
        )
    return "  \n".join(lines)


def _to_simulated(screen: Screen, step: int) -> str:
    """Return how near the picture of an edited scene is to that of the generator's own simulation, in words."""
    true_picture, picture = screen.true_picture(step), screen.film_picture(step)
    if true_picture is None or picture is None:
        return ""
    seen = metric(PSNR)
    value = picture_psnr(screen.as_recorded(picture), true_picture)
    return f" but MuJoCo's own simulation: {seen.title} **{seen.shown(value)} {seen.printed_unit}**"


def _measured(screen: Screen, step: int, may_render: bool) -> dict[str, float] | None:
    """Return the figures of a step, None while the picture of the film is not drawn."""
    session, view = screen.session, screen.view
    if step > session.now.num_steps:
        return None
    known = session.now.figures
    if (step, view) not in known:
        picture = screen.film_picture(step)
        if picture is None and may_render:
            picture = session.render(step, session.opened.cameras[view : view + 1])[0]
        if picture is None:
            return None
        known[step, view] = session.measure(step, view, screen.as_recorded(picture))
    return known[step, view]
