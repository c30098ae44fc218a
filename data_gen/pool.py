"""Running jobs in spawned worker processes so that Ctrl-C, SIGTERM or a crash at any moment ends cleanly."""

import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from types import FrameType
from typing import Any

from data_gen import worker
from vpd_lightning.errors import OutOfMemoryError

_JOBS_AHEAD = 2  # per worker: enough to keep all busy, few enough to be dropped at once
_POLL_SECONDS = 0.2
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def run_jobs(
    jobs: Mapping[Path, tuple[Any, ...]],
    initializer_arguments: tuple[Any, ...],
    environment: Mapping[str, str],
    num_workers: int,
    advance: Callable[[], None],
) -> dict[Path, worker.MadeFile]:
    """Run ``worker.make_file(*jobs[path])`` for every path and return what each returned.

    ``environment`` is what workers find before they import anything. ``advance`` is called after each job.

    Raises:
        OutOfMemoryError: a worker was killed from outside or crashed.
    """
    context = get_context("spawn")  # GL contexts and HDF5 do not survive a fork
    stop = context.Event()
    results: dict[Path, worker.MadeFile] = {}
    with deferred_signals() as received, _environment(environment):
        pool = ProcessPoolExecutor(
            num_workers, mp_context=context, initializer=worker.start, initargs=(*initializer_arguments, stop)
        )
        try:
            remaining, running = iter(jobs.items()), dict[Future[worker.MadeFile], Path]()
            while not received:
                with _blocked_signals():  # submitting starts workers, which inherit the mask and lift it themselves
                    while len(running) < _JOBS_AHEAD * num_workers and (job := next(remaining, None)) is not None:
                        running[pool.submit(worker.make_file, *job[1])] = job[0]
                if not running:
                    break
                finished, _ = wait(running, timeout=_POLL_SECONDS, return_when=FIRST_COMPLETED)
                for future in finished:
                    results[running.pop(future)] = future.result()
                    advance()
        except BrokenProcessPool as error:
            raise OutOfMemoryError(
                "A worker process ended early: memory ran out, or its GL library crashed.\n"
                f"Run it again with fewer workers (workers={max(1, num_workers // 2)}); finished files are kept."
            ) from error
        finally:
            stop.set()  # workers leave at the next frame, and no half file stays
            pool.shutdown(wait=True, cancel_futures=True)
    if len(results) < len(jobs):  # a signal whose own handler returned
        raise KeyboardInterrupt
    return results


def num_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def deferred_signals() -> Iterator[list[int]]:
    """Note Ctrl-C and SIGTERM in the list given, and deliver them at the end of the block.

    An exception in the middle of ``concurrent.futures`` would leave its locks taken and hang the process.
    """
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    try:
        wanted = [number for number in _SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
        previous = {number: signal.signal(number, note) for number in wanted}
    except ValueError:  # not the main thread: signals do not come here
        yield received
        return
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])


@contextmanager
def _blocked_signals() -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    previous = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in previous.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
