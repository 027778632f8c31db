"""chaos.py RUN: how exactly must a model know the state to predict rewards? Plays the replay's last
five episodes again, in the simulator: from every state, but with normal errors in all its
positions (rad, m) and ten times larger ones in all speeds, with the true actions. Prints JSON: the
correlation of the rewards 1, 5 and 15 decisions later with the true ones.
"""

import json
import sys
from pathlib import Path

import numpy as np
from limits import diswm


def decide(env, action):
    """A decision in the simulator, without a picture → reward"""
    low, high = env.unwrapped.action_space.low, env.unwrapped.action_space.high
    action = low + (action + 1) / 2 * (high - low)
    return sum(env.unwrapped.env.step(action).reward for _ in range(env.action_repeat))


run = Path(sys.argv[1])
cfg = diswm.read_checkpoint(run / "checkpoint.pt")["config"]
rng = np.random.default_rng(0)
with diswm.config_env(cfg, cfg.dst) as env:
    physics, episodes = env.unwrapped.env.physics, []
    for path in sorted((run / "episodes").glob("*.npy"))[-5:]:
        rows = np.load(path)
        seed = diswm.derived_seed(cfg.seed, "finetune", int(path.stem))
        episode = diswm.Episode(env, seed, "none")
        states = [physics.get_state()]
        for action in rows["action"][1:]:
            episode.step(action)
            states.append(physics.get_state())
        assert np.allclose([row["reward"] for row in episode.rows], rows["reward"], atol=1e-6)
        episodes.append((rows, states))
    speeds = np.arange(len(states[0])) >= physics.model.nq
    for error in (0.003, 0.01, 0.03, 0.1):
        came = {1: [], 5: [], 15: []}
        for rows, states in episodes:
            for t in range(len(rows) - 15):
                noise = error * np.where(speeds, 10, 1) * rng.standard_normal(len(speeds))
                with physics.reset_context():
                    physics.set_state(states[t] + noise)
                for k in range(1, 16):
                    reward = decide(env, rows["action"][t + k])
                    if k in came:
                        came[k].append((reward, rows["reward"][t + k]))
        scores = {f"ahead {k}": round(np.corrcoef(np.transpose(pairs))[0, 1], 3)
                  for k, pairs in came.items()}
        print(json.dumps(dict(task=cfg.dst, error=error) | scores), flush=True)
