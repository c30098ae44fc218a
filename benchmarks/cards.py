"""The cards of released models, written again from what lies beside them."""

import json
from pathlib import Path

import yaml

from vpd_lightning.release.model_card import CardContent, model_card

_MEGABYTE = 1_000_000
# What a card says of the machine that trained the model; only the card keeps it.
_MACHINE = ("- device: ", "- versions: ", "- source: ")


def card(folder: Path) -> str:
    """Return the card of a released model; what it says of the machine is taken from the card that is there."""
    index, metrics = (json.loads((folder / name).read_text()) for name in ("release.json", "metrics.json"))
    config = yaml.safe_load((folder / "config.yaml").read_text())
    megabytes = (folder / "model.safetensors").stat().st_size / _MEGABYTE
    text = model_card(CardContent(index["name"], index, config, metrics, metrics.get("training"), {}, megabytes))
    machine = [line for line in (folder / "README.md").read_text().splitlines() if line.startswith(_MACHINE)]
    before, end, after = text.partition("\n\n`config.yaml` holds every setting.")
    return "\n".join([before, *machine]) + end + after
