"""Fig. B: how diverse are the videos, beside what the agent meets online? t-SNE of clips' latents.

Of a finetune run, with its teacher's encoder: clips of consecutive frames from the videos and from
the run's replay. Writes sample_diversity.png and .json into the run. t-SNE keeps neighbours, not
distances, so the figures count: the mean distance of a clip to the nearest one of its own set from
another episode (those of the same overlap), and from a clip of the replay to the nearest video.
"""

import json
from dataclasses import replace
from pathlib import Path

import common
import numpy as np
import plot
import torch
from tqdm import tqdm

import diswm


def draw_clips(folder, count, length, rng):
    """Clips, (N, T, 64, 64, 3), without seams, starts uniform, and each one's episode, (N,)."""
    replay = diswm.Replay(folder)
    lengths = np.diff(replay.bounds)
    room = np.maximum(lengths - length + 1, 0)  # starts in each episode
    if (room > 0).sum() < 2:
        raise diswm.UserError(f"{folder} has no two episodes of {length} frames; use a smaller "
                              "--length")
    clips, episodes = [], []
    while len(set(episodes)) < 2:  # else no clip has one of another episode
        episodes = rng.choice(len(room), count, p=room / room.sum())
    for index in episodes:
        start = rng.integers(room[index])
        clips.append(np.array(replay.read(replay.paths[index])["image"][start:start + length]))
    return np.stack(clips), episodes

@torch.no_grad()
def clip_latents(encoder, clips, device):
    """Each clip's latents, the encoder's means of all its frames in a row: (N, T · Z)."""
    rows = [encoder.encode(diswm.to_device(dict(image=clip), device)["image"])["mean"].flatten()
            for clip in tqdm(clips, desc="clips", leave=False, disable=None)]
    return torch.stack(rows).float().cpu().numpy()

def nearest_distance(points, others, episodes=None):
    """The distance of each point to the nearest of `others`, not of its own episode if given."""
    distance = torch.cdist(torch.from_numpy(points).double(), torch.from_numpy(others).double())
    if episodes is not None:
        distance[torch.from_numpy(episodes[:, None] == episodes)] = torch.inf
    return distance.min(1).values.numpy()

def draw(points, figures, path, title):
    """points: {set: (N, 2)}"""
    from matplotlib.figure import Figure  # slow to import
    axes = Figure(figsize=(6, 5), layout="constrained").subplots()
    for (name, xy), color, marker in zip(points.items(), ("#0072B2", "#D55E00"), "o^", strict=True):
        mean, low, high = figures[name]
        axes.scatter(*xy.T, s=14, alpha=0.7, color=color, marker=marker, lw=0,
                     label=f"{name}: {mean:.2f} [{low:.2f}, {high:.2f}]")
    axes.set(title=title, xticks=[], yticks=[])
    axes.figure.legend(loc="outside lower center", fontsize=8, title_fontsize=8,
                       title="distance to the nearest clip of another episode, 95 % interval")
    axes.figure.savefig(path, dpi=200)

def find_videos(cfg, run):
    """The episodes of a finished collect run beside a finetune run, whatever its folder is now."""
    runs = str(run.resolve().parent.parent.parent.parent)
    folder = diswm.run_folder(replace(cfg, runs=runs, method="dreamerv2", tag=""), "collect")
    path = diswm.finished_run(folder)
    if path:
        return path.parent / "episodes"
    raise diswm.UserError(f"no finished {folder}; name the folder of the videos: --videos")

def measure(run, videos=None, clips=200, length=50, seed=0):
    """Compare a run's videos and replay, write picture and JSON. Returns the figures."""
    from sklearn.manifold import TSNE  # slow to import
    cfg, agent, saved = diswm.open_run(run / "checkpoint.pt")
    if getattr(agent, "teacher", None) is None:
        raise diswm.UserError(f"{run} has no teacher; give a finetune run of --method diswm")
    if clips < 4:
        raise diswm.UserError(f"{clips} clips are too few to compare")
    rng, latents, figures = np.random.default_rng(seed), {}, {}
    folders = dict(videos=videos or find_videos(cfg, run), replay=run / "episodes")
    for name, folder in folders.items():
        images, episodes = draw_clips(folder, clips, length, rng)
        latents[name] = x = clip_latents(agent.teacher, images, cfg.device)
        figures[name] = plot.mean_interval(nearest_distance(x, x, episodes))
    figures["replay to videos"] = plot.mean_interval(
        nearest_distance(latents["replay"], latents["videos"]))
    flat = TSNE(random_state=seed, perplexity=min(30, clips // 2)).fit_transform(
        np.concatenate([*latents.values()]))
    points = dict(videos=flat[:clips], replay=flat[clips:])
    step = saved["done"]["env_steps"]
    draw(points, figures, run / "sample_diversity.png",
         f"{cfg.src} → {cfg.dst}, {cfg.method}, seed {cfg.seed}, step {step:,}\n"
         f"{clips} clips of {length} frames each")
    result = dict(clips=clips, length=length, seed=seed, step=step, nearest_distance=figures,
                  points={name: xy.tolist() for name, xy in points.items()})
    (run / "sample_diversity.json").write_text(json.dumps(result) + "\n")
    for name, (mean, low, high) in figures.items():
        print(f"{name}: mean nearest distance {mean:.2f} [{low:.2f}, {high:.2f}]")
    print(f"wrote {run}/sample_diversity.png and sample_diversity.json")
    return figures

def main(argv=None):
    parser = diswm.Parser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, metavar="RUN", help="a finetune run: runs/…/seed0")
    parser.add_argument("--videos", type=Path, help="their folder, *.npy; default: collect's")
    parser.add_argument("--clips", type=int, default=200, help="of each; default: 200 (paper)")
    parser.add_argument("--length", type=int, default=50, help="frames; default: 50 (paper)")
    parser.add_argument("--seed", type=int, default=0, help="of the clips and of t-SNE")
    measure(**vars(parser.parse_args(argv)))

if __name__ == "__main__":
    common.run_script(main)
