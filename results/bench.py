"""Time an update, a pretraining update, a batch, a frame and a decision; count the parameters."""

import json
import resource
import sys
import tempfile
import timeit
from dataclasses import replace

import common
import gymnasium as gym
import mujoco
import numpy as np
import torch
from tqdm import tqdm

import diswm


def median_s(function, repeats):
    """Median wall time of a call, after one to warm up."""
    return float(np.median(timeit.repeat(function, number=1, repeat=repeats + 1)[1:]))

def time_updates(cfg, agent, folder, repeats):
    """Seconds of the updates and of a batch from disk; the peak memory of an online run."""
    rng, replay = np.random.default_rng(0), diswm.Replay(folder, diswm.agent_row(agent.action_dim))
    noise = np.zeros(max(1000, cfg.batch_length), replay.dtype)
    noise["image"] = rng.integers(0, 256, noise["image"].shape, np.uint8)
    replay.add(noise)
    del noise  # 12 MB of the peak

    def sample():
        return replay.sample(cfg.batch_size, cfg.batch_length, rng)

    def update():
        diswm.check_finite(agent.update(data, cfg.eta, 1))

    def pretraining_update():  # as in diswm.train_video_predictor
        batch = diswm.to_device(frames, cfg.device)
        with diswm.autocast(cfg):
            loss, terms = video.loss(video(batch), batch)
        terms["model_grad_norm"] = diswm.descend(loss, optimizer, cfg.grad_clip)
        diswm.check_finite(terms)

    data = sample()
    result = dict(train_step_s=median_s(update, repeats))
    result["peak_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    result["sample_ms"] = 1e3 * median_s(sample, 20)
    frames = {name: data[name] for name in diswm.VIDEO_ROW.names}
    video = diswm.VideoPredictor(cfg).to(cfg.device)
    optimizer = diswm.adam(video, cfg.model_lr)
    result["pretrain_step_s"] = median_s(pretraining_update, repeats)
    return result

def count_parameters(agent):
    """Of each part, and in total."""
    parts = dict(agent.behaviour.named_children(), world_model=agent.model, teacher=agent.teacher)
    counts = {name: sum(parameter.numel() for parameter in part.parameters())
              for name, part in parts.items() if part}
    return counts | dict(total=sum(counts.values()))

def time_simulator(cfg, task):
    """Milliseconds of a frame and of a decision: policy, simulator, frame."""
    with diswm.config_env(replace(cfg, time_limit=0), task) as env:
        agent = diswm.Agent(cfg, *env.action_space.shape)
        row = diswm.Episode(env, 0, "train").rows[0]
        return (1e3 * median_s(env.render, 40),
                1e3 * median_s(lambda: env.step(agent.act(row, None, explore=True)[0]), 40))

def bench(cfg, repeats):
    """All figures of a Config, as a dict."""
    versions = {m.__name__: m.__version__ for m in (torch, mujoco, gym, np)}
    result = dict(device=cfg.device, precision=cfg.precision, threads=torch.get_num_threads(),
                  versions=versions | dict(python=sys.version.split()[0]))
    result |= {name: getattr(cfg, name) for name in ("method", "batch_size", "batch_length")}
    with diswm.config_env(cfg, cfg.dst) as env:
        agent = diswm.Agent(cfg, *env.action_space.shape)
    with tempfile.TemporaryDirectory() as folder:
        result |= time_updates(cfg, agent, folder, max(1, repeats))
    result |= dict(params=count_parameters(agent), frame_ms={}, decision_ms={})
    for task in tqdm(diswm.FAMILIES, "simulators", leave=False, disable=None):
        result["frame_ms"][task], result["decision_ms"][task] = time_simulator(cfg, task)
    return result

def main(argv=None):
    chosen = diswm.Parser(add_help=False, allow_abbrev=False)
    preset = "paper" if torch.cuda.is_available() else "small"
    chosen.add_argument("--preset", choices=diswm.PRESETS, default=preset, help=f"here: {preset}")
    chosen.add_argument("--method", choices=diswm.METHODS, default="diswm")
    known, _ = chosen.parse_known_args(argv)
    defaults = replace(diswm.PRESETS[known.preset], **diswm.METHODS[known.method])
    parser = diswm.Parser(description=__doc__, parents=[chosen], allow_abbrev=False)
    parser.add_argument("--json", action="store_true", help="print one line")
    parser.add_argument("--repeats", type=int, default=5, help="updates to take the median of")
    groups = "dst environment models encoder carry_over bonus z_dim behaviour machine"
    diswm.add_config_flags(parser, groups.split(), defaults)
    given = vars(parser.parse_args(argv))
    cfg = replace(defaults, **{name: given[name] for name in given if name in vars(defaults)})
    result = bench(diswm.prepare_machine(cfg), given["repeats"])
    print(json.dumps(result, indent=None if given["json"] else 2))

if __name__ == "__main__":
    common.run_script(main)
