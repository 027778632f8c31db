"""Load a run and act: an example to copy into a notebook or a loop of your own."""

from pathlib import Path

import common

import diswm


def play(run, seed=0):
    """An episode of a run's policy, without exploration, in the colours of training's end."""
    cfg, agent, _ = diswm.open_run(run / "checkpoint.pt")
    if not isinstance(agent, diswm.Agent):
        raise diswm.UserError(f"{run} is a video predictor without a policy; give a finetune run")
    with diswm.config_env(cfg, cfg.dst) as env:
        phase, _ = diswm.color_phase(cfg, cfg.steps - 1)
        episode, state = diswm.Episode(env, seed, phase), None
        while not episode.over:
            action, state = agent.act(episode.rows[-1], state, explore=False)
            episode.step(action)
    return episode

def main(argv=None):
    parser = diswm.Parser(description=__doc__)
    parser.add_argument("run", type=Path, metavar="RUN", help="a finetune run: runs/…/seed0")
    episode = play(parser.parse_args(argv).run)
    print(f"return {episode.total:.1f} in {len(episode.rows) - 1} decisions")

if __name__ == "__main__":
    common.run_script(main)
