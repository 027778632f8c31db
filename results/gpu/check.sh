#!/usr/bin/env bash
# What only a GPU can show, in one call of under ten minutes; run it in the repository's root. Writes to $OUT, by default results/gpu:
#   graph.txt            (a) losses of the update as a graph and as plain calls, 100 updates from the same weights and noise
#   <card>-<preset>.json (b) results/bench.py of `paper` and `small`
#   walker_walk.jsonl    (c) `paper`, dreamerv2, without distractors: training returns of 240 at 50k and 470 at 95k are the yardstick
# On the lent machine: first, here, bash ../shared/gpu/prepare.sh tqdm imageio tensorboard absl-py markdown werkzeug markupsafe protobuf grpcio pillow
# and with carry=[".gpu"] there: . .gpu/setup.sh; bash results/gpu/check.sh
# Trial on a CPU: PRESET=debug STEPS=300 PYTHON=.venv/bin/python OUT=/tmp/check bash results/gpu/check.sh
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.." || exit 1
export MUJOCO_GL=${MUJOCO_GL:-egl} OUT=${OUT:-results/gpu}
python=${PYTHON:-python3} preset=${PRESET:-} begin=$SECONDS code=0
mkdir -p "$OUT"
rm -f "$OUT/walker_walk.jsonl"
card=$($python -c 'import torch
name = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"
print(name.replace(" ", "_"))')

echo "(a) graph and plain calls"
timeout 120 $python results/gpu/compare.py "${preset:-paper}" 2>&1 | tee "$OUT/graph.txt" || code=1

echo "(b) bench"
for size in ${preset:-paper small}; do
    timeout 75 $python results/bench.py --preset "$size" --tasks walker_walk --json >"$OUT/$card-$size.json" && cat "$OUT/$card-$size.json" || code=1
done

echo "(c) yardstick, in what is left of 570 seconds"
runs=$(mktemp -d)
timeout --signal=INT $((570 - SECONDS + begin)) $python diswm.py finetune --preset "${preset:-paper}" --method dreamerv2 --dst walker_walk \
    --colors original --color-range 0 --switch 1 --steps "${STEPS:-100000}" --eval-every 20000 --eval-episodes 5 --runs "$runs"
cp "$runs"/finetune/*/dreamerv2/seed0/metrics.jsonl "$OUT/walker_walk.jsonl"
rm -r "$runs"
tail -n 1 "$OUT/walker_walk.jsonl" || code=1
echo "took $((SECONDS - begin)) s on $card"
exit $code
