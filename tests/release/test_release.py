"""Released models: the same weights and predictions, nothing of the machine they come from, and damage is noticed."""

import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch
import yaml
from torch import nn

import vpd_lightning
from tests.released_model import cameras, figures, predict, synthetic_frames, write_run, write_slotformer
from vpd_lightning.data.trained_on import TRAINED_ON
from vpd_lightning.errors import CheckpointError, ConfigError
from vpd_lightning.loading import LoadedModel, load_model
from vpd_lightning.release.card_figures import beaten_by, beaten_in_motion_by, figure_lines
from vpd_lightning.release.model_card import CardContent, model_card, protocol_words
from vpd_lightning.release.portable import absolute_paths, portable_config, portable_data_folder
from vpd_lightning.release.release import TrainedSystem, find_metrics, float32_weights, write_release
from vpd_lightning.release.release_folder import check_release, list_releases, sha256
from vpd_lightning.release.results_folder import beside_checkpoint
from vpd_lightning.types import RGBDFrames

FILES = ["README.md", "config.yaml", "metrics.json", "model.safetensors", "release.json"]
BOXES = {"scene": "boxes", "preset": "small", "seed": 0}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("somebody")
    return write_run(folder / "runs" / "first", folder / "datasets" / "boxes")


def trained_system(model: LoadedModel) -> TrainedSystem:
    return TrainedSystem(
        system=model.simulator, config=model.config, checkpoint=model.path, step=model.step,
        sha256=model.sha256, trained_on=model.trained_on,
    )  # fmt: skip


@pytest.fixture(scope="module")
def trained(checkpoint: Path) -> TrainedSystem:
    model = load_model(checkpoint)
    return trained_system(model)


@pytest.fixture(scope="module")
def original(trained: TrainedSystem, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A release that tests copy before they damage it."""
    folder = tmp_path_factory.mktemp("released") / "boxes"
    folder.mkdir()
    write_release(folder, trained, find_metrics(trained, None), name="boxes", max_megabytes=20)
    return folder


@pytest.fixture
def release(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "boxes"))


def test_a_release_predicts_bit_for_bit_what_the_run_did(checkpoint: Path, original: Path) -> None:
    before, after = load_model(checkpoint), load_model(original)
    assert sorted(path.name for path in original.iterdir()) == FILES
    assert (after.step, after.name, after.input_views) == (before.step, before.name, before.input_views)
    expected = before.simulator.state_dict()
    assert set(after.simulator.state_dict()) == set(expected)
    for name, value in after.simulator.state_dict().items():
        assert torch.equal(value, expected[name])
    frames = predict(vpd_lightning.load(original))
    assert torch.equal(frames, predict(before.simulator)) and frames.std() > 0
    assert load_model(original / "model.safetensors").path == after.path


def test_weights_are_float32_under_the_names_of_the_state_dict(trained: TrainedSystem, original: Path) -> None:
    stored = safetensors.torch.load_file(original / "model.safetensors")
    assert set(stored) == set(trained.system.state_dict())
    assert {value.dtype for value in stored.values() if value.is_floating_point()} == {torch.float32}


@pytest.mark.parametrize("name", ["model.safetensors", "config.yaml"])
def test_a_flipped_bit_is_noticed(release: Path, name: str) -> None:
    content = bytearray((release / name).read_bytes())
    content[len(content) // 2] ^= 1
    (release / name).write_bytes(content)
    with pytest.raises(CheckpointError, match=f"{name} is damaged"):
        load_model(release)
    assert f"{name} is damaged" in list_releases(release.parent)[0]["fault"]


@pytest.mark.parametrize("name", ["model.safetensors", "config.yaml", "release.json"])
def test_a_missing_file_is_named(release: Path, name: str) -> None:
    (release / name).unlink()
    with pytest.raises(CheckpointError, match=rf"not whole: {re.escape(name)} is missing"):
        load_model(release)


@pytest.mark.parametrize("name", ["README.md", "metrics.json"])
def test_a_release_without_its_card_or_figures_is_not_whole(release: Path, name: str) -> None:
    (release / name).unlink()
    with pytest.raises(CheckpointError, match=rf"not whole: {re.escape(name)} is missing"):
        check_release(release)


def forge(release: Path, name: str, content: bytes) -> None:
    """Replace a file together with its checksum, as somebody who means harm would."""
    (release / name).write_bytes(content)
    index = json.loads((release / "release.json").read_text())
    index["sha256"][name] = sha256(content)
    (release / "release.json").write_text(json.dumps(index))


@pytest.mark.parametrize("section", ["encoder", "model", "renderer"])
def test_a_configuration_that_names_foreign_code_is_refused(release: Path, tmp_path: Path, section: str) -> None:
    config = yaml.safe_load((release / "config.yaml").read_text())
    config[section] = {"_target_": "os.system", "command": f"touch {tmp_path}/hacked"}
    forge(release, "config.yaml", yaml.safe_dump(config).encode())
    with pytest.raises(CheckpointError, match="cannot build"):
        load_model(release)
    assert not (tmp_path / "hacked").exists()


def test_a_reference_in_a_configuration_is_refused(release: Path, tmp_path: Path) -> None:
    config = yaml.safe_load((release / "config.yaml").read_text())
    config["renderer"]["near"] = "${oc.create:{_target_:os.mkdir,path:hacked}}"
    forge(release, "config.yaml", yaml.safe_dump(config).encode())
    with pytest.raises(CheckpointError, match="holds a reference"):
        load_model(release)
    assert not Path("hacked").exists()


@pytest.mark.parametrize("folder", ["/data/x", "../x", "a/../../x", "~/x", "C:\\x", "\\x", "a\\..\\..\\x"])
def test_a_place_outside_of_the_current_folder_is_refused(release: Path, folder: str) -> None:
    config = yaml.safe_load((release / "config.yaml").read_text())
    for place in ({"data": {**config["data"], "folder": folder}}, {"more": [{"deep": folder}]}):
        forge(release, "config.yaml", yaml.safe_dump({**config, **place}).encode())
        with pytest.raises(CheckpointError, match="outside of the current folder"):
            load_model(release)


@pytest.mark.parametrize("psnr", ["'<b>'", None, True, [1.0]])
def test_an_index_whose_figure_is_no_number_is_refused(release: Path, psnr: object) -> None:
    index = json.loads((release / "release.json").read_text())
    (release / "release.json").write_text(json.dumps({**index, "psnr": psnr}))
    with pytest.raises(CheckpointError, match="lacks psnr"):
        check_release(release)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("config.yaml", b"!!python/object/apply:os.system ['touch hacked']", "not plain YAML"),
        ("config.yaml", b"a: &a [1, 2]\nb: [*a, *a]", "alias"),
        ("config.yaml", b"[1, 2]", "holds no settings"),
        ("config.yaml", b"experiment: boxes", "does not say what model"),
        ("config.yaml", b"\xff\xfe", "not plain YAML"),
        ("model.safetensors", b"", "no weights"),
        ("model.safetensors", b"PK\x03\x04" + bytes(100), "no weights"),
        ("model.safetensors", safetensors.torch.save({"a": torch.zeros(2)}), "do not fit"),
    ],
)
def test_forged_files_are_refused(release: Path, name: str, content: bytes, said: str) -> None:
    forge(release, name, content)
    with pytest.raises(CheckpointError, match=said):
        load_model(release)


@pytest.mark.parametrize("content", ["", "[]", "{", '{"format_version": 2}', '{"format_version": 1, "step": 3}'])
def test_what_is_no_index_is_refused(release: Path, content: str) -> None:
    (release / "release.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"release\.json"):
        load_model(release)


def test_nothing_of_the_machine_is_left(checkpoint: Path, original: Path) -> None:
    texts = {name: (original / name).read_text() for name in FILES if name != "model.safetensors"}
    foreign = ("/home/", "/tmp/", "/root", "somebody", str(checkpoint.parents[1]), "vpd-train", "runs/first")
    for name, text in texts.items():
        assert not [word for word in foreign if word in text], name
        assert not re.search(r"(?<![\w:/.])/[a-z]+/", text), name
    config = yaml.safe_load(texts["config.yaml"])
    assert not absolute_paths(config) and config["data"]["folder"] == "datasets/boxes"
    assert not {"run", "logger", "resume"} & set(config)
    metrics = json.loads(texts["metrics.json"])
    assert (metrics["data"], metrics["checkpoint"]) == ("datasets/boxes", "checkpoints/last.ckpt")


def test_the_card_says_what_it_is_and_how_good(original: Path) -> None:
    card = (original / "README.md").read_text()
    assert "| PSNR (dB) | 25.12 | 24.87 to 25.38 | 22.61 | 20.10 |" in card
    assert "| Chamfer distance (cm) | 3.88 | 3.84 to 3.92 | | |" in card
    for said in (
        "seed 0",
        "updates: 7",
        "5.0 minutes on the processor clock",
        "Apache-2.0",
        "released/boxes",
        "0123abc",
    ):
        assert said in card, said
    assert "does not beat" not in card, "25.1 dB against 22.6"


def test_the_card_sets_motion_beside_what_sees_nothing(original: Path) -> None:
    metrics = json.loads((original / "metrics.json").read_text())
    errors = {"centroid_error": 0.3, "centroid_error_copy": 0.9, "centroid_error_constant": 0.25}
    metrics["motion"] = {name: {"mean": error, "ci95": None} for name, error in errors.items()}

    assert "no motion 90.0 cm and the best constant displacement 25.0 cm" in "\n".join(figure_lines(metrics))
    assert beaten_in_motion_by(metrics, "centroid_error") == ["the best constant displacement"]
    assert beaten_in_motion_by({"motion": None}, "centroid_error") == []


def test_the_card_admits_what_it_does_not_know(trained: TrainedSystem, original: Path) -> None:
    metrics = json.loads((original / "metrics.json").read_text())
    metrics["chamfer"] = metrics["psnr_moving"]["mean"] = metrics["psnr_moving"]["ci95"] = None
    assert beaten_by(metrics, "psnr") == beaten_by(metrics, "psnr_moving") == []
    metrics["references"]["train_mean"]["psnr"]["mean"] = 25.2
    assert beaten_by(metrics, "psnr") == ["the training mean"], "the model has 25.1"
    metrics["psnr"]["other_views"] = metrics["references"]["copy_last"]["psnr"]["other_views"] = 20.0
    table = "\n".join(figure_lines(metrics))
    assert "Chamfer" not in table and "None" not in table
    assert "| PSNR (dB), other cameras | 20.00 |  | 20.00 |" in table


def test_the_card_says_what_it_was_trained_on_from(original: Path) -> None:
    config, metrics = load_model(original).config, json.loads((original / "metrics.json").read_text())
    index = {**json.loads((original / "release.json").read_text()), TRAINED_ON: ["a", "b", "c"]}
    content = CardContent("boxes", index, {**config, "generate": BOXES}, metrics, None, {}, megabytes=1.0)
    begun = {"pretraining": {"ckpt": "released/before"}, "trainer": {"devices": 2, "strategy": "ddp"}}

    assert "splits.train=3" in model_card(content) and "begun from" not in model_card(content)
    training = {"seconds": 60.0, "clock": "cpu"}
    card = model_card(replace(content, config={**content.config, **begun}, training=training))
    assert "- begun from the weights of `released/before`" in card and "splits.train=" not in card
    assert "the weights of `released/before`: the two trainings saw 3 trajectories in all" in card
    assert "1.0 minutes on the processor clock of each of 2 processes" in card


def test_the_card_says_how_to_get_its_figures_again(original: Path) -> None:
    metrics, config = json.loads((original / "metrics.json").read_text()), load_model(original).config
    assert protocol_words(config["protocol"], metrics["protocol"]) == []
    assert "vpd-eval ckpt=released/boxes  " in (original / "README.md").read_text()
    measured = {**metrics["protocol"], "start_frames": [4, 5], "split": "validation"}
    words = protocol_words({**config["protocol"], "start_frames": [0]}, measured)
    assert words == ["protocol.split=validation", "protocol.start_frames=[4,5]"]


def test_figures_of_another_checkpoint_are_refused(trained: TrainedSystem, checkpoint: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(checkpoint.parents[1], run)
    other = run / "checkpoints" / "best.ckpt"
    other.write_bytes(b"other bytes")
    changed = replace(trained, checkpoint=other, step=3, sha256=hashlib.sha256(b"other bytes").hexdigest())
    with pytest.raises(ConfigError, match="figures of another checkpoint"):
        find_metrics(changed, None)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"change": {"renderer": {"near": 1.0}}}, "measured with change="),
        ({"sleeping": True}, "measured with sleeping=True"),
        ({"hide_depth": True}, "measured with hide_depth=True"),
        ({"protocol": {"split": "validation"}}, "about the validation split"),
        ({"protocol": []}, "protocol is not what vpd-eval writes"),
        ({"psnr": 3.0}, "psnr is not what"),
        ({"psnr": {"mean": None}}, "psnr.mean is not what"),
        ({"references": {"copy_last": 1}}, "references.copy_last is not what"),
        ({"chamfer": "x"}, "chamfer is not what"),
    ],
)
def test_figures_of_something_else_are_refused(
    trained: TrainedSystem, tmp_path: Path, changed: dict[str, object], said: str
) -> None:
    metrics = find_metrics(trained, None)
    (tmp_path / "metrics.json").write_text(json.dumps({**metrics, **changed}))
    with pytest.raises(ConfigError, match=said) as caught:
        find_metrics(trained, str(tmp_path / "metrics.json"))
    assert "metrics=FILE" in str(caught.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [(None, "vpd-eval ckpt="), ("{", "cannot be read"), ('{"psnr": NaN}', "NaN is no figure"), ("{}", "lacks")],
)
def test_a_model_without_figures_is_not_released(
    trained: TrainedSystem, tmp_path: Path, content: str | None, said: str
) -> None:
    if content is not None:
        (tmp_path / "metrics.json").write_text(content)
    with pytest.raises(ConfigError, match=said):
        find_metrics(trained, str(tmp_path / "metrics.json"))


def test_what_is_too_large_is_refused(trained: TrainedSystem, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at most 0.01 are allowed"):
        write_release(tmp_path, trained, find_metrics(trained, None), name="boxes", max_megabytes=0.01)


def test_numbers_that_float32_cannot_hold_are_refused() -> None:
    system = nn.Linear(2, 1, dtype=torch.float64)
    nn.init.constant_(system.weight, 0.5)
    nn.init.constant_(system.bias, 0.25)
    assert float32_weights(system)["weight"].dtype == torch.float32
    nn.init.constant_(system.bias, 1 / 3)
    with pytest.raises(CheckpointError, match="bias"):
        float32_weights(system)


def test_results_of_a_release_go_elsewhere(original: Path, in_folder: Path) -> None:
    path = load_model(original).path
    assert beside_checkpoint(path, "evaluation") == in_folder / "runs" / "boxes" / "evaluation"


@pytest.fixture
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("folder", "portable"),
    [
        ("datasets/boxes", "datasets/boxes"),
        ("/data/somebody/boxes", "datasets/boxes"),
        ("../elsewhere/boxes", "datasets/boxes"),
        ("sets/../../boxes", "datasets/boxes"),
        ("sets/..", "datasets/data"),
        ("~/boxes", "datasets/boxes"),
        ("C:\\Users\\somebody\\boxes", "datasets/boxes"),
        ("{here}/sets/boxes", "sets/boxes"),
    ],
)
def test_data_folders_become_relative(in_folder: Path, folder: str, portable: str) -> None:
    assert portable_data_folder(folder.format(here=in_folder)) == portable


def test_paths_outside_of_what_is_built_go(in_folder: Path) -> None:
    config = {
        "run": {"root": "runs", "folder": "/srv/runs/a"},
        "pretraining": {"ckpt": "runs/savi/last.ckpt", "share": 0.4},
        "data": {"folder": "datasets/boxes", "slots": "/srv/runs/a/slots.h5", "views": [0, 1]},
        "trainer": {"max_steps": 3, "default_root_dir": "/srv/runs/a"},
        "model": {"dim": 3},
    }
    assert portable_config(config) == {
        "pretraining": {"ckpt": None, "share": 0.4},
        "data": {"folder": "datasets/boxes", "slots": None, "views": [0, 1]},
        "trainer": {"max_steps": 3},
        "model": {"dim": 3},
    }
    with pytest.raises(ConfigError, match="cannot be built without it"):
        portable_config({"model": {"weights": "/srv/weights.pt"}})


def test_a_system_without_particles_is_released_alike(tmp_path: Path) -> None:
    model = load_model(write_slotformer(tmp_path / "run"))
    trained = trained_system(model)
    metrics = {**figures(model.path, tmp_path), "chamfer": None, "motion": None}
    folder = tmp_path / "slots"
    folder.mkdir()
    write_release(folder, trained, metrics, name="slots", max_megabytes=20)
    assert check_release(folder)["system"] == "slotformer"
    rgb, depth = synthetic_frames(6, 1)
    context = RGBDFrames(rgb, depth, cameras(6, 1))
    after = vpd_lightning.load(folder).predict_frames(context, cameras(2, 1))
    assert torch.equal(after, model.simulator.predict_frames(context, cameras(2, 1)))
    card = (folder / "README.md").read_text()
    assert "vpd-render" not in card and "Chamfer" not in card and "SlotFormer" in card


def test_what_has_no_particles_does_not_sleep(tmp_path: Path) -> None:
    path = write_slotformer(tmp_path / "run")
    with pytest.raises(ConfigError, match="needs particles"):
        load_model(path, sleeping=True)
