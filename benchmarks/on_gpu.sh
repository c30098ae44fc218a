#!/bin/bash
# For a GPU machine that is lent for a quarter of an hour: what is wanted most comes first, and each part leaves what it has.
#
#   benchmarks/on_gpu.sh OUT PACK [MINUTES]    # PACK: python -m benchmarks.rented_gpu pack, MINUTES: of training (6)
#
# Needs torch, triton, pytest and what the package imports. Two to three trainings beside each other are as fast as one.
set -u
out=$1 pack=$2 minutes=${3:-6}
export PYTHONPATH=$PWD:$PWD/src${PYTHONPATH:+:$PYTHONPATH} OMP_NUM_THREADS=2 PYTHONUNBUFFERED=1
mkdir -p "$out"

# What an update spends its time on: the next thing to make faster.
timeout 60 python3 -m benchmarks.rented_gpu train --pack "$pack" --out "$out/profiled" --profile 5 > "$out/profile.txt" 2>&1
tail -n 1 "$out/profile.txt"

# SIGINT: pytest then prints why tests failed that had run.
timeout -s INT 80 python3 -m pytest -q -p no:cacheprovider -m gpu tests/graph tests/renderer tests/dynamics > "$out/tests.txt" 2>&1
grep -E "passed|failed|^E  |^FAILED" "$out/tests.txt" | cut -c1-160 | tail -n 25

timeout 200 python3 -m benchmarks.gpu --out "$out/results" --only train_step frames dynamics > "$out/benchmarks.txt" 2>&1
tail -n 25 "$out/benchmarks.txt" | cut -c1-160

for seed in 0 1 2; do
    timeout "$((60 * minutes + 40))" python3 -m benchmarks.rented_gpu train --pack "$pack" --out "$out/seed_$seed" \
        --seed "$seed" --clips 8 --minutes "$minutes" --minutes-in-all "$minutes" > "$out/seed_$seed.txt" 2>&1 &
done
wait
tail -n 6 "$out"/seed_*.txt
