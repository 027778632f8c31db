"""Compare 100 updates as a graph with as many plain calls, from the same weights and noise."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import diswm  # noqa: E402


def smooth_batch(cfg, rng):
    """Squares on plain backgrounds, where a model has something to learn."""
    shape = cfg.batch_size, cfg.batch_length
    first = np.zeros(shape, bool)
    first[:, 0] = True
    image = np.empty((*shape, 64, 64, 3), np.uint8)
    image[:] = rng.integers(0, 256, (*shape, 1, 1, 3))
    y, x = rng.integers(0, 40, 2)
    image[:, :, y:y + 24, x:x + 24] = rng.integers(0, 256, 3)
    return dict(image=image, is_first=first, reward=rng.random(shape, np.float32),
                action=rng.uniform(-1, 1, (*shape, 6)).astype(np.float32),
                discount=np.ones(shape, np.float32))

def losses(cfg, graph, updates=100):
    """Metrics of each update, (updates, metrics), and their names."""
    torch.manual_seed(0)
    agent = diswm.Agent(cfg, 6)
    update = agent.update if graph else agent.update.function  # as on a CPU
    rows = []
    for index in range(updates):
        torch.manual_seed(index)
        batch = smooth_batch(cfg, np.random.default_rng(index % 4))
        metrics = update(batch | dict(eta=0.1, index=index))
        rows.append([value.item() for value in metrics.values()])
    return np.array(rows), list(metrics)

def main():
    cfg = diswm.prepare_machine(replace(diswm.PRESETS[sys.argv[1]], precision="auto"))
    (graph, names), (again, _), (plain, _) = (losses(cfg, kind) for kind in (True, True, False))
    print(f"{cfg.device} {cfg.precision}: relative differences, at most, of 100 updates; the "
          "last column is of two graphs, which atomic sums on a GPU may set apart")

    def worst(one, two):
        return (np.abs(one - two) / np.maximum(np.abs(two), 1e-3)).max(0)

    columns = worst(graph[:10], plain[:10]), worst(graph, plain), worst(graph, again)
    print(f"{'':20}{'10 updates':>12}{'100':>12}{'two graphs':>12}")
    for name, *values in zip(names, *columns, strict=True):
        print(f"{name:20}" + "".join(f"{value:12.2e}" for value in values))
    terms = [names.index(name) for name in ("image", "reward", "kl")]
    good = np.isfinite(graph).all() and worst(graph[:10], plain[:10])[terms].max() < 0.02
    print("agree" if good else "DO NOT AGREE")
    sys.exit(not good)

if __name__ == "__main__":
    main()
