"""The specification of DisWM: read the test names from top to bottom.

Each docstring says which equation a test checks, or which real bug of the published code it kills.
Oracles are independent of `diswm.py`: torch.distributions, numpy loops, derivatives by hand. A
planted bug is put back into the production code, and the tests named with it must fail.
"""

import base64
import contextlib
import copy
import dataclasses
import functools
import hashlib
import inspect
import io
import itertools
import json
import multiprocessing
import os
import re
import resource
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from importlib import import_module as script
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import imageio.v3 as iio
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from hypothesis import HealthCheck, example, given, settings, stateful
from hypothesis import strategies as st
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.distributions import (
    Categorical,
    Normal,
    TanhTransform,
    TransformedDistribution,
    kl_divergence,
)
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import diswm
from diswm import METHODS, PRESETS, TASKS, Config, Replay, UserError, make_env

settings.register_profile(
    "diswm", max_examples=15, deadline=None, derandomize=bool(os.environ.get("CI")),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
settings.load_profile("diswm")
torch.set_num_threads(1)

slow = pytest.mark.slow
PAPER_TASKS = ("walker_walk", "cheetah_run", "hopper_stand", "finger_spin", "cartpole_swingup",
               "reacher_easy", "humanoid_walk")
seeds = st.integers(0, 2**31 - 1)
sizes = st.integers(1, 5)

def tiny_config(method="diswm", **changes):
    """The debug preset in fp32 on the CPU, as the method, with some values changed."""
    values = dict(precision="fp32", device="cpu", method=method) | METHODS[method] | changes
    return dataclasses.replace(PRESETS["debug"], **values)

def fake_batch(batch=3, length=8, action_dim=2, seed=0):
    """A numpy batch of noise in the replay's format, with a seam where it is long enough."""
    rng = np.random.default_rng(seed)
    first = np.zeros((batch, length), bool)
    first[:, 0] = True
    if length >= 4:
        first[0, length // 2] = True
    terminal = np.zeros_like(first)
    terminal[:, :-1] = first[:, 1:]
    return dict(
        image=rng.integers(0, 256, (batch, length, 64, 64, 3), np.uint8), is_first=first,
        action=rng.uniform(-1, 1, (batch, length, action_dim)).astype(np.float32),
        reward=rng.normal(size=(batch, length)).astype(np.float32),
        discount=1 - terminal.astype(np.float32))

def make_agent(cfg, action_dim=2, seed=0):
    """An agent; its frozen teacher, if its method distils, has random weights."""
    torch.manual_seed(seed)
    return diswm.Agent(cfg, action_dim)

def update(agent, batch, eta, index):
    """An update as train_agent does it."""
    return agent.update(batch | dict(eta=eta, index=index))

def snapshot(module):
    """Copies of all weights."""
    return {name: value.clone() for name, value in module.state_dict().items()}

def same(module, weights):
    """Whether all weights are still those of the snapshot, bit for bit."""
    return all(torch.equal(value, weights[name]) for name, value in module.state_dict().items())

def randn(seed, *shape):
    """float64 standard-normal numbers."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)

def leaf(x):
    """A copy that collects a gradient."""
    return x.detach().clone().requires_grad_()

def gaussian(seed, *shape):
    """A float64 diagonal normal as the RSSM has them: mean and std, which collect gradients."""
    std = 0.1 + 2 * torch.sigmoid(randn(seed + 1, *shape))
    return dict(mean=leaf(randn(seed, *shape)), std=leaf(std))

class FakeEnv(gym.Env):
    """Noise for ten decisions of two env steps each; counts decisions, lists the resets' phases."""
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)

    def __init__(self):
        self.count, self.phases = 0, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.phases.append((options or {}).get("phase"))
        return self.np_random.integers(0, 256, (64, 64, 3), np.uint8), {}

    def step(self, action):
        self.count += 1
        image = self.np_random.integers(0, 256, (64, 64, 3), np.uint8)
        return image, 1.0, False, self.count % 10 == 0, dict(env_steps=2)

class Stop(Exception):
    """Cuts a training off."""

def train_fake(cfg, folder, env=None, fresh=False, stage="finetune", stop_after=None):
    """Train an agent in FakeEnv with the real loop, in runs under `folder` → (run, env, agent).
    stop_after: raise Stop after so many logged episodes (and their checkpoints)."""
    cfg, env = dataclasses.replace(cfg, runs=str(folder)), env or FakeEnv()
    run = diswm.Run(cfg, stage, fresh)
    torch.manual_seed(cfg.seed)
    agent = diswm.Agent(cfg, *env.action_space.shape)
    record, count = run.record, []

    def counted(**row):
        record(**row)
        count.append(row)
        if len(count) == stop_after:
            raise Stop

    run.record = counted
    with contextlib.suppress(Stop):
        diswm.train_agent(cfg, run, env, agent)
    run.writer.close()  # its thread would write while a folder is removed
    run.lock.close()
    return SimpleNamespace(run=run, env=env, agent=agent, rows=count)

def run_cli(*argv):
    """Run a command in this process → (exit code, stdout, stderr)."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = diswm.main([str(arg) for arg in argv])
        except SystemExit as stop:  # argparse's --help
            code = stop.code
    return code, out.getvalue(), err.getvalue()

def succeed(*argv):
    """Run a command that must work, and say nothing on stderr. Returns stdout."""
    code, out, err = run_cli(*argv)
    assert (code, err) == (0, "")
    return out

def refuse(*argv, code=1, says=""):
    """Run a command that must fail with exactly one line that names the cause. Returns the line."""
    result, _, err = run_cli(*argv)
    assert result == code and err.startswith("error: ") and err.count("\n") == 1, err
    for text in [says] if isinstance(says, str) else says:
        assert text in err, f"{text!r} is not in {err!r}"
    return err

DEBUG = ("--preset", "debug", "--device", "cpu", "--precision", "fp32")

@pytest.fixture(scope="session")
def root(tmp_path_factory):
    """A folder in which collect and pretrain (debug) are finished: runs/ with one teacher."""
    folder = tmp_path_factory.mktemp("root")
    succeed("pretrain", "--src", "cheetah_run", "--runs", folder / "runs", *DEBUG)
    return folder

@pytest.fixture(scope="session")
def teacher(root):
    """The finished teacher's checkpoint."""
    return root / "runs/pretrain/cheetah_run/diswm/seed0/checkpoint.pt"

@pytest.fixture(scope="session")
def finished(root):
    """The run folder of a finetuning that went through without interruption."""
    succeed("finetune", "--dst", "walker_walk", "--runs", root / "runs", *DEBUG)
    return root / "runs/finetune/cheetah_run-walker_walk/diswm/seed0"

@pytest.fixture(autouse=True)
def one_thread():
    """A command in this process may have set more, which crawl beside another test run."""
    torch.set_num_threads(1)

# === The paper's values ===========================================================================

as_batch = functools.partial(diswm.to_device, device="cpu")  # from numpy, as a model sees it
TABLE = [  # appendix, "Hyperparameters of DisWM", row by row
    ("video: β₁", "beta1", 1), ("video: β₂", "beta2", 0.015), ("video: latents", "z_dim", 20),
    ("video: learning rate", "model_lr", 3e-4), ("world model: η", "eta", 0.1),
    ("world model: β", "beta", 0.015), ("world model: α", "alpha", 1),
    ("world model: latents", "z_dim", 20), ("world model: B", "batch_size", 50),
    ("world model: L", "batch_length", 50), ("world model: learning rate", "model_lr", 3e-4),
    ("behaviour: H", "horizon", 15), ("behaviour: γ", "gamma", 0.99),
    ("behaviour: λ", "lambda_", 0.95), ("behaviour: actor learning rate", "actor_lr", 8e-5),
    ("behaviour: critic learning rate", "critic_lr", 8e-5)]
TEXT = [  # the paper's words elsewhere
    ("3.4: η falls to 0.01", "eta_end", 0.01), ("4.1: 10⁶ environment steps", "steps", 1_000_000),
    ("4.1: other colours from the midpoint", "switch", 0.5),
    ("Fig. 4a: from Cheetah Run", "src", "cheetah_run"),
    ("Fig. 4a: to Walker Walk", "dst", "walker_walk")]

@pytest.mark.parametrize("row, field, value", TABLE + TEXT)
def test_a_config_has_the_papers_value_by_default(row, field, value):
    """So has `--preset paper`, and so has `--method diswm`."""
    assert getattr(Config(), field) == value
    assert PRESETS["paper"] == Config() and METHODS[Config().method] == {}

def test_an_ablation_switches_off_its_own_term_and_no_other():
    """Fig. 7, left. β₂ is β of the pretraining."""
    assert METHODS["no_distill"] == dict(eta=0, eta_end=0)
    assert METHODS["no_disentangle"] == dict(beta=0, beta2=0)

def test_seeds_differ_by_run_purpose_and_index():
    """The published replay sampler is always at seed 0."""
    keys = itertools.product((0, 1, 7), ("finetune", "evaluate", "pretrain", "collect"), range(9))
    assert len({diswm.derived_seed(*key) for key in keys}) == 3 * 4 * 9

def test_every_field_that_claims_to_be_of_the_table_is_in_a_row_of_it():
    """The comments of Config, which are also its help, say where a value is from."""
    claimed = re.findall(r"^    (\w+): .*\(table\)", inspect.getsource(Config), re.MULTILINE)
    assert set(claimed) == {field for _, field, _ in TABLE}

def test_images_are_64_by_64_centred_pixels_channels_first():
    """The table's first row, in the replay and at both ends of the models: −0.5 … 0.5."""
    image, feat = as_batch(fake_batch(2, 3))["image"], torch.zeros(2, 3, 250)
    expected = fake_batch(2, 3)["image"].transpose(0, 1, 4, 2, 3) / 255 - 0.5
    np.testing.assert_allclose(image.numpy(), expected, atol=1e-6)
    assert diswm.VIDEO_ROW["image"].shape == (64, 64, 3) and image.shape == (2, 3, 3, 64, 64)
    code = diswm.BetaVAEEncoder().encode(image)
    assert [code[name].shape for name in ("embed", "mean", "logvar")] == [(2, 3, 20)] * 3
    assert diswm.ConvEncoder().encode(image)["embed"].shape == (2, 3, 1024)
    for decoder in (diswm.BetaVAEDecoder, diswm.ConvDecoder):
        assert decoder(250)(feat).shape == image.shape

def test_an_agent_for_six_actions_has_3_657_367_parameters():
    """World model and teacher, actor, critic and the slow critic, in the paper's sizes."""
    agent = make_agent(dataclasses.replace(Config(), device="cpu", precision="fp32"), 6)
    parts = agent.model, agent.teacher, agent.behaviour.actor, agent.behaviour.critic
    count = [sum(p.numel() for p in part.parameters()) for part in parts]
    assert count == [1_838_657, 389_096, 586_412, 421_601]
    assert sum(p.numel() for p in agent.parameters()) == sum(count) + count[-1] == 3_657_367

# === KL and distributions =========================================================================

def torch_kl(q, p):
    """KL[q || p] summed over the last dimension, by torch.distributions."""
    return kl_divergence(Normal(q["mean"], q["std"]), Normal(p["mean"], p["std"])).sum(-1)

@given(seeds, sizes, sizes, sizes)
def test_beta_vae_kl_is_the_kl_to_the_standard_normal_summed_over_latents(
        seed, batch, length, dims):
    """The disentanglement term of Eqs. (2), (5): (B, T, Z) → (B, T), over no other dimension.
    Exactly 0 at the standard normal, where the published code leaves a stray 1e-6."""
    mean, logvar = randn(seed, batch, length, dims), randn(seed + 1, batch, length, dims)
    value = diswm.beta_vae_kl(mean, logvar)
    oracle = kl_divergence(Normal(mean, (logvar / 2).exp()), Normal(0.0, 1.0))
    torch.testing.assert_close(value, torch.einsum("btz->bt", oracle))
    assert (value >= 0).all() and (diswm.beta_vae_kl(0 * mean, 0 * mean) == 0).all()

def test_the_maths_passes_gradcheck():
    """Finite differences in float64 for the β-VAE's KL and the λ-return."""
    torch.autograd.gradcheck(diswm.beta_vae_kl, tuple(leaf(randn(i, 3, 2)) for i in range(2)))
    torch.autograd.gradcheck(diswm.lambda_return, tuple(leaf(x) for x in returns_problem(0, 4)))

@given(st.lists(st.floats(-5, 5), min_size=1, max_size=9))
def test_clipped_actions_stay_in_bounds_and_keep_their_gradient(values):
    """Straight-through: a plain clamp would leave a saturated actor without a gradient."""
    action = torch.tensor(values, requires_grad=True)
    clipped, _ = make_agent(tiny_config(actor="clipped")).behaviour.squash(action)
    assert (clipped.abs() < 1).all()
    inside = action.abs() < 0.999
    torch.testing.assert_close(clipped[inside], action[inside])
    assert torch.equal(torch.autograd.grad(clipped.sum(), action)[0], torch.ones(len(values)))

@pytest.mark.parametrize("actor", diswm.CHOICES["actor"])
def test_acted_and_imagined_actions_stay_inside_the_bounds(actor):
    """The published "truncated" normal is not truncated: its actions leave [−1, 1]."""
    cfg, images = tiny_config(horizon=5, actor=actor), fake_batch(1, 32)["image"][0]
    agent = make_agent(cfg)
    rows = [dict(image=image, action=np.zeros(2, np.float32)) for image in images]
    acted = np.stack([agent.act(row, None, explore=True)[0] for row in rows])
    assert acted.shape == (32, 2) and acted.dtype == np.float32 and (np.abs(acted) <= 1).all()
    rssm, recur, seen = agent.model.rssm, agent.model.rssm.recur, []
    rssm.recur = lambda state, action: seen.append(action.detach()) or recur(state, action)
    agent.behaviour.imagine(agent.model, rssm.initial(32))
    assert len(seen) == 5 and (torch.stack(seen).abs() <= 1).all()

@pytest.mark.parametrize("actor", diswm.CHOICES["actor"])
def test_evaluation_takes_the_actors_mode(actor):
    """Mode = tanh(m) of either actor, without noise; the state of the filter goes on."""
    agent, state = make_agent(tiny_config(actor=actor)), None
    row = dict(image=fake_batch(1, 1)["image"][0, 0], action=np.zeros(2, np.float32))
    for _ in range(3):
        before, (action, state) = state, agent.act(row, state, explore=False)
        m, _ = agent.behaviour.actor(agent.model.rssm.feat(state)).chunk(2, -1)
        np.testing.assert_allclose(action, torch.tanh(m)[0].detach().numpy(), atol=1e-5)
    assert not torch.allclose(state["deter"], before["deter"])
    (mode, one), (sample, two) = (
        torch.manual_seed(7) and agent.act(row, before, explore) for explore in (False, True))
    assert torch.equal(one["stoch"], two["stoch"]) and not np.allclose(mode, sample)

@pytest.mark.parametrize("clip", [1e9, 1e-2])
def test_a_step_is_clipped_adam_on_the_optimisers_own_weights_and_no_others(clip):
    """By hand in numpy: a gradient of norm `clip` at most, bias-corrected moments, ε = 1e-5.
    Other weights that the loss reaches, and own ones that it does not, keep their bytes."""
    torch.manual_seed(0)
    own = torch.nn.ModuleList([torch.nn.Linear(3, 4), torch.nn.Linear(2, 2)]).double()
    other = torch.nn.Linear(4, 1).double()
    fixed, unused, trained = snapshot(other), snapshot(own[1]), list(own[0].parameters())
    optimizer, weights = diswm.adam(own, 1e-2), [p.detach().numpy().copy() for p in trained]
    first, second = [0.0, 0.0], [0.0, 0.0]
    for step in range(1, 9):
        loss = (other(own[0](randn(step, 5, 3)))**3).sum()
        gradients = [g.numpy() for g in torch.autograd.grad(loss, trained, retain_graph=True)]
        norm = np.sqrt(sum((g**2).sum() for g in gradients))
        assert diswm.descend(loss, optimizer, clip).item() == pytest.approx(norm)
        for i, gradient in enumerate(gradients):
            gradient = gradient * min(1.0, clip / (norm + 1e-6))
            first[i] = 0.9 * first[i] + 0.1 * gradient
            second[i] = 0.999 * second[i] + 0.001 * gradient**2
            root = np.sqrt(second[i] / (1 - 0.999**step))
            weights[i] -= 1e-2 * first[i] / (1 - 0.9**step) / (root + 1e-5)
        for parameter, weight in zip(trained, weights, strict=True):
            np.testing.assert_allclose(parameter.detach().numpy(), weight, rtol=1e-9)
    assert same(other, fixed) and same(own[1], unused)

# === KL balancing and free nats ===================================================================

@given(seeds, sizes, sizes, st.floats(0, 1), st.floats(0, 3))
def test_the_kl_loss_is_the_batch_mean_or_the_free_nats_if_they_are_more(
        seed, batch, length, balance, free_nats):
    """As published, free nats act on the mean: steps of 0.1 and 3.0 nats and 1 free nat give 1.55,
    not (1 + 3) / 2. The (B, T) value that is logged is the plain KL."""
    post, prior = gaussian(seed, batch, length, 3), gaussian(seed + 9, batch, length, 3)
    loss, value = diswm.rssm_kl_loss(post, prior, balance, free_nats)
    torch.testing.assert_close(value, torch_kl(post, prior))
    assert loss.item() == pytest.approx(max(value.mean().item(), free_nats))

@given(seeds, st.sampled_from([0.0, 0.2, 0.5, 0.8, 1.0]), st.sampled_from([-0.1, 0.1]))
def test_kl_gradient_is_split_balance_to_the_prior_and_the_rest_to_the_posterior(
        seed, balance, more):
    """DreamerV2's KL balancing, the right way round; below the free nats nothing is trained."""
    post, prior = gaussian(seed, 2, 3, 4), gaussian(seed + 9, 2, 3, 4)
    leaves, kl = [*post.values(), *prior.values()], torch_kl(post, prior).mean()
    loss, _ = diswm.rssm_kl_loss(post, prior, balance, kl.item() + more)
    shares = [1 - balance] * 2 + [balance] * 2 if more < 0 else [0.0] * 4
    for got, plain, share in zip(torch.autograd.grad(loss, leaves),
                                 torch.autograd.grad(kl, leaves), shares, strict=True):
        torch.testing.assert_close(got, share * plain)

# === Distillation =================================================================================

@given(seeds, sizes, sizes, st.integers(1, 20))
def test_distillation_is_equation_3_summed_over_time_and_averaged_over_the_batch(
        seed, batch, length, dims):
    """Σ_t mean_B KL(softmax teacher || softmax task), by torch's Categorical: the scale at which
    η = 0.1 was tuned ("batchmean" on (B, T, Z)). The student's gradient is (p_task − p_teacher) / B
    and the teacher, a fixed target (section 3.3), gets none."""
    teacher, task = (leaf(randn(seed + i, batch, length, dims)) for i in range(2))
    loss = diswm.distillation_loss(teacher, task)
    oracle = kl_divergence(Categorical(logits=teacher), Categorical(logits=task)).sum(1).mean(0)
    assert loss.shape == () and loss.item() >= -1e-12
    torch.testing.assert_close(loss, oracle)
    grad, none = torch.autograd.grad(loss, (task, teacher), allow_unused=True)
    torch.testing.assert_close(grad, (task.softmax(-1) - teacher.softmax(-1)).detach() / batch)
    assert none is None or not none.any()

def test_teacher_bytes_are_unchanged_by_updates_and_in_no_optimiser():
    """The published code switches the teacher's gradients back on and trains it along."""
    agent = make_agent(tiny_config())
    before, student = snapshot(agent.teacher), snapshot(agent.model.encoder)
    for index in range(3):
        metrics = update(agent, fake_batch(seed=index), 0.6, index)
    assert metrics["distill"] > 0 and not same(agent.model.encoder, student)
    assert same(agent.teacher, before)
    trained = {id(p) for o in agent.optimizers.values() for p in o.param_groups[0]["params"]}
    assert trained and not trained & {id(p) for p in agent.teacher.parameters()}
    assert all(p.grad is None and not p.requires_grad for p in agent.teacher.parameters())

def picture_batch(batch=3, length=8, seed=0):
    """A fake_batch whose images show a bright square; colours and place differ in each."""
    data, rng = fake_batch(batch, length), np.random.default_rng(seed)
    for image in data["image"].reshape(-1, 64, 64, 3):
        y, x = rng.integers(0, 40, 2)
        image[:] = rng.integers(0, 128, 3)
        image[y:y + 24, x:x + 24] = rng.integers(128, 256, 3)
    return data

def test_distillation_brings_the_students_latents_towards_its_teachers():
    """The same batch and teacher: with η > 0 Eq. (3) falls well below its start, with η = 0
    it rises."""
    first, last = {}, {}
    for eta in (0.0, 20.0):
        agent = make_agent(tiny_config(model_lr=3e-3))
        values = [update(agent, picture_batch(), eta, i)["distill"].item() for i in range(60)]
        first[eta], last[eta] = values[0], np.mean(values[-10:])
    assert last[20] < 0.6 * first[20] and last[0] > first[0] == first[20]

@given(st.floats(0.01, 1), st.floats(0, 1), st.integers(10, 10**5), st.integers(0, 10**5), seeds)
def test_eta_is_zero_before_its_delay_then_falls_in_a_line_to_its_end(
        start, end, decay, delay, seed):
    """Section 3.4, by np.interp; 0.1 … 0.01 take 45 000 decisions. An end above the start, as that
    of --eta 0.001, never raises it."""
    papers = [diswm.current_eta(Config(), step) for step in (0, 25_000, 45_000, 10**6)]
    assert papers == pytest.approx([0.1, 0.05, 0.01, 0.01])
    across_domains = [diswm.current_eta(Config(dst="pusher"), step) for step in (49_999, 50_000)]
    assert across_domains == [0, 0.1]
    rest = min(start, end)
    for step in (seed % (2 * (delay + decay)), delay - 1, delay, delay + decay // 2, delay + decay):
        line = np.interp(step, [delay, delay + decay * (1 - rest / start)], [start, rest])
        eta = diswm.eta_schedule(step, start, end, decay, delay)
        assert eta == pytest.approx(line if step >= delay else 0.0) and eta <= start

# === Returns and actor-critic =====================================================================

def returns_problem(seed, horizon, *batch):
    """Random reward, value, discount (H, ...) in [0, 1), bootstrap (...)."""
    return (randn(seed, horizon, *batch), randn(seed + 1, horizon, *batch),
            torch.sigmoid(randn(seed + 2, horizon, *batch)), randn(seed + 3, *batch))

def n_step_mixture(*problem, lambda_):
    """The slow oracle: every n-step return of every t, mixed with weights (1 − λ) λ^(n − 1)."""
    reward, value, discount, bootstrap = (x.detach().double().numpy() for x in problem)
    values, horizon, returns = [*value, bootstrap], len(reward), np.zeros_like(reward)
    for t in range(horizon):
        total, gamma = np.zeros_like(bootstrap), np.ones_like(bootstrap)
        for n in range(1, horizon - t + 1):
            total, gamma = total + gamma * reward[t + n - 1], gamma * discount[t + n - 1]
            weight = (1 - lambda_) * lambda_ ** (n - 1) if t + n < horizon else lambda_ ** (n - 1)
            returns[t] += weight * (total + gamma * values[t + n])
    return returns

@given(seeds, st.integers(1, 8), sizes, st.floats(0, 1))
def test_lambda_return_is_the_mixture_of_all_n_step_returns_in_time_order(seed, horizon, n, l):
    """Appendix B; the published λ-return comes out reversed in time."""
    problem = returns_problem(seed, horizon, n)
    result = diswm.lambda_return(*problem, l)
    assert result.shape == (horizon, n)
    np.testing.assert_allclose(result.numpy(), n_step_mixture(*problem, lambda_=l), atol=1e-9)

def stubbed_behaviour(seed, rho):
    """World model and actor-critic whose imagination is a given tensor; the slow critic differs."""
    cfg = tiny_config(horizon=4, entropy_scale=0.3, rho=rho)
    torch.manual_seed(seed)
    model, behaviour = diswm.WorldModel(cfg, 2), diswm.ActorCritic(cfg, 2)
    with torch.no_grad():
        for weights in behaviour.slow_critic.parameters():
            weights.add_(0.3 * torch.randn_like(weights))
    feats = leaf(3 * torch.randn(5, 3, cfg.stoch + cfg.deter))
    log_prob, entropy = (leaf(torch.randn(4, 3)) for _ in range(2))
    behaviour.imagine = lambda *args: (feats[:-1], feats[-1], log_prob, entropy)
    return model, behaviour, feats, log_prob, entropy

@given(seeds, st.floats(0, 1))
def test_actor_and_critic_losses_are_those_of_appendix_b(seed, rho):
    """ρ V + (1 − ρ) ln π · sg(V − v) + entropy; ½ (V − v)²; both weighted by Π γ. By loops, with
    targets of the slow critic and the true first discount."""
    model, behaviour, feats, log_prob, entropy = stubbed_behaviour(seed, rho)
    first = 0.99 * torch.tensor([1.0, 0.0, 1.0])
    actor, critic, _ = behaviour.losses(model, model.rssm.initial(3), first)
    with torch.no_grad():
        reward, gamma, slow, online = (head(feats)[..., 0] for head in (
            model.reward, model.discount, behaviour.slow_critic, behaviour.critic))
    gamma = torch.cat([first[None], torch.sigmoid(gamma[1:])])
    target = n_step_mixture(reward[:-1], slow[:-1], gamma[:-1], slow[-1], lambda_=0.95)
    actor_sum = critic_sum = 0.0
    for n in range(3):
        weight = 1.0
        for t in range(4):
            advantage = target[t, n] - online[t, n].item()
            critic_sum += weight * 0.5 * advantage**2
            actor_sum -= weight * (rho * target[t, n] + 0.3 * entropy[t, n].item()
                                   + (1 - rho) * log_prob[t, n].item() * advantage)
            weight *= gamma[t, n].item()
    assert critic.item() == pytest.approx(critic_sum / 12, rel=1e-4, abs=1e-6)
    assert actor.item() == pytest.approx(actor_sum / 12, rel=1e-4, abs=1e-6)

@pytest.mark.parametrize("rho", [0.0, 1.0])
def test_rho_chooses_between_dynamics_backprop_and_reinforce(rho):
    """ρ = 1: the actor's gradient comes along the states; ρ = 0: along ln π only."""
    model, behaviour, feats, log_prob, _ = stubbed_behaviour(0, rho)
    actor, critic, _ = behaviour.losses(model, model.rssm.initial(3), torch.full((3,), 0.99))
    by_state, by_log_prob = torch.autograd.grad(actor, (feats, log_prob), retain_graph=True,
                                                materialize_grads=True)
    assert by_state.any() == (rho == 1) and by_log_prob.any() == (rho == 0)
    assert torch.autograd.grad(critic, feats, allow_unused=True)[0] is None

@pytest.mark.parametrize("actor", diswm.CHOICES["actor"])
def test_imagination_follows_the_policy_from_the_given_states_for_horizon_transitions(actor):
    """States s_0 … s_H, log-probs and entropies of a_0 … a_{H−1}, by torch.distributions. The last
    state's gradient reaches all of the actor: action → state. For the policy states are data."""
    agent, taken = make_agent(tiny_config(horizon=4, actor=actor)), []
    behaviour, rssm, recur = agent.behaviour, agent.model.rssm, agent.model.rssm.recur
    start = {key: torch.randn_like(x) for key, x in rssm.initial(9).items()}
    rssm.recur = lambda state, action: taken.append((state, action)) or recur(state, action)
    feats, last, log_prob, entropy = behaviour.imagine(agent.model, start)
    states = [start, *(state for state, _ in taken[1:])]  # a_t is taken in s_t
    expected = torch.stack([torch.cat([s["stoch"], s["deter"]], -1) for s in states])
    assert torch.equal(feats, expected) and len(feats) == 4
    m, s = behaviour.actor(feats).chunk(2, -1)
    std, action = 2 * torch.sigmoid(s / 2) + 0.1, torch.stack([action for _, action in taken])
    inside = (action.abs() < 0.99).all(-1)  # others were clipped, or rounded
    policy = Normal(torch.tanh(m), std)
    if actor == "squashed":  # its entropy is −E ln π, estimated by the sample
        policy = TransformedDistribution(Normal(m, std), TanhTransform())
        expected = Normal(m, std).entropy() + torch.log1p(-action**2)
    else:
        expected = policy.entropy()
    torch.testing.assert_close(entropy[inside], expected.sum(-1)[inside], rtol=1e-3, atol=1e-3)
    expected = policy.log_prob(action).sum(-1)[inside]
    torch.testing.assert_close(log_prob[inside], expected, rtol=1e-3, atol=1e-3)
    gradients = torch.autograd.grad(last.sum(), list(behaviour.actor.parameters()),
                                    retain_graph=True)
    assert len(expected) > 3 and all(gradient.any() for gradient in gradients)
    assert {None} == {*torch.autograd.grad(log_prob.sum() + entropy.sum(), list(rssm.parameters()),
                                           allow_unused=True)}

LINE = SimpleNamespace(  # a toy world model: a point on a line that an action moves; best at 0.6
    reward=lambda feat: -(feat[..., 1:] - 0.6)**2,
    discount=lambda feat: torch.full_like(feat[..., 1:], 2.2),  # 0.9
    rssm=SimpleNamespace(feat=diswm.RSSM.feat, prior=lambda place: dict(stoch=place, deter=place),
                         recur=lambda state, action: state["deter"] + action))

class Constant(torch.nn.Module):
    """An actor that heeds no state: m, and 0 for its std."""
    def __init__(self, m):
        super().__init__()
        self.m = torch.nn.Parameter(torch.tensor([m]))

    def forward(self, feat):
        return torch.cat([self.m, 0 * self.m]).expand(*feat.shape[:-1], 2)

@given(st.floats(1, 20), st.sampled_from([-1, 1]))
def test_an_actor_on_the_wrong_side_always_learns_that_it_is(size, side):
    """However large |m|: the derivative of Eq. (5)'s objective never falls below the entropy's."""
    cfg = tiny_config(stoch=1, deter=1, horizon=3)
    torch.manual_seed(0)
    behaviour, model = diswm.ActorCritic(cfg, 1), SimpleNamespace(**vars(LINE))
    model.reward = lambda feat: -side * feat[..., 1:]  # go the other way
    behaviour.actor = Constant(side * size)
    start = LINE.rssm.prior(torch.zeros(256, 1))
    loss, _, _ = behaviour.losses(model, start, torch.full((256,), 0.9))
    gradient, = torch.autograd.grad(loss, behaviour.actor.m)
    assert side * gradient.item() > cfg.entropy_scale / 2

@pytest.mark.parametrize("rho, push", [(1.0, 0), (0.0, 0), (1.0, 8), (1.0, -8)])
def test_an_actor_learns_to_do_what_a_known_reward_asks_for(rho, push):
    """By either gradient, and from an actor that pushes to one side in every state: six decisions
    by the mode from nine places come close to the best ones, and were far below (−70, −120)."""
    cfg = tiny_config(stoch=1, deter=1, horizon=5, rho=rho, units=32)
    torch.manual_seed(0)
    behaviour = diswm.ActorCritic(cfg, 1)
    behaviour.actor.net[-1].bias.data[0] += push

    def play(decide):
        place, total = torch.linspace(-1, 1, 9)[:, None], 0.0
        for _ in range(6):
            feat = torch.cat([place, place], -1)
            place = place + decide(feat).detach().clamp(-1, 1)
            total += LINE.reward(torch.cat([place, place], -1)).mean().item()
        return total

    def mode(feat):
        return behaviour.squash(behaviour.policy(feat).mean)[0]

    before, best = play(mode), play(lambda f: 0.6 - f[:, 1:])
    actor, critic = (diswm.adam(net, 3e-3) for net in (behaviour.actor, behaviour.critic))
    for update in range(400 if push else 200):
        if update % 10 == 0:
            behaviour.slow_critic.load_state_dict(behaviour.critic.state_dict())
        start = LINE.rssm.prior(2 * torch.rand(64, 1) - 1)
        actor_loss, critic_loss, _ = behaviour.losses(LINE, start, torch.full((64,), 0.9))
        diswm.descend(actor_loss, actor, 100.0)
        diswm.descend(critic_loss, critic, 100.0)
    assert before < best - 2 and play(mode) > best - (3 if push else 0.5)

@pytest.mark.parametrize("still", ["model", "actor", "critic"])
def test_each_update_changes_its_own_part_and_no_other(still):
    """With one learning rate at zero that part keeps its bytes, whatever the other losses do."""
    agent = make_agent(tiny_config(**{f"{still}_lr": 0.0}))
    parts = dict(model=agent.model, actor=agent.behaviour.actor, critic=agent.behaviour.critic)
    before = {name: snapshot(part) for name, part in parts.items()}
    for index in range(2):
        update(agent, fake_batch(seed=index), 0.6, index)
    assert {name for name, part in parts.items() if same(part, before[name])} == {still}

def test_slow_critic_is_copied_at_update_zero_and_every_slow_every_updates():
    """Between copies it keeps its bytes while the critic learns; a copy precedes the update."""
    agent = make_agent(tiny_config(slow_every=3))
    for index in range(7):
        if index % 3 == 0:
            expected = snapshot(agent.behaviour.critic)
        update(agent, fake_batch(batch=2, length=3, seed=index), 0.6, index)
        assert same(agent.behaviour.slow_critic, expected)
        assert not same(agent.behaviour.critic, expected)

@pytest.mark.parametrize("count", [0, 1, 5])
def test_imagination_starts_from_all_states_of_a_batch_or_from_some(count):
    """Posteriors, detached, each at most once, with its own true discount: 0 at a terminal."""
    agent, seen, data = make_agent(tiny_config(imagine_starts=count)), [], fake_batch(2, 8)
    loss, losses = agent.model.loss, agent.behaviour.losses
    agent.model.loss = lambda out, *args: seen.append(out["post"]) or loss(out, *args)
    agent.behaviour.losses = lambda *args: seen.extend(args[1:]) or losses(*args)
    assert all(value.isfinite() for value in update(agent, data, 0.6, 0).values())
    post, start, discount = seen
    post = {key: x.detach().flatten(0, 1) for key, x in post.items()}
    rows = [(post["stoch"] == stoch).all(-1).nonzero().item() for stoch in start["stoch"]]
    assert len(set(rows)) == len(rows) == (count or 16)
    assert all(torch.equal(start[key], x[rows]) for key, x in post.items())
    assert not any(x.requires_grad for x in start.values())
    true = 0.99 * torch.from_numpy(data["discount"]).flatten()
    torch.testing.assert_close(discount, true[rows])

# === Loss shapes ==================================================================================

@pytest.mark.parametrize("method", METHODS)
@given(sizes, st.integers(2, 6), sizes, sizes, sizes, sizes)
def test_terms_are_per_frame_and_losses_are_finite_scalars(
        method, batch, length, action, z, stoch, deter):
    """For any size: terms (B, T), metrics finite scalars, each term's metric its mean."""
    cfg, data = (tiny_config(method, z_dim=z, stoch=stoch, deter=deter),
                 as_batch(fake_batch(batch, length, action)))
    expected = {"image", "disentangle"} if cfg.encoder == "beta_vae" else {"image"}
    for model, heads in ((diswm.VideoPredictor(cfg), set()),
                         (diswm.WorldModel(cfg, action), {"reward", "discount"})):
        out = model(data)
        terms, (loss, metrics) = model.frame_losses(out, data), model.loss(out, data)
        assert terms.keys() == expected | heads
        assert all(term.shape == (batch, length) for term in terms.values())
        assert all(x.shape == () and x.isfinite() for x in (loss, *metrics.values()))
        for name, term in terms.items():
            torch.testing.assert_close(metrics[name], term.mean())

@pytest.mark.parametrize("method", METHODS)
def test_every_trainable_parameter_of_its_stage_gets_a_gradient_and_no_other_does(method):
    """Pretraining trains the whole predictor; an agent's update all but teacher and slow critic.
    APV no longer needs the prior of its action-free RSSM: the weight of that KL is 0."""
    cfg = tiny_config(method, free_nats=0.0, grad_clip=1e9)
    agent, video, batch = make_agent(cfg), diswm.VideoPredictor(cfg), as_batch(fake_batch())
    metrics, own = update(agent, fake_batch(), cfg.eta, 0), agent.behaviour
    diswm.descend(video.loss(video(batch), batch)[0], diswm.adam(video, 1e-3), 1e9)
    silent = {name for part in (agent.model, own.actor, own.critic, video)
              for name, p in part.named_parameters() if p.grad is None or not p.grad.any()}
    assert all("below.prior_net." in name for name in silent) and bool(silent) == (method == "apv")
    gradients = [p.grad for p in agent.model.parameters() if p.grad is not None]
    norm = torch.stack([gradient.norm() for gradient in gradients]).norm()
    torch.testing.assert_close(norm, metrics["model_grad_norm"])  # none from the behaviour's
    assert (agent.teacher is None) == (cfg.eta == 0)
    for fixed in filter(None, [agent.teacher, own.slow_critic]):
        assert all(p.grad is None for p in fixed.parameters())

scales = st.floats(0, 5).map(lambda x: round(x, 3))

@given(scales, scales, scales, scales)
def test_the_losses_are_the_weighted_sums_of_equations_2_and_5(alpha, beta, reward, eta):
    """Image + α KL + β disentangle + heads + η distill: β = 0, η = 0 remove exactly their terms.
    A video predictor's image + β₁ KL + β₂ disentangle has weights of its own."""
    torch.manual_seed(0)
    cfg = tiny_config(alpha=alpha, beta=beta, reward_scale=reward, beta1=7.0, beta2=8.0)
    model, batch = diswm.WorldModel(cfg, 2), as_batch(fake_batch(2, 3))
    out, z_disen = model(batch), torch.randn(2, 3, cfg.z_dim)
    loss, m = model.loss(out, batch, z_disen, eta)
    torch.testing.assert_close(loss, m["image"] + alpha * m["kl_loss"] + beta * m["disentangle"]
                               + reward * m["reward"] + m["discount"] + eta * m["distill"])
    student = Categorical(logits=out["code"]["embed"])
    oracle = kl_divergence(Categorical(logits=z_disen), student).sum(1).mean()
    torch.testing.assert_close(m["distill"], oracle)
    torch.testing.assert_close(m["kl"], torch_kl(out["post"], out["prior"]).mean())
    model = diswm.VideoPredictor(tiny_config(alpha=7.0, beta=8.0, beta1=alpha, beta2=beta))
    loss, m = model.loss(model(batch), batch)
    torch.testing.assert_close(loss, m["image"] + alpha * m["kl_loss"] + beta * m["disentangle"])

def test_the_terms_are_the_negative_log_likelihoods_of_equations_4_and_5():
    """½ squared error over pixels and reward; cross-entropy to the soft target γ (1 − terminal)."""
    torch.manual_seed(0)
    model, batch = diswm.WorldModel(tiny_config(), 2), as_batch(fake_batch(2, 4))
    out = model(batch)
    terms = model.frame_losses(out, batch)
    feat, constant = out["feat"], Normal(0.0, 1.0).log_prob(torch.zeros(()))
    image = (constant - Normal(model.decoder(feat), 1.0).log_prob(batch["image"])).sum((-3, -2, -1))
    reward = constant - Normal(model.reward(feat)[..., 0], 1.0).log_prob(batch["reward"])
    p, target = torch.sigmoid(model.discount(feat)[..., 0]), 0.99 * batch["discount"]
    entropy = -target * p.log() - (1 - target) * (1 - p).log()
    std = (out["code"]["logvar"] / 2).exp()
    disentangle = kl_divergence(Normal(out["code"]["mean"], std), Normal(0.0, 1.0)).sum(-1)
    oracles = dict(image=image, reward=reward, discount=entropy, disentangle=disentangle)
    for name, oracle in oracles.items():
        torch.testing.assert_close(terms[name], oracle, rtol=1e-4, atol=1e-5)

@pytest.mark.parametrize("form", [(4, 2, 1), (5, 2), (6, 2), (4, 1)])  # kernel, stride, padding
@given(seeds, sizes, sizes, sizes, sizes)
def test_a_deconvolution_is_pytorchs_and_has_its_gradients(form, seed, n, inputs, outputs, size):
    """Whichever way it goes: of one pixel, by a kernel of odd size, or neither; then an ELU."""
    torch.manual_seed(seed)
    size += len(form) == 3  # ours does not pad a single pixel
    x, results = randn(seed, n, inputs, size, size), []
    layer = torch.nn.ConvTranspose2d(inputs, outputs, *form).double()
    for kind in torch.nn.ConvTranspose2d, diswm.Deconvolution:
        net = torch.nn.Sequential(kind(inputs, outputs, *form).double(), torch.nn.ELU(inplace=True))
        net[0].load_state_dict(layer.state_dict())
        y = net(start := leaf(x))
        results.append([y, *torch.autograd.grad((y**2).sum(), [start, *net.parameters()])])
    torch.testing.assert_close(*results)

@pytest.mark.parametrize("kind, actions", [("VideoPredictor", 0), ("WorldModel", 2)])
def test_one_batch_again_and_again_is_learnt(kind, actions):
    """Each image becomes known: the error falls far below that of the images' mean."""
    torch.manual_seed(0)
    cfg = tiny_config(cnn_depth=8, stoch=16, deter=32, hidden=32)
    model, batch = getattr(diswm, kind)(cfg, actions), as_batch(picture_batch())
    optimizer = diswm.adam(model, 5e-3)
    for _ in range(100):
        loss, metrics = model.loss(model(batch), batch)
        diswm.descend(loss, optimizer, 100.0)
    blind = 0.5 * (batch["image"] - batch["image"].mean((0, 1)))**2
    assert metrics["image"] < 0.3 * blind.sum((-3, -2, -1)).mean()
    assert "reward" not in metrics or metrics["reward"] < 0.2 * batch["reward"].var()

# === RSSM =========================================================================================

def window(seed, batch=3, length=6, action_dim=2, kind="RSSM"):
    """An RSSM and a window: embed, action, is_first."""
    torch.manual_seed(seed)
    rssm = getattr(diswm, kind)(action_dim, 4, stoch=3, deter=5, hidden=6).requires_grad_(False)
    first = torch.zeros(batch, length, dtype=torch.bool)
    first[:, 0] = True
    return rssm, torch.randn(batch, length, 4), torch.randn(batch, length, action_dim), first

@contextlib.contextmanager
def no_noise():
    """Inside, samples are a fixed quantile, so that windows of different shape can be compared."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diswm.Normal, "rsample", lambda self: self.mean + 0.3 * self.stddev)
        yield

def close(a, b):
    """Whether two states agree in deter, stoch, mean and std."""
    return all(torch.allclose(a[key], b[key], atol=1e-5) for key in a)

def pick(state, index):
    """Index every tensor of a state."""
    return {key: value[index] for key, value in state.items()}

both_kinds = pytest.mark.parametrize("kind", ["RSSM", "StackedRSSM"])

@both_kinds
@given(seeds, sizes, sizes)
def test_filtering_a_window_equals_filtering_step_by_step(kind, seed, batch, length):
    """Training (observe) and acting (step) are one filter; priors come from the same h_t."""
    rssm, embed, action, first = window(seed, batch, length, kind=kind)
    with no_noise():
        post, prior = rssm.observe(embed, action, first)
        state = rssm.initial(batch)
        for t in range(length):
            state = rssm.step(state, action[:, t], embed[:, t], 1 - first[:, t, None].float())
            assert close(state, pick(post, (slice(None), t)))
            assert close(rssm.prior(state["deter"]), pick(prior, (slice(None), t)))

@both_kinds
@given(seeds, st.integers(1, 5))
def test_is_first_forgets_the_state_and_the_previous_action(kind, seed, seam):
    """From a seam on, a window gives the states of a window that starts there."""
    rssm, embed, action, first = window(seed, kind=kind)
    first[:, seam] = True
    with no_noise():
        post, _ = rssm.observe(embed, action, first)
        action[:, seam] += 7  # of another episode
        alone, _ = rssm.observe(embed[:, seam:], action[:, seam:], first[:, seam:])
    assert close(pick(post, (slice(None), slice(seam, None))), alone)

@both_kinds
@given(seeds, st.integers(1, 5))
def test_filtering_is_causal_and_priors_do_not_see_their_own_image(kind, seed, t):
    """Row t's image changes posteriors from t, priors from t + 1; row t's action both from t on.
    The gradient goes all the way back, in the RSSM below too."""
    rssm, embed, action, first = window(seed, kind=kind)
    bump = torch.zeros(1, 6, 1)
    bump[:, t] = 3
    with no_noise():
        states = rssm.observe(embed, action, first)
        by_image = rssm.observe(embed + bump, action, first)
        by_action = rssm.observe(embed, action + bump, first)

    def change(kind, other):  # first row that differs
        gap = (states[kind]["mean"] - other[kind]["mean"]).abs().amax((0, 2)) > 1e-6
        return gap.nonzero()[0].item() if gap.any() else len(gap)
    assert [change(0, by_image), change(1, by_image)] == [t, t + 1]
    assert [change(0, by_action), change(1, by_action)] == [t, t]
    post, _ = rssm.observe(embed.requires_grad_(), action, first)
    for state in {"deter", "below"} & post.keys():
        gradient, = torch.autograd.grad(post[state][:, -1].sum(), embed, retain_graph=True)
        assert gradient[:, 0].any()

@pytest.mark.parametrize("method", ["diswm", "apv"])
@given(st.permutations(range(3)))
def test_permuting_the_batch_permutes_the_losses(method, order):
    """Windows do not see each other, neither as images nor as states."""
    torch.manual_seed(0)
    model, batch = diswm.WorldModel(tiny_config(method), 2), as_batch(fake_batch(3, 4))
    permuted = {name: value[list(order)] for name, value in batch.items()}
    with no_noise():
        losses, others = (model.frame_losses(model(rows), rows) for rows in (batch, permuted))
    for name, loss in losses.items():
        torch.testing.assert_close(others[name], loss[list(order)], rtol=1e-4, atol=1e-4)

def test_the_action_free_model_takes_no_actions():
    """Eq. (1): the same states whatever the batch says about actions; Eq. (4): not so."""
    cfg, batch = tiny_config(), as_batch(fake_batch(2, 4))
    changed = batch | {"action": batch["action"] + 1}
    without = {name: batch[name] for name in ("image", "is_first")}
    with no_noise():
        video, world = diswm.VideoPredictor(cfg), diswm.WorldModel(cfg, 2)
        assert torch.equal(video(batch)["feat"], video(without)["feat"])
        assert torch.equal(video(batch)["feat"], video(changed)["feat"])
        assert not torch.allclose(world(batch)["feat"], world(changed)["feat"])
    count = [sum(p.numel() for p in model.rssm.parameters()) for model in (video, world)]
    assert count[1] - count[0] == 2 * cfg.hidden  # the action's input weights

def test_the_recurrence_is_a_gru_cell_with_layer_norm():
    """One linear map and norm for reset, candidate, update; h' = u·c + (1 − u)·h, u = σ(x − 1)."""
    rssm, embed, action, _ = window(0)
    state = {key: torch.randn_like(x) for key, x in rssm.initial(3).items()}
    x = rssm.inputs(torch.cat([state["stoch"], action[:, 0]], -1))
    gates = rssm.gru(torch.cat([x, state["deter"]], -1))
    reset, candidate, update = torch.nn.functional.layer_norm(gates, (15,)).chunk(3, -1)
    update = torch.sigmoid(update - 1)
    candidate = torch.tanh(torch.sigmoid(reset) * candidate)
    expected = update * candidate + (1 - update) * state["deter"]
    torch.testing.assert_close(rssm.recur(state, action[:, 0]), expected)

def test_latents_are_sampled_not_means():
    """The β-VAE's 𝐳 and the RSSM's z_t, as the paper writes; the published code takes means."""
    cfg, batch = tiny_config(), as_batch(fake_batch(2, 3))
    for model in (diswm.VideoPredictor(cfg), diswm.WorldModel(cfg, 2)):
        one, two = model(batch), model(batch)
        assert torch.equal(one["code"]["mean"], two["code"]["mean"])
        assert not torch.allclose(one["code"]["embed"], two["code"]["embed"])
        assert not torch.allclose(one["post"]["mean"][:, 0], two["post"]["mean"][:, 0])  # q sees it
        assert not torch.allclose(one["post"]["stoch"], one["post"]["mean"])

def test_each_row_of_a_traversal_varies_one_latent():
    """Fig. 5: here one alone reaches the pictures, so no other row may change. Most nats first."""
    torch.manual_seed(0)
    cfg = tiny_config(z_dim=4)
    model, batch = diswm.VideoPredictor(cfg), as_batch(fake_batch(1, 3))
    with torch.no_grad():
        embed = model.rssm.post_net.net[0].weight[:, cfg.deter:]
        embed[:, [0, 1, 3]] = 0
        embed[:, 2] *= 9
    pictures, names = diswm.latent_traversal(model, batch, (-9, 0, 9))
    assert pictures.shape == (4, 4, 64, 64, 3)
    changing = [name[:2] for name, row in zip(names, pictures, strict=True)
                if np.ptp(row[1:], 0).any()]
    nats = [float(name.split()[1]) for name in names]
    assert changing == ["z2"] and nats == sorted(nats, reverse=True)

def test_open_loop_predicts_from_its_first_images_and_all_actions():
    """Later images appear as the truth alone; each action changes what follows it."""
    torch.manual_seed(0)
    model, batch = diswm.WorldModel(tiny_config(), 2), as_batch(fake_batch(1, 9))

    def predict(**changes):
        torch.manual_seed(0)
        return diswm.open_loop(model, batch | changes, context=5)
    truth, prediction, _ = predict()
    image, action = batch["image"].clone(), batch["action"].clone()
    image[:, 5:] = 0
    action[:, 7] += 9
    other, unchanged, _ = predict(image=image)
    assert (truth != other).any() and np.array_equal(prediction, unchanged)
    _, changed, _ = predict(action=action)
    differ = (prediction != changed).reshape(9, -1).any(1)
    assert not differ[:7].any() and differ[7:].all()

# === Baselines: stack, intrinsic bonus, weights carried over ======================================

@given(seeds)
def test_the_stack_is_an_action_free_rssm_under_one_that_sees_its_states(seed):
    """APV, section 4.2: q(s_t | s_{t−1}, a_{t−1}, z_t) on top of q(z_t | z_{t−1}, o_t).
    The state below is an action-free RSSM's of embed; the one above sees [embed, below]."""
    stack, embed, action, first = window(seed, kind="StackedRSSM")
    first[1, 3] = True
    with no_noise():
        post, prior = stack.observe(embed, action, first)
        below, _ = stack.below.observe(embed, None, first)
        feat = torch.cat([below["stoch"], below["deter"]], -1)
        above = diswm.RSSM(2, 4 + 3 + 5, stoch=3, deter=5, hidden=6)
        above.load_state_dict({k: x for k, x in stack.state_dict().items() if "below" not in k})
        states = above.observe(torch.cat([embed, feat], -1), action, first)
    assert torch.allclose(post["below"], feat, atol=1e-6)
    assert close(states[0], post) and close(states[1], prior)

def test_imagination_goes_on_without_the_rssm_below():
    """Its video-only state cannot be imagined under actions; only the upper one is (APV)."""
    agent, results = make_agent(tiny_config("apv")), []
    start = {key: torch.randn_like(x) for key, x in agent.model.rssm.initial(4).items()}
    for below in (start["below"], torch.randn_like(start["below"])):
        torch.manual_seed(0)
        results.append(agent.behaviour.imagine(agent.model, start | dict(below=below)))
    assert all(torch.equal(one, two) for one, two in zip(*results, strict=True))

class BonusOracle:
    """APV's bonus by brute force, in numpy: loops over windows, sorted distances, a plain list."""

    def __init__(self, projection, k, window, size, momentum):
        self.projection, self.k, self.window = projection.double().numpy(), k, window
        self.size, self.momentum, self.seen, self.scale = size, momentum, [], 1.0

    def __call__(self, feat):
        rows, length = feat.shape[0], feat.shape[1] - self.window + 1
        new = [feat[b, t:t + self.window].double().numpy().mean(0) @ self.projection
               for b in range(rows) for t in range(length)]
        self.seen = (new + self.seen)[:self.size]
        far = [np.mean(sorted(np.linalg.norm(x - y) for y in self.seen)[:self.k]) for x in new]
        self.scale = self.momentum * self.scale + (1 - self.momentum) * np.mean(far)
        return np.reshape(far, (rows, length)) / self.scale

@pytest.mark.parametrize("centre, spread, rtol", [(0, 1, 1e-4), (10, 0.01, 0.01)])
@given(seeds, sizes, st.integers(1, 4), st.integers(1, 40), sizes, st.integers(4, 7))
def test_the_bonus_is_the_normalised_mean_distance_to_the_k_nearest_neighbours(
        centre, spread, rtol, seed, k, window, size, batch, length):
    """Of window means, projected, among the newest of the queue, the batch at hand included; over
    four batches, so that the queue overflows. A float32 matrix product would lose distances a
    thousand times smaller than the states."""
    torch.manual_seed(seed)
    bonus = diswm.IntrinsicBonus(6, k, window, size, dims=4, momentum=0.9)
    oracle = BonusOracle(bonus.projection, k, window, size, 0.9)
    for _ in range(4):
        feat = centre + spread * torch.randn(batch, length, 6)
        np.testing.assert_allclose(bonus(feat).numpy(), oracle(feat), rtol=rtol, atol=1e-6)
        count = len(oracle.seen)
        np.testing.assert_allclose(bonus.queue[:count].numpy(), oracle.seen, rtol=1e-4, atol=1e-6)
        assert bonus.scale.item() == pytest.approx(oracle.scale, rel=1e-4)
        assert bonus.queue.shape == (size, 4) and bonus.queue[count:].isnan().all()

def test_the_bonus_is_data_with_apvs_constants():
    """k 16, windows of 5, 4096 entries of 128, projection of std 1/128, momentum 0.99, weight 0.1;
    a window too short for one of 5 is one itself."""
    torch.manual_seed(0)
    bonus = diswm.IntrinsicBonus(250)
    assert (bonus.k, bonus.window, bonus.momentum, *bonus.queue.shape) == (16, 5, 0.99, 4096, 128)
    assert METHODS["apv"]["bonus"] == 0.1 and not list(bonus.parameters())
    assert bonus.projection.std().item() == pytest.approx(1 / 128, rel=0.02)
    reward = bonus(leaf(torch.randn(3, 9, 250)))
    assert reward.shape == (3, 5) and not reward.requires_grad
    assert bonus(torch.randn(2, 3, 250)).shape == (2, 1)

@pytest.mark.parametrize("carry_over", ["stack", "none"])
def test_the_bonus_is_added_to_the_rewards_target_and_the_last_rows_have_none(carry_over):
    """r + 0.1 · bonus of s_t below, for the rows that begin a window of 5; the others train no
    reward. Without a stack it looks at the model's own states."""
    agent, seen = make_agent(tiny_config("apv", carry_over=carry_over)), {}
    fresh, loss = copy.deepcopy(agent.model.bonus), agent.model.loss

    def spy(out, batch, *args):
        seen.update(out=out, terms=agent.model.frame_losses(out, batch),
                    prediction=agent.model.reward(out["feat"])[:, :4, 0])
        return loss(out, batch, *args)
    agent.model.loss, data = spy, fake_batch()
    update(agent, data, 0.0, 0)
    out, reward = seen["out"], torch.from_numpy(data["reward"])[:, :4]
    bonus = fresh(out["post"]["below"] if carry_over == "stack" else out["feat"])
    error = 0.5 * (seen["prediction"] - reward - 0.1 * bonus)**2
    torch.testing.assert_close(seen["terms"]["reward"], error)
    assert seen["terms"]["discount"].shape == (3, 8)

@pytest.mark.parametrize("method, encoder", [
    ("dv2_finetune", "conv"), ("dv2_finetune", "beta_vae"), ("apv", "conv")])
def test_carried_weights_see_videos_as_the_predictor_did(method, encoder):
    """A predictor without actions fits one that gets zeros, or the RSSM below in any case."""
    cfg = tiny_config(method, encoder=encoder)
    video, world = diswm.VideoPredictor(cfg), diswm.WorldModel(cfg, 2)
    batch = as_batch(fake_batch(2, 4))
    world.carry_over(video)
    zeros = batch | dict(action=torch.zeros_like(batch["action"]))
    with no_noise():
        seen, states = video(batch), world(zeros)
        below = world(batch)["post"].get("below", states["feat"])
    assert torch.allclose(below, seen["feat"], atol=1e-4)
    assert torch.equal(world.decoder(seen["feat"]), video.decoder(seen["feat"]))

# === Graphs: what a GPU does, on a CPU ============================================================

class Tape(TorchDispatchMode):
    """torch.cuda.CUDAGraph's part: records the kernels of a call and where their results lie; a
    replay computes them anew, in the same places, from what lies there then."""
    READS = ("_local_scalar_dense", "nonzero", "masked_select", "normal.Tensor_Tensor")

    def __init__(self):
        super().__init__()
        self.kernels, self.recorded = [], False

    def __torch_dispatch__(self, kernel, types, args=(), kwargs=None):
        assert not any(name in str(kernel) for name in self.READS), f"{kernel} waits for the GPU"
        out = kernel(*args, **kwargs or {})
        if kernel.namespace == "aten":  # else a mark for the profiler
            self.kernels.append((kernel, args, kwargs or {}, out))
        return out

    @torch.no_grad()
    def replay(self):
        for kernel, args, kwargs, out in self.kernels if self.recorded else ():
            again = kernel(*args, **kwargs)
            for old, new in zip(tree_leaves(out), tree_leaves(again), strict=True):
                if old is not None and old.data_ptr() != new.data_ptr():
                    old.copy_(new)
        self.recorded = True  # to record computed it, unlike on a GPU

@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Makes what is Graphed take the GPU's way, in CPU memory, and count its function's calls."""
    for name, stand_in in dict(
            current_stream=lambda: None, CUDAGraph=Tape, graph=lambda tape, stream: tape).items():
        monkeypatch.setattr(torch.cuda, name, stand_in)

    def take(graphed):
        function, calls = graphed.function, []
        graphed.function = lambda inputs: calls.append(0) or function(inputs)
        graphed.device = "cpu:0"  # which is not "cpu"
        return calls
    return take

@pytest.mark.parametrize("method", METHODS)
def test_an_update_recorded_once_and_replayed_is_the_update_itself(method, as_on_a_gpu):
    """With other batches, η, noise and slow critics than when it was recorded: nothing in it reads
    a value, and nothing that changes is left outside. Adam's step count and APV's queue were."""
    cfg = tiny_config(method, slow_every=3, imagine_starts=9)
    plain, graphed = make_agent(cfg), make_agent(cfg)
    calls = as_on_a_gpu(graphed.update)
    for index in range(7):
        metrics = []
        for agent in plain, graphed:
            torch.manual_seed(index)
            metrics.append(update(agent, fake_batch(seed=index), 0.6 - 0.05 * index, index))
        torch.testing.assert_close(*metrics, rtol=1e-3, atol=1e-4)
    assert len(calls) == 4
    torch.testing.assert_close(plain.state_dict(), graphed.state_dict(), rtol=1e-3, atol=1e-4,
                               equal_nan=True)  # an empty queue

def test_a_decision_recorded_once_and_replayed_is_the_decision_itself(as_on_a_gpu):
    """By mode or by sample, over two episodes, with the state of the one forgotten; and results
    are no buffers that the next replay overwrites."""
    plain, graphed = make_agent(tiny_config("apv")), make_agent(tiny_config("apv"))
    calls, states, kept = as_on_a_gpu(graphed.decide), [None, None], []
    for index in range(9):
        row = {key: value[0, index % 8] for key, value in fake_batch(seed=index).items()}
        states = [None, None] if index == 6 else states
        for which, agent in enumerate((plain, graphed)):
            torch.manual_seed(index)
            action, states[which] = agent.act(row, states[which], explore=index % 2 == 0)
            kept.append(action)
        torch.testing.assert_close(*states)
    assert len(calls) == 4
    np.testing.assert_allclose(kept[::2], kept[1::2], rtol=1e-5, atol=1e-6)

def test_a_pretraining_recorded_once_and_replayed_is_the_same(root, as_on_a_gpu, tmp_path,
                                                             monkeypatch):
    """As an agent's update; the images of each call are its own."""
    calls = []

    class Recorded(diswm.Graphed):
        def __init__(self, function, device):
            super().__init__(function, device)
            calls.append(as_on_a_gpu(self))

    weights = []
    for folder in tmp_path / "plain", tmp_path / "graph":
        succeed("pretrain", *DEBUG, "--pretrain-updates", 6, "--runs", folder,
                "--videos", root / "runs/collect/cheetah_run/dreamerv2/seed0/episodes")
        run = folder / "pretrain/cheetah_run/diswm/seed0"
        weights.append(everything(run)["model"])
        monkeypatch.setattr(diswm, "Graphed", Recorded)
    assert [len(each) for each in calls] == [4]
    torch.testing.assert_close(*weights, rtol=1e-3, atol=1e-4)

@pytest.mark.parametrize("native, device, expected", [
    (True, "auto", ("cuda", "bf16")), (False, "cuda", ("cuda", "fp32")), (True, "cpu", ("cpu",))])
def test_a_gpu_is_taken_where_there_is_one_and_an_old_one_computes_in_fp32(
        native, device, expected, monkeypatch):
    """TF32 where it can; graphs want a stream of their own. The CPU's abilities do not matter, and
    older PyTorch cannot tell them."""
    called = []
    for name, answer in dict(is_available=True, is_bf16_supported=native, Stream="a stream",
                             set_stream=None).items():
        monkeypatch.setattr(torch.cuda, name, lambda *args, name=name, answer=answer, **kwargs: (
            called.append((name, *args)) or answer))
    monkeypatch.setattr(torch, "set_float32_matmul_precision", lambda *args: called.append(args))
    if expected[0] == "cuda":
        monkeypatch.delattr(torch.cpu, "get_capabilities")
    cfg = diswm.prepare_machine(Config(device=device, threads=torch.get_num_threads()))
    assert (cfg.device, cfg.precision)[:len(expected)] == expected
    assert (("set_stream", "a stream") in called) == (("high",) in called) == (cfg.device == "cuda")

@pytest.mark.parametrize("method", METHODS)
def test_update_and_decision_make_no_tensor_on_another_device(method, monkeypatch):
    """On PyTorch's meta device, whose tensors have no values to read and mix with no other's."""
    monkeypatch.setattr(diswm, "adam", lambda module, lr: torch.optim.Adam(module.parameters()))
    monkeypatch.setattr(torch, "autocast", lambda *args, **kwargs: contextlib.nullcontext())
    cfg = tiny_config(method, imagine_starts=9)
    object.__setattr__(cfg, "device", "meta")  # no choice of --device
    agent, batch = make_agent(cfg), fake_batch() | dict(eta=0.1, index=0)
    agent.update.function(batch)
    row = {key: value[0, :1] for key, value in batch.items() if key in ("image", "action")}
    state = agent.decide.function(row | dict(explore=True) | agent.model.rssm.initial(1))
    assert {x.device.type for x in state.values()} == {"meta"}
    monkeypatch.setattr(Normal, "rsample", lambda self: self.mean + torch.randn(self.mean.shape))
    with pytest.raises(RuntimeError, match="device"):
        agent.update.function(batch)

@pytest.mark.parametrize("actions", [0, 2])
def test_a_gru_cell_is_one_piece_for_the_compiler(actions, monkeypatch):
    """On a GPU torch.compile gets it: no break, for windows, imagination and acting."""
    monkeypatch.setattr(torch, "compile", functools.partial(
        torch.compile, backend="eager", fullgraph=True))
    rssm = diswm.VideoPredictor(tiny_config(device="cuda"), actions).rssm
    for batch, extra in ((3, {}), (24, dict(mean=torch.zeros(24, 3))), (1, {}), (3, {})):
        state = {key: torch.randn_like(x) for key, x in rssm.initial(batch).items()} | extra
        action = torch.randn(batch, actions)
        plain = diswm.RSSM.recur(rssm, state, action)
        torch.testing.assert_close(rssm.recur(state, action), plain)
    assert rssm.recur.__wrapped__ == diswm.RSSM.recur.__get__(rssm)

# === Replay =======================================================================================

ROWS = diswm.agent_row(action_dim=2)
FIELDS = dict(image=np.uint8, is_first=np.bool_, action=np.float32, reward=np.float32,
              discount=np.float32)

def numbered_rows(first, length, terminal=False):
    """An episode whose rows carry their number, `first` … `first + length − 1`, in every field."""
    rows = [dict(image=np.full((64, 64, 3), n % 251, np.uint8), action=np.float32([n, -n]),
                 reward=n / 2, discount=1.0, is_first=n == first)
            for n in range(first, first + length)]
    rows[-1]["discount"] -= terminal
    return rows

def rows_of(replay, start, length):
    """A window of a replay, over all episodes in it: dict of arrays."""
    pieces = list(replay.window(start, length))
    return {key: np.concatenate([piece[key] for piece in pieces]) for key in pieces[0]}

def assert_rows(arrays, rows):
    """The arrays hold these rows, field by field, in the dtypes of an episode."""
    for key, dtype in FIELDS.items():
        expected = np.array([row[key] for row in rows], dtype)
        assert arrays[key].dtype == dtype and np.array_equal(arrays[key], expected), key

class ReplayMachine(stateful.RuleBasedStateMachine):
    """Replay against a plain list of episodes: add, read, sample, reopen, go back."""

    @stateful.initialize()
    def start(self):
        self.tmp = tempfile.TemporaryDirectory()
        self.folder, self.count, self.episodes = Path(self.tmp.name) / "episodes", 0, []
        self.replay = Replay(self.folder, ROWS, device="cpu:0")
        self.saved = []

    @property
    def flat(self):
        return [row for episode in self.episodes for row in episode]

    @stateful.rule(length=st.integers(1, 9), terminal=st.booleans())
    def add(self, length, terminal):
        self.episodes.append(numbered_rows(self.count, length, terminal))
        self.replay.add(self.episodes[-1])
        self.count += length

    @stateful.precondition(lambda self: self.episodes)
    @stateful.rule(data=st.data())
    def read_a_window(self, data):
        start = data.draw(st.integers(0, len(self.flat) - 1))
        length = data.draw(st.integers(1, len(self.flat) - start))
        window = rows_of(self.replay, start, length)
        assert_rows(window, self.flat[start:start + length])

    @stateful.precondition(lambda self: self.episodes)
    @stateful.rule(data=st.data(), batch=st.integers(1, 4), seed=st.integers(0, 99))
    def draw_a_batch(self, data, batch, seed):
        """Of windows that lie in the replay; their first row is_first, and so is every seam. From
        the disk and from a device's copy they are the same."""
        length = data.draw(st.integers(1, len(self.flat)))
        windows, copies = (replay.sample(batch, length, seed)
                           for replay in (Replay(self.folder, ROWS), self.replay))
        for name, window in windows.items():
            assert np.array_equal(window, copies[name].numpy())
        numbers = [int(row["action"][0]) for row in self.flat]
        for b in range(batch):
            start = numbers.index(windows["action"][b, 0, 0])
            first, *rest = self.flat[start:start + length]
            window = {key: value[b] for key, value in windows.items()}
            assert_rows(window, [first | dict(is_first=True), *rest])

    @stateful.rule()
    def checkpoint(self):
        self.saved = list(self.episodes)

    @stateful.rule()
    def reopen(self):
        """A write that was cut off, into a file of another name, is no episode."""
        self.folder.mkdir(exist_ok=True)
        (self.folder / f"{len(self.episodes):06d}.npy.tmp").write_bytes(b"half")
        self.replay = Replay(self.folder, ROWS, device="cpu:0")

    @stateful.rule()
    def go_back_to_checkpoint(self):
        """A run that was cut off before its next checkpoint: later episodes go."""
        self.replay.keep(len(self.saved))
        self.episodes = list(self.saved)

    @stateful.invariant()
    def holds_the_same_rows_and_no_others(self):
        assert self.replay.bounds == [0, *np.cumsum([len(rows) for rows in self.episodes])]
        assert self.replay.paths == sorted(self.folder.glob("*.npy"))
        assert len(self.replay.paths) == len(self.episodes)

    def teardown(self):
        self.tmp.cleanup()

def test_replay_agrees_with_a_list_of_episodes_through_any_history(monkeypatch):
    """Windows, seams, order, save and load, going back."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (1e12, 1e12))
    stateful.run_state_machine_as_test(ReplayMachine, settings=settings(
        settings.get_profile("diswm"), max_examples=40, stateful_step_count=25))

def test_replay_reaches_every_start_and_no_other(tmp_path):
    """An off-by-one in the sampler loses the newest row for ever: windows start anywhere."""
    replay = Replay(tmp_path, ROWS)
    replay.add(numbered_rows(0, 7))
    replay.add(numbered_rows(7, 6))
    batch = replay.sample(600, 4, 0)
    starts, counts = np.unique(batch["action"][:, 0, 0].astype(int), return_counts=True)
    assert starts.tolist() == list(range(10)) and counts.min() > 30  # uniform: 60 each

def test_batches_of_a_full_gpu_are_read_ahead_and_the_same(tmp_path, monkeypatch):
    """They follow from seed, index and episodes alone, also right after an episode was added."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (3e9, 1e12))
    on_gpu, plain = Replay(tmp_path, ROWS, device="cpu:0"), Replay(tmp_path, ROWS)
    cfg, kept, read = tiny_config(seed=3), [], []
    monkeypatch.setattr(on_gpu.thread, "submit", lambda *args, real=on_gpu.thread.submit:
                        read.append(args[-1]) or real(*args))
    for index in range(8):
        if index % 3 == 0:
            on_gpu.add(numbered_rows(9 * index, 9))
            plain.append(on_gpu.paths[-1])
        kept.append(bool(on_gpu.copies))
        batches = (replay.batch(dataclasses.replace(cfg, device=device), index)
                   for replay, device in ((on_gpu, "cuda"), (plain, "cpu")))
        for one, two in zip(*(batch.values() for batch in batches), strict=True):
            assert np.array_equal(one, two)
    assert read == [[cfg.seed, index] for index in range(1, 9)]
    assert kept == [False] * 8 and not plain.ahead

def test_episodes_are_plain_arrays_of_which_none_may_be_missing(tmp_path):
    """Files that numpy opens and maps, without pickles, with these five fields. A run whose
    episodes were deleted must not go on with fewer."""
    replay, rows = Replay(tmp_path, ROWS), numbered_rows(0, 4, terminal=True)
    replay.add(rows)
    for mode in (None, "r"):
        file = np.load(tmp_path / "000000.npy", mmap_mode=mode, allow_pickle=False)
        assert_rows(file, rows)
    assert set(file.dtype.names) == set(FIELDS) and file["discount"].tolist() == [1, 1, 1, 0]
    (tmp_path / "000000.npy").unlink()
    with pytest.raises(UserError, match="--fresh"):
        Replay(tmp_path, ROWS).keep(1)

class CountingSimulator(FakeEnv):
    """Nothing but a counter: step n rewards n + action / 2; step 3, and no other, succeeds."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    mujoco_renderer = SimpleNamespace(default_cam_config=None)
    data = mujoco.MjData(model)

    def reset(self, *, seed=None, options=None):
        self.count, self.action = 0, -1.0
        return None, {}

    def step(self, action):
        self.count, self.action = self.count + 1, float(action[0])
        over, reward = self.count == self.length, self.count + self.action / 2
        return (None, reward, over and self.terminates, over and not self.terminates,
                {self.key: float(self.count == 3)})

class CountingEnv(diswm.DistractingEnv):
    """The production wrapper of it, whose pixel (0, 0) shows step and action of the simulator."""

    def __init__(self, length, repeat=2, **changes):
        simulator = CountingSimulator()
        vars(simulator).update(dict(length=length, terminates=False, key="success") | changes)
        super().__init__(simulator, "counting", "train", action_repeat=repeat)

    def render(self):
        image = np.zeros((64, 64, 3), np.uint8)
        image[0, 0, :2] = self.unwrapped.count, round((self.unwrapped.action + 1) * 100)
        return image

def assert_aligned(rows, repeat, length, terminates=False):
    """Row t: image[t], the action[t] and reward[t] that led to it; row 0 has zeros, is_first."""
    assert len(rows["reward"]) == -(-length // repeat) + 1
    for t, ((count, code, _), action) in enumerate(zip(
            rows["image"][:, 0, 0], rows["action"][:, 0].astype(float), strict=True)):
        steps = np.arange((t - 1) * repeat + 1, count + 1) if t else np.zeros(0)
        assert count == min(t * repeat, length) and rows["is_first"][t] == (t == 0)
        assert code == (round((action + 1) * 100) if t else 0)
        assert rows["reward"][t] == pytest.approx((steps + action / 2).sum(), abs=1e-4)
        assert rows["discount"][t] == (not terminates or count < length)
    assert not rows["action"][0].any()

@settings(max_examples=8)
@given(repeat=st.integers(1, 3), length=st.integers(9, 30), terminates=st.booleans())
def test_replay_rows_align_image_with_the_action_and_reward_that_led_to_it(
        repeat, length, terminates):
    """Through the production loop and action repeat; discount 0 in a terminal's row only."""
    cfg = tiny_config("dreamerv2", steps=2 * length, switch=1.0, prefill=3, train_every=3,
                      batch_length=3, eval_episodes=1)
    env = CountingEnv(length, repeat, terminates=terminates)
    with env, tempfile.TemporaryDirectory() as folder:
        run = train_fake(cfg, folder, env).run
        episodes = [np.load(path) for path in (run.folder / "episodes").iterdir()]
    assert len(episodes) == 2 and run.done.updates > 0  # the agent, not only prefill, has acted
    for rows in episodes:
        assert_aligned(rows, repeat, length, terminates)

@pytest.mark.parametrize("key", ["success", "is_success"])  # of Meta-World, of Fetch
@pytest.mark.parametrize("length, success", [(9, 1.0), (2, 0.0)])
def test_evaluation_sums_rewards_once_and_counts_success_at_any_step(length, success, key):
    """Success at step 3, the first of its decision's two: the last step alone misses it."""
    cfg = tiny_config("dreamerv2", eval_episodes=3)
    for agent in (None, make_agent(cfg)):
        with CountingEnv(length, key=key) as env:
            result, episode = diswm.evaluate_agent(cfg, env, agent, "train")
        rows = {name: np.array([row[name] for row in episode.rows]) for name in FIELDS}
        assert_aligned(rows, 2, length)
        assert result["returns"][-1] == pytest.approx(rows["reward"].sum())
        assert result["return"] == pytest.approx(np.mean(result["returns"]))
        assert len(result["returns"]) == 3 and result["success"] == success

def test_random_actions_are_not_the_simulators_own_random_numbers():
    """The bug it kills: of the same seed, the first one told where Pusher's cylinder stands."""
    action = diswm.Episode(FakeEnv(), 5, "train").env.action_space.sample()
    same, _ = gym.utils.seeding.np_random(5)
    assert np.abs(action - same.uniform(-1, 1, 2)).max() > 0.01

# === Environments =================================================================================

CENTERS = dict(train=(0.7, 0.3, 0.5), shifted=(0.5, 0.7, 0.3))

def play(env, seed, steps=4, phase=None, repeat=1):
    """Reset, then act at random, by the seed → a picture, a state and a reward of each row."""
    rng, data = np.random.default_rng(seed), env.unwrapped.data
    phase = phase or env.get_wrapper_attr("phase")
    results = [(env.reset(seed=seed, options=dict(phase=phase))[0], 0.0)]
    for _ in range(steps + 1):
        state = data.qpos.tobytes() + data.qvel.tobytes()
        yield results[-1][0], state, sum(result[1] for result in results)
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        results = [env.step(action) for _ in range(repeat)]

@pytest.mark.parametrize("task", sorted({*PAPER_TASKS, *diswm.FAMILIES, "drawer_close"}))
@pytest.mark.filterwarnings("ignore:.*The environment .* is different from the unwrapped version.*")
def test_every_task_is_a_gymnasium_env_with_64_by_64_pixels_and_bounded_actions(task):
    """Through the one stack; rewards of DMC are 0 … 1 per env step, and a decision has two."""
    with make_env(task, time_limit=20) as env:
        for picture, _, reward in play(env, 0):
            assert picture.shape == (64, 64, 3) and picture.dtype == np.uint8
            assert picture.std() > 5 and np.isfinite(reward)
            assert task not in TASKS or 0 <= reward <= 2
        assert (env.action_space.low == -1).all() and (env.action_space.high == 1).all()
        check_env(env, skip_render_check=True, skip_close_check=True)

@pytest.mark.parametrize("task", [*diswm.FAMILIES, "quadruped_escape", "HandManipulateBlock-v1"])
def test_same_seed_gives_the_same_whatever_was_played_before_and_another_seed_others(task):
    """The published code leaves its colours unseeded; Meta-World ignores reset(seed); quadruped has
    a new terrain, which only its own renderer shows; a hand's reset leaves its warm start."""
    with make_env(task, phase="shifted") as one, make_env(task, seed=3) as two:
        *_, other = play(two, 6, 15, phase="eval")
        for first, again in zip(play(one, 5), play(two, 5, phase="shifted"), strict=True):
            assert np.array_equal(first[0], again[0]) and first[1:] == again[1:]
            assert not np.array_equal(first[0], other[0])
        assert not np.array_equal(*(next(play(one, seed, phase="none"))[0].copy()
                                    for seed in (5, 6)))

@pytest.mark.parametrize("task", diswm.FAMILIES)
def test_each_phase_looks_different_and_none_is_the_task_as_it_is(task):
    """Returning to `none` restores everything; `eval` differs where a task keeps it apart. Tops
    of DrawerWorld, by colour: a blue grid, brown wood, grey metal; the rest stays."""
    def looks(env):
        model = env.unwrapped.model
        return np.concatenate([model.mat_rgba.flat, model.geom_rgba.flat, model.geom_matid])
    original, pictures = looks(diswm.bare_simulator(task)[0]), {}
    with make_env(task) as env:
        for phase in ("train", "shifted", "eval", "none"):
            pictures[phase] = env.reset(seed=3, options=dict(phase=phase))[0].astype(int)
            assert np.array_equal(looks(env), original) == (phase == "none")
    train, shifted, evaluation, none = views = pictures.values()
    for one, two in ((train, shifted), (train, none), (shifted, none)):
        assert np.abs(one - two).mean() > 2
    assert (shifted != evaluation).any() == (task == "drawer_open")
    if task == "drawer_open":
        grid, wood, metal, _ = (view[50:, 12:50].mean((0, 1)) for view in views)
        assert grid[2] > 1.3 * grid[0] and wood[0] > 1.3 * wood[2] and np.ptp(metal) < metal[0] / 9
        assert max(np.abs(view - none)[30:36, :12].mean() for view in views) < 10

def moving_share(task):
    """Which part of the picture can move, by MuJoCo's segmentation, at three episodes' starts."""
    shares, kinds = [], mujoco.mjtObj
    with make_env(task, phase="none") as env:
        env.renderer.enable_segmentation_rendering()
        model = env.unwrapped.model
        for picture, *_ in (row for seed in range(3) for row in [*play(env, seed, 4 * seed)][::4]):
            index, kind = np.moveaxis(picture, -1, 0)
            moves = kind == kinds.mjOBJ_SKIN
            for drawn, bodies in ((kinds.mjOBJ_GEOM, model.geom_bodyid),
                                  (kinds.mjOBJ_SITE, model.site_bodyid)):
                moves[kind == drawn] = model.body_weldid[bodies[index[kind == drawn]]] != 0
            shares.append(moves.mean())
    return np.mean(shares)

@pytest.mark.parametrize("task", [
    "acrobot_swingup", "ball_in_cup_catch", "cartpole_three_poles", "fish_swim", "quadruped_run",
    "pendulum_swingup", "swimmer_swimmer15", "Reacher-v5", "InvertedDoublePendulum-v5",
    "PointMaze_UMaze-v3", pytest.param("all", marks=slow)])
def test_the_agent_is_in_the_picture(task):
    """At least 1 % of it, but of dots in an arena, whose goal a closer camera would lose."""
    diswm.check_task("FetchReach-v4")  # registers the robotics ids
    newest = {spec.name: spec.id for spec in sorted(
        gym.registry.values(), key=lambda spec: spec.version or 0) if "Dense" not in spec.name
        and re.search(r"gymnasium(\.envs\.mujoco|_robotics)", str(spec.entry_point))}
    every = *TASKS, *diswm.OTHER_TASKS, *newest.values()
    for name in every if task == "all" else [task]:
        dot = name.startswith(("point_mass", "PointMaze"))
        assert moving_share(name) >= (0.0004 if dot else 0.01), name

def test_camera_names_one_of_the_tasks_cameras(tmp_path):
    """walker_walk's first one is "side"; the error says which there are."""
    with (make_env("walker_walk") as usual, make_env("walker_walk", camera="side") as side,
          make_env("walker_walk", camera="back") as back):
        assert (usual.render() == side.render()).all() and (usual.render() != back.render()).any()
    refuse("collect", "--src", "walker_walk", "--camera", "front", "--runs", tmp_path, *DEBUG,
           says="no camera 'front'; walker_walk has: side, back")

@pytest.mark.parametrize("task", ["drawer_open", "drawer_close", "FetchReach-v4"])
def test_first_picture_shows_what_the_reset_has_placed(task):
    """Meta-World moves the drawer, Fetch its goal, but MuJoCo drew them where they had been."""
    with make_env(task, phase="none") as env:
        for seed in range(3):
            picture = env.reset(seed=seed)[0].copy()
            mujoco.mj_forward(env.unwrapped.model, env.unwrapped.data)
            assert np.array_equal(picture, env.render())
        if task == "FetchReach-v4":
            goal = env.unwrapped.model.site("target0").id
            assert np.allclose(env.unwrapped.data.site_xpos[goal], env.unwrapped.goal)

def test_pusher_has_a_black_object_one_table_colour_and_one_arm_colour():
    """The published distractor."""
    with make_env("pusher") as env:
        for seed in range(5):
            env.reset(seed=seed)
            model = env.unwrapped.model
            colors = {tuple(model.geom(name).rgba[:3])
                      for name in ("uar", "ua", "ef", "sp", "fa", "sl", "e1", "e2")}
            assert len(colors) == 1 and tuple(model.geom("table").rgba[:3]) not in colors
            assert not model.geom_rgba[model.body("object").geomadr[0], :3].any()
            assert (np.abs(np.array(*colors) - CENTERS["train"]) <= 0.2 + 1e-6).all()

@pytest.mark.parametrize("task", ["HalfCheetah-v5", "FetchReach-v4", "Hopper-v5"])
def test_distractor_of_any_mujoco_task_changes_the_colors_that_mujoco_uses(task):
    """geom_rgba hides the material's colour unless it is (.5, .5, .5, 1)."""
    with make_env(task, phase="none") as env:
        model, picture = env.unwrapped.model, env.reset(seed=0)[0]
        own = (model.geom_matid < 0) | (model.geom_rgba != (0.5, 0.5, 0.5, 1)).any(1)
        shown = []
        for phase in ("none", "train"):
            env.reset(seed=0, options=dict(phase=phase))
            shown += [np.where(own[:, None], model.geom_rgba, model.mat_rgba[model.geom_matid])]
        assert (shown[0] != shown[1])[:, :3].any(1).all() and (shown[0] == shown[1])[:, 3].all()
        assert np.array_equal(env.reset(seed=0, options=dict(phase="none"))[0], picture)

def test_zero_color_range_around_the_originals_changes_no_pixel():
    """--colors original --color-range 0 is the task as it is."""
    with make_env("walker_walk", colors="original", color_range=0.0) as env:
        plain, zero = (next(play(env, 5, phase=phase))[0] for phase in ("none", "train"))
    with make_env("walker_walk") as env:
        assert np.array_equal(plain, zero) and not np.array_equal(plain, next(play(env, 5))[0])

@pytest.mark.parametrize("task", [*diswm.FAMILIES, "cartpole_swingup", "reacher_easy"])
def test_neither_the_distractor_nor_looking_changes_what_happens(task):
    """State and reward are bit-identical. The distractor's random stream is its own. Fetch puts
    its goal when it is looked at, which left another start to MuJoCo's solver."""
    with make_env(task, phase="none") as env, make_env(task, phase="train") as distracted:
        blind = [*play(env.env, 7, 10, "none", env.action_repeat)]  # the same one, undrawn
        for row, plain, seen in zip(blind, play(env, 7, 10), play(distracted, 7, 10), strict=True):
            assert row[1:] == plain[1:] == seen[1:]
            assert not np.array_equal(plain[0], seen[0])

@settings(max_examples=10)
@given(phase=st.sampled_from(["train", "shifted"]), half=st.floats(0.01, 0.6),
       seed=st.integers(0, 999), colors=st.sampled_from(["published", "original"]))
def test_colors_fill_the_box_of_their_phase(phase, half, seed, colors):
    """Boxes of ± range around (0.7, 0.3, 0.5) and (0.5, 0.7, 0.3), or around the originals."""
    with make_env("walker_walk", phase="none", colors=colors, color_range=half) as env:
        colors_now, draws = env.unwrapped.model.mat_rgba[:, :3], []
        original = colors_now.astype(float)
        for index in range(30):
            env.reset(seed=seed + index, options=dict(phase=phase))
            draws.append(colors_now.copy())
    centers = dict(train=original, shifted=original[:, [2, 0, 1]])
    center = np.array((centers if colors == "original" else CENTERS)[phase])
    low, high = np.clip(center - half, 0, 1), np.clip(center + half, 0, 1)
    assert (draws >= low - 1e-6).all() and (draws <= high + 1e-6).all()
    assert (np.ptp(draws, axis=0) > 0.5 * (high - low)).all()

@pytest.mark.parametrize("repeat", [1, 2, 5])
def test_action_repeat_sums_the_rewards_of_its_steps_once(repeat):
    """Against plain steps of the simulator. Published code: `reward += reward` doubles them; two
    wrappers apply the repeat twice."""
    raw, rng = diswm.DMControlEnv("walker", "walk"), np.random.default_rng(repeat)
    with raw, make_env("walker_walk", action_repeat=repeat) as env:
        raw.reset(seed=repeat)
        env.reset(seed=repeat)
        for _ in range(12):
            action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            _, reward, *_, info = env.step(action)
            rewards = [raw.step(action)[1] for _ in range(repeat)]
            assert reward > 0 and np.isclose(reward, sum(rewards), rtol=1e-9)
            assert (env.unwrapped.data.qpos == raw.data.qpos).all() and info["env_steps"] == repeat

@pytest.mark.parametrize("task, given, repeat, limit", [
    ("walker_walk", 7, 2, 7), ("walker_walk", 0, 30, 1000), ("pusher", 0, 30, 100),
    ("drawer_open", 0, 30, 200), ("FetchReach-v4", 0, 30, 50), ("HalfCheetah-v5", 8, 2, 8),
    ("walker_walk", 1010, 30, 1010), ("drawer_open", 510, 30, 510)])
def test_time_limit_counts_env_steps_and_is_no_terminal(task, given, repeat, limit):
    """By default the task's own. A repeat that it cuts short counts the steps that were made. The
    bug it kills: a limit above the simulator's own was cut to that, unsaid."""
    with make_env(task, time_limit=given, action_repeat=repeat) as env:
        env.reset(seed=0)
        steps, over = 0, False
        while not over:
            *_, terminated, truncated, info = env.step(env.action_space.sample())
            steps, over = steps + info["env_steps"], terminated or truncated
    assert steps == limit and truncated and not terminated

def test_gymnasium_finds_its_conventions_kept():
    """render_mode, decisions a second, a spec that goes through JSON; an unknown phase."""
    env = gym.make("DisWM/walker_walk-v0", render_mode="rgb_array", action_repeat=4, size=32)
    assert env.render_mode == "rgb_array" and env.metadata["render_fps"] == pytest.approx(10)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert np.array_equal(env.reset(seed=1)[0], again.reset(seed=1)[0])
    with pytest.raises(UserError, match="'nigth'.*train, shifted, eval, none"):
        env.reset(options=dict(phase="nigth"))
    assert env.reset(seed=1)[0].shape == (32, 32, 3)

def test_ten_envs_alive_at_once_do_not_mix_textures():
    """gymnasium's renderer forgets to switch GL contexts: one env gets the other's textures. Nor
    does a terrain, for which dm_control made a context of its own, that outlived close()."""
    kinds = [(task, phase) for task in diswm.FAMILIES for phase in ("train", "shifted")]
    alone = []
    for task, phase in kinds:
        with make_env(task, phase=phase) as env:
            alone.append([*play(env, 2, 2)])
    with make_env("quadruped_escape") as env:
        assert env.unwrapped.env.physics.contexts is None
        scene = env.renderer.scene  # the rangefinder's rays covered the picture
        assert mujoco.mjtGeom.mjGEOM_LINE not in [g.type for g in scene.geoms[:scene.ngeom]]
    with contextlib.ExitStack() as stack:
        plays = [zip(play(stack.enter_context(make_env(task, phase=phase)), 2, 2), rows,
                     strict=True) for (task, phase), rows in zip(kinds, alone, strict=True)]
        for i in np.random.default_rng(0).permutation([*range(len(kinds))] * 3):
            together, apart = next(plays[i])
            assert np.array_equal(together[0], apart[0]), kinds[i]

def test_registered_ids_work_in_other_processes(tmp_path, task="drawer_open"):
    """gymnasium.make after `import diswm`, and AsyncVectorEnv under spawn; no GL error at exit,
    not even of an environment that is left open."""
    script = tmp_path / "user.py"
    script.write_text(f"""
import gymnasium
def make():
    import diswm
    return gymnasium.make("DisWM/{task}-v0", phase="shifted", size=32, action_repeat=3)
if __name__ == "__main__":
    env, envs = make(), gymnasium.vector.AsyncVectorEnv([make], context="spawn")
    picture, _ = env.reset(seed=5)
    assert picture.shape == (32, 32, 3) and (envs.reset(seed=[5])[0][0] == picture).all()
    assert env.step(env.action_space.sample())[-1]["env_steps"] == 3
    envs.close()
""")
    done = subprocess.run([sys.executable, "-W", "ignore", script], capture_output=True, text=True,
                          env=os.environ | dict(PYTHONPATH=str(Path(diswm.__file__).parent)))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert {f"DisWM/{name}-v0" for name in PAPER_TASKS} <= gym.registry.keys()

FIRST = "import mujoco, dm_control.suite, gymnasium.envs.mujoco.mujoco_rendering, diswm"

@pytest.mark.parametrize("gl, argv, code", [
    (None, ["-c", f"{FIRST}; diswm.make_env('walker_walk')"], 0),
    *((gl, [diswm.__file__, "doctor", "walker_walk"], gl != " EGL")
      for gl in (" EGL", "bogus", "glfw"))])
def test_any_mujoco_gl_and_order_of_imports_works_or_is_one_line(gl, argv, code, tmp_path):
    """Without a display: EGL, or one line that names it; no traceback, at the end either."""
    unset = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY")
    env = {name: value for name, value in os.environ.items() if name not in unset}
    env |= dict(PYTHONPATH=str(README.parent)) | (dict(MUJOCO_GL=gl) if gl else {})
    done = subprocess.run([sys.executable, "-W", "ignore", *argv], capture_output=True, text=True,
                          env=env, cwd=tmp_path)
    assert done.returncode == code == done.stderr.count("\n"), done.stderr
    assert ("export MUJOCO_GL=egl" in done.stderr) == code

def test_a_forked_process_says_what_to_do_instead_of_hanging():
    """gymnasium.make_vec(…, vectorization_mode="async") forks by default: OpenGL hung there."""
    with (pytest.raises(UserError, match='context="spawn"'),
          multiprocessing.get_context("fork").Pool(1) as pool):
        pool.apply_async(make_env, ("walker_walk",)).get(20)

@pytest.mark.parametrize("cut", [2, 3, 4, 99])
@pytest.mark.parametrize("switch, after", [(0.5, "shifted"), (1.0, "train")])
def test_colors_switch_exactly_once_at_the_midpoint_of_a_live_run(switch, after, cut, tmp_path):
    """At half of the env steps, where the running episode ends; or never. A switch that fires on
    `step == midpoint` is lost, or fires twice, when a run is cut there and goes on."""
    cfg = tiny_config("dreamerv2", steps=100, switch=switch, prefill=1000, eval_episodes=1)
    with make_env("walker_walk", time_limit=20) as env:
        rows, seen, reset, colors = [], [], env.reset, env.unwrapped.model.mat_rgba[:, :3]
        env.reset = lambda **kw: (reset(**kw), seen.append((env.phase, colors.mean(0))))[0]
        for stop_after in (cut, None):
            rows += train_fake(cfg, tmp_path, env, stop_after=stop_after).rows
    ends = [20, 40, 50, 70, 90, 100] if switch < 1 else [20, 40, 60, 80, 100]
    phases = ["train" if end <= 50 else after for end in ends]
    assert [(row["step"], row["phase"]) for row in rows] == list(zip(ends, phases, strict=True))
    assert [phase for phase, _ in seen] == [*phases, after]  # the last one is an evaluation
    assert len({color.tobytes() for _, color in seen}) == len(seen)  # new ones in each episode
    assert all(np.abs(color - CENTERS[phase]).max() < 0.15 for phase, color in seen)

# === Stage transitions ============================================================================

def at_start(stage, cfg):
    """Go through a stage to the point where training would start → (Run, what it would train)."""
    def start(run, unit, total, **parts):
        found.extend((run, parts))
        raise Stop
    found = []
    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(Stop):
        patch.setattr(diswm.Run, "start", start)
        stage(cfg)
    return found

@pytest.fixture(scope="session")
def files(root, teacher, tmp_path_factory):
    """What a stage may be given, right and wrong, by name. conv: a video predictor without latents,
    for apv and dv2_finetune; half: a teacher that is not finished; set: what collect made."""
    folder, state = tmp_path_factory.mktemp("files"), torch.load(teacher)
    state["finished"] = False
    torch.save(state, folder / "half.pt")
    videos = root / "runs/collect/cheetah_run/dreamerv2/seed0/episodes"
    cfg = tiny_config("apv", runs=str(folder), videos=str(videos))
    return dict(teacher=teacher, conv=diswm.pretrain(cfg) / "checkpoint.pt", video=teacher.parent,
                half=folder / "half.pt", policy=videos.with_name("checkpoint.pt"), set=videos)

PRETRAIN = "run: python diswm.py pretrain --src cheetah_run --method {} --seed 0 --runs {},"
REFUSED = {  # why: (the command's words, what it says)
    "no teacher": ("finetune", PRETRAIN.format("diswm", "runs")),
    "none in these runs": ("finetune --runs else/where", PRETRAIN.format("diswm", "else/where")),
    **{f"no teacher of {method}": (f"finetune --method {method}", PRETRAIN.format(method, "runs"))
       for method in ("no_disentangle", "dv2_finetune", "apv")},
    "no such teacher": ("finetune --teacher lost.pt", "lost.pt"),
    "teacher unfinished": ("finetune --teacher {half}", PRETRAIN.format("diswm", "runs")),
    "policy as teacher": ("finetune --teacher {policy}", PRETRAIN.format("diswm", "runs")),
    "another source": ("finetune --src pusher --teacher {teacher}", "add --src cheetah_run"),
    "other latents": ("finetune --z-dim 10 --teacher {teacher}", "add --z-dim 20"),
    "no latents": ("finetune --encoder conv --teacher {teacher}", "add --encoder beta_vae"),
    "weights": ("finetune --carry-over weights --hidden 7 --teacher {teacher}", "add --hidden 10"),
    "source is target": ("finetune --dst cheetah_run --teacher {teacher}", "both cheetah_run"),
    "discrete actions": ("finetune --dst CartPole-v1 --teacher {teacher}", "continuous actions"),
    "no videos": ("pretrain --videos .", "results/import_videos.py"),
    "no run to evaluate": ("evaluate --run lost", "python diswm.py finetune"),
    "no policy to evaluate": ("evaluate --run {video}", "give a finetune run"),
    "no run to traverse": ("traverse --run lost", "python diswm.py finetune"),
}

@pytest.mark.parametrize("why", REFUSED)
def test_a_refused_start_says_in_one_line_what_is_missing_and_leaves_no_folder(
        why, files, tmp_path, monkeypatch):
    """collect → pretrain → finetune → evaluate: none starts without the right one before."""
    monkeypatch.chdir(tmp_path)
    words, says = REFUSED[why]
    words = words.format(**files).split()
    refuse(*words, *(DEBUG if words[0] not in ("evaluate", "traverse") else ()), says=says)
    assert not list(tmp_path.iterdir())

def test_teacher_and_student_of_one_seed_start_apart(files, tmp_path):
    """The bug it kills: with the same first weights, their latents were aligned one by one (r = .3
    after 1 000 updates of the teacher, .0 for any other seed) before Eq. (3) had done anything."""
    cfg = tiny_config(runs=str(tmp_path), teacher=str(files["teacher"]), videos=str(files["set"]))
    def encoder(stage, name):
        part = at_start(stage, cfg)[1][name]
        weights = getattr(part, "model", part).encoder.parameters()
        return torch.cat([weight.detach().flatten() for weight in weights if weight.ndim > 1])
    one, two = ((encoder(diswm.pretrain, "model"), encoder(diswm.finetune, "agent"))
                for _ in range(2))
    assert torch.equal(one[0], two[0]) and torch.equal(one[1], two[1])
    assert torch.cosine_similarity(*one, dim=0).abs() < 0.1

@pytest.mark.parametrize("method", METHODS)
def test_collecting_is_dreamerv2_whichever_method_asks_for_videos(method, tmp_path):
    """One video set serves all methods: nothing of theirs may reach the agent that collects."""
    (run, parts), (plain, others) = (at_start(diswm.collect, tiny_config(name, runs=str(tmp_path)))
                                     for name in (method, "dreamerv2"))
    assert run.cfg == plain.cfg and run.folder == plain.folder
    assert run.cfg.switch == 1 and run.cfg.eta == 0 and parts["agent"].teacher is None
    assert same(parts["agent"], snapshot(others["agent"]))

def test_other_seeds_and_other_pretrainings_reuse_one_finished_video_set(files, tmp_path):
    """The bugs it kills: a pretraining with other latents was refused, as the collecting had been
    started with another z_dim; and one with another seed took an unfinished set."""
    sets = tmp_path / "collect/cheetah_run/dreamerv2"
    shutil.copytree(files["set"].parent, sets / "seed0")
    argv = ("pretrain", "--runs", tmp_path, *DEBUG, "--pretrain-updates", 2)
    said = succeed(*argv, "--z-dim", 10) + succeed(*argv, "--seed", 1)
    assert said.count(f"--videos {sets / 'seed0/episodes'} of sha256") == 2
    refuse(*argv, "--seed", 0, "--tag", "x", "--colors", "original",
           says="--colors published (now original)")  # else it trains on the wrong videos
    assert [path.name for path in sets.iterdir()] == ["seed0"]
    state = torch.load(sets / "seed0/checkpoint.pt")
    state["finished"] = False
    torch.save(state, sets / "seed0/checkpoint.pt")
    assert f"--videos {sets / 'seed2/episodes'} of" in succeed(*argv, "--seed", 2)

def test_other_seeds_and_targets_reuse_one_teacher_but_prefer_their_own(teacher, tmp_path):
    """Only what it gives has to fit: with distillation alone, the student's RSSM is its own."""
    found, pretrained = [0, 0, 3, 0], tmp_path / "pretrain/cheetah_run/diswm"
    for seed in set(found):
        shutil.copytree(teacher.parent, pretrained / f"seed{seed}")
    for seed, changes in zip(found, ({}, dict(seed=1, dst="pusher"), dict(seed=3),
                                     dict(stoch=7, hidden=8)), strict=True):
        path, _ = diswm.find_teacher(tiny_config(runs=str(tmp_path), **changes))
        assert path == pretrained / f"seed{seed}/checkpoint.pt"

@pytest.mark.parametrize("method, carry_over", [
    ("diswm", "none"), ("diswm", "stack"), ("dv2_finetune", "weights"), ("apv", "stack")])
def test_exactly_the_named_weights_come_from_the_pretraining_and_the_rest_is_fresh(
        method, carry_over, files, tmp_path):
    """From 6 actions to 1, at update 0. The teacher is the video predictor's encoder. Where
    weights are carried over, encoder, decoder and RSSM (in a stack, the one below) are the video
    predictor's too. All else, input weights of actions among it, is an untrained agent's."""
    path = files["conv" if METHODS[method] else "teacher"]
    cfg = tiny_config(method, dst="cartpole_swingup", runs=str(tmp_path), teacher=str(path),
                      carry_over=carry_over, bonus=0.1 if carry_over == "stack" else 0.0)
    found = at_start(diswm.finetune, cfg)[1]["agent"].state_dict()
    video, expected, taken = torch.load(path)["model"], make_agent(cfg, 1).state_dict(), []
    if method == "diswm":
        taken += [(name.replace("encoder.", "teacher."), value) for name, value in video.items()
                  if name.startswith("encoder.")]
    if carry_over != "none":
        below = "rssm.below." if carry_over == "stack" else "rssm."
        taken += [("model." + name.replace("rssm.", below), video[name]) for name in video]
    for name, value in taken:
        assert expected[name].shape == value.shape or name == "model.rssm.inputs.0.weight"
        expected[name][..., :value.shape[-1]] = value
    assert taken and found.keys() == expected.keys()
    assert_identical(dict(found), dict(expected))

def test_pretraining_learns_from_images_and_where_episodes_begin_alone(files, tmp_path):
    """From collect to pretrain goes exactly the video: no action, no reward, whatever they are."""
    for path in sorted(files["set"].iterdir()):
        rows = np.load(path)
        assert set(rows.dtype.names) == set(FIELDS) and rows["reward"].any()
        Replay(tmp_path / "bare").add(rows)
    one, two = (torch.load(diswm.pretrain(tiny_config(
        runs=str(tmp_path / videos.name), videos=str(videos), pretrain_updates=3)) /
        "checkpoint.pt")["model"] for videos in (tmp_path / "bare", files["set"]))
    assert one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)

def schedule(cfg, folder, env):
    """Train in FakeEnv without learning → (decisions before which the agent acted, and of each
    update: decisions until then, rows in the replay, its index, its η)."""
    acted, updates, act, sample = [], [], diswm.Agent.act, Replay.sample
    def counted_act(agent, *args, explore):
        acted.extend([env.count] if explore else [])  # else in an evaluation
        return act(agent, *args, explore)
    def counted_sample(replay, *args):
        updates.append((env.count, replay.bounds[-1]))
        return sample(replay, *args)
    def update(agent, batch):
        updates[-1] += batch["index"], batch["eta"]
        return dict(loss=torch.zeros(()))
    cfg = dataclasses.replace(cfg, steps=100, switch=1.0, eval_episodes=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diswm.Agent, "act", counted_act)
        patch.setattr(diswm.Agent, "update", update)
        patch.setattr(Replay, "sample", counted_sample)
        train_fake(cfg, folder, env)
    return acted, updates

@given(prefill=st.integers(0, 35), first=st.integers(1, 4), every=st.integers(1, 6),
       length=st.integers(2, 25), delay=st.integers(-1, 40), decay=st.integers(5, 60),
       dst=st.sampled_from(["walker_walk", "pusher", "drawer_open", "FetchReach-v4"]))
@example(prefill=15, first=3, every=5, length=8, dst="pusher", delay=-1, decay=20)
@example(prefill=20, first=3, every=5, length=8, dst="walker_walk", delay=-1, decay=20)
def test_prefill_then_first_updates_then_steady_state_on_a_live_eta(
        prefill, first, every, length, dst, delay, decay):
    """The published schedule. η counts live decisions, prefill included: delay, decay, floor. The
    bugs it kills: the published code copies the step once, so η stays at 0.095, across domains at
    0; learning began before the second of two random episodes was stored."""
    cfg = tiny_config("diswm", dst=dst, prefill=prefill, first_updates=first, train_every=every,
                      batch_length=length, eta_delay=delay, eta_decay=decay, eta=0.1, eta_end=0.01)
    with tempfile.TemporaryDirectory() as folder:
        acted, updates = schedule(cfg, folder, FakeEnv())
    # Episodes have ten decisions, so eleven rows. Random ones are whole and hold a window.
    start = next(n for n in range(0, 99, 10) if n >= prefill and n // 10 * 11 >= length)
    due = [n for n in range(start + 1, 51) if n % every == 0]
    due = due[:1] * first + due[1:]
    assert acted == list(range(start, 50))
    assert [update[:3] for update in updates] == [
        (n, (n - 1) // 10 * 11, index) for index, n in enumerate(due)]
    if delay < 0:
        delay = 0 if dst == "walker_walk" else decay  # across domains it waits
    for decisions, *_, eta in updates:
        expected = 0 if decisions < delay else max(0.1 * (1 - (decisions - delay) / decay), 0.01)
        assert eta == pytest.approx(expected)

@pytest.mark.parametrize("steps, short", [(118, True), (120, False)])
def test_a_run_too_short_for_an_update_warns_at_its_start(
        steps, short, tmp_path, caplog, monkeypatch):
    """50 decisions of prefill, an update per 10. Nor does a clock set back make rates negative."""
    caplog.set_level("INFO", "diswm")
    monkeypatch.setattr("tqdm.std.time", itertools.count(1e9, -60).__next__)
    run = train_fake(tiny_config("dreamerv2", steps=steps, eval_episodes=1), tmp_path).run
    assert ("warning: --steps end" in caplog.messages[1]) == short == (run.done.updates == 0)
    assert min(row["rate"] for row in log_rows(run.folder)) > 0

# === The tests bite: a real bug of the method put back makes its test fail ========================

def teacher_in_the_optimiser(real, agent, cfg, action_dim):
    """The published code: the teacher's gradients on, its weights in the model's optimiser."""
    real(agent, cfg, action_dim)
    agent.teacher.requires_grad_(True)
    together = torch.nn.ModuleList([agent.model, agent.teacher])
    agent.optimizers["model"] = diswm.adam(together, cfg.model_lr)

def teacher_trained_too(real, z_disen, z_task):
    """A distillation loss without the stop-gradient."""
    log_p, log_q = z_disen.log_softmax(-1), z_task.log_softmax(-1)
    return (log_p.exp() * (log_p - log_q)).sum((-1, -2)).mean()

def the_old_actor(real, behaviour, feat):
    """The published normal around tanh(m)."""
    behaviour.cfg = dataclasses.replace(behaviour.cfg, actor="clipped")
    return real(behaviour, feat)

def free_nats_first(real, post, prior, balance, free_nats):
    """Free nats on every step, before the mean."""
    value = real(post, prior, balance, free_nats)[1]
    return value.clamp(min=free_nats).mean(), value

def action_kept(real, rssm, state, action, embed, keep):
    """`is_first` forgets the state, but not the action of another episode."""
    state = {key: x * keep for key, x in state.items()}
    return real(rssm, state, action, embed, torch.ones_like(keep))

def steps_weighted(*weights):
    """Action repeat that makes a step for each weight, and sums rewards by them."""
    def step(real, env, action):
        results = [env.env.step(action) for _ in weights]
        reward = sum(weight * result[1] for weight, result in zip(weights, results, strict=True))
        return env.render(), reward, *results[-1][2:4], dict(env_steps=2)
    return step

repeat = test_action_repeat_sums_the_rewards_of_its_steps_once, 2
distillation = (
    test_distillation_is_equation_3_summed_over_time_and_averaged_over_the_batch, 0, 2, 3, 5)
returns = test_lambda_return_is_the_mixture_of_all_n_step_returns_in_time_order, 0, 5, 3, 0.95
losses = test_actor_and_critic_losses_are_those_of_appendix_b, 0, 0.6
seam = test_is_first_forgets_the_state_and_the_previous_action, "RSSM", 0, 3
METHOD_BUGS = {  # name: what is patched; the bug; the tests that must fail, and their arguments
    "teacher in the optimiser": (
        "Agent.__init__", teacher_in_the_optimiser,
        (test_teacher_bytes_are_unchanged_by_updates_and_in_no_optimiser,)),
    "teacher trained by the loss": ("distillation_loss", teacher_trained_too, distillation),
    "distillation averaged over time": (
        "distillation_loss", lambda real, p, q: real(p, q) / p.shape[1], distillation),
    "distillation in the wrong direction": (
        "distillation_loss", lambda real, p, q: real(q, p), distillation),
    "eta stuck at its first step": (
        "eta_schedule", lambda real, step, *args: real(0, *args),
        (test_prefill_then_first_updates_then_steady_state_on_a_live_eta,
         20, 3, 5, 8, "walker_walk", -1, 20)),
    "v_t for v_{t+1}": (
        "lambda_return", lambda real, r, v, d, b, l:
        real(r, torch.cat([v[:1], v[:-1]]), d, v[-1], l), returns, losses),
    "reversed returns": (
        "lambda_return", lambda real, *args: real(*args).flip(0), returns, losses),
    "returns that go on after the end": (
        "lambda_return", lambda real, r, v, d, b, l: real(r, v, d * 0 + 0.99, b, l),
        returns, losses),
    "actions that learn nothing from where they lead": (
        "ActorCritic.squash", lambda real, self, x: tuple(y.detach() for y in real(self, x)),
        (test_an_actor_learns_to_do_what_a_known_reward_asks_for, 1.0, 0)),
    "the old actor, which one side can hold for good": (
        "ActorCritic.policy", the_old_actor,
        (test_an_actor_on_the_wrong_side_always_learns_that_it_is, 20.0, 1)),
    "the old actor, which starts at one side": (
        "ActorCritic.policy", the_old_actor,
        (test_an_actor_learns_to_do_what_a_known_reward_asks_for, 1.0, 8)),
    "unclipped action": (
        "ActorCritic.squash", lambda real, self, x: (x, torch.zeros_like(x)),
        (test_acted_and_imagined_actions_stay_inside_the_bounds, "clipped")),
    "plain clamp of an action": (
        "ActorCritic.squash",
        lambda real, self, x: (x.clamp(1e-6 - 1, 1 - 1e-6), torch.zeros_like(x)),
        (test_clipped_actions_stay_in_bounds_and_keep_their_gradient, [-9.0, 0.5, 9.0])),
    "unclipped gradient": (
        "descend", lambda real, loss, optimizer, clip: real(loss, optimizer, 1e9),
        (test_a_step_is_clipped_adam_on_the_optimisers_own_weights_and_no_others, 1e-2)),
    "free nats before the mean": (
        "rssm_kl_loss", free_nats_first,
        (test_the_kl_loss_is_the_batch_mean_or_the_free_nats_if_they_are_more, 0, 3, 3, 0.8, 3.0)),
    "KL balance the wrong way round": (
        "rssm_kl_loss", lambda real, q, p, balance, free: real(q, p, 1 - balance, free),
        (test_kl_gradient_is_split_balance_to_the_prior_and_the_rest_to_the_posterior, 0, 1.0, -1)),
    "means for samples": (
        "Normal.rsample", lambda real, self: self.mean, (test_latents_are_sampled_not_means,)),
    "state kept across a seam": ("RSSM.step", lambda real, *args: real(*args[:-1], 1), seam),
    "action kept across a seam": ("RSSM.step", action_kept, seam),
    "doubled reward": ("DistractingEnv.step", steps_weighted(2, 2), repeat),
    "doubled repeat": ("DistractingEnv.step", steps_weighted(1, 1, 1, 1), repeat),
    "the last step's reward alone": ("DistractingEnv.step", steps_weighted(0, 1), repeat)}

@pytest.mark.parametrize("bug", METHOD_BUGS)
def test_a_planted_bug_of_the_method_is_caught(bug, monkeypatch):
    """The real tests pass, and each fails once the bug is in the production function."""
    name, plant, *tests = METHOD_BUGS[bug]
    *owner, attribute = name.split(".")
    owner = getattr(diswm, owner[0]) if owner else diswm
    real = getattr(owner, attribute)
    for outcome in (contextlib.nullcontext(), pytest.raises(AssertionError)):
        for test, *args in tests:
            with outcome:  # of the test itself: hypothesis would look for its own examples
                getattr(getattr(test, "hypothesis", None), "inner_test", test)(*args)
        monkeypatch.setattr(owner, attribute, lambda *args: plant(real, *args))

# === System: one whole pipeline ===================================================================

TERMS = {
    "image", "reward", "discount", "kl_loss", "kl", "disentangle", "distill", "eta", "actor",
    "critic", "actor_entropy", "actor_slope", "actor_spread", "actor_std", "actor_saturated",
    "value_correlation", "value", "imagined_reward", "imagined_return", "model_grad_norm",
    "actor_grad_norm", "critic_grad_norm", "train_return", "eval_return", "eval_std", "rate"}
COLLECTED = "collect/cheetah_run/dreamerv2/seed0"
PRETRAINED = "pretrain/cheetah_run/diswm/seed0"
FINETUNED = "finetune/cheetah_run-walker_walk/diswm/seed0"
ONE = ("--threads", 1)  # more crawl beside another process

def log_rows(run):
    """metrics.jsonl as a list of dicts."""
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]

def all_files(folder):
    """What each file of a folder holds."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

def check_picture(path, low=100):
    """The file opens as a picture of sane size that is not of one colour."""
    picture = iio.imread(path)
    assert min(picture.shape[:2]) >= low and max(picture.shape[:2]) < 4000 and picture.std() > 5

@pytest.fixture
def copied(finished, tmp_path):
    """A copy of the finished finetuning, in tmp_path as its --runs."""
    return Path(shutil.copytree(finished, tmp_path / FINETUNED))

@pytest.fixture
def workdir(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path

def test_pipeline_logs_every_loss_term_counts_env_steps_and_switches_once(finished):
    """All numbers are finite. Steps in logs are simulator steps: repeat × decisions; 300 of them,
    half in each phase."""
    rows = log_rows(finished)
    assert {key for row in rows for key in row} >= TERMS
    assert all(np.isfinite(value).all() for row in rows for value in row.values()
               if not isinstance(value, str))
    assert [row["step"] for row in rows] == [50, 100, 150, 200, 250, 300]
    assert all(row["step"] == row["env_steps"] == 2 * row["decisions"] for row in rows)
    assert [row["phase"] for row in rows] == ["train"] * 3 + ["shifted"] * 3
    assert [row["step"] for row in rows if "eval_return" in row] == [100, 200, 300]
    assert [row["eval_step"] for row in rows if "eval_return" in row] == [100, 200, 300]

def test_pipeline_evaluates_and_draws(finished, teacher, root):
    """pretrain → finetune → evaluate → traverse on real DMC leaves files that open."""
    out = succeed("evaluate", *ONE, "--run", finished / "checkpoint.pt")
    result = json.loads((finished / "evaluation.json").read_text())
    assert (result["task"], result["phase"], result["step"]) == ("walker_walk", "shifted", 300)
    for name in ("", "sampled_", "random_"):
        returns = result[f"{name}returns"]
        assert len(returns) == 2 and result[f"{name}return"] == pytest.approx(np.mean(returns))
        assert result[f"{name}std"] == pytest.approx(np.std(returns))
    assert len({result[f"{name}return"] for name in ("", "sampled_", "random_")}) == 3
    assert f"return {result['return']:.1f} ± {result['std']:.1f}" in out
    video = iio.imread(finished / "evaluation.mp4")
    assert video.shape[1:] == (256, 256, 3) and 24 <= len(video) <= 28 and video.std() > 5
    collected = root / "runs" / COLLECTED
    for run in (finished, teacher.parent, collected):
        succeed("traverse", *ONE, "--run", run)
        check_picture(run / "open_loop.png")
        check_picture(run / "film.png", low=100)
        if run != collected:  # DreamerV2 has no latents
            check_picture(run / "traversal.png", low=500)
            assert iio.imread(run / "traversal.mp4").shape[0] == len(diswm.TRAVERSAL)
    for name in ("open_loop", "traversal"):
        images = EventAccumulator(str(finished), dict(images=0)).Reload().Images(name)
        assert [image.step for image in images] == [100, 200, 300]

def test_a_finished_run_continued_does_nothing(copied, tmp_path):
    """The same command run again resumes where it stopped: at the end. config.json is for people:
    garbage in it changes nothing, as the checkpoint holds the Config."""
    (copied / "config.json").write_text("{garbage")
    before = all_files(copied)
    succeed("finetune", "--dst", "walker_walk", "--runs", tmp_path, *DEBUG)
    succeed("traverse", *ONE, "--run", copied)
    after = all_files(copied)
    assert {path: after[path] for path in before} == before
    assert {path.name.split(".tfevents")[0] for path in after.keys() - before.keys()} <= {
        "events.out", "film.png", "open_loop.png", "traversal.png", "traversal.mp4"}
    origin, = map(json.loads, (copied / "provenance.jsonl").read_text().splitlines())
    _, path, *_, digest = origin["teacher"].split()  # --teacher PATH of sha256 …
    assert hashlib.sha256(Path(path).read_bytes()).hexdigest().startswith(digest)

def test_a_tagged_run_says_where_it_came_from_and_goes_to_wandb(teacher, root, monkeypatch):
    """The plain method's teacher serves it. wandb is imported only then, before events."""
    run, calls = root / "runs" / FINETUNED.replace("diswm", "diswm+x"), []
    argv = ("finetune", "--runs", root / "runs", *DEBUG, "--tag", "x", "--steps", 50, "--wandb", 1)
    monkeypatch.setitem(sys.modules, "wandb", None)  # as if it were not installed
    refuse(*argv, says="wandb")
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=lambda **given: calls.append(
        (given["project"], given["sync_tensorboard"], list(run.glob("events*"))))))
    succeed(*argv)
    assert calls == [("1", True, [])]
    _, origin = map(json.loads, (run / "provenance.jsonl").read_text().splitlines())
    git = ["git", "-C", README.parent, "describe", "--always", "--dirty"]
    commit = subprocess.run(git, capture_output=True, text=True).stdout.strip()
    assert origin["commit"] == commit  # "": no repository
    assert origin["torch"] == torch.__version__ and os.uname().release in origin["machine"]

def test_other_flags_are_refused_with_their_names(copied, tmp_path):
    """A resumed run must not silently change what it computes; where it runs may change."""
    before, argv = all_files(copied), ("finetune", "--runs", tmp_path, *DEBUG)
    refuse(*argv, "--beta", 0.5, "--lambda", 0.5, says=(
        str(copied), "--beta 0.015 (now 0.5)", "--lambda 0.95 (now 0.5)", "--fresh"))
    assert all_files(copied) == before
    refuse("finetune", "--runs", tmp_path, *DEBUG[2:], "--preset", "small",
           says="was started with other flags: add --preset debug (now small), or")
    succeed(*argv, "--threads", 2)

@pytest.mark.parametrize("steps, switch, longer", [
    (100, 1.0, 1.0), (99, 1.0, 1.0), (100, 0.5, 0.25)])
def test_a_run_goes_on_for_more_steps_but_its_trained_colors_stay(steps, switch, longer, tmp_path):
    """It equals one that was asked for all steps at once; --switch, a share of them, is said. A bug
    that it kills: a run whose last decision went beyond its steps had "changed colours" there."""
    def trained(name, **changes):
        cfg = dataclasses.replace(tiny_config("dreamerv2", eval_episodes=1), **changes)
        return everything(train_fake(cfg, tmp_path / name).run.folder)
    trained("run", steps=steps, switch=switch)
    if switch < 1:
        with pytest.raises(UserError, match="at step 50: add --switch 0.25$"):
            trained("run", steps=200)
    more = trained("run", steps=200, switch=longer)
    assert more["done"]["env_steps"] == 200 and more["done"]["updates"] > 5
    assert_identical(more, trained("at once", steps=200, switch=longer))

def test_videos_and_teacher_are_known_by_content_and_may_not_change(
        root, teacher, copied, tmp_path):
    """Else a run mixes two video sets. A folder may move; a missing one is refused."""
    ours, other, moved = (tmp_path / name for name in ("ours", "other", "moved"))
    shutil.copytree(root / "runs" / COLLECTED / "episodes", ours)
    shutil.copytree(ours, other)
    rows = np.load(other / "000001.npy")
    rows["image"][5, 5, 5] ^= 1
    np.save(other / "000001.npy", rows)
    argv = ("pretrain", "--runs", tmp_path, *DEBUG)
    interrupt(diswm, "descend", 9, (*argv, "--videos", ours))
    refuse(*argv, "--videos", other, says=(
        f"started with --videos {ours} of sha256 ", f", not --videos {other} of sha256 "))
    succeed(*argv, "--videos", ours.rename(moved))
    for videos in (other, ours):
        refuse(*argv, "--videos", videos, says=str(videos))
    argv, path = ("finetune", "--runs", tmp_path, *DEBUG, "--teacher"), tmp_path / "teacher.pt"
    refuse(*argv, path, says="no checkpoint")
    succeed(*argv, shutil.copy(teacher, path))
    refuse(*argv, tmp_path / PRETRAINED / "checkpoint.pt", says=(
        f"started with --teacher {teacher} of", f"not --teacher {tmp_path / PRETRAINED}"))

def test_a_collect_cut_off_goes_on_whatever_pretraining_is_to_follow(tmp_path):
    """A bug, if it fails: it is refused for flags that collect has not, and that it never uses."""
    interrupt(diswm.Replay, "add", 2, ("collect", "--runs", tmp_path, *DEBUG))
    succeed("pretrain", "--pretrain-updates", 2, "--beta1", 0.5, "--runs", tmp_path, *DEBUG)

def test_fresh_starts_over_and_killed_right_then_still_resumes(finished, copied, root, tmp_path):
    """What was there is gone; what then stands at 0 steps goes on without --fresh."""
    argv = ("finetune", "--runs", tmp_path, *DEBUG)
    shutil.copytree(root / "runs/pretrain", tmp_path / "pretrain")
    interrupt(diswm.Run, "save", 1, (*argv, "--fresh"))
    assert [path.name for path in copied.iterdir()] == ["lock"]
    interrupt(diswm.DistractingEnv, "step", 1, (*argv, "--fresh"))
    assert diswm.read_checkpoint(copied / "checkpoint.pt")["done"]["env_steps"] == 0
    shutil.rmtree(tmp_path / "pretrain")  # the checkpoint has its teacher
    succeed(*argv)
    assert_identical(everything(copied), everything(finished))

def test_fresh_loses_nothing_to_a_mistake(copied, teacher, tmp_path, monkeypatch):
    """The bug it kills: the old run was gone before the new one's teacher was looked for. Without
    --fresh, a run whose checkpoint was deleted does not begin anew with the old episodes."""
    argv = ("finetune", "--runs", tmp_path, *DEBUG, "--teacher")
    before = all_files(copied)
    refuse(*argv, tmp_path / "nope.pt", "--fresh", says="nope.pt")
    refuse(*argv, teacher, "--fresh", "--z-dim", 7, says=("does not fit", "--z-dim 20"))
    with monkeypatch.context() as patch:
        patch.setattr(diswm.mujoco, "Renderer", lambda *args: None.eglQueryString)
        refuse(*argv, teacher, "--fresh", says=("eglQueryString", "run_all.sh"))
    assert all_files(copied) == before
    (copied / "checkpoint.pt").unlink()
    refuse(*argv, teacher, says=("no checkpoint", "--fresh"))
    assert len(all_files(copied)) == len(before) - 1
    (copied / "episodes/000000.npy").write_bytes(b"damaged")  # which need not be read
    interrupt(diswm.DistractingEnv, "step", 1, (*argv, teacher, "--fresh"))

def test_evaluate_plays_as_it_was_trained_but_for_what_it_is_given(copied, tmp_path, monkeypatch):
    """The bug it kills: --eval-episodes was accepted, and the run's own number played. The episode
    that the switch ends, and its evaluation, have the first colours."""
    state, returns = torch.load(copied / "checkpoint.pt"), {}
    for step, phase, flags in ((149, "train", ()), (150, "shifted", ("--eval-episodes", 3)),
                               (150, "shifted", ("--colors", "original"))):
        state["done"]["env_steps"] = step
        torch.save(state, copied / "checkpoint.pt")
        assert f"{phase} colours" in succeed("evaluate", *ONE, "--run", copied, *flags)
        returns[(step, *flags)] = json.loads((copied / "evaluation.json").read_text())["returns"]
    assert [len(values) for values in returns.values()] == [2, 3, 2]
    assert len({values[0] for values in returns.values()}) == 3
    before = all_files(copied)
    interrupt(iio, "imwrite", 1, ("evaluate", *ONE, "--run", copied))
    for command in "evaluate", "traverse":
        succeed(command, *ONE, "--run", copied, "--out", tmp_path / f"my/{command}")
    assert all_files(copied) == before
    assert [len(all_files(tmp_path / f"my/{name}")) for name in ("evaluate", "traverse")] == [2, 4]

@pytest.mark.parametrize("method", ["dreamerv2", "no_distill"])
def test_methods_without_a_teacher_need_no_pretraining(method, tmp_path):
    """The baselines and ablations run through the same command."""
    succeed("finetune", "--method", method, "--runs", tmp_path, *DEBUG, "--steps", 120)
    values = {key for row in log_rows(next(tmp_path.rglob("seed0"))) for key in row}
    assert "distill" not in values and ("disentangle" in values) == (method != "dreamerv2")

@pytest.mark.parametrize("task", ["pusher", "drawer_open", "FetchReach-v4"])
def test_cross_domain_pipeline_waits_with_distillation_and_evaluates(task, teacher, tmp_path):
    """The published delay is eta_decay decisions (80 of 100 here; updates at 60, 60, 70, then at
    80, 90, 100); drawers are judged on metal, which training never shows."""
    succeed("finetune", "--dst", task, "--teacher", teacher, "--runs", tmp_path, *DEBUG,
            "--steps", 200, "--eval-every", 200, "--eta-decay", 80)
    run = tmp_path / f"finetune/cheetah_run-{task}/diswm/seed0"
    rows = log_rows(run)
    assert {row["decisions"]: row["eta"] for row in rows if "eta" in row} == {
        75: 0, 100: pytest.approx(np.mean([0.6, 0.525, 0.45]))}
    metal, counts = task == "drawer_open", task != "pusher"
    succeed("evaluate", *ONE, "--run", run)
    result = json.loads((run / "evaluation.json").read_text())
    assert result["phase"] == rows[-1]["eval_phase"] == ("eval" if metal else "shifted")
    assert ("eval_success" in rows[-1]) == ("success" in result) == counts

@pytest.mark.parametrize("task, actions", [
    ("Hopper-v5", 3), ("cartpole_swingup", 1), ("humanoid_walk", 21)])
def test_tasks_with_early_ends_and_1_to_21_actions_train(task, actions, tmp_path):
    """Hopper falls: its last row has discount 0, which a time limit's has not."""
    succeed("finetune", "--dst", task, "--method", "dreamerv2", "--runs", tmp_path, *DEBUG,
            "--steps", 160, "--eval-every", 80)
    run, = tmp_path.rglob("seed0")
    assert run.parent.parent.name == f"cheetah_run-{task}" and log_rows(run)[-1]["updates"] > 0
    episodes = [np.load(path) for path in (run / "episodes").glob("*.npy")]
    assert all(episode["action"].shape[1] == actions for episode in episodes)
    assert all((episode["discount"][:-1] == 1).all() for episode in episodes)
    assert any(episode["discount"][-1] == 0 for episode in episodes) == (task == "Hopper-v5")
    evaluated = [row for row in log_rows(run) if "eval_return" in row]
    assert [row["eval_step"] for row in evaluated] == [80, 160]  # due, and done soon after
    assert all(0 <= row["step"] - row["eval_step"] < 50 for row in evaluated)

def test_bf16_steps_like_fp32():
    """On real frames the loss agrees within 0.1 %, each module's gradient has a cosine of at least
    0.9999. (The actor's and critic's losses are near zero, so only their gradients.)"""
    batch = fake_batch(8, 16, 6)
    with make_env("walker_walk", seed=0) as env:
        env.action_space.seed(0)
        frames = [env.step(env.action_space.sample())[0] for _ in range(128)]
    batch["image"] = np.array(frames).reshape(8, 16, 64, 64, 3)

    def step(precision):
        """The loss of Eq. (5) and each module's gradient, of an update that changes no weight."""
        cfg = dataclasses.replace(PRESETS["small"], precision=precision, device="cpu", model_lr=0.0,
                                  actor_lr=0.0, critic_lr=0.0, grad_clip=1e9)
        agent = make_agent(cfg, 6)
        terms, model = update(agent, batch, 0.1, 1), agent.model
        loss = sum(weight * terms[name].item()
                   for name, weight in (model.weights | dict(distill=0.1)).items())
        modules = dict(model.named_children(), actor=agent.behaviour.actor,
                       critic=agent.behaviour.critic)
        return loss, {name: torch.cat([p.grad.flatten().double() for p in module.parameters()])
                      for name, module in modules.items()}
    (loss, plain), (rounded_loss, rounded) = step("fp32"), step("bf16")
    assert rounded_loss != loss and rounded_loss == pytest.approx(loss, rel=1e-3)
    for name in plain:
        assert torch.cosine_similarity(plain[name], rounded[name], 0) >= 0.9999, name

def test_doctor_says_what_runs_here_and_which_task_does_not(workdir, monkeypatch):
    """A missing package is one line with its mend. That it renders all families where nothing
    fails is a command of README.md."""
    for name in ("metaworld", "metaworld.env_dict"):
        monkeypatch.setitem(sys.modules, name, None)  # as if it were not installed
    code, out, err = run_cli("doctor", "pusher", "drawer_open")
    assert code == 1 and err.count("\n") == 1
    assert all(text in err for text in ("drawer_open", "metaworld", "run_all.sh"))
    assert all(text in out for text in ("torch", "mujoco", "gymnasium", "numpy", "CUDA"))
    assert run_cli("doctor", "pusher")[0] == 0
    check_picture(workdir / "doctor.png")

TRAIN, READ = "collect pretrain finetune", " evaluate traverse"
HELP = {  # how a line begins: the commands whose help has it
    "run: ": TRAIN + READ, "models: ": TRAIN, "distillation, Eq. (3)": "finetune",
    "machine:": TRAIN + READ, "  --preset ": TRAIN, "  --fresh ": TRAIN, "  --run ": READ,
    "  --seed ": TRAIN + READ, "  --dst ": "finetune", "  --steps ": "finetune",
    "  --beta2 ": "pretrain", "  --eval-episodes ": TRAIN + " evaluate", "  --batch-size ": TRAIN}

@pytest.mark.parametrize("command", diswm.COMMANDS)
def test_help_shows_groups_and_only_the_commands_own_flags(command, monkeypatch):
    """`evaluate` and `traverse` have no sizes of models: those stand in the checkpoint."""
    monkeypatch.setenv("COLUMNS", "200")
    out = succeed(command, "--help")
    for line, commands in HELP.items():
        assert (f"\n{line}" in out) == (command in commands.split()), line

@pytest.mark.parametrize("flags, defaults", [
    ((), {"batch-size": 16, "bonus": 0.0, "eta": 0.156}),
    (("--preset", "small", "--method", "apv"), {"batch-size": 16, "bonus": 0.1, "eta": 0.0}),
    (("--method=dreamerv2", "--preset=paper"),
     {"batch-size": 50, "encoder": "'conv'", "eta": 0.0, "lambda": 0.95})], ids=" ".join)
def test_help_shows_the_defaults_of_the_preset_and_method_named(flags, defaults, monkeypatch):
    """What the command would do without further flags."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out = succeed("finetune", *flags, "--help")
    for name, value in defaults.items():
        assert re.search(rf"^  --{name} [^\n]*\s+[^\n]*; default: {value}$", out, re.M), name

README = Path(diswm.__file__).with_name("README.md")
SHORT = {  # what each command or script is given on top, so that it takes seconds
    "collect": (*DEBUG, "--collect-steps", 200), "finetune": (*DEBUG, "--steps", 300),
    "pretrain": (*DEBUG, "--collect-steps", 200, "--pretrain-updates", 20),
    "evaluate": ONE, "traverse": ONE, "bench": (*DEBUG, "--repeats", 1),
    "disentanglement": ("--frames", 60), "sample_diversity": ("--clips", 8, "--length", 9)}

def readme_commands():
    """Every `python diswm.py …` and `python results/….py …` in README.md's bash blocks."""
    blocks = re.findall(r"^```bash\n(.*?)^```", README.read_text(), re.M | re.S)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines
            if re.match(r"python (diswm|results/\w+)\.py\b", line)]

def test_the_readmes_lines_load_a_run_and_act(finished, root, monkeypatch):
    """As they stand there."""
    lines, = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    monkeypatch.chdir(root)
    exec(lines, played := {})
    played["env"].close()
    assert played["episode"].over and played["episode"].total > 0

def test_every_readme_command_runs(workdir):
    """In file order, in one folder, at debug size (also where the README gives a longer one)."""
    commands = readme_commands()
    assert {argv[1] for argv in commands if argv[0] == "diswm.py"} == diswm.COMMANDS.keys()
    for program, *argv in commands:
        name = argv[0] if program == "diswm.py" else Path(program).stem
        argv = [str(word) for word in (*argv, *SHORT.get(name, ()))]
        if program == "diswm.py":
            succeed(*argv)
        else:
            done = subprocess.run([sys.executable, README.parent / program, *argv],
                                  capture_output=True, text=True)
            assert done.returncode == 0, f"{program} {argv}: {done.stderr}"
    check_picture(workdir / "doctor.png")

# === System: cut and resume =======================================================================

def before_call(patch, owner, name, call, action):
    """From now on, `action` happens just before the `call`-th call of owner.name, counted from 1.
    Returns the count of calls, in a list."""
    original, count = getattr(owner, name), [0]

    def wrapper(*args, **kwargs):
        count[0] += 1
        if count[0] == call:
            action()
        return original(*args, **kwargs)

    patch.setattr(owner, name, wrapper)
    return count

def interrupt(owner, name, call, argv):
    """Run a command with a Ctrl-C in it: it exits 130, in one line, and it really fell there."""
    with pytest.MonkeyPatch.context() as patch:
        count = before_call(patch, owner, name, call, lambda: signal.raise_signal(signal.SIGINT))
        refuse(*argv, code=130, says="training goes on from")
    assert count[0] >= call, f"{name} was called only {count[0]} times"

def cut_command(root, runs, method="diswm"):
    """130 decisions: learning from the 50th on, slow copies at updates 0, 4, 8. The switch, at 130,
    falls into an episode; so does no evaluation: they follow episodes 3 and 6."""
    teacher = root / f"runs/pretrain/cheetah_run/{method}/seed0/checkpoint.pt"
    return ("finetune", "--method", method, "--runs", runs, *DEBUG, "--steps", 260,
            "--eval-every", 120, "--slow-every", 4, "--teacher", teacher)

def everything(run):
    """All that a run leaves behind and that must not depend on interruptions or on its place."""
    state = torch.load(run / "checkpoint.pt")
    assert state.pop("log") == (run / "metrics.jsonl").read_text()
    config = state.pop("config").items()
    assert state["done"].pop("seconds") > 0
    return state | dict(
        inputs={name: said[-12:] for name, said in state["inputs"].items()},  # no paths
        config={name: value for name, value in config if name not in diswm.MAY_CHANGE},
        rows=[{name: value for name, value in row.items() if name not in ("seconds", "rate")}
              for row in log_rows(run)],
        files={path.name: path.read_bytes() for path in sorted((run / "episodes").glob("*"))})

def assert_identical(one, two, where=""):
    """Equal bit for bit, through dicts."""
    assert type(one) is type(two), where
    if isinstance(one, dict):
        assert list(one) == list(two), where
        for key in one:
            assert_identical(one[key], two[key], f"{where}/{key}")
    elif isinstance(one, torch.Tensor):
        assert one.dtype == two.dtype, where
        assert torch.equal(one.nan_to_num(), two.nan_to_num()), where  # NaN: APV's empty queue
    else:
        assert one == two, where

@pytest.fixture(scope="session")
def uncut(root, tmp_path_factory):
    """What uninterrupted finetunings leave behind, by method."""
    results = {}
    for method in ("diswm", "apv"):
        succeed("pretrain", "--method", method, "--runs", root / "runs", *DEBUG)
        runs = tmp_path_factory.mktemp(method)
        succeed(*cut_command(root, runs, method))
        results[method] = everything(next(runs.rglob("seed0")))
    return results

@pytest.mark.parametrize("method, owner, name, call", [
    ("diswm", diswm.Agent, "update", 2),
    ("diswm", diswm.DistractingEnv, "step", 80),
    ("diswm", diswm, "write_whole", 15),
    ("apv", diswm.DistractingEnv, "step", 116),
    ("apv", diswm.Agent, "update", 5)], ids=[
    "between the first updates", "in an evaluation", "after the log, before its checkpoint",
    "at the first decision in shifted colours, of a stack", "at a copy of its slow critic"])
def test_finetuning_cut_and_resumed_equals_an_uncut_run_bit_for_bit(
        method, owner, name, call, root, uncut, tmp_path):
    """Weights, Adam, slow critic, bonus, replay files, log: wherever Ctrl-C falls. The pretraining
    is left as it was (published: trained along), and no longer needed."""
    *argv, source = cut_command(root, tmp_path, method)
    teacher = Path(shutil.copy(source, tmp_path / "teacher.pt"))
    interrupt(owner, name, call, (*argv, teacher))
    assert teacher.read_bytes() == source.read_bytes()
    teacher.unlink()
    succeed(*argv[:-1])  # without --teacher
    run, = tmp_path.rglob("seed0")
    assert_identical(everything(run), uncut[method])
    agent = torch.load(run / "checkpoint.pt")["agent"]
    for key, value in torch.load(source)["model"].items():
        if key.startswith("encoder."):
            assert torch.equal(value, agent.get(key.replace("encoder", "teacher"), value))
            assert not torch.equal(value, agent[f"model.{key}"])
    seconds, starts = [row["seconds"] for row in log_rows(run)], run / "provenance.jsonl"
    assert seconds == sorted(seconds) and len(starts.read_text().splitlines()) == 2

def pretrain_command(root, runs, updates=210):
    """Pretraining from the videos that are there, in the smallest windows; a row each 100."""
    return ("pretrain", "--videos", root / "runs" / COLLECTED / "episodes", *DEBUG, "--runs", runs,
            "--batch-size", 1, "--batch-length", 2, "--pretrain-updates", updates)

@pytest.fixture(scope="session")
def brief(root, tmp_path_factory):
    """What an uninterrupted pretraining leaves behind."""
    runs = tmp_path_factory.mktemp("brief")
    succeed(*pretrain_command(root, runs))
    return everything(runs / PRETRAINED)

@pytest.mark.parametrize("owner, name, call, spoil", [
    (diswm.Replay, "add", 1, lambda log: None),
    (diswm, "write_whole", 4, lambda log: None),
    (diswm, "descend", 99, lambda log: log.unlink()),
    (diswm, "descend", 150, lambda log: log.write_bytes(log.read_bytes()[:99])),
    (diswm.Run, "save", 3, lambda log: log.write_bytes(log.read_bytes() + b'{"step": 999}\n'))],
    ids=["at once", "at its video", "log lost", "log cut off", "a row too many"])
def test_pretraining_cut_and_resumed_equals_an_uncut_run_bit_for_bit(
        owner, name, call, spoil, root, brief, tmp_path):
    """Batches and noise follow from an update's number: only weights and Adam need saving. The log
    is the checkpoint's, whatever became of the file."""
    argv = pretrain_command(root, tmp_path)
    interrupt(owner, name, call, argv)
    spoil(tmp_path / PRETRAINED / "metrics.jsonl")
    succeed(*argv)
    assert_identical(everything(tmp_path / PRETRAINED), brief)

# The command line, in which the call-th write of a file by this name dies half way.
DIES = """
import os, pathlib, signal, sys
import diswm
name, left, write = sys.argv[1], int(sys.argv[2]), pathlib.Path.write_bytes
def half(path, content):
    global left
    left -= path.name.startswith(name)
    if left == 0:
        write(path, bytes(content)[:len(content) // 2])
        os.kill(os.getpid(), signal.SIGKILL)
    return write(path, content)
pathlib.Path.write_bytes = half
sys.exit(diswm.main(sys.argv[3:]))
"""
EPISODE, CHECKPOINT = "0", "checkpoint.pt"  # how the names of their files begin

def start(argv, *dies):
    """A real process of a command line, once it is at work. dies: (name, call) of a fatal write."""
    code = ["-c", DIES, *map(str, dies)] if dies else [diswm.__file__]
    process = subprocess.Popen(
        [sys.executable, *code, *map(str, argv)], text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env=os.environ | dict(PYTHONPATH=str(README.parent)))
    for line in process.stdout:
        if re.search(r", at [\d,]+ of ", line):
            break
    return process

def kill(argv, moment):
    """SIGKILL a real process so many seconds after it is at work, or in the write (name, call).
    Returns whether it died of that; else it had finished before."""
    process = start(argv, *([] if isinstance(moment, float) else moment))
    if isinstance(moment, float):
        time.sleep(moment)
        process.kill()
    _, err = process.communicate()
    assert process.returncode in (0, -signal.SIGKILL), err
    return process.returncode != 0

def test_processes_killed_or_stopped_by_ctrl_c_resume_bit_for_bit(root, uncut, tmp_path):
    """Killed in an episode's write and in a checkpoint's; then a real Ctrl-C: one line, and 130 as
    shells have it. Meanwhile a second process is refused: two would mix their logs and episodes."""
    argv, run = cut_command(root, tmp_path), tmp_path / FINETUNED
    for moment, left in (((EPISODE, 2), "episodes/000001.npy.tmp"),
                         ((CHECKPOINT, 2), "checkpoint.pt.tmp")):
        assert kill(argv, moment) and (run / left).stat().st_size > 0
    process = start(argv)
    process.send_signal(signal.SIGSTOP)
    for extra in (), ("--fresh",):
        refuse(*argv, *extra, says=("another process", str(run)))
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGCONT)
    _, err = process.communicate()
    assert process.returncode == 130 and err.startswith("error: inter") and err.count("\n") == 1
    assert 2 <= diswm.read_checkpoint(run / "checkpoint.pt")["done"]["episodes"] < 6
    succeed(*argv)
    assert_identical(everything(run), uncut["diswm"])
    assert not list(run.rglob("*.tmp"))

@slow
def test_twenty_kills_of_collect_pretrain_and_finetune_change_nothing(root, uncut, tmp_path):
    """Some in a checkpoint's write, some in an episode's, the others anywhere: weights, moments,
    replay, log equal those of the uninterrupted runs. pytest -rP shows when."""
    rng, died = np.random.default_rng(0), []
    for folder, argv in ((COLLECTED, ("collect", *DEBUG, "--collect-steps", 600)),
                         (PRETRAINED, pretrain_command(root, "", 900)),
                         (FINETUNED, (*cut_command(root, ""), "--steps", 600))):
        succeed(*argv, "--runs", tmp_path / "whole")
        whole, run = everything(tmp_path / "whole" / folder), tmp_path / "killed" / folder
        writes = [(CHECKPOINT, 1), (CHECKPOINT, 2), (EPISODE, 1), (EPISODE, 2)]
        moments = [*writes[:3 if argv[0] == "pretrain" else 4], *rng.uniform(0, 2, 6).tolist()]
        for index in rng.permutation(len(moments)):
            if kill((*argv, "--runs", tmp_path / "killed"), moments[index]):
                died.append((argv[0], moments[index]))
            else:
                assert_identical(everything(run), whole)
                shutil.rmtree(run)
        succeed(*argv, "--runs", tmp_path / "killed")
        assert_identical(everything(run), whole)
        assert not list(run.rglob("*.tmp"))
    print(*died, sep="\n")
    inside = [moment[0] for _, moment in died if isinstance(moment, tuple)]
    assert len(died) >= 20 and min(inside.count(CHECKPOINT), inside.count(EPISODE)) >= 3

@pytest.mark.parametrize("stage, owner, name, call", [
    ("finetune", diswm.Replay, "add", 2), ("pretrain", diswm.Run, "record", 2),
    ("pretrain", diswm.Run, "save", 2), ("pretrain", diswm.os, "replace", 6)],
    ids=["episode", "TensorBoard", "config.json", "checkpoint"])
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_full_disk_loses_nothing(stage, owner, name, call, root, uncut, brief, tmp_path):
    """The run stops with one line, its last checkpoint loads, and with space it goes on. Here the
    operating system lets no file grow from a call on."""
    argv, run, whole = pretrain_command(root, tmp_path), tmp_path / PRETRAINED, brief
    if stage == "finetune":
        argv, run, whole = cut_command(root, tmp_path), tmp_path / FINETUNED, uncut["diswm"]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        before_call(patch, owner, name, call,
                    lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1])))
        try:
            refuse(*argv, says="File too large")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert diswm.read_checkpoint(run / "checkpoint.pt")
    succeed(*argv)
    assert_identical(everything(run), whole)

def test_a_full_gpu_is_one_line_with_the_flag_to_lower(tmp_path, monkeypatch):
    """PyTorch's own message goes on for a paragraph."""
    error = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB. GPU 0 has 8 GiB")
    monkeypatch.setattr(diswm.Agent, "update", lambda *args: exec("raise error", dict(error=error)))
    line = refuse("collect", *DEBUG, "--runs", tmp_path, says=("out of memory", "--batch-size"))
    assert len(line) < 80

@pytest.mark.parametrize("loss, broken, term", [
    ("distillation_loss", lambda value: value * np.nan, "distill"),
    ("rssm_kl_loss", lambda value: (value[0] * np.nan, value[1]), "kl_loss"),
    ("distillation_loss", lambda value: value + (value * 0).sqrt(), "non-finite model_grad_norm")],
    ids=["distillation", "KL", "gradient of √0 alone"])
def test_nan_stops_the_run_by_name_and_saves_nothing(loss, broken, term, root, uncut, tmp_path):
    """Of a loss or only of its gradient. The checkpoint is that of the last episode before; when
    the cause is gone, the run goes on as if nothing had been."""
    argv, run, real = cut_command(root, tmp_path), tmp_path / FINETUNED, getattr(diswm, loss)
    calls = itertools.count(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diswm, loss, lambda *args: (
            broken(real(*args)) if next(calls) == 4 else real(*args)))
        refuse(*argv, says=("non-finite", term, "--fresh"))
    saved = diswm.read_checkpoint(run / "checkpoint.pt")
    assert saved["done"]["env_steps"] == 130 and len(log_rows(run)) == 3
    assert all(value.isfinite().all() for value in saved["agent"].values())
    if "grad" in term:
        succeed(*argv)
        assert_identical(everything(run), uncut["diswm"])

# === System: bad input ============================================================================

@pytest.mark.parametrize("argv, says", [
    ("finetune --dst walker_wlak", "unknown walker_walk cartpole_swingup"),
    ("pretrain --src drawer", "unknown drawer_open"),
    ("finetune --dst HalfCheeta-v5 --method dreamerv2", "HalfCheeta-v5 walker_walk"),
    ("finetune --dst DisWM/drawer_open-v0", "unknown drawer_open"),
    ("collect --src lqr_lqr_2_1", "unknown lqr_lqr_2_1"),
    ("collect --src FetchReach", "FetchReach hopper_hop"), ("finetune --dst qqq", "qqq pusher"),
    ("finetune --batchsize 1", "--batchsize --batch-size"), ("evaluate", "--run"), ("", "COMMAND"),
    ("collect walker_walk", "walker_walk --src --preset"), ("finetune --qqq", "--qqq --batch-size"),
    ("frobnicate", "frobnicate pretrain finetune"), ("collect --method apv", "collect --method"),
    ("doctor --seed 1", "doctor --seed"), ("evaluate --run x --fresh", "evaluate --fresh"),
    ("finetune --preset huge", "paper small debug"), ("finetune --colors pink", "pink published"),
    ("finetune --method ppo", "ppo dreamerv2 no_distill"), ("finetune --steps 2.5", "--steps 2.5"),
    ("finetune --steps 0", "--steps 0: not from 1"), ("finetune --eta nan", "--eta nan: not 0"),
    ("finetune --model-lr inf", "--model-lr inf: not 0"), ("finetune --seed -1", "--seed -1 0"),
    ("pretrain --batch-length 1", "--batch-length 1: not from 2 to"),
    ("finetune --gamma 1.5", "--gamma 1.5: not from 0 to 1")])
def test_wrong_usage_exits_2_and_lists_what_there_is(argv, says, workdir, monkeypatch):
    """Unknown task, flag, preset, method, command or value (NaN is less than nothing and more);
    nothing happens, and nothing is written."""
    monkeypatch.setattr(torch, "set_num_threads", lambda number: None)
    refuse(*argv.split(), code=2, says=says.split())
    assert not list(workdir.iterdir())

def test_a_copy_under_another_name_runs_itself(tmp_path):
    """The bug it kills: the last lines imported `diswm`, the unedited file or none."""
    source = Path(diswm.__file__).read_text()
    (tmp_path / "mine.py").write_text(source.replace("distracting source task", "changed copy"))
    (tmp_path / "diswm.py").write_text("raise SystemExit('the other file')")
    done = subprocess.run([sys.executable, "-W", "ignore", tmp_path / "mine.py", "--help"],
                          capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "") and "Learn in the changed copy" in done.stdout

def test_checkpoint_with_a_payload_is_refused_and_not_executed(teacher, tmp_path, monkeypatch):
    """A teacher from the internet must not run code, not even with the variable that allows it."""
    marker, path = tmp_path / "executed", tmp_path / "checkpoint.pt"
    state = torch.load(teacher)
    payload = type("Payload", (), dict(__reduce__=lambda _: (os.system, (f"touch {marker}",))))()
    torch.save(state | {"config": payload}, path)
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")
    refuse("finetune", "--teacher", path, "--runs", tmp_path, *DEBUG, says="checkpoint.pt")
    refuse("evaluate", "--run", tmp_path, says=("checkpoint.pt", "--fresh"))
    assert not marker.exists()
    torch.load(path, weights_only=False)
    assert marker.exists()  # the payload was a real one

def test_file_that_is_no_checkpoint_of_ours_is_refused(teacher, tmp_path):
    """Cut off, or no torch file at all; a state_dict, a list, a tensor; another version's Config;
    another model."""
    path, ours, whole = tmp_path / "checkpoint.pt", torch.load(teacher), teacher.read_bytes()
    cuts = [whole[:length] for length in np.linspace(1, len(whole) - 1, 20, dtype=int)]
    for content in (b"", b"PK\x03\x04 not a zip", b"hello\n" * 99, b"\x80\x02.", *cuts,
                    {"weight": torch.ones(2)}, (1, 2), torch.ones(3), {"config": 3},
                    ours | dict(config=ours["config"] | dict(envs=1)), ours | dict(model={}),
                    ours | dict(config=ours["config"] | dict(gamma=-1.0))):
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            torch.save(content, path)
        with pytest.raises(UserError, match="checkpoint.pt.*--fresh"):
            diswm.open_run(path)

def test_no_path_in_a_checkpoint_is_followed(teacher, finished, tmp_path):
    """A stranger's checkpoint could else have any folder opened: traverse once read `videos`."""
    bait, opened, watching = tmp_path / "bait", [], [True]
    bait.mkdir()
    for source in (teacher.parent, finished):
        run = Path(shutil.copytree(source, tmp_path / source.relative_to(source.parents[3])))
        state = torch.load(run / "checkpoint.pt")
        state["config"] |= dict.fromkeys(("runs", "teacher", "videos"), str(bait))
        torch.save(state, run / "checkpoint.pt")
    sys.addaudithook(lambda event, args: opened.append(str(args[0])) if (
        watching and event in ("open", "os.listdir", "os.scandir")) else None)
    succeed("evaluate", *ONE, "--run", run)
    for path in (FINETUNED, PRETRAINED):
        succeed("traverse", *ONE, "--run", tmp_path / path)
    diswm.find_teacher(tiny_config(runs=str(tmp_path)))
    succeed("finetune", "--dst", "walker_walk", "--runs", tmp_path, *DEBUG)
    watching.clear()
    assert opened and not [path for path in opened if str(bait) in path]

@pytest.mark.parametrize("rows, says", [
    (np.zeros((12, 64, 64, 3), np.uint8), "bad.npy import_videos.py uint8"),
    (np.zeros(12, [("image", np.float32, (64, 64, 3)), ("is_first", bool)]),
     "bad.npy import_videos.py f4"),
    (np.zeros(12, [("image", np.uint8, (64, 64, 3))]), "bad.npy import_videos.py is_first"),
    (np.array([{}, None], object), "bad.npy import_videos.py Python objects"),
    (np.zeros(7, diswm.VIDEO_ROW), "7 frames too few import_videos.py")],
    ids=["plain array", "float images", "no is_first", "objects", "less than a window"])
def test_foreign_video_is_one_line(rows, says, tmp_path):
    """It names the file and what is wrong with it; nothing is unpickled."""
    np.save(tmp_path / "bad.npy", rows)
    refuse("pretrain", "--videos", tmp_path, "--runs", tmp_path / "runs", *DEBUG,
           says=says.split())

@settings(max_examples=40)
@given(data=st.data())
def test_damaged_episode_is_read_or_refused_but_never_a_traceback(data):
    """Bytes flipped in the header, or any other length of the file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bad.npy"
        np.save(path, np.zeros(3, diswm.VIDEO_ROW))
        content = bytearray(whole := path.read_bytes())
        for _ in range(data.draw(st.integers(0, 3))):
            content[data.draw(st.integers(0, 200))] = data.draw(st.integers(0, 255))
        length = data.draw(st.just(len(whole)) | st.integers(0, len(whole)))
        path.write_bytes(content[:length])
        try:
            assert next(Replay(folder).window(0, 1))["image"].shape == (1, 64, 64, 3)
            assert length == len(whole)
        except UserError as error:
            assert "bad.npy" in str(error) and bytes(content[:length]) != whole

def test_altered_or_strange_episodes_of_a_run_do_no_harm(copied, tmp_path):
    """Episodes are mapped, not parsed: what else would be read as numbers is refused by name. So
    is a copy that sorts first; none is deleted for it."""
    path, argv = copied / "episodes/000001.npy", ("finetune", "--runs", tmp_path, *DEBUG)
    rows = np.load(path)
    for other in (np.zeros(26, diswm.agent_row(5)), rows[["image", "is_first", "action"]]):
        np.save(path, other)
        refuse(*argv, says="000001.npy")
        refuse("traverse", "--run", copied, says="000001.npy")
    np.save(path, rows)
    shutil.copy(path, path.with_name("000001 (copy).npy"))
    refuse(*argv, says="lacks episodes")
    assert (copied / "episodes/000005.npy").exists()

FLAGS = [diswm.flag_name(field.name) for field in dataclasses.fields(Config)
         if field.name not in ("runs", "threads")]
WORDS = (st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=8)
         | st.integers().map(str) | st.floats().map(str)
         | st.sampled_from(["nan", "-inf", "1e999", "9" * 5000, "--", "-h-", "10" * 6, "0", "1"]))

@settings(max_examples=40)
@given(command=st.sampled_from(["collect", "pretrain", "finetune", "evaluate", "traverse"]),
       options=st.lists(st.tuples(st.sampled_from([*FLAGS, "--run", "--bogus", ""]), WORDS),
                        max_size=4))
def test_any_command_line_is_understood_or_one_line(command, options):
    """Random flags and values. What is understood ends where a run would be opened."""
    def opened(*args):
        raise UserError("understood")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diswm, "Run", opened)
        patch.setattr(diswm, "read_checkpoint", opened)
        patch.setattr(torch, "set_num_threads", lambda number: None)
        code, _, err = run_cli(command, *(word for option in options for word in option))
    assert code in (1, 2) and err.startswith("error: ") and err.count("\n") == 1, err

# === The laboratory: curves =======================================================================

LABORATORY = Path(diswm.__file__).parent / "results"
sys.path.append(str(LABORATORY))

def test_every_script_has_help_and_a_mistake_is_one_line(monkeypatch, capsys):
    """As the command line runs them; sys.exit(text) prints it and exits with 1."""
    for path in set(LABORATORY.glob("*.py")) - {LABORATORY / "common.py"}:
        for flags, says in (["--help"], "0"), (["nowhere"] * 2, "[12]|error: .*nowhere.*"):
            monkeypatch.setattr(sys, "argv", [path.name, *flags])
            with pytest.raises(SystemExit) as stop:
                runpy.run_path(str(path), run_name="__main__")
            out, err = capsys.readouterr()
            assert re.fullmatch(says, str(stop.value)) and err.count("\n") < 2
            assert ("usage:" in out) == (says == "0")
            assert (err + str(stop.value)).count("error: ") == (says != "0")

def test_area_final_and_switch_figures_are_those_worked_out_by_hand():
    """area: trapezia by the steps that all seeds have; unequal gaps must count as such. What the
    longer seeds have alone is drawn, by its number of seeds, and counts for nothing."""
    figures = script("plot").curve_figures
    runs = [{10: 0, 20: 10, 40: 20, 50: 60}, {10: 2, 20: 12, 30: 99, 50: 62, 40: 22, 60: 7, 70: 8}]
    found = figures(runs, switch=25)
    assert found["steps"] == [10, 20, 40, 50, 60, 70] and found["counts"] == [2, 2, 2, 2, 1, 1]
    assert found["curve"] == [[1, 0, 2], [11, 10, 12], [21, 20, 22], [61, 60, 62], [7], [8]]
    assert found["final_step"] == 50 and found["final"] == [31, 30, 32]  # of two seeds, the range
    assert found["area"][0] == pytest.approx((5 * 10 + 15 * 20 + 40 * 10) / 40 + 1)
    assert (found["before"][0], found["after"][0]) == (11, 21)
    assert figures(runs, switch=40)["before"][0] == 21  # evaluated in the old colours still
    assert "before" not in figures(runs) | figures(runs, switch=50)
    assert figures(runs[:1])["final"] == [30]  # no interval that nobody measured
    with pytest.raises(UserError, match="share no"):
        figures([{10: 1}, {20: 1}])

def test_methods_are_compared_seed_by_seed_at_the_steps_that_both_have():
    """Methods that each vary by 90 between seeds may differ by 5 in every one."""
    differences = script("plot").paired_differences
    ours = dict(seed0={10: 5, 20: 95}, seed1={10: 6, 20: 5, 30: 9}, seed7={10: 0})
    theirs = dict(seed0={10: 1, 20: 90, 30: 9}, seed1={10: 0, 20: 0}, seed2={10: 0})
    assert differences(ours, theirs, switch=10) == dict(
        seeds=2, final_step=20,
        final=[5, 4.5, 5.5], area=[5, 4.5, 5.5], before=[5, 4, 6], after=[5, 5, 5])
    assert differences(ours, dict(seed1=theirs["seed1"])) == {}  # no interval of one difference
    assert differences(ours, dict(seed0={10: 0}, seed1={20: 0})) == {}  # at no common step

def test_plot_draws_the_published_figures_from_the_published_logs(tmp_path, monkeypatch, capsys):
    """Evaluations count for when they were due; ids keep their hyphen; −300 is in the picture."""
    from matplotlib.axes import Axes
    panels, real = {}, Axes.set
    monkeypatch.setattr(Axes, "set", lambda axes, **values: (
        panels.update({values["title"]: axes}) or real(axes, **values)))
    (tmp_path / "a-Hopper-v5/diswm/seed0").mkdir(parents=True)
    (tmp_path / "a-Hopper-v5/diswm/seed0/metrics.jsonl").write_text(
        '{"step": 23, "eval_step": 20, "eval_return": 5, "phase": "train"}\n')
    runs = [*tmp_path.glob("*/*/seed0"), *sorted(LABORATORY.glob("former_actor/*/*/seed*"))]
    script("plot").main([*map(str, runs), "--out", str(tmp_path)])
    found = json.loads((tmp_path / "curves.json").read_text())
    assert found["a → Hopper-v5"]["diswm"]["steps"] == [20]
    for pair in ("cheetah_run-walker_walk", "finger_spin-cartpole_swingup"):
        panel = pair.replace("-", " → ")
        published = json.loads((LABORATORY / f"former_actor/{pair}.json").read_text())[panel]
        assert published.keys() == found[panel].keys()
        for method in published:
            figures = found[panel][method]
            for name, value in figures.items():
                assert published[method][name] == json.loads(json.dumps(value))
    assert ("cartpole_swingup: diswm, 3 seeds, at 100,000 env steps, final [127.3, 75.2, 156.8]"
            in capsys.readouterr().out)
    assert panels["a → Hopper-v5"].get_ylim()[0] == 0 > panels["cheetah_run → pusher"].get_ylim()[0]
    assert iio.imread(tmp_path / "curves.png").std() > 10

def write_log(folder, rows=2, **changes):
    """A folder with the log and config.json of a run."""
    folder.mkdir(parents=True)
    log = [json.dumps(dict(step=i, phase="train", eval_success=i / 4)) for i in range(rows)]
    (folder / "metrics.jsonl").write_text("\n".join(log))
    (folder / "config.json").write_text(json.dumps(vars(tiny_config(**changes))))
    return folder

def test_plot_pools_equal_settings_only_overlays_sources_and_honours_the_suffix(tmp_path):
    """Fig. 8, Table B. The bugs it kills: two values of η, one run twice, or other lengths drawn as
    two seeds; a method without new colours judged before and after another's."""
    plot, first = script("plot"), write_log(tmp_path / "1")
    other = write_log(tmp_path / "2", seed=2, eta=0.5)
    copy = Path(shutil.copytree(first, tmp_path / "3"))
    longer = write_log(tmp_path / "longer", seed=1, steps=600)
    for run, says in ((other, "but eta is 0.6 and 0.5; .*--tag"), (copy, "are both seed0 of diswm"),
                      (longer, "colours change at step 150 and 300")):
        with pytest.raises(UserError, match=says):
            plot.collect_figures([first, run], "eval_success")
    runs = [first, write_log(tmp_path / "4", rows=3, seed=1, runs="elsewhere", threads=2)]
    runs += [write_log(tmp_path / str(changes), **changes) for changes in (
        dict(eta=0.5, tag="x"), dict(src="hopper_hop"), dict(src="hopper_hop", method="dreamerv2"))]
    argv = [*map(str, runs), "--by", "src", "--metric", "eval_success", "--out"]
    for suffix, begins in ("pdf", b"%PDF"), ("svg", b"<?xml"), ("png", b"\x89PNG"):
        plot.main([*argv, str(tmp_path / f"c.{suffix}")])
        assert (tmp_path / f"c.{suffix}").read_bytes().startswith(begins)
    curves = json.loads((tmp_path / "c.json").read_text())["walker_walk"]
    assert curves.keys() > {"diswm from hopper_hop", "diswm+x from cheetah_run", "dreamerv2"}
    assert curves["diswm from cheetah_run"]["counts"] == [2, 2, 1]
    log = tmp_path / "1/metrics.jsonl"
    log.write_text(log.read_text() + '\n{"step": 2, "phase": "shifted", "eval_success": 1}')
    curves, = plot.collect_figures(runs, "eval_success", "src").values()
    assert [curves[name]["switch"] for name in ("diswm from cheetah_run", "dreamerv2")] == [1, None]

def test_a_sweep_trains_each_value_apart_and_what_needs_no_videos_once(tmp_path):
    """Of the real run_all.sh, with a Python that notes what it is asked. Only these runs are drawn,
    whatever else lies in their folders; each has a log, in no folder that a start would clear."""
    (tmp_path / ".venv/bin").mkdir(parents=True)
    (tmp_path / ".venv/bin/python").write_text(
        '#!/bin/bash\necho "$@" >>calls\n[[ $1 != -c ]] || cat >/dev/null\n')
    (tmp_path / ".venv/bin/python").chmod(0o755)
    shutil.copy(README.with_name("run_all.sh"), tmp_path)
    (tmp_path / "requirements.txt").write_text("torch==2")
    for variables in dict(SWEEP="eta=1,.1 z_dim=5"), dict(
            METHODS="dreamerv2 apv", PAIRS="cheetah_run:walker_walk finger_spin:walker_walk"):
        subprocess.run(["bash", "run_all.sh"], cwd=tmp_path, check=True,
                       env=os.environ | variables | dict(JOBS="2"))
    calls = (tmp_path / "calls").read_text()
    own = "--z-dim 5 --teacher runs/tour/pretrain/cheetah_run/diswm+z_dim=5/seed0/checkpoint.pt"
    found = re.findall(r"(finetune|pretrain) .*?--tag (\S+) (.*?)(?: --threads|\n)", calls)
    assert sorted(found) == [
        ("finetune", "eta=.1", "--eta .1"), ("finetune", "eta=1", "--eta 1"),
        ("finetune", "z_dim=5", own), ("pretrain", "z_dim=5", "--z-dim 5")]
    assert sorted(re.findall(r"finetune .*--src (\w+) .*--method (dream\w+|apv)", calls)) == [
        ("cheetah_run", "apv"), ("cheetah_run", "dreamerv2"), ("finger_spin", "apv")]
    runs = "runs/tour/finetune/cheetah_run-walker_walk/{} " * 3
    expected = runs.format(*(f"diswm+{x}/seed0" for x in ("eta=1", "eta=.1", "z_dim=5"))).strip()
    assert re.search(r"plot.py .*--by pair (.*)", calls)[1] == expected
    assert calls.count("plot.py --out runs/tour/curves.png --by src ") == 1
    assert {path.parent.name for path in tmp_path.rglob("seed0.log")} == {
        "diswm+eta=1", "diswm+eta=.1", "diswm+z_dim=5", "dreamerv2", "apv"}

# === The laboratory: report, diversity of samples =================================================

def test_report_is_one_file_without_links_whose_sliders_have_all_decodings(finished):
    """It opens without a network. Each slider's strip holds its 33 values."""
    script("report").main([str(finished)])
    page = (finished / "report.html").read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:)|https?://""", page)
    strips = re.findall(r"url\(data:image/png;base64,([^)]*)\)", page)
    shapes = {iio.imread(base64.b64decode(strip), extension=".png").shape for strip in strips}
    assert len(strips) == page.count("<input") == 20 and shapes == {(64, 33 * 64, 3)}
    assert len(iio.imread(finished / "traversal.mp4")) == 33

def test_sample_diversity_is_the_distance_to_the_nearest_clip_of_another_episode():
    """By hand. The README's command draws it."""
    points, episodes = np.array([[0.0, 0], [0, 1], [3, 0], [3, 4]]), np.array([0, 0, 1, 1])
    distances = script("sample_diversity").nearest_distance(points, points, episodes)
    assert distances.tolist() == pytest.approx([3, 10**0.5, 3, 18**0.5])

# === The laboratory: disentanglement ==============================================================

def test_dci_and_mig_of_codes_whose_scores_are_known():
    """Eastwood & Williams (2018), Chen et al. (2018). R² is of held-out data: trees know their
    own noise by heart. A latent that β has switched off must not give NaN."""
    score = script("disentanglement").disentanglement
    factors, *noise = np.random.default_rng(0).uniform(-1, 1, (4, 1200, 3))
    permuted, share = score(np.hstack([factors[:, [2, 0, 1]] * [-9, 0.1, 1], noise[0]]), factors)
    assert 0.9 < min(permuted.values()) <= max(permuted.values()) <= 1
    assert share.argmax(1).tolist() == [1, 2, 0] and share[:, 3:].max() < 0.02
    rotated, _ = score(factors @ np.array([[1, 2, 2], [-2, -1, 2], [2, -2, 1]]) / 3, factors)
    assert rotated.pop("informativeness") > 0.8 > 0.4 > max(rotated.values())
    assert score(noise[0], factors)[0]["informativeness"] < 0.02
    twice, _ = score(np.hstack([factors + 0.05 * noise[1], factors + 0.05 * noise[2]]), factors)
    assert twice["disentanglement"] > 0.9 > 0.8 > twice["completeness"] and twice["mig"] < 0.1
    assert np.isfinite([*score(np.zeros((1200, 1)), factors)[0].values()]).all()

def test_labelled_frames_know_the_colors_and_joints_that_they_show():
    """A label one frame off would call any encoder entangled; check it against the pixels.
    finger_spin's target is hidden: no latent can know its colour, so it is no factor."""
    frames = script("disentanglement").labelled_frames
    images, factors, names = frames(tiny_config(dst="cartpole_swingup"), 100)
    label = factors[:, [names.index(f"floor colour ({c})") for c in ("red", "green", "blue")]]
    seen = np.corrcoef(images[:, 56:].mean((1, 2)).T, label.T)[:3, 3:]  # below the cart
    assert seen.diagonal().min() > 0.9 and (seen - np.eye(3)).max() < 0.5  # each by itself
    assert (label.min(0) >= [0.3, 0.1, 0.1]).all() and (label.max(0) <= [0.9, 0.9, 0.7]).all()
    assert np.ptp(label, 0).min() > 0.45  # of both phases
    assert np.abs(factors[:, names.index("hinge_1")]).max() <= np.pi
    _, _, names = frames(tiny_config(dst="finger_spin"), 9)
    assert "effector colour (red)" in names and "target colour (red)" not in names

def test_start_encoder_is_the_first_checkpoint_bit_for_bit(root, teacher, tmp_path):
    """It is made anew from the seed; it must be what a run begins and, at rate 0, ends with."""
    videos = root / "runs/collect/cheetah_run/dreamerv2/seed0/episodes"
    for *argv, part, prefix in (("finetune", "--teacher", teacher, "--steps", 2, "agent", "model."),
                                ("pretrain", "--videos", videos, "model", "")):
        succeed(*argv[:1], *DEBUG, *argv[1:], "--seed", 3, "--model-lr", 0, "--runs", tmp_path)
        saved = diswm.read_checkpoint(*tmp_path.glob(f"{argv[0]}/*/diswm/seed3/checkpoint.pt"))
        start = script("disentanglement").encoder_at_start(saved, 6).state_dict()
        assert all(torch.equal(start[n], saved[part][f"{prefix}encoder.{n}"]) for n in start)

def test_disentanglement_scores_encoders_and_labels_the_picture(finished, teacher, monkeypatch):
    """Real DMC. A row by nats for each latent, with the factor that it follows most."""
    drawn = []
    monkeypatch.setattr(diswm, "draw_grid", lambda pictures, rows, *_: drawn.append(rows))
    for folder, encoders, task in ((finished, ["teacher", "start", "end"], "walker_walk"),
                                   (teacher.parent, ["start", "end"], "cartpole_swingup")):
        script("disentanglement").main([str(folder), "--frames", "60", "--dst", task])
        result = json.loads((folder / "disentanglement.json").read_text())
        assert [*result] == ["task", "factors", *encoders] and result["task"] == task
        share, rows = np.array(result["end"]["share"]), [row.split("  ") for row in drawn.pop()]
        assert rows == sorted(rows, key=lambda row: -float(row[1].removesuffix(" nats")))
        for latent, _, follows in rows:
            best = share[:, int(latent[1:])]
            assert follows == f"{result['factors'][best.argmax()]} {best.max():.2f}"

# === The laboratory: bench, videos ================================================================

def test_bench_reports_times_memory_and_parameters_as_one_json_object(capsys):
    """Names with units; what the paper calls 5.8 M parameters is counted by part."""
    script("bench").main(["--json", "--repeats", "1", *DEBUG])
    result = json.loads(capsys.readouterr().out)
    names = ("train_step_s", "pretrain_step_s", "sample_ms", "peak_rss_mb", "batch_size")
    times = [*result["frame_ms"].values(), *result["decision_ms"].values()]
    assert min(*times, *(result[name] for name in names)) > 0 and len(times) == 10
    assert result["params"].pop("total") == sum(result["params"].values()) > 0

VIDEO = np.repeat(np.arange(0, 240, 20, np.uint8), 96 * 128 * 3).reshape(12, 96, 128, 3)
RGBA = np.concatenate([VIDEO, 255 - VIDEO[..., :1]], -1)
ARRAYS = dict(plain=VIDEO, first=np.moveaxis(VIDEO, -1, 1), grey=VIDEO[..., 0], rgba=RGBA,
              floats=VIDEO / 255, single=VIDEO[..., :1], fortran=np.asfortranarray(VIDEO))

@pytest.mark.parametrize("kind", [*ARRAYS, "film.mp4", "film.gif", "pictures", "chunk.npz"])
def test_videos_are_imported_as_people_have_them(kind, tmp_path, capsys, monkeypatch):
    """All become the same frames; one line says how. Where an episode begins is kept."""
    source, first = tmp_path / "source", np.arange(12) % 8 == 3
    source.mkdir()
    if kind.startswith("film"):
        iio.imwrite(source / kind, VIDEO, **dict(fps=25) if "mp4" in kind else {})
    elif kind == "pictures":
        (source / kind).mkdir()
        for i, picture in enumerate(RGBA):
            iio.imwrite(source / kind / f"frame_{i}.png", picture)  # 10 comes after 9
    elif kind == "chunk.npz":
        np.savez_compressed(source / kind, image=VIDEO, is_first=first, reward=np.zeros(12))
    else:
        np.save(source / "video.npy", ARRAYS[kind])
    monkeypatch.setattr(script("import_videos"), "CHUNK", 5)
    script("import_videos").main([str(source), str(tmp_path / "episodes")])
    episodes = Replay(tmp_path / "episodes")
    window = rows_of(episodes, 0, 12)
    error = np.abs(window["image"].astype(int) - np.arange(0, 240, 20)[:, None, None, None])
    assert error.max() <= (4 if "mp4" in kind else 0) and episodes.bounds == [0, 5, 10, 12]
    begins = [0, 3, 11] if "npz" in kind else [0]
    assert np.flatnonzero(window["is_first"]).tolist() == begins
    says, total = capsys.readouterr().out.splitlines()
    assert "12 frames of " in says and "by area" in says and total.endswith("1 videos")

@pytest.mark.parametrize("crop", [False, True])
def test_frames_are_resized_by_area_and_squeezed_or_cropped(crop):
    """Each pixel is the mean of those that it covers; --crop takes the middle square."""
    picture = np.random.default_rng(0).integers(0, 256, (128, 256, 3), np.uint8)
    area = (picture[:, 64:192] if crop else picture).reshape(64, 2, 64, -1, 3).mean((1, 3))
    assert np.abs(script("import_videos").to_frame(picture, crop) - area).max() <= 1

def test_a_long_video_is_never_in_memory_as_a_whole(tmp_path):
    """Neither 50 000 imported frames, 614 MB, nor the 691 MB that are being imported."""
    (tmp_path / "raw").mkdir()
    for path, *kind in (("long.npy", diswm.VIDEO_ROW, (50_000,)),
                        ("raw/large.npy", np.uint8, (1500, 480, 320, 3))):
        np.lib.format.open_memmap(tmp_path / path, "w+", *kind).flush()
    pretrain = ("diswm.py", "pretrain", "--videos", tmp_path, "--runs", tmp_path / "runs", *DEBUG)
    code = ("import atexit, runpy, sys; del sys.argv[0]; sys.path.append('results'); "
            "status = open('/proc/self/status'); "
            "atexit.register(lambda: print(status.read().split('VmHWM:')[1].split()[0])); "
            "runpy.run_path(sys.argv[0], run_name='__main__')")
    for argv in pretrain, ("results/import_videos.py", tmp_path / "raw", tmp_path / "episodes"):
        process = subprocess.run([sys.executable, "-c", code, *argv], cwd=README.parent,
                                 stdout=subprocess.PIPE, text=True, check=True)
        peak = int(process.stdout.split()[-1])  # kB, of which 500 MB are imports
        assert peak < 1_000_000, argv

def test_what_is_no_video_is_refused(tmp_path):
    """One line names the file and what is wrong with it, also where the end is cut off."""
    path, argv = tmp_path / "bad.npz", [str(tmp_path), str(tmp_path / "episodes")]
    for array, says in ((np.full((9, 64, 64, 3), 2.0), "[2, 2]"),
                        (np.array([{}], object), "pickle"),
                        (np.zeros((64, 64, 3), np.uint8), "(64, 64, 3)"),
                        (np.zeros((0, 64, 64, 3), np.uint8), "(0, 64"), (None, "not a zip")):
        np.savez(path, image=array)
        path.write_bytes(path.read_bytes()[:-9 if array is None else None])
        with pytest.raises(UserError, match=f"bad.npz is no video .*{re.escape(says)}"):
            script("import_videos").main(argv)
    iio.imwrite(tmp_path / "cover.png", np.zeros((9, 9, 2), np.uint8))  # grey and alpha
    with pytest.raises(UserError, match="holds videos, as bad.npz, and single pictures"):
        script("import_videos").main(argv)
    path.unlink()
    (tmp_path / "episodes").rmdir()
    with pytest.raises(UserError, match="has 2 channels"):
        script("import_videos").main(argv)
