"""chaos.py RUN: how exactly must a model know the state to predict rewards? Plays the replay's last
five episodes again, in the simulator: from every state, but with normal errors in all its
positions (rad, m) and ten times larger ones in all speeds, with the true actions. Prints JSON: the
correlation of the rewards 1, 5 and 15 decisions later with the true ones.
"""

import json
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
from limits import diswm, played_again

run = Path(sys.argv[1])
cfg = diswm.read_checkpoint(run / "checkpoint.pt")["config"]
episodes = []
with diswm.config_env(cfg, cfg.dst) as env:
    for path in sorted((run / "episodes").glob("*.npy"))[-5:]:
        rows = np.load(path)
        states = [env.unwrapped.env.physics.get_state()
                  for _ in played_again(env, cfg, int(path.stem), rows)]
        episodes.append((rows, states))

simulator, _ = diswm.bare_simulator(cfg.dst)  # draws no pictures
simulator = gym.wrappers.RescaleAction(simulator, np.float32(-1), np.float32(1))
simulator.reset()
physics, rng = simulator.unwrapped.env.physics, np.random.default_rng(0)
speeds = np.arange(len(states[0])) >= physics.model.nq
for error in (0.003, 0.01, 0.03, 0.1):
    came = {1: [], 5: [], 15: []}
    for rows, states in episodes:
        for t in range(len(rows) - 15):
            noise = error * np.where(speeds, 10, 1) * rng.standard_normal(len(speeds))
            with physics.reset_context():
                physics.set_state(states[t] + noise)
            for k in range(1, 16):
                action = rows["action"][t + k]
                reward = sum(simulator.step(action)[1] for _ in range(cfg.action_repeat))
                if k in came:
                    came[k].append((reward, rows["reward"][t + k]))
    scores = {f"ahead {k}": round(np.corrcoef(np.transpose(pairs))[0, 1], 3)
              for k, pairs in came.items()}
    print(json.dumps(dict(task=cfg.dst, error=error) | scores), flush=True)
