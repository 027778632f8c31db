"""limits.py RUN [EPISODES]: which part of an agent limits it? Compares what its parts say with what
happened, in the replay's last episodes and in as many new ones, played by samples. Prints a line of
JSON for each: [R², correlation, mean prediction, mean truth] of

reward       the reward head at filtered states
ahead k      the reward k decisions after a filtered state, predicted with the true actions and no
             further images; "sum of 15": of all those rewards
critic       its value, and the discounted rewards of the next 200 decisions (87 % of them all)
image        the decoder's picture of a filtered state, and the true one
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))
import diswm  # noqa: E402


def score(predicted, true):
    """→ [R², correlation, mean prediction, mean truth]"""
    predicted, true = predicted.flatten(), true.flatten()
    r2 = 1 - (predicted - true).square().mean() / true.var(correction=0)
    correlation = torch.corrcoef(torch.stack([predicted, true]))[0, 1]
    return torch.stack([r2, correlation, predicted.mean(), true.mean()])


@torch.no_grad()
def compare(model, rows, critic=None):
    """A WorldModel and an episode's rows, as an array of agent_row, → dict of scores."""
    batch = {name: rows[name].copy()[None] for name in rows.dtype.names}
    batch = diswm.to_device(batch, "cpu")
    out, reward, action = model(batch), batch["reward"][0], batch["action"][0]
    feat, post = out["feat"][0], {name: x[0] for name, x in out["post"].items()}
    scores = dict(reward=score(model.reward(feat[1:]), reward[1:]),
                  image=score(model.decoder(feat), batch["image"][0]))
    if critic:
        count, returns = len(reward) - 200, 0.0
        for k in reversed(range(200)):
            returns = reward[k:k + count] + model.cfg.gamma * returns
        scores["critic"] = score(critic(feat[:count]), returns)
    count, sums = len(reward) - 15, 0.0
    state = {name: x[:count] for name, x in post.items()}
    for k in range(1, 16):
        state = model.rssm.prior(model.rssm.recur(state, action[k:k + count]))
        pair = torch.stack([model.reward(model.rssm.feat(state))[:, 0], reward[k:k + count]])
        sums = sums + pair
        if k in (1, 5, 15):
            scores[f"ahead {k}"] = score(*pair)
    return scores | {"sum of 15": score(*sums)}


def average(scores):
    """The mean over episodes of each score, rounded."""
    return {key: [round(x, 3) for x in torch.stack([s[key] for s in scores]).mean(0).tolist()]
            for key in scores[0]}


def played_again(env, cfg, index, rows):
    """A run's episode, played anew without distractors: its rows in turn, with the same rewards."""
    episode = diswm.Episode(env, diswm.derived_seed(cfg.seed, "finetune", index), "none")
    yield episode.rows[0]
    for action, reward in zip(rows["action"][1:], rows["reward"][1:], strict=True):
        episode.step(action)
        assert np.isclose(episode.rows[-1]["reward"], reward, atol=1e-6)
        yield episode.rows[-1]


def main():
    run, episodes = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 4
    cfg, agent, saved = diswm.open_run(run / "checkpoint.pt", threads=1)
    phase, _ = diswm.color_phase(cfg, min(saved["done"]["env_steps"], cfg.steps - 1))
    torch.manual_seed(0)
    dtype, new = diswm.agent_row(agent.action_dim), []
    seen = [np.load(path) for path in sorted((run / "episodes").glob("*.npy"))[-episodes:]]
    env = diswm.config_env(cfg, cfg.dst)
    for index in range(episodes):
        episode, state = diswm.Episode(env, 10_000 + index, phase), None
        while not episode.over:
            action, state = agent.act(episode.rows[-1], state, explore=True)
            episode.step(action)
        rows = [tuple(row[name] for name in dtype.names) for row in episode.rows]
        new.append(np.array(rows, dtype))
    for name, those in dict(seen=seen, new=new).items():
        result = dict(run="/".join(run.resolve().parts[-3:]), step=saved["done"]["env_steps"],
                      phase=phase, episodes=name,
                      returns=[float(rows["reward"].sum()) for rows in those])
        scores = [compare(agent.model, rows, agent.behaviour.critic) for rows in those]
        print(json.dumps(result | average(scores)), flush=True)


if __name__ == "__main__":
    main()
