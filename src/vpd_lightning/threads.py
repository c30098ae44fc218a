"""Compiled loops on several CPU threads."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Task = TypeVar("Task")
Answer = TypeVar("Answer")


def in_threads(work: Callable[[Task], Answer], tasks: Sequence[Task]) -> list[Answer]:
    """Call ``work`` for each task, on as many threads as PyTorch uses; answers come in the order of the tasks.

    The caller cuts its work into tasks that do not depend on the number of threads, so that results do not either.
    ``work`` must give up Python's lock (``nogil``) for this to be of use.
    """
    num_threads = min(torch.get_num_threads(), len(tasks))
    if num_threads <= 1:
        return [work(task) for task in tasks]
    # One pool per call: a pool that is kept does not survive a fork.
    with ThreadPoolExecutor(num_threads) as pool:
        return list(pool.map(work, tasks))
