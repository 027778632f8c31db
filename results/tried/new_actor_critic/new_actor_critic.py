"""new_actor_critic.py RUN UPDATES plain|tamed: a new actor-critic in a finished run's model, which
stays as it is. tamed: no state's gradient at its action is longer than the batch's mean. Prints,
every 250 updates, metrics, and every 500 returns of 4 episodes, by mode and by samples."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))
import diswm  # noqa: E402

run, count, kind, rows = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3], []
cfg, agent, _ = diswm.open_run(run / "checkpoint.pt", precision="bf16", threads=1)
torch.manual_seed(1)
agent.behaviour = behaviour = diswm.ActorCritic(cfg, agent.action_dim)
actor, critic = (diswm.adam(net, cfg.actor_lr) for net in (behaviour.actor, behaviour.critic))
agent.model.requires_grad_(False)
squash = behaviour.squash


def tamed(x):
    def shorten(grad):
        norm = grad.norm(dim=-1, keepdim=True)
        return grad * (norm.mean() / (norm + 1e-30)).clamp(max=1)
    if x.requires_grad:
        x.register_hook(shorten)
    return squash(x)


if kind == "tamed":
    behaviour.squash = tamed
replay = diswm.Replay(run / "episodes", diswm.agent_row(agent.action_dim))
env = diswm.config_env(cfg, cfg.dst)
for index in range(count + 1):
    if index and index % 250 == 0:
        row = dict(kind=kind, update=index) | diswm.mean_metrics(rows)
        if index % 500 == 0:
            for name, explore in ("return", False), ("sampled", True):
                row[name] = diswm.evaluate_agent(
                    replace(cfg, eval_episodes=4), env, agent, "train", explore)[0]["return"]
        print(json.dumps(row), flush=True)
        rows = []
    torch.manual_seed(1000 + index)
    batch = diswm.to_device(replay.sample(cfg.batch_size, cfg.batch_length, [1, index]), "cpu")
    with agent.model.autocast:
        with torch.no_grad():
            start = {name: x.flatten(0, 1) for name, x in agent.model(batch)["post"].items()}
        discount = cfg.gamma * batch["discount"].flatten()
        chosen = torch.rand_like(discount).argsort()[:cfg.imagine_starts]
        start = {name: x[chosen] for name, x in start.items()}
        if index % cfg.slow_every == 0:
            behaviour.slow_critic.load_state_dict(behaviour.critic.state_dict())
        actor_loss, critic_loss, metrics = behaviour.losses(agent.model, start, discount[chosen])
    norm = diswm.descend(actor_loss, actor, cfg.grad_clip)
    diswm.descend(critic_loss, critic, cfg.grad_clip)
    rows.append({name: x.detach() for name, x in metrics.items()} | dict(actor_grad_norm=norm))
