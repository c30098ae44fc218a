"""The commands of this package; they read ``GOMP_SPINCOUNT`` and ``OMP_WAIT_POLICY`` as OpenMP does.

PyTorch's threads wait for each other after every operation. GNU OpenMP has the one that waits spin for some ten
milliseconds before it sleeps, and where another process holds a core, the thread that is waited for may not run for as
long. On two cores beside one busy process a training of the demo came to 4 updates in 48 seconds. With 4,000 turns it
came to 40, and to 83 instead of 89 where nothing else ran (docs/notes.md).
"""

import os

SPIN_COUNT = 4000

# Here because it is read once, when PyTorch is imported, and every command imports this package before.
if not {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & os.environ.keys():
    os.environ["GOMP_SPINCOUNT"] = str(SPIN_COUNT)
