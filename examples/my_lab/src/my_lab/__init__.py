"""Our components for vpd-lightning."""

from pathlib import Path

config_folder = Path(__file__).parent / "conf"
