"""Checkpoints that were damaged, cut short, or made to run something."""

import json
import pickle
import random
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
import yaml

import vpd_lightning
from tests.reliability.gadgets import gadgets
from tests.reliability.outcome import Outcome
from tests.reliability.trainings import is_equal, make_data, run, words
from vpd_lightning.commands import export
from vpd_lightning.errors import CheckpointError
from vpd_lightning.release.release_folder import CONFIG_FILE, INDEX_FILE, sha256
from vpd_lightning.training.checkpoint_files import load_checkpoint, write_checkpoint


def is_refused(path: Path) -> bool:
    """Whether loading gives the error meant for it; any other error is let through."""
    try:
        vpd_lightning.load(path)
    except CheckpointError:
        return True
    return False


def checkpoints(work: Path, *, num_flips: int = 100) -> list[Outcome]:
    """Harm a real checkpoint and a release made of it."""
    folder = work / "short"
    run(words(make_data(work / "data"), folder, 6, "evaluate=true"))
    good = (folder / "checkpoints" / "last.ckpt").read_bytes()
    path = work / "harmed.ckpt"
    path.write_bytes(good)
    vpd_lightning.load(path)  # unharmed it loads
    return [
        _flips(good, path, num_flips),
        _cuts(good, path),
        _gadgets(work),
        _configurations(folder, work),
    ]


def _flips(good: bytes, path: Path, count: int) -> Outcome:
    """Between the records of a checkpoint, and in their headers, there are bytes that nothing depends on."""
    draw, held, refused = random.Random(0), 0, 0
    path.write_bytes(good)
    whole = load_checkpoint(path)
    for _ in range(count):
        place = draw.randrange(len(good))
        path.write_bytes(good[:place] + bytes([good[place] ^ draw.randint(1, 255)]) + good[place + 1 :])
        if is_refused(path):
            refused += 1
        else:
            held += is_equal(whole, load_checkpoint(path))
    return Outcome(
        "checkpoints with one random byte changed were refused, or read bit for bit as before",
        count,
        held + refused,
        f"{refused} refused; {len(good):,} bytes",
    )


def _cuts(good: bytes, path: Path) -> Outcome:
    """Every length of a small checkpoint, and every thousandth of a real one and its last hundred."""
    small = path.with_name("small.ckpt")
    write_checkpoint({"state_dict": {"weight": torch.ones(3)}}, small)
    load_checkpoint(small)
    content = small.read_bytes()
    tried = held = 0
    lengths = sorted({*range(0, len(good), max(len(good) // 1000, 1)), *range(len(good) - 100, len(good))})
    for whole, target, sizes in ((content, small, range(len(content))), (good, path, lengths)):
        for size in sizes:
            target.write_bytes(whole[:size])
            tried += 1
            held += is_refused(target)
    return Outcome(
        "checkpoints that were cut short were refused", tried, held, "every length of a small one among them"
    )


def _gadgets(work: Path) -> Outcome:
    """Each gadget in three kinds of file; each must run when unpickled plainly, and not run when we load it."""
    place = Path(tempfile.mkdtemp(dir=work))
    trace, script = place / "trace", place / "files" / "script.py"
    script.parent.mkdir()
    writers: dict[str, Callable[[Any, Path], None]] = {
        "of vpd-train": lambda bad, path: write_checkpoint({"state_dict": {}, "extra": bad}, path),
        "of torch.save": lambda bad, path: torch.save({"state_dict": {}, "extra": bad}, path),
        "of pickle": lambda bad, path: path.write_bytes(pickle.dumps({"state_dict": {}, "extra": bad})) and None,
    }
    tried = held = 0
    found = gadgets(trace, script)
    for name, bad in found.items():
        pickle.loads(pickle.dumps(bad))
        if not trace.exists():
            raise RuntimeError(f"the gadget {name} does nothing, and so would show nothing")
        for write in writers.values():
            shutil.rmtree(trace, ignore_errors=True)
            path = place / "bad.ckpt"
            write(bad, path)
            tried += 1
            held += is_refused(path) and not trace.exists()
        shutil.rmtree(trace, ignore_errors=True)
    return Outcome("checkpoints that run something when unpickled ran nothing", tried, held, f"{len(found)} gadgets")


def _configurations(folder: Path, work: Path) -> Outcome:
    """What a checkpoint or a release says of the classes to build is not believed."""
    trace = work / "trace"
    harms = list(_harmful_configurations(trace))
    released = work / "released"
    if export.main([f"ckpt={folder}", f"out={released}"]) != 0:
        raise RuntimeError("the training could not be exported")
    tried = held = 0
    for harm in harms:
        content = load_checkpoint(folder / "checkpoints" / "last.ckpt")
        harm(content["hyper_parameters"])
        path = work / "configured.ckpt"
        write_checkpoint(content, path)
        copy = work / "released_harmed"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(released, copy)
        config = yaml.safe_load((copy / CONFIG_FILE).read_text())
        harm(config)
        (copy / CONFIG_FILE).write_text(yaml.safe_dump(config))
        index = json.loads((copy / INDEX_FILE).read_text())
        index["sha256"][CONFIG_FILE] = sha256((copy / CONFIG_FILE).read_bytes())  # a forger knows how
        (copy / INDEX_FILE).write_text(json.dumps(index))
        for harmed in (path, copy):
            tried += 1
            held += is_refused(harmed) and not trace.exists()
    return Outcome("checkpoints and releases that name other classes to build were refused", tried, held)


def _harmful_configurations(trace: Path) -> Iterator[Callable[[dict[str, Any]], None]]:
    call = {"_target_": "os.mkdir", "path": str(trace)}
    for section in ("encoder", "dynamics", "renderer"):
        yield lambda config, section=section: config.__setitem__(section, dict(call))
        yield lambda config, section=section: config[section].__setitem__("extra", dict(call))
    yield lambda config: config["renderer"].__setitem__("_target_", "subprocess.call")
    yield lambda config: config["renderer"].__setitem__("_target_", "vpd_lightning.commands.train.main")
    yield lambda config: config["renderer"].__setitem__("near", "${oc.env:HOME}")
    yield lambda config: config.__setitem__("scene", "${oc.create:{}}")
