"""Where the configuration lies: inside the installed package, or at the root of a checkout."""

from pathlib import Path

from vpd_lightning.errors import ConfigError


def config_folder() -> Path:
    """Return the folder of the configuration: ``conf/`` inside the wheel, else ``conf/`` at the root of the checkout.

    Raises:
        ConfigError: neither is there.
    """
    package = Path(__file__).resolve().parents[1]
    candidates = [package / "conf", package.parents[1] / "conf"]
    for folder in candidates:
        if (folder / "train.yaml").is_file():
            return folder
    looked = " and ".join(str(folder) for folder in candidates)
    raise ConfigError(
        f"the configuration folder is missing.\nLooked in {looked}.\n"
        "Install the package again: pip install --force-reinstall vpd-lightning (or pip install -e . in a checkout)."
    )
