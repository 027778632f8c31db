"""more_updates.py RUN UPDATES [PART=RATE …]: go on updating a finished run without new data, with
other learning rates of model, actor or critic (0: as it is). Prints, every 500 updates, the returns
of 10 episodes, by mode and by samples, and the metrics."""

import json
import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))
import diswm  # noqa: E402

run, count, rows = Path(sys.argv[1]), int(sys.argv[2]), []
rates = dict(word.split("=") for word in sys.argv[3:])
cfg, agent, saved = diswm.open_run(run / "checkpoint.pt", precision="auto", threads=1)
for name, optimizer in agent.optimizers.items():
    optimizer.load_state_dict(saved[name])
    optimizer.param_groups[0]["lr"] = float(rates.get(name, optimizer.param_groups[0]["lr"]))
replay = diswm.Replay(run / "episodes", diswm.agent_row(agent.action_dim))
env, first = diswm.config_env(cfg, cfg.dst), saved["done"]["updates"]
for index in range(first, first + count + 1):
    if (index - first) % 500 == 0:
        mode, sampled = (diswm.evaluate_agent(cfg, env, agent, "train", explore)[0]
                         for explore in (False, True))
        row = dict(extra=index - first, ret=mode["return"], std=mode["std"],
                   sampled=sampled["return"]) | (diswm.mean_metrics(rows) if rows else {})
        print(json.dumps(row), flush=True)
        rows = []
    torch.manual_seed(index)
    rows.append(agent.update(replay.batch(cfg, index) | dict(index=index, eta=0.0)))
