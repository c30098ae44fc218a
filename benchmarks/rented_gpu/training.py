"""The training loop on torch alone: the project's stages, losses, clips and optimiser, without Hydra and Lightning."""

import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from importlib import import_module
from multiprocessing import Value
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from benchmarks.rented_gpu.packing import PackedMovingRays, PackedTrajectory
from benchmarks.rented_gpu.progress import Progress, adam_second_moments, restore_adam, write_progress
from vpd_lightning.data.collate import collate_clips
from vpd_lightning.data.dataset import ClipDataset
from vpd_lightning.data.sampler import StepBatchSampler
from vpd_lightning.errors import NonFiniteError
from vpd_lightning.randomness import derive_seed
from vpd_lightning.training.averaging import share_kept
from vpd_lightning.types import VideoBatch

_WITHOUT_END = 1_000_000  # updates, more than time allows
STAGES = ("encoder", "dynamics", "renderer")
CLIPS = (
    "seed", "batch_size", "num_steps", "num_steps_schedule", "rays_per_step", "input_views", "target_views",
    "start_frames", "load_future", "load_driven",
)  # fmt: skip


def build(section: Any, **more: Any) -> Any:
    """Build what a resolved section describes by ``_target_``, sections inside of it first."""
    if isinstance(section, list):
        return [build(item) for item in section]
    if not isinstance(section, Mapping):
        return section
    values = {key: build(item) for key, item in section.items() if key != "_target_"}
    if "_target_" not in section:
        return values
    module, _, kind = str(section["_target_"]).rpartition(".")
    return getattr(import_module(module), kind)(**values, **more)


def build_system(config: Mapping[str, Any]) -> nn.Module:
    """Build the system with the same initial weights as ``vpd-train`` gives it."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(config["seed"], "weights"))
        return build(config["model"], **{name: build(config[name]) for name in STAGES})


class Training:
    """Takes a training through its phases until a deadline.

    Args:
        phases: plain settings of each training, its number of ``updates`` and its ``share`` of the time.
        trajectories: what clips are drawn from.
        device: of the networks.
        num_workers: processes that draw the clips.
        progress: where to go on.
        seconds_in_all: what all phases together may take, earlier calls counted in; then lengths of clips and learning
            rates follow the time, as with the time budget of ``vpd-train``. None counts updates.
        precision: of matrix products instead of the one in the settings: bf16, tf32 or float32.
    """

    def __init__(
        self,
        phases: Sequence[Mapping[str, Any]],
        trajectories: Sequence[PackedTrajectory],
        device: torch.device,
        num_workers: int,
        progress: Progress,
        seconds_in_all: float | None = None,
        precision: str | None = None,
    ) -> None:
        self.phases, self.trajectories, self.device = phases, trajectories, device
        self.num_workers, self.progress = num_workers, progress
        self.seconds_in_all, self.precision = seconds_in_all, precision
        self.num_taken = 0  # updates of this object
        self._share = Value("d", 0.0, lock=False)  # of the phase's time; also seen by the processes that draw clips
        self._begin()

    @property
    def is_done(self) -> bool:
        """Whether all updates of all phases are taken."""
        return self.progress.phase == len(self.phases)

    def run(self, deadline: float, out: Path, seconds_per_save: float) -> None:
        """Train until ``time.perf_counter()`` reaches the deadline, and leave the state in ``out``."""
        saved = time.perf_counter()
        while not self.is_done and time.perf_counter() < deadline:
            began = time.perf_counter()
            for batch in self._batches():
                self._update(batch)
                now = time.perf_counter()
                self._count(now - began)  # the wait for clips is in it
                began = now
                if now - saved > seconds_per_save:
                    self.save(out)
                    saved = now
                if now >= deadline or self._phase_is_done:
                    break
            if self._phase_is_done:
                self._next_phase()
        self.save(out)

    @property
    def _phase_is_done(self) -> bool:
        if self.seconds_in_all is None:
            return bool(self.progress.step == self.phases[self.progress.phase]["updates"])
        return self._share.value >= 1.0

    def _count(self, seconds: float) -> None:
        progress = self.progress
        progress.seconds += seconds
        progress.phase_seconds += seconds
        self._share.value = self._share_done()
        if progress.step % 10 == 0 or progress.step == 1:
            where = {"phase": progress.phase, "step": progress.step, "seconds": round(progress.seconds, 2)}
            progress.curve.append(where | self._last)

    def _share_done(self) -> float:
        """Return how much of the phase is done: of its time where that is limited, else of its updates."""
        config = self.phases[self.progress.phase]
        if self.seconds_in_all is None:
            return float(self.progress.step / config["updates"])
        return float(min(1.0, self.progress.phase_seconds / (config["share"] * self.seconds_in_all)))

    def profiled(self, warm_up: int, updates: int = 3) -> str:
        """Take ``warm_up`` updates, and return a table of the operations of the next ones, the longest first."""
        batches = iter(self._batches())
        for _ in range(warm_up):
            self._update(next(batches))
        with torch.profiler.profile() as record:
            for _ in range(updates):
                self._update(next(batches))
        on_device = self.device.type == "cuda"
        totals = record.key_averages()
        calls = sum(item.count for item in totals if item.key in ("cudaLaunchKernel", "cuLaunchKernelEx"))
        waits = sum(item.count for item in totals if "Synchronize" in item.key or item.key == "aten::item")
        order = "self_cuda_time_total" if on_device else "self_cpu_time_total"
        rows = totals.table(sort_by=order, row_limit=25, max_name_column_width=60)
        return f"{rows}\n{calls / updates:.0f} kernels and {waits / updates:.0f} waits an update"

    def save(self, out: Path) -> None:
        """Write the state."""
        names = {weight: name for name, weight in self.system.named_parameters()}
        self.progress.weights = {name: value.detach() for name, value in self.system.state_dict().items()}
        self.progress.second_moments = adam_second_moments(self.optimizer, names)
        self.progress.average = dict(self._average)
        write_progress(out, self.progress)

    def _begin(self) -> None:
        """Build the system of the current phase with the weights there are, as far as it has a place for them."""
        config = self.phases[min(self.progress.phase, len(self.phases) - 1)]
        self.system = build_system(config).to(self.device).train()
        own = self.system.state_dict()
        known = {name: value for name, value in self.progress.weights.items() if name in own}
        self.system.load_state_dict(known, strict=False)
        self.losses = [build(section) for section in config["loss"].values() if section is not None]
        self.optimization = build(config["optimizer"])
        self.optimization.freeze(self.system)
        self.optimizer, _ = self.optimization.build(self.system, config["updates"])
        self._rates = [group["initial_lr"] for group in self.optimizer.param_groups]
        named = dict(self.system.named_parameters())
        moments = {name: value for name, value in self.progress.second_moments.items() if name in named}
        restore_adam(self.optimizer, named, moments, self.progress.step)
        self.clip = config["trainer"].get("gradient_clip_val")
        precision = config["trainer"].get("precision")
        if self.precision is not None:
            precision = {"bf16": "bf16-mixed"}.get(self.precision, self.precision)
        self.is_bf16 = precision == "bf16-mixed" or (precision == "auto" and self.device.type == "cuda")
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = precision == "tf32"
        self._averaging = config.get("averaging")
        trained = {name: weight for name, weight in named.items() if weight.requires_grad and self._averaging}
        self._average = {
            name: self.progress.average.get(name, weight.detach()).to(weight, copy=True)
            for name, weight in trained.items()
        }
        self._averaged = list(trained.values())
        self._last: dict[str, float] = {}
        self._share.value = self._share_done()

    def _next_phase(self) -> None:
        """Go on with the average of the weights, which is what the end of a training of ``vpd-train`` hands over."""
        self.system.load_state_dict(self._average, strict=False)
        self.progress.weights = {name: value.detach() for name, value in self.system.state_dict().items()}
        self.progress.second_moments, self.progress.average = {}, {}
        self.progress.phase, self.progress.step, self.progress.phase_seconds = self.progress.phase + 1, 0, 0.0
        self._average = {}
        if not self.is_done:
            self._begin()

    def _batches(self) -> DataLoader[VideoBatch]:
        config = self.phases[self.progress.phase]
        updates = config["updates"] if self.seconds_in_all is None else _WITHOUT_END
        fraction = config["data"].get("moving_ray_fraction", 0.0)
        clips = ClipDataset(
            trajectories=self.trajectories,
            max_steps=updates,
            moving_rays=PackedMovingRays(fraction) if fraction else None,
            training_progress=None if self.seconds_in_all is None else lambda: self._share.value,
            num_steps_schedule=_schedule(config["data"]["num_steps_schedule"]),
            # Packs of before actions do not say load_driven.
            **{name: config["data"][name] for name in CLIPS if name in config["data"] and name != "num_steps_schedule"},
        )
        sampler = StepBatchSampler(
            batch_size=clips.batch_size,
            max_steps=updates,
            rank=0,
            world_size=1,
            first_step=lambda: self.progress.step,
        )
        return DataLoader(
            clips,
            batch_sampler=sampler,
            collate_fn=collate_clips,
            num_workers=self.num_workers,
            pin_memory=self.device.type == "cuda",
        )

    def _backward(self, batch: VideoBatch) -> Tensor:
        """Compute the gradients of a batch; return its loss."""
        with torch.autocast(self.device.type, torch.bfloat16) if self.is_bf16 else nullcontext():
            output = self.system(batch)
            loss = torch.stack([part.weight * part(output, batch) for part in self.losses]).sum()
        loss.backward()
        return loss.detach()

    def _update(self, batch: VideoBatch) -> None:
        progress = self.progress
        batch = batch.to(self.device)
        factor = self.optimization.lr_factor(progress.step, self._expected_updates())
        for group, rate in zip(self.optimizer.param_groups, self._rates, strict=True):
            group["lr"] = rate * factor
        self.optimizer.zero_grad(set_to_none=True)
        loss = self._backward(batch)
        weights = [weight for weight in self.system.parameters() if weight.grad is not None]
        norm = nn.utils.clip_grad_norm_(weights, self.clip or float("inf"))
        values = torch.stack([loss.float(), norm.float()]).tolist()
        if not all(value < float("inf") for value in values):  # NaN, too
            place = f"phase {progress.phase}, update {progress.step}"
            raise NonFiniteError(f"Loss {values[0]}, gradient {values[1]} in {place}.\nGo on from the last state.")
        self.optimizer.step()
        progress.step += 1
        self.num_taken += 1
        if self._average:
            kept = share_kept(progress.step, **self._averaging)
            torch._foreach_lerp_(list(self._average.values()), [w.detach() for w in self._averaged], 1.0 - kept)
        self._last = {
            "num_steps": batch.rgbs.shape[1],
            "loss": values[0],
            "gradient_norm": values[1],
            "lr": self._rates[0] * factor,
        }

    def _expected_updates(self) -> int:
        """Return how many updates the phase will have at the pace so far."""
        if self.seconds_in_all is None:
            return int(self.phases[self.progress.phase]["updates"])
        return round(self.progress.step / max(self._share.value, 1e-6)) + 1


def _schedule(schedule: Mapping[str, Any] | None) -> dict[float, Any] | None:
    """Give the schedule of rollout lengths its numbers back, which are words in JSON."""
    return schedule and {float(start): steps for start, steps in schedule.items()}
