#!/bin/bash
# For a GPU machine that is lent for a quarter of an hour: what is wanted most comes first, and each part leaves what it has.
#
#   benchmarks/on_gpu.sh OUT PACK [MINUTES]    # PACK: python -m benchmarks.rented_gpu pack, MINUTES: of training (6)
#
# Needs torch, triton, pytest and what the package imports. Two or three trainings beside each other are as fast as one.
# OUT gets at most eight files, which is all that may return: logs and results in one, state and curve of each training.
set -u
out=$1 pack=$2 minutes=${3:-6}
export PYTHONPATH=$PWD:$PWD/src${PYTHONPATH:+:$PYTHONPATH} OMP_NUM_THREADS=2 PYTHONUNBUFFERED=1
mkdir -p "$out"
logs=$(mktemp -d)
keep() { tar czf "$out/logs.tgz" -C "$logs" .; }

# What an update spends its time on: the next thing to make faster.
timeout 60 python3 -m benchmarks.rented_gpu train --pack "$pack" --out "$logs" --profile 5 > "$logs/profile.txt" 2>&1
tail -n 1 "$logs/profile.txt"

# SIGINT: pytest then prints why tests failed that had run.
timeout -s INT 80 python3 -m pytest -q -p no:cacheprovider -m gpu tests/graph tests/renderer tests/dynamics > "$logs/tests.txt" 2>&1
grep -E "passed|failed|^E  |^FAILED" "$logs/tests.txt" | cut -c1-160 | tail -n 25

timeout 200 python3 -m benchmarks.gpu --out "$logs/results" --only train_step frames dynamics > "$logs/benchmarks.txt" 2>&1
tail -n 25 "$logs/benchmarks.txt" | cut -c1-160
keep

for seed in 0 1 2; do
    timeout "$((60 * minutes + 40))" python3 -m benchmarks.rented_gpu train --pack "$pack" --out "$out/seed_$seed" \
        --seed "$seed" --clips 8 --minutes "$minutes" --minutes-in-all "$minutes" > "$logs/seed_$seed.txt" 2>&1 &
done
wait
tail -n 6 "$logs"/seed_*.txt
keep
