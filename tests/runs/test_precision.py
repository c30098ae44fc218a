"""What ``trainer.precision=auto`` chooses, records and keeps."""

from pathlib import Path

import pytest
import torch
import yaml

from vpd_lightning.errors import CheckpointError
from vpd_lightning.runs.precision import bfloat16_instructions, chosen_precision

CPU = {"accelerator": "cpu", "precision": "auto"}


def with_capabilities(monkeypatch: pytest.MonkeyPatch, **capabilities: bool) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_f": True, **capabilities}, raising=False)


@pytest.mark.parametrize("name", ["avx512_bf16", "amx_bf16", "bf16"])
def test_bfloat16_where_the_processor_multiplies_it(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with_capabilities(monkeypatch, **{name: True})

    precision, reason = chosen_precision(CPU, None)

    assert precision == "bf16-mixed" and name in reason


def test_float32_where_it_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    with_capabilities(monkeypatch, avx512_bf16=False)

    assert chosen_precision(CPU, None)[0] == "32-true"
    assert chosen_precision({"accelerator": "mps"}, None)[0] == "32-true"
    monkeypatch.delattr(torch.cpu, "get_capabilities")  # an older PyTorch
    assert bfloat16_instructions() == ""


@pytest.mark.parametrize(("is_native", "precision"), [(True, "bf16-mixed"), (False, "32-true")])
def test_a_gpu_is_asked_for_products_of_its_own(
    is_native: bool, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: is_native)

    assert chosen_precision({"accelerator": "auto"}, None)[0] == precision


def test_a_run_that_goes_on_keeps_its_precision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_capabilities(monkeypatch, avx512_bf16=True)
    recorded = tmp_path / "config.yaml"
    recorded.write_text(yaml.safe_dump({"trainer": {"precision": "32-true"}}))

    assert chosen_precision(CPU, recorded)[0] == "32-true"
    recorded.write_text("trainer: [")
    with pytest.raises(CheckpointError, match=r"trainer.precision=32-true"):
        chosen_precision(CPU, recorded)
