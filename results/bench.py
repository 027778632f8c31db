"""Time an update, a pretraining update, a batch, a frame and a decision; count the parameters. On a
GPU also its memory, the kernels of an update, and a run of 3000 env steps."""

import itertools
import json
import resource
import sys
import tempfile
import timeit
from dataclasses import replace

import common
import numpy as np
import torch
from tqdm import tqdm

import diswm


def median_s(function, repeats, device="cpu"):
    """Median time of a call, after one to warm up; on a GPU by its own clock, after five, as the
    fourth records a graph."""
    if device == "cpu":
        return float(np.median(timeit.repeat(function, number=1, repeat=repeats + 1)[1:]))
    for _ in range(5):
        function()
    marks = [torch.cuda.Event(enable_timing=True) for _ in range(repeats + 1)]
    marks[0].record()
    for mark in marks[1:]:
        function()
        mark.record()
    torch.cuda.synchronize()
    return float(np.median([a.elapsed_time(b) for a, b in itertools.pairwise(marks)])) / 1e3

def time_updates(cfg, agent, folder, repeats):
    """Seconds of the updates, and of a batch; the peak memory of an online run."""
    rows, rng = diswm.agent_row(agent.action_dim), np.random.default_rng(0)
    noise = np.zeros(max(1000, cfg.batch_length), rows)
    noise["image"] = rng.integers(0, 256, noise["image"].shape, np.uint8)
    diswm.Replay(folder, rows).add(noise)
    del noise  # 12 MB of the peak
    replay = diswm.Replay(folder, rows, cfg.device)

    def sample():
        return replay.sample(cfg.batch_size, cfg.batch_length, rng.integers(2**32))

    def time(function, repeats=repeats):
        return median_s(function, repeats, cfg.device)

    data = sample()
    numbers = dict(eta=cfg.eta, index=1)
    result = dict(train_step_s=time(lambda: agent.update(data | numbers)))
    result["peak_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    result["sample_ms"] = 1e3 * time(sample, 20)
    frames = {name: data[name] for name in diswm.VIDEO_ROW.names}
    video = diswm.VideoPredictor(cfg).to(cfg.device)
    optimizer = diswm.adam(video, cfg.model_lr)

    def update(batch):  # as in diswm.train_video_predictor
        batch = diswm.to_device(batch, cfg.device)
        with video.autocast:
            loss, metrics = video.loss(video(batch), batch)
        return metrics | dict(norm=diswm.descend(loss, optimizer, cfg.grad_clip))

    update = diswm.Graphed(update, cfg.device)
    result["pretrain_step_s"] = time(lambda: update(frames))
    return result

def measure_gpu(cfg, agent):
    """What only a GPU has: name, memory, kernels of an update; env steps/s of a short run."""
    result = dict(card=torch.cuda.get_device_name(),
                  gpu_memory_mb=torch.cuda.max_memory_allocated() / 2**20)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        agent.update.function(agent.update.inputs)  # not its graph
        torch.cuda.synchronize()
    on_gpu = torch.autograd.DeviceType.CUDA
    result["kernels"] = sum(event.device_type == on_gpu for event in profile.events())
    return result | dict(run_env_steps_per_s=time_run(cfg, 3000))

def time_run(cfg, steps):
    """Env steps/s of a whole run, evaluation of one episode included."""
    with tempfile.TemporaryDirectory() as folder, diswm.config_env(cfg, cfg.dst) as env:
        cfg = replace(cfg, runs=folder, steps=steps, prefill=min(500, cfg.prefill), eval_episodes=1,
                      first_updates=1, eval_every=steps)
        agent, start = diswm.Agent(cfg, *env.action_space.shape), timeit.default_timer()
        diswm.train_agent(cfg, diswm.Run(cfg, "finetune"), env, agent)
        return steps / (timeit.default_timer() - start)

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
                1e3 * median_s(lambda: env.step(agent.act(row, None, explore=True)[0]), 40,
                               cfg.device))

def bench(cfg, repeats, tasks):
    """All figures of a Config, as a dict."""
    result = dict(device=cfg.device, precision=cfg.precision, threads=torch.get_num_threads(),
                  versions=diswm.VERSIONS | dict(python=sys.version.split()[0]))
    result |= {name: getattr(cfg, name) for name in ("method", "batch_size", "batch_length")}
    with diswm.config_env(cfg, cfg.dst) as env:
        agent = diswm.Agent(cfg, *env.action_space.shape)
    with tempfile.TemporaryDirectory() as folder:
        result |= time_updates(cfg, agent, folder, max(1, repeats))
    if cfg.device == "cuda":
        result |= measure_gpu(cfg, agent)
    result |= dict(params=count_parameters(agent), frame_ms={}, decision_ms={})
    for task in tqdm(tasks, "simulators", leave=False, disable=None):
        result["frame_ms"][task], result["decision_ms"][task] = time_simulator(cfg, task)
    return result

def estimate(cfg):
    """Say how long each stage of a preset takes here, from a few seconds of measuring."""
    with diswm.config_env(cfg, cfg.dst) as env:
        agent = diswm.Agent(cfg, *env.action_space.shape)
    with tempfile.TemporaryDirectory() as folder:
        times = time_updates(cfg, agent, folder, 1)
    decision, batch = time_simulator(cfg, cfg.dst)[1] / 1e3, times["sample_ms"] / 1e3

    def online(steps, evaluation=500):  # decisions of an episode
        decisions = steps / cfg.action_repeat
        updates = max(0, decisions - cfg.prefill) / cfg.train_every + cfg.first_updates
        played = decisions + steps // cfg.eval_every * cfg.eval_episodes * evaluation
        return played * decision + updates * (times["train_step_s"] + batch)

    hours = dict(collect=online(cfg.collect_steps), finetune=online(cfg.steps),
                 pretrain=cfg.pretrain_updates * (times["pretrain_step_s"] + batch))
    return ", ".join(f"{stage} {seconds / 3600:.2g} h" for stage, seconds in hours.items())

def main(argv=None):
    chosen = diswm.Parser(add_help=False, allow_abbrev=False)
    preset = "paper" if torch.cuda.is_available() else "small"
    chosen.add_argument("--preset", choices=diswm.PRESETS, default=preset, help=f"here: {preset}")
    chosen.add_argument("--method", choices=diswm.METHODS, default="diswm")
    known, _ = chosen.parse_known_args(argv)
    defaults = replace(diswm.PRESETS[known.preset], **diswm.METHODS[known.method])
    parser = diswm.Parser(description=__doc__, parents=[chosen], allow_abbrev=False)
    parser.add_argument("--json", action="store_true", help="print one line")
    parser.add_argument("--estimate", action="store_true", help="only say how long stages take")
    parser.add_argument("--tasks", nargs="*", metavar="TASK", default=diswm.FAMILIES,
                        help="tasks whose frames and decisions are timed")
    parser.add_argument("--repeats", type=int, default=5, help="updates to take the median of")
    groups = ("dst steps collect_steps pretrain_updates acting environment models encoder "
              "carry_over bonus z_dim behaviour machine")
    diswm.add_config_flags(parser, groups.split(), defaults)
    given = vars(parser.parse_args(argv))
    cfg = replace(defaults, **{name: given[name] for name in given if name in vars(defaults)})
    cfg = diswm.prepare_machine(cfg)
    if given["estimate"]:
        print(f"here about: {estimate(cfg)}")
        return
    result = bench(cfg, given["repeats"], given["tasks"])
    print(json.dumps(result, indent=None if given["json"] else 2))

if __name__ == "__main__":
    common.run_script(main)
