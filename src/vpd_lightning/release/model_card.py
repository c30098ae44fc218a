"""The page that comes with a released model: what it is, how it was made, how good it is, and what it is not for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vpd_lightning.data.trained_on import TRAINED_ON
from vpd_lightning.metrics.registry import HEADLINE, referenced, scores
from vpd_lightning.release.card_figures import beaten_by, beaten_in_motion_by, figure_lines, short_title
from vpd_lightning.release.system_notes import describe_system, reads_depth, renders_any_camera


@dataclass(frozen=True)
class CardContent:
    """What the card is written from; nothing in it names a machine.

    ``training`` is the run's ``training_time.json`` (null where it has none), ``environment`` its ``environment.json``.
    """

    name: str
    index: Mapping[str, Any]
    config: Mapping[str, Any]
    metrics: Mapping[str, Any]
    training: Mapping[str, Any] | None
    environment: Mapping[str, Any]
    megabytes: float


def model_card(content: CardContent) -> str:
    """Return the card as Markdown."""
    sections = (
        _front_matter(content.index),
        f"# {content.name}",
        _introduction(content),
        *_section("Figures", figure_lines(content.metrics)),
        *_section("Load it", _usage_lines(content)),
        *_section("Data", _data_lines(content.config, content.metrics, content.index.get(TRAINED_ON))),
        *_section("Training", _training_lines(content)),
        *_section("Intended use", [_INTENDED_USE]),
        *_section("Limits", _limit_lines(content)),
        *_section("Licence", [_LICENCE]),
    )
    return "\n\n".join(sections) + "\n"


def _front_matter(index: Mapping[str, Any]) -> str:
    tags = ["learned-simulation", "video-prediction", "rgb-d", str(index["system"])]
    return "\n".join(["---", "license: apache-2.0", "library_name: vpd-lightning", f"tags: [{', '.join(tags)}]", "---"])


def _introduction(content: CardContent) -> str:
    index = content.index
    return (
        f"{describe_system(index['system'])}\n\n"
        f"System `{index['system']}`, experiment `{index['experiment']}`, seed {index['seed']}: "
        f"{index['num_parameters']:,} parameters in {content.megabytes:.1f} MB of float32. Made with VPD Lightning, an "
        "independent implementation of [Learning 3D Particle-based Simulators from RGB-D Videos]"
        "(https://arxiv.org/abs/2312.05359); these are not the paper's weights."
    )


def _section(title: str, lines: Sequence[str]) -> list[str]:
    return [f"## {title}", "\n".join(lines)]


def _usage_lines(content: CardContent) -> list[str]:
    folder, views = content.config["data"]["folder"], content.config["scene"]["input_views"]
    is_filmed = renders_any_camera(content.index["system"])
    words = " ".join(protocol_words(content.config.get("protocol") or {}, content.metrics["protocol"]))
    return [
        "```",
        f"vpd-eval ckpt=released/{content.name}{words and ' '}{words}      # the figures above",
        *([f"vpd-render ckpt=released/{content.name}    # films of its predictions"] if is_filmed else ()),
        "```",
        "",
        f"Both look for the data in `{folder}`; `data.folder=` names another place."
        if is_filmed
        else f"It looks for the data in `{folder}`; `data.folder=` names another place.",
        "",
        "```python",
        "import vpd_lightning as vpd",
        "",
        f'system = vpd.load("released/{content.name}")  # checks the SHA-256; runs no code from the folder',
        "```",
        "",
        _input_line(content.index["system"], list(views)),
    ]


def protocol_words(run_protocol: Mapping[str, Any], measured: Mapping[str, Any]) -> list[str]:
    """Return the options with which ``vpd-eval`` gives the figures, where the run's own protocol is another."""
    # The number of trajectories in the figures is how many there were, not how many were asked for.
    keys = [key for key in run_protocol if key in measured and key != "num_trajectories"]
    return [f"protocol.{key}={measured[key]}".replace(" ", "") for key in keys if measured[key] != run_protocol[key]]


def _input_line(system: str, views: list[int]) -> str:
    if not renders_any_camera(system):
        return "Input: the first frames of one camera's video, whichever camera; neither depth nor its pose is read."
    frames = "RGB-D frames" if reads_depth(system) else "colour frames (depth is not read)"
    return f"Input: two {frames} of the calibrated cameras {views} of the data set."


def _data_lines(config: Mapping[str, Any], metrics: Mapping[str, Any], trained_on: Sequence[str] | None) -> list[str]:
    folder, wanted = config["data"]["folder"], config.get("generate")
    digest = metrics.get("data_sha256")
    lines = []
    # The folder may hold another number than the preset says; how many there were is known where all were trained on,
    # and nothing else was.
    before = _trained_before(config)
    is_known = trained_on is not None and config["data"].get("num_trajectories") is None and not before
    size = f" splits.train={len(trained_on or ())}" if is_known else ""
    if wanted and wanted.get("scene"):
        lines += [
            f"Synthetic videos of the scene `{wanted['scene']}`, preset `{wanted['preset']}`, simulated with MuJoCo. "
            "Making them again gives the same physics; pictures agree bit for bit on one machine only:",
            "",
            "```",
            f"vpd-data generate scene={wanted['scene']} preset={wanted['preset']} out={folder} seed={wanted['seed']}"
            + size,
            "```",
        ]
    else:
        lines.append(f"Recordings in `{folder}`; they do not come with the model.")
    count = config["data"].get("num_trajectories")
    if count is not None:
        lines += ["", f"Trained on {count} of its training trajectories."]
    if before and trained_on is not None:
        lines += [
            "",
            f"It began with the weights of `{before}`: the two trainings saw {len(trained_on)} trajectories in all. "
            "How many of them are of this data set is not known here; `splits.train` says how many are generated.",
        ]
    if digest:
        lines += ["", f"The figures are of the data set with the SHA-256 `{digest}`."]
    return lines


def _training_lines(content: CardContent) -> list[str]:
    config, training = content.config, content.training
    lines = [f"- updates: {content.index['step']:,}"]
    if _trained_before(config):
        lines.append(f"- begun from the weights of `{_trained_before(config)}`")
    each = f" of each of {num_processes(config)} processes" if num_processes(config) > 1 else ""
    budget = (config.get("callbacks") or {}).get("time_budget")
    limit = (config.get("trainer") or {}).get("max_steps")
    if isinstance(budget, Mapping) and budget.get("minutes") is not None:
        lines.append(f"- budget: {budget['minutes']:g} minutes on the {_clock(budget['clock'])} clock{each}")
    elif limit:
        lines.append(f"- budget: {limit:,} updates")
    if training:
        seconds = float(training["seconds"])
        lines.append(f"- time used: {seconds / 60:.1f} minutes on the {_clock(training['clock'])} clock{each}")
        first = (training.get("pretraining") or {}).get("seconds", training.get("seconds_before"))
        if first:
            lines.append(f"- of these, the first training and what it prepared: {float(first) / 60:.1f} minutes")
    else:
        lines.append("- time used: not recorded")
    lines.append(f"- batch of {config['data'].get('batch_size')} clips, seed {content.index['seed']}")
    devices = content.environment.get("devices")
    if devices:
        lines.append(f"- device: {'; '.join(map(str, devices))}")
    versions = content.environment.get("versions") or {}
    shown = [f"{name} {versions[name]}" for name in ("python", "torch", "lightning") if name in versions]
    if shown:
        lines.append(f"- versions: {', '.join(shown)}")
    if content.environment.get("git_commit"):
        lines.append(f"- source: commit `{content.environment['git_commit']}`")
    return [*lines, "", "`config.yaml` holds every setting."]


def num_processes(config: Mapping[str, Any]) -> int:
    """Return how many processes a training ran in, by its configuration; 1 where that depends on the machine."""
    trainer = config.get("trainer") or {}
    devices, nodes = trainer.get("devices", 1), trainer.get("num_nodes", 1)
    is_known = str(trainer.get("strategy", "")).startswith("ddp") and isinstance(devices, int)
    return max(1, devices) * int(nodes) if is_known else 1


def _trained_before(config: Mapping[str, Any]) -> str | None:
    """Return the weights that the training began with, where it had any."""
    found = (config.get("pretraining") or {}).get("ckpt")
    return str(found) if found else None


def _clock(name: str) -> str:
    return {"cpu": "processor", "wall": "wall"}.get(name, name)


def _limit_lines(content: CardContent) -> list[str]:
    system = content.index["system"]
    lines = [
        "- It knows one kind of scene, with its cameras, workspace and number of bodies. Elsewhere it fails, and does "
        "not say so.",
        "- Predictions get worse with every step; `metrics.json` has the figures per step. It gives no uncertainty.",
        "- Image averages hide much, because most of a picture stands still: look at the moving pixels.",
        "- The figures compare within this project, on this data set, and not with the paper's tables.",
    ]
    metrics = content.metrics
    beaten = [(info, what) for info in scores() for what in beaten_by(metrics, info.name)]
    beaten += [(info, what) for info in referenced() for what in beaten_in_motion_by(metrics, info.name)]
    lines += [f"- **By {short_title(info)} it does not beat {what}.**" for info, what in beaten]
    if not renders_any_camera(system):
        lines.append("- It predicts the views it is given and no others.")
    elif metrics[HEADLINE].get("other_views") is None:
        lines.append("- All cameras of its data set are inputs: the figures say nothing of new views.")
    return lines


_INTENDED_USE = (
    "Research and teaching: to look at what the system predicts, to compare with it, to build on it. "
    "Not for controlling machines, and not for decisions about anything that matters outside a screen."
)
_LICENCE = "Apache-2.0, as the code."
