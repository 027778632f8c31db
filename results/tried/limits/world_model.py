"""world_model.py RUN UPDATES NAME [FIELD=VALUE ...] [clean] [glorot] [seed=K]: a new world model,
without an agent, learns from the replay of RUN but its last five episodes, and is scored on those
by limits.py: [R², correlation, mean prediction, mean truth]. clean: the same episodes, played anew
without distractors, which leaves states and rewards as they were. Prints JSON every 300 updates;
image, reward and kl of training, mean of the last 100 updates, have "train" before them.
"""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from limits import average, compare, diswm, played_again

run, updates, name = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
given = dict(word.split("=") for word in sys.argv[4:] if "=" in word)
seed = int(given.pop("seed", 0))
cfg = diswm.read_checkpoint(run / "checkpoint.pt")["config"]
changes = {field: type(getattr(cfg, field))(value) for field, value in given.items()}
cfg = diswm.prepare_machine(replace(cfg, precision="auto", threads=1, **changes))
episodes = [np.load(path) for path in sorted((run / "episodes").glob("*.npy"))]
if "clean" in sys.argv[4:]:
    with diswm.config_env(cfg, cfg.dst) as env:
        for index, rows in enumerate(episodes):
            rows["image"] = [row["image"] for row in played_again(env, cfg, index, rows)]
torch.manual_seed(seed)
model = diswm.WorldModel(cfg, *episodes[0].dtype["action"].shape)
if "glorot" in sys.argv[4:]:
    for module in model.modules():
        if isinstance(module, (torch.nn.Linear, torch.nn.Conv2d, torch.nn.ConvTranspose2d)):
            torch.nn.init.xavier_uniform_(module.weight)
            torch.nn.init.zeros_(module.bias)
optimizer, metrics = diswm.adam(model, cfg.model_lr), []
with tempfile.TemporaryDirectory() as folder:
    for index, rows in enumerate(episodes[:-5]):
        np.save(Path(folder) / f"{index:06d}.npy", rows)
    replay = diswm.Replay(folder, episodes[0].dtype)
    for index in range(updates):
        torch.manual_seed(index)
        batch = replay.sample(cfg.batch_size, cfg.batch_length, [7, index])
        batch = diswm.to_device(batch, "cpu")
        with model.autocast:
            loss, terms = model.loss(model(batch), batch)
        diswm.descend(loss, optimizer, cfg.grad_clip)
        metrics.append({key: terms[key].detach() for key in ("image", "reward", "kl")})
        if (index + 1) % 300 == 0:
            torch.manual_seed(0)
            train = diswm.mean_metrics(metrics[-100:])
            row = {f"train {key}": round(value, 3) for key, value in train.items()}
            row |= dict(name=name, update=index + 1, episodes=len(episodes))
            scores = average([compare(model, rows) for rows in episodes[-5:]])
            print(json.dumps(row | scores), flush=True)
