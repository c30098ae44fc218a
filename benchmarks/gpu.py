"""Everything that a GPU should show, in one go: ``python -m benchmarks.gpu [--out FOLDER]``; under 10 minutes.

Needs torch, triton and what the core imports: no Hydra, no Lightning. Each part runs in a process of its own with a
budget of seconds, writes ``gpu_<part>_<device>.json``, and is skipped where that file is there already: start it again
after an interruption. A part that fails, or whose time is up, leaves its rows so far in
``gpu_<part>_partial_<device>.json`` and its traceback in ``gpu_<part>_<device>.failed.txt``; the exit code is 1 then.
``--device cpu --rehearse`` runs everything at tiny sizes on a CPU, Triton's kernels in its interpreter. Where PyYAML is
missing, ``--stages FILE`` takes what ``python -m benchmarks.stages FILE`` wrote elsewhere.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

# Part -> budget in seconds; a command that installs nothing and prints its table within ten minutes.
PARTS = {
    "knn": 70,
    "features": 50,
    "train_step": 130,
    "dynamics": 90,
    "frames": 60,
    "memory": 60,
    "scaling": 100,
}


PARTIAL = "_partial"  # in the name of a result that is not complete


def main(arguments: list[str] | None = None) -> int:
    """Run all parts that have no result yet, then print their tables; 1 if one failed."""
    options = _options(arguments)
    if options.part:
        return _run_part(options)
    start, failed = time.perf_counter(), []
    patience = 5 if options.device == "cpu" else 1  # interpreted kernels
    options.out.mkdir(parents=True, exist_ok=True)
    for part in options.only or PARTS:
        path = options.out / f"gpu_{part}_{options.device}.json"
        if path.exists():
            print(f"{part}: already there", flush=True)
            continue
        began = time.perf_counter()
        reason = _in_own_process(part, patience * PARTS[part], options)
        taken = time.perf_counter() - began
        print(f"{part}: {'done' if reason is None else reason} ({taken:.0f} s)", flush=True)
        if reason is not None:
            failed.append(part)
    failed += _print_tables(options)
    print(f"{time.perf_counter() - start:.0f} s in all; failed: {', '.join(failed) or 'none'}")
    return int(bool(failed))


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--rehearse", action="store_true", help="tiny sizes")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--stages", type=Path, help="JSON of the stages' settings, where PyYAML is missing")
    parser.add_argument("--only", nargs="+", choices=sorted(PARTS), help="these parts only")
    parser.add_argument("--part", choices=sorted(PARTS), help="run this part here, in this process")
    options = parser.parse_args(arguments)
    if options.device == "cpu" and not options.rehearse:
        parser.error("a CPU can only rehearse: add --rehearse (vpd-bench measures CPUs)")
    return options


def _in_own_process(part: str, budget: float, options: argparse.Namespace) -> str | None:
    """Run a part; return what went wrong. A fault on the device then spoils nothing that comes after it."""
    command = [sys.executable, "-m", "benchmarks.gpu", "--part", part, "--device", options.device]
    command += ["--out", str(options.out), "--repeats", str(options.repeats)]
    command += ["--rehearse"] * options.rehearse
    command += ["--stages", str(options.stages)] if options.stages else []
    root = Path(__file__).resolve().parents[1]
    source = [str(root), str(root / "src")] if (root / "src" / "vpd_lightning").is_dir() else [str(root)]
    path = os.pathsep.join([*filter(None, [os.environ.get("PYTHONPATH")]), *source])
    environment = {**os.environ, "PYTHONPATH": path}
    if options.device == "cpu":
        environment |= {"TRITON_INTERPRET": "1", "OMP_NUM_THREADS": "1"}
    report = options.out / f"gpu_{part}_{options.device}.failed.txt"
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=budget)
    except subprocess.TimeoutExpired as error:
        said = "".join(s if isinstance(s, str) else s.decode() for s in (error.stdout, error.stderr) if s)
        report.write_text(f"not done within {budget} s\n{said}")
        return f"not done within {budget} s, see {report}"
    if done.returncode:
        report.write_text(done.stdout + done.stderr)
        return f"{(done.stderr.strip().splitlines() or ['no message'])[-1][:160]}, see {report}"
    report.unlink(missing_ok=True)
    return None


def _run_part(options: argparse.Namespace) -> int:
    """Measure one part and write its result."""
    import torch

    from benchmarks import gpu_parts, stages
    from benchmarks.measuring import Options
    from benchmarks.results_files import write

    if options.stages:
        stages.use_prepared(options.stages)
    torch.backends.cuda.matmul.allow_tf32 = False  # float32 means float32; bf16 is measured as bf16
    device = torch.device(options.device)
    size = "tiny" if options.rehearse else "full"
    how = Options(device, size, 1 if options.rehearse else options.repeats)
    for result in getattr(gpu_parts, options.part)(how):
        write(f"gpu_{options.part}{PARTIAL}", device, result, options.out)
    for suffix in (".csv", ".json"):
        partial = options.out / f"gpu_{options.part}{PARTIAL}_{device.type}{suffix}"
        partial.replace(options.out / f"gpu_{options.part}_{device.type}{suffix}")
    return 0


def _print_tables(options: argparse.Namespace) -> list[str]:
    """Print what is there; return the parts within which something failed (its traceback is among the facts)."""
    from benchmarks.results_files import read, shown, table

    failed = []
    for part in options.only or PARTS:
        names = (f"gpu_{part}_{options.device}.json", f"gpu_{part}{PARTIAL}_{options.device}.json")
        paths = [options.out / name for name in names if (options.out / name).exists()]
        if paths:
            content = read(paths[0])
            failed += [f"{part}: {name}" for name in content["facts"] if name.endswith(" failed")]
            part_of = ", as far as it got" if PARTIAL in paths[0].name else ""
            print(f"\n{part}{part_of}: {content['device']}\n{table(content['rows'])}")
            for name, value in content["facts"].items():
                print(f"{name}: {shown(value)}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
