"""The specification of DisWM: read the test names from top to bottom.

Each docstring says which equation a test checks, or which real bug of the published code it kills.
Oracles are independent of `diswm.py`: torch.distributions, numpy loops, Monte Carlo, derivatives by
hand. Properties that a planted bug must break live in plain `check_…` functions, which reach the
production code through the module.
"""

import contextlib
import copy
import dataclasses
import functools
import inspect
import io
import itertools
import json
import math
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from torch.distributions import Categorical, Normal, kl_divergence
from torch.utils import tensorboard

import diswm
from diswm import METHODS, PRESETS, TASKS, Replay, UserError, make_env, make_row

settings.register_profile(
    "diswm", max_examples=15, deadline=None, derandomize=bool(os.environ.get("CI")),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
settings.load_profile("diswm")
torch.set_num_threads(1)

slow = pytest.mark.slow
PAPER_TASKS = ("walker_walk", "cheetah_run", "hopper_stand", "finger_spin", "cartpole_swingup",
               "reacher_easy", "humanoid_walk")
CPU = torch.device("cpu")
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
        image=rng.integers(0, 256, (batch, length, 64, 64, 3), np.uint8),
        action=rng.uniform(-1, 1, (batch, length, action_dim)).astype(np.float32),
        reward=rng.normal(size=(batch, length)).astype(np.float32),
        discount=1 - terminal.astype(np.float32), is_first=first, is_terminal=terminal,
        **{key: rng.normal(size=(batch, length, 20)).astype(np.float32) for key in diswm.TEACHER})


def make_agent(cfg, action_dim=2, seed=0):
    """An agent with a random frozen teacher if its method distils."""
    torch.manual_seed(seed)
    distils = cfg.eta > 0 and cfg.encoder == "beta_vae"
    teacher = diswm.freeze(diswm.BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth)) if distils else None
    return diswm.Agent(cfg, action_dim, CPU, teacher)


def make_trainer(cfg, folder, teacher=None):
    """A trainer with its environments."""
    return diswm.AgentTrainer(cfg, diswm.config_envs(cfg, cfg.dst), Path(folder), CPU, teacher)


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


def run_cli(*argv):
    """Run a command in this process → (exit code, stdout, stderr)."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = diswm.main([str(arg) for arg in argv])
        except SystemExit as stop:  # argparse
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


# === KL and distributions =========================================================================

def torch_kl(q, p):
    """KL[q || p] summed over the last dimension, by torch.distributions."""
    return kl_divergence(Normal(q["mean"], q["std"]), Normal(p["mean"], p["std"])).sum(-1)


@given(seeds, sizes, sizes)
def test_gaussian_kl_equals_torch_distributions_and_is_never_negative(seed, n, dims):
    """The closed form behind Eqs. (2), (5); an exchanged p and q would show."""
    q, p = gaussian(seed, n, dims), gaussian(seed + 9, n, dims)
    value = diswm.gaussian_kl(q["mean"], q["std"], p["mean"], p["std"])
    torch.testing.assert_close(value.sum(-1), torch_kl(q, p))
    assert (value >= -1e-12).all()


def test_gaussian_kl_equals_a_monte_carlo_average():
    """KL = E_q[ln q − ln p], within five standard errors."""
    q, p = Normal(0.7, 0.6), Normal(-0.4, 1.3)
    torch.manual_seed(0)
    x = q.sample((200_000,))
    gap = (q.log_prob(x) - p.log_prob(x)).double()
    value = float(diswm.gaussian_kl(q.mean, q.stddev, p.mean, p.stddev))
    assert abs(gap.mean() - value) < 5 * gap.std() / len(gap) ** 0.5


@given(seeds, sizes, sizes)
def test_beta_vae_kl_is_the_kl_to_the_standard_normal_and_additive_over_dims(seed, n, dims):
    """The disentanglement term of Eqs. (2), (5): a sum over Z, not a mean."""
    mean, logvar = randn(seed, n, dims), randn(seed + 1, n, dims)
    value = diswm.beta_vae_kl(mean, logvar)
    oracle = kl_divergence(Normal(mean, (logvar / 2).exp()), Normal(0.0, 1.0)).sum(-1)
    torch.testing.assert_close(value, oracle)
    assert (value >= 0).all()
    torch.testing.assert_close(diswm.beta_vae_kl(mean.tile(3), logvar.tile(3)), 3 * oracle)


def test_beta_vae_kl_is_exactly_zero_at_the_standard_normal():
    """The published code leaves a stray 1e-6 there."""
    assert (diswm.beta_vae_kl(torch.zeros(4, 20), torch.zeros(4, 20)) == 0).all()


def test_the_maths_passes_gradcheck():
    """Finite differences in float64 for every differentiable formula."""
    q, p = gaussian(0, 3, 2), gaussian(5, 3, 2)
    torch.autograd.gradcheck(diswm.gaussian_kl, (q["mean"], q["std"], p["mean"], p["std"]))
    torch.autograd.gradcheck(diswm.beta_vae_kl, (q["mean"], p["mean"]))
    torch.autograd.gradcheck(diswm.normal_log_prob, (q["mean"], p["mean"], p["std"]))
    torch.autograd.gradcheck(diswm.normal_entropy, (q["std"],))
    teacher = randn(3, 2, 3, 4)
    torch.autograd.gradcheck(
        lambda z: diswm.distillation_loss(teacher, z), (leaf(randn(4, 2, 3, 4)),))
    torch.autograd.gradcheck(diswm.lambda_return, tuple(leaf(x) for x in returns_problem(0, 4)))


def test_log_prob_and_entropy_equal_torch_distributions():
    """ln π(a | s) and the entropy of the actor's loss, summed over the action."""
    d, x = gaussian(2, 5, 3), randn(7, 5, 3)
    normal = Normal(d["mean"], d["std"])
    log_prob = diswm.normal_log_prob(x, d["mean"], d["std"])
    torch.testing.assert_close(log_prob, normal.log_prob(x).sum(-1))
    torch.testing.assert_close(diswm.normal_entropy(d["std"]), normal.entropy().sum(-1))


def test_sums_run_over_the_last_dimension_of_a_window():
    """(B, T, ·) → (B, T). In two dimensions a sum over dim +1 instead of −1 looks the same."""
    x, mean, std = randn(0, 2, 3, 4), randn(1, 2, 3, 4), randn(2, 2, 3, 4).exp()
    normal = Normal(mean, std)
    for value, oracle in (
            (diswm.beta_vae_kl(mean, 2 * std.log()), kl_divergence(normal, Normal(0.0, 1.0))),
            (diswm.normal_log_prob(x, mean, std), normal.log_prob(x)),
            (diswm.normal_entropy(std), normal.entropy())):
        torch.testing.assert_close(value, torch.stack(
            [torch.stack([row.sum() for row in window]) for window in oracle]))


@pytest.mark.parametrize("function, defaults", [
    ("rssm_kl_loss", dict(balance=0.8, free_nats=1.0)), ("lambda_return", dict(lambda_=0.95)),
    ("eta_schedule", dict(start=0.1, end=0.01, decay_steps=50_000, delay=0))])
def test_the_maths_has_the_papers_values_by_default(function, defaults):
    """Who calls a function as a library gets the hyperparameter table."""
    parameters = inspect.signature(getattr(diswm, function)).parameters.values()
    assert {p.name: p.default for p in parameters if p.default is not p.empty} == defaults


@pytest.mark.parametrize("clip", [1e9, 1e-2])
def test_adam_steps_like_torchs_own_bit_for_bit(clip):
    """A weight that a loss does not reach keeps its value; a continued optimiser goes on alike."""
    torch.manual_seed(0)
    ours = torch.nn.ModuleList(
        [torch.nn.Linear(3, 4), torch.nn.LayerNorm(4), torch.nn.Linear(2, 2)])
    theirs = copy.deepcopy(ours)
    adam, oracle = diswm.Adam(ours, 1e-3), torch.optim.Adam(theirs.parameters(), 1e-3, eps=1e-5)
    for step in range(20):
        x = torch.randn(5, 3)
        norm = adam.minimize((ours[1](ours[0](x))**3).sum(), clip)
        oracle.zero_grad()
        (theirs[1](theirs[0](x))**3).sum().backward()
        assert norm == torch.nn.utils.clip_grad_norm_(theirs.parameters(), clip)
        oracle.step()
        assert same(ours, snapshot(theirs))
        state, adam = adam.state_dict(), diswm.Adam(ours, 1e-3)
        adam.load_state_dict(state)
        assert adam.count == step + 1


def test_actions_are_clipped_one_millionth_inside_the_bounds():
    """Section 2, row 8: ±(1 − 1e-6)."""
    clipped = diswm.clip_action(torch.tensor([-9.0, -0.5, 9.0], dtype=torch.float64))
    torch.testing.assert_close(clipped.tolist(), [1e-6 - 1, -0.5, 1 - 1e-6], atol=1e-12, rtol=0)


def test_samples_have_their_moments_and_the_derivatives_of_a_reparameterised_draw():
    """dx/dμ = 1, dx/dσ = (x − μ)/σ, and so ∇E[x²] = (2μ, 2σ)."""
    torch.manual_seed(0)
    mean = torch.full((200_000,), 0.7, dtype=torch.float64, requires_grad=True)
    std = torch.full((200_000,), 1.3, dtype=torch.float64, requires_grad=True)
    x = diswm.gaussian_sample(mean, std)
    by_mean, by_std = torch.autograd.grad(x.sum(), (mean, std), retain_graph=True)
    torch.testing.assert_close(by_mean, torch.ones_like(x))
    torch.testing.assert_close(by_std, ((x - mean) / std).detach())
    assert x.mean().item() == pytest.approx(0.7, abs=0.02)
    assert x.std().item() == pytest.approx(1.3, abs=0.02)
    by_mean, by_std = torch.autograd.grad((x**2).sum(), (mean, std))
    assert by_mean.mean().item() == pytest.approx(1.4, abs=0.04)
    assert by_std.mean().item() == pytest.approx(2.6, abs=0.04)


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=9))
def test_clipped_actions_stay_in_bounds_and_keep_their_gradient(values):
    """Straight-through: a plain clamp would leave a saturated actor without a gradient."""
    action = torch.tensor(values, requires_grad=True)
    clipped = diswm.clip_action(action)
    assert (clipped.abs() < 1).all()
    inside = action.abs() < 0.999
    torch.testing.assert_close(clipped[inside], action[inside])
    assert torch.equal(torch.autograd.grad(clipped.sum(), action)[0], torch.ones(len(values)))


def check_actions_stay_inside_the_bounds():
    """Neither acted nor imagined actions leave (−1, 1)."""
    agent = make_agent(tiny_config(horizon=5))
    images = fake_batch(batch=1, length=32)["image"][0]
    action, _ = agent.act(images, np.zeros((32, 2), np.float32), None, explore=True)
    assert action.shape == (32, 2) and (np.abs(action) < 1).all()
    rssm, seen = agent.model.rssm, []
    recur = rssm.recur
    rssm.recur = lambda state, action: seen.append(action.detach()) or recur(state, action)
    agent.behaviour.imagine(agent.model, rssm.initial(32))
    assert len(seen) == 5 and (torch.stack(seen).abs() < 1).all()


def test_acted_and_imagined_actions_stay_inside_the_bounds():
    """The published "truncated" normal is not truncated: its actions leave [−1, 1]."""
    check_actions_stay_inside_the_bounds()


def test_evaluation_takes_the_actors_mode():
    """Mode = tanh(m), the policy's mean, without noise."""
    agent, zeros = make_agent(tiny_config()), np.zeros((4, 2), np.float32)
    images = fake_batch(batch=1, length=4)["image"][0]
    action, state = agent.act(images, zeros, None, explore=False)
    mean, _, _ = agent.behaviour.policy(agent.model.rssm.feat(state))
    np.testing.assert_allclose(action, mean.detach().numpy(), atol=1e-6)
    assert not np.allclose(action, agent.act(images, zeros, None, explore=True)[0])


# === KL balancing and free nats ===================================================================

@given(seeds, sizes, sizes, st.floats(0, 1), st.floats(0, 3))
def test_kl_value_is_the_plain_kl_per_step(seed, batch, length, balance, free_nats):
    """Neither balance nor free nats touch the (B, T) value that is logged."""
    post, prior = gaussian(seed, batch, length, 3), gaussian(seed + 9, batch, length, 3)
    loss, value = diswm.rssm_kl_loss(post, prior, balance, free_nats)
    torch.testing.assert_close(value, torch_kl(post, prior))
    assert loss.item() == pytest.approx(max(value.mean().item(), free_nats))


def check_kl_gradient_is_split(seed=0, balance=0.8):
    """Prior side: balance × the plain KL's gradient; posterior side: (1 − balance) ×."""
    post, prior = gaussian(seed, 2, 3, 4), gaussian(seed + 9, 2, 3, 4)
    leaves = [*post.values(), *prior.values()]
    plain = torch.autograd.grad(torch_kl(post, prior).mean(), leaves)
    split = torch.autograd.grad(diswm.rssm_kl_loss(post, prior, balance, 0.0)[0], leaves)
    for got, whole, share in zip(split, plain, [1 - balance] * 2 + [balance] * 2, strict=True):
        torch.testing.assert_close(got, share * whole)


@given(seeds, st.sampled_from([0.0, 0.2, 0.5, 0.8, 1.0]))
def test_kl_gradient_is_split_balance_to_the_prior_and_the_rest_to_the_posterior(seed, balance):
    """DreamerV2's KL balancing, the right way round; 0 and 1 silence one side."""
    check_kl_gradient_is_split(seed, balance)


@given(seeds, st.floats(0.01, 2))
def test_below_the_free_nats_the_kl_loss_is_constant_with_zero_gradient(seed, margin):
    """loss = free nats exactly, and nothing is trained."""
    post, prior = gaussian(seed, 2, 3, 4), gaussian(seed + 9, 2, 3, 4)
    free_nats = torch_kl(post, prior).mean().item() + margin
    loss, _ = diswm.rssm_kl_loss(post, prior, 0.8, free_nats)
    assert loss.item() == pytest.approx(free_nats)
    for grad in torch.autograd.grad(loss, [*post.values(), *prior.values()], allow_unused=True):
        assert grad is None or not grad.any()


def check_free_nats_act_on_the_mean():
    """Steps of 0.1 and 3.0 nats with 1 free nat: 1.55, not (1 + 3) / 2."""
    mean = (2 * torch.tensor([[[0.1], [3.0]]])).sqrt()  # KL = μ² / 2
    post, prior = dict(mean=mean, std=mean * 0 + 1), dict(mean=mean * 0, std=mean * 0 + 1)
    loss, value = diswm.rssm_kl_loss(post, prior, free_nats=1.0)
    torch.testing.assert_close(value, torch.tensor([[0.1, 3.0]]))
    assert loss.item() == pytest.approx(1.55)


def test_free_nats_act_on_the_mean_not_on_each_step():
    """As published: [0.1, 3.0] nats give 1.55, not 2.0."""
    check_free_nats_act_on_the_mean()


# === Distillation =================================================================================

def check_distillation_is_equation_3(seed=0, batch=2, length=3, dims=5):
    """Σ_t mean_B KL(softmax teacher || softmax task); its gradient is (p_task − p_teacher) / B."""
    teacher, task = (leaf(randn(seed + i, batch, length, dims)) for i in range(2))
    loss = diswm.distillation_loss(teacher, task)
    oracle = kl_divergence(Categorical(logits=teacher), Categorical(logits=task)).sum(1).mean(0)
    assert loss.shape == () and loss.item() >= -1e-12
    torch.testing.assert_close(loss, oracle)
    grad, = torch.autograd.grad(loss, task)
    torch.testing.assert_close(grad, (task.softmax(-1) - teacher.softmax(-1)).detach() / batch)


@given(seeds, sizes, sizes, st.integers(1, 20))
def test_distillation_is_equation_3_summed_over_time_and_averaged_over_the_batch(
        seed, batch, length, dims):
    """Eq. (3) against torch's Categorical, its direction and its analytic gradient included."""
    check_distillation_is_equation_3(seed, batch, length, dims)


@given(seeds, st.floats(-50, 50))
def test_distillation_is_zero_exactly_for_latents_equal_up_to_a_constant(seed, shift):
    """Softmax forgets a shift of all dimensions, and nothing else."""
    z, noise = randn(seed, 2, 3, 5), randn(seed + 1, 2, 3, 5)
    assert diswm.distillation_loss(z, z + shift).item() == pytest.approx(0, abs=1e-10)
    assert diswm.distillation_loss(z + shift, z).item() == pytest.approx(0, abs=1e-10)
    assert diswm.distillation_loss(z, z + noise).item() > 1e-4


@given(seeds, st.permutations(range(5)))
def test_distillation_ignores_a_common_permutation_of_the_latents_but_not_of_one_side(seed, order):
    """The latents are compared dimension by dimension."""
    teacher, task = randn(seed, 2, 3, 5), randn(seed + 1, 2, 3, 5)
    both = diswm.distillation_loss(teacher[..., order], task[..., order])
    torch.testing.assert_close(both, diswm.distillation_loss(teacher, task))
    if list(order) != sorted(order):
        assert diswm.distillation_loss(teacher, teacher[..., order]).item() > 1e-9


def check_distillation_scale(name="distillation_loss", seed=0, times=4):
    """Twice the time, twice the loss; twice the batch, the same loss."""
    def value(repeat_batch, repeat_time):
        sides = [randn(seed + i, 2, 3, 5).repeat(repeat_batch, repeat_time, 1) for i in range(4)]
        if name == "distillation_loss":
            return diswm.distillation_loss(*sides[:2])
        keys = ("mean", "logvar")
        return getattr(diswm, name)(*(dict(zip(keys, pair, strict=True))
                                      for pair in (sides[:2], sides[2:])))
    torch.testing.assert_close(value(1, times), times * value(1, 1))
    torch.testing.assert_close(value(times, 1), value(1, 1))


@pytest.mark.parametrize("name", ["distillation_loss", "gaussian_distillation_loss"])
@given(seeds, st.integers(2, 5))
def test_distillation_is_proportional_to_time_and_independent_of_the_batch_size(name, seed, times):
    """The scale at which the paper's η = 0.1 was tuned ("batchmean" on (B, T, Z))."""
    check_distillation_scale(name, seed, times)


def test_gaussian_distillation_is_the_kl_from_the_teachers_posterior():
    """`--distill gaussian`: closed form against torch.distributions, teacher first."""
    teacher, task = (dict(mean=randn(i, 2, 3, 5), logvar=randn(i + 1, 2, 3, 5)) for i in (0, 5))
    p, q = (dict(mean=d["mean"], std=(d["logvar"] / 2).exp()) for d in (teacher, task))
    loss = diswm.gaussian_distillation_loss(teacher, task)
    torch.testing.assert_close(loss, torch_kl(p, q).sum(1).mean(0))


def check_no_gradient_reaches_the_teacher():
    """Backward through either distillation loss leaves the teacher's latents without a gradient."""
    z_disen, z_task = leaf(randn(0, 2, 3, 5)), leaf(randn(1, 2, 3, 5))
    diswm.distillation_loss(z_disen, z_task).backward()
    codes = [{k: leaf(randn(i, 2, 3, 5)) for k in ("mean", "logvar")} for i in (2, 3)]
    diswm.gaussian_distillation_loss(*codes).backward()
    for fixed in (z_disen, *codes[0].values()):
        assert fixed.grad is None or not fixed.grad.any()
    for trained in (z_task, *codes[1].values()):
        assert trained.grad.any()


def test_no_gradient_reaches_the_teachers_latents():
    """The teacher is a fixed target (section 3.3); the student gets the gradient."""
    check_no_gradient_reaches_the_teacher()


@contextlib.contextmanager
def kept_gradients():
    """Inside, gradients stay on their weights, so that one can look at them."""
    def grad(loss, weights, real=torch.autograd.grad, **how):
        gradients = real(loss, weights, **how)
        for weight, gradient in zip(weights, gradients, strict=True):
            weight.grad = gradient
        return gradients
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.autograd, "grad", grad)
        yield


def check_teacher_is_frozen():
    """Same bytes after three updates, evaluation mode, no gradients, in no optimiser."""
    agent = make_agent(tiny_config())
    before, student = snapshot(agent.teacher), snapshot(agent.model.encoder)
    with kept_gradients():
        for update in range(3):
            metrics = agent.update(fake_batch(seed=update), 0.6, update)
    assert metrics["distill"] > 0 and not same(agent.model.encoder, student)
    assert same(agent.teacher, before)
    assert not agent.teacher.training
    assert all(p.grad is None and not p.requires_grad for p in agent.teacher.parameters())
    optimizers = [x for x in vars(agent).values() if isinstance(x, diswm.Adam)]
    trained = {id(p) for optimizer in optimizers for p in optimizer.weights}
    assert len(optimizers) == 3
    assert not trained & {id(p) for p in agent.teacher.parameters()}


def test_teacher_bytes_are_unchanged_by_updates_and_in_no_optimiser():
    """The published code switches the teacher's gradients back on and trains it along."""
    check_teacher_is_frozen()


@given(st.floats(0.01, 1), st.floats(0.0, 1), st.integers(10, 10**5), st.integers(0, 10**5))
def test_eta_is_zero_before_its_delay_then_falls_to_its_exact_end(start, share, decay, delay):
    """Section 3.4: 0 before the delay, start at it, never rising, resting exactly at the end."""
    end = start * share
    eta = [diswm.eta_schedule(delay + k * decay // 20, start, end, decay, delay) for k in range(60)]
    assert eta[0] == start and eta[-1] == end == eta[20]
    assert all(b <= a for a, b in zip(eta, eta[1:], strict=False))
    assert delay == 0 or diswm.eta_schedule(delay - 1, start, end, decay, delay) == 0
    half = diswm.eta_schedule(delay + decay // 2, start, 0.0, decay, delay)
    assert half == pytest.approx(start * (1 - (decay // 2) / decay))


@given(st.floats(0, 1), st.floats(0, 1), st.integers(0, 10**5))
def test_eta_never_exceeds_its_start(start, end, step):
    """The bug it kills: --eta 0.001 trained with the default end, 0.01, from the first decision."""
    assert min(start, end) <= diswm.eta_schedule(step, start, end, 1000) <= start


@pytest.mark.parametrize("step, eta", [
    (0, 0.1), (10_000, 0.08), (25_000, 0.05), (45_000, 0.01), (10**6, 0.01)])
def test_eta_has_the_papers_values(step, eta):
    """From 0.1 to 0.01 in 45 000 decisions."""
    assert diswm.eta_schedule(step) == pytest.approx(eta, abs=1e-12)


class FakeEnv(gym.Env):
    """Noise for ten decisions of two env steps each; counts its decisions."""


    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    count = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.integers(0, 256, (64, 64, 3), np.uint8), {}

    def step(self, action):
        self.count += 1
        image = self.np_random.integers(0, 256, (64, 64, 3), np.uint8)
        return image, 1.0, False, self.count % 10 == 0, dict(env_steps=2)


def check_eta_falls_during_a_run(delay=0):
    """In a real training loop every update sees η of the decisions so far, prefill included."""
    cfg = tiny_config(steps=120, prefill=10, train_every=5, eta=0.6, eta_end=0.06, eta_decay=40,
                      eta_delay=delay, eval_every=10**6, eval_episodes=1)
    envs, seen, update = [], [], diswm.Agent.update

    def spy(self, *args, **kwargs):
        metrics = update(self, *args, **kwargs)
        seen.append((max(env.count for env in envs), metrics["eta"].item()))
        return metrics

    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setattr(diswm, "make_env", lambda *a, **k: envs.append(FakeEnv()) or envs[-1])
        patch.setattr(diswm.Agent, "update", spy)
        teacher = diswm.freeze(diswm.BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth))
        trainer = make_trainer(cfg, folder, teacher)
        while trainer.progress < trainer.total:
            trainer.advance()
    assert len(seen) > 8
    for decisions, eta in seen:
        live = 0.0 if decisions < delay else max(0.6 * (1 - (decisions - delay) / 40), 0.06)
        assert eta == pytest.approx(live)
    assert len({eta for _, eta in seen}) > 4


@pytest.mark.parametrize("delay", [0, 25])
def test_eta_differs_between_the_updates_of_a_live_run(delay):
    """The published code copies the step once: η stays at 0.095, across domains at 0."""
    check_eta_falls_during_a_run(delay)


# === Returns and actor-critic =====================================================================

def returns_problem(seed, horizon, *batch):
    """Random reward, value, discount (H, ...) in [0, 1), bootstrap (...)."""
    return (randn(seed, horizon, *batch), randn(seed + 1, horizon, *batch),
            torch.sigmoid(randn(seed + 2, horizon, *batch)), randn(seed + 3, *batch))


def n_step_mixture(reward, value, discount, bootstrap, lambda_):
    """The slow oracle: every n-step return of every t, mixed with weights (1 − λ) λ^(n − 1)."""
    reward, value, discount, bootstrap = (x.detach().double().numpy() for x in
                                          (reward, value, discount, bootstrap))
    values, horizon = [*value, bootstrap], len(reward)
    returns = np.zeros_like(reward)
    for t in range(horizon):
        total, gamma = np.zeros_like(bootstrap), np.ones_like(bootstrap)
        for n in range(1, horizon - t + 1):
            total = total + gamma * reward[t + n - 1]
            gamma = gamma * discount[t + n - 1]
            weight = (1 - lambda_) * lambda_ ** (n - 1) if t + n < horizon else lambda_ ** (n - 1)
            returns[t] += weight * (total + gamma * values[t + n])
    return returns


def check_lambda_return_is_the_n_step_mixture(seed=0, horizon=5, n=3, lambda_=0.95):
    """lambda_return against the slow oracle."""
    problem = returns_problem(seed, horizon, n)
    result = diswm.lambda_return(*problem, lambda_)
    assert result.shape == (horizon, n)
    np.testing.assert_allclose(result.numpy(), n_step_mixture(*problem, lambda_), atol=1e-9)


@given(seeds, st.integers(1, 8), sizes, st.floats(0, 1))
def test_lambda_return_is_the_mixture_of_all_n_step_returns_in_time_order(seed, horizon, n, l):
    """Appendix B; the published λ-return comes out reversed in time."""
    check_lambda_return_is_the_n_step_mixture(seed, horizon, n, l)


def test_lambda_zero_is_the_one_step_target_and_lambda_one_the_discounted_sum():
    """By hand: r = 1, 2, 3; γ = ½; v = 10, 20, 40 and 80 behind them."""
    reward, value = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([10.0, 20.0, 40.0])
    problem = reward, value, torch.full((3,), 0.5), torch.tensor(80.0)
    assert diswm.lambda_return(*problem, 0.0).tolist() == [11.0, 22.0, 43.0]
    assert diswm.lambda_return(*problem, 1.0).tolist() == [12.75, 23.5, 43.0]


@given(seeds, st.floats(-3, 3))
def test_lambda_return_is_linear_in_rewards_and_values(seed, scale):
    """V(x + c y) = V(x) + c V(y) for the same discounts."""
    r, v, discount, b = returns_problem(seed, 5, 2)
    r2, v2, _, b2 = returns_problem(seed + 9, 5, 2)
    whole = diswm.lambda_return(r + scale * r2, v + scale * v2, discount, b + scale * b2)
    one, two = diswm.lambda_return(r, v, discount, b), diswm.lambda_return(r2, v2, discount, b2)
    torch.testing.assert_close(whole, one + scale * two)


@given(st.floats(-5, 5), st.floats(0, 0.99), st.floats(0, 1), st.integers(1, 15))
def test_constant_reward_has_its_discounted_sum_as_fixed_point(reward, gamma, lambda_, horizon):
    """r, γ constant and v = r / (1 − γ) everywhere: every V is that too."""
    value = torch.full((horizon,), reward / (1 - gamma), dtype=torch.float64)
    ones = torch.ones_like(value)
    result = diswm.lambda_return(reward * ones, value, gamma * ones, value[0], lambda_)
    torch.testing.assert_close(result, value)


@given(seeds, st.integers(0, 4))
def test_a_zero_discount_cuts_the_future(seed, end):
    """γ_k = 0: up to k no return knows what comes after, and V_k = r_k."""
    reward, value, discount, bootstrap = returns_problem(seed, 5, 2)
    discount[end] = 0
    result = diswm.lambda_return(reward, value, discount, bootstrap)
    torch.testing.assert_close(result[end], reward[end])
    reward[end + 1:], value[end + 1:], bootstrap = 1e3, -1e3, bootstrap + 1e3
    changed = diswm.lambda_return(reward, value, discount, bootstrap)
    torch.testing.assert_close(changed[: end + 1], result[: end + 1])


def stubbed_behaviour(seed, horizon=4, **changes):
    """World model and actor-critic whose imagination is a given tensor; the slow critic differs."""
    cfg = tiny_config(horizon=horizon, entropy_scale=0.3, tanh_scale=0.2, **changes)
    torch.manual_seed(seed)
    model, behaviour = diswm.WorldModel(cfg, 2), diswm.ActorCritic(cfg, 2)
    with torch.no_grad():
        for weights in behaviour.slow_critic.parameters():
            weights.add_(0.3 * torch.randn_like(weights))
    feats = leaf(3 * torch.randn(horizon + 1, 3, cfg.stoch + cfg.deter))
    log_prob, entropy, square = (leaf(torch.randn(horizon, 3)) for _ in range(3))
    behaviour.imagine = lambda *args: (feats[:-1], feats[-1], log_prob, entropy, square)
    return model, behaviour, feats, log_prob, entropy, square


def check_behaviour_losses_are_appendix_b(seed=0, rho=0.6):
    """Both losses against loops: targets of the slow critic, weights Π γ, true first discount."""
    model, behaviour, feats, log_prob, entropy, square = stubbed_behaviour(seed, rho=rho)
    first = 0.99 * torch.tensor([1.0, 0.0, 1.0])
    actor, critic, _ = behaviour.losses(model, model.rssm.initial(3), first)
    with torch.no_grad():
        reward, gamma = model.reward(feats), torch.sigmoid(model.discount(feats))
        gamma[0] = first
        slow, online = behaviour.slow_critic(feats), behaviour.critic(feats).numpy()
    target = n_step_mixture(reward[:-1], slow[:-1], gamma[:-1], slow[-1], behaviour.cfg.lambda_)
    actor_sum = critic_sum = 0.0
    for n in range(3):
        weight = 1.0
        for t in range(4):
            advantage = target[t, n] - online[t, n]
            critic_sum += weight * 0.5 * advantage**2
            actor_sum -= weight * (rho * target[t, n] + 0.3 * entropy[t, n].item()
                                   + (1 - rho) * log_prob[t, n].item() * advantage
                                   - 0.2 * square[t, n].item())
            weight *= gamma[t, n].item()
    assert critic.item() == pytest.approx(critic_sum / 12, rel=1e-4, abs=1e-6)
    assert actor.item() == pytest.approx(actor_sum / 12, rel=1e-4, abs=1e-6)


@given(seeds, st.floats(0, 1))
def test_actor_and_critic_losses_are_those_of_appendix_b(seed, rho):
    """ρ V + (1 − ρ) ln π · sg(V − v) + entropy − m²; ½ (V − v)²; both weighted by Π γ."""
    check_behaviour_losses_are_appendix_b(seed, rho)


@pytest.mark.parametrize("rho", [0.0, 1.0])
def test_rho_chooses_between_dynamics_backprop_and_reinforce(rho):
    """ρ = 1: the actor's gradient comes along the states; ρ = 0: along ln π only."""
    model, behaviour, feats, log_prob, _, _ = stubbed_behaviour(0, rho=rho)
    actor, critic, _ = behaviour.losses(model, model.rssm.initial(3), torch.full((3,), 0.99))
    by_state, by_log_prob = torch.autograd.grad(actor, (feats, log_prob), allow_unused=True,
                                                retain_graph=True)
    assert (by_state is not None and by_state.any().item()) == (rho == 1)
    assert (by_log_prob is not None and by_log_prob.any().item()) == (rho == 0)
    assert torch.autograd.grad(critic, feats, allow_unused=True)[0] is None


def test_dynamics_gradient_reaches_the_actor_through_imagined_states():
    """With ρ = 1 and no entropy bonus, the only path is action → state → reward and value."""
    agent = make_agent(tiny_config(rho=1.0, entropy_scale=0.0))
    start = agent.model.rssm.initial(4)
    loss, _, _ = agent.behaviour.losses(agent.model, start, torch.full((4,), 0.99))
    for grad in torch.autograd.grad(loss, list(agent.behaviour.actor.parameters())):
        assert grad.any()


def test_imagination_starts_at_the_given_states_and_makes_horizon_transitions():
    """States s_0 … s_H, log-probs, entropies and m² of a_0 … a_{H−1}."""
    agent = make_agent(tiny_config(horizon=4))
    start = {key: torch.randn_like(x) for key, x in agent.model.rssm.initial(5).items()}
    feats, last, log_prob, entropy, square = agent.behaviour.imagine(agent.model, start)
    assert len(feats) == 4 and last.shape == feats[0].shape
    assert log_prob.shape == entropy.shape == square.shape == (4, 5)
    torch.testing.assert_close(feats[0], torch.cat([start["stoch"], start["deter"]], -1))
    mean = agent.behaviour.policy(feats)[0]
    torch.testing.assert_close(square, torch.atanh(mean).square().sum(-1))


@pytest.mark.parametrize("scale", [0.0, 0.01])
def test_the_scale_of_m_squared_revives_an_actor_whose_tanh_is_saturated(scale):
    """At m = ±9 tanh lets nothing through: without the scale the mode stays, whatever it earns."""
    agent = make_agent(tiny_config(tanh_scale=scale, actor_lr=0.01))
    bias = list(agent.behaviour.actor.parameters())[-1]  # of (mean, std), two numbers each
    with torch.no_grad():
        bias[:2] = torch.tensor([9.0, -9.0])
    start, first = agent.model.rssm.initial(8), torch.full((8,), 0.99)
    for _ in range(200):
        loss, _, metrics = agent.behaviour.losses(agent.model, start, first)
        agent.actor_adam.minimize(loss, 100.0)
    assert (metrics["actor_tanh"] > 2 * 8**2) == (scale == 0)


def test_log_prob_trains_the_policy_for_given_states_and_actions():
    """REINFORCE: states and actions are data; ln π trains the mean and nothing in the model."""
    agent = make_agent(tiny_config(horizon=4))
    *_, log_prob, entropy, _ = agent.behaviour.imagine(agent.model, agent.model.rssm.initial(5))
    bias = list(agent.behaviour.actor.parameters())[-1]  # of (mean, std), two numbers each
    model = list(agent.model.rssm.parameters())
    grads = torch.autograd.grad(log_prob.sum() + entropy.sum(), [bias, *model], allow_unused=True)
    assert (grads[0][:2].abs() > 1e-3).all()
    assert all(grad is None for grad in grads[1:])


@pytest.mark.parametrize("still", ["model", "actor", "critic"])
def test_each_update_changes_its_own_part_and_no_other(still):
    """With one learning rate at zero that part keeps its bytes, whatever the other losses do."""
    agent = make_agent(tiny_config(**{f"{still}_lr": 0.0}))
    parts = dict(model=agent.model, actor=agent.behaviour.actor, critic=agent.behaviour.critic)
    before = {name: snapshot(part) for name, part in parts.items()}
    for update in range(2):
        agent.update(fake_batch(seed=update), 0.6, update)
    assert {name for name, part in parts.items() if same(part, before[name])} == {still}


def test_slow_critic_is_copied_at_update_zero_and_every_slow_every_updates():
    """Between copies it keeps its bytes while the critic learns; a copy precedes the update."""
    agent = make_agent(tiny_config(slow_every=3))
    for update in range(7):
        if update % 3 == 0:
            expected = snapshot(agent.behaviour.critic)
        agent.update(fake_batch(batch=2, length=3, seed=update), 0.6, update)
        assert same(agent.behaviour.slow_critic, expected)
        assert not same(agent.behaviour.critic, expected)


# === Loss shapes ==================================================================================

def noise_teacher(out, seed=0):
    """A teacher's latents for the output of a world model."""
    torch.manual_seed(seed)
    return {key: torch.randn_like(out["code"]["embed"]) for key in ("embed", "mean", "logvar")}


@pytest.mark.parametrize("method", METHODS)
@given(sizes, st.integers(2, 6), sizes, sizes, sizes, sizes)
def test_terms_are_per_step_and_losses_are_finite_scalars(
        method, batch, length, action, z, stoch, deter):
    """For any size: terms (B, T), metrics finite scalars, each term's metric its mean."""
    cfg = tiny_config(method, z_dim=z, stoch=stoch, deter=deter)
    data = diswm.to_device(fake_batch(batch, length, action), CPU)
    video = {key: data[key] for key in ("image", "is_first")}
    code = {"disentangle"} if cfg.encoder == "beta_vae" else set()
    for model, rows, heads in ((diswm.VideoPredictor(cfg), video, set()),
                               (diswm.WorldModel(cfg, action), data, {"reward", "discount"})):
        out = model(rows)
        terms = model.terms(out, rows)
        assert terms.keys() >= {"image"} | code | heads
        assert all(term.shape == (batch, length) for term in terms.values())
        loss, metrics = model.loss(out, rows)
        assert loss.shape == () and loss.isfinite()
        assert all(value.shape == () and value.isfinite() for value in metrics.values())
        for name, term in terms.items():
            torch.testing.assert_close(metrics[name], term.mean())


def gets_gradient(modules):
    """Names of the weights that have a gradient other than zero, and of all weights."""
    named = {f"{i}.{n}": p for i, part in enumerate(modules) for n, p in part.named_parameters()}
    return {name for name, p in named.items() if p.grad is not None and p.grad.any()}, set(named)


@pytest.mark.parametrize("distill", ["softmax", "gaussian"])
@pytest.mark.parametrize("method", METHODS)
def test_every_trainable_parameter_of_its_stage_gets_a_gradient_and_no_other_does(method, distill):
    """Pretraining trains the whole predictor; an agent's update all but teacher and slow critic.
    APV no longer needs the prior of its action-free RSSM: the weight of that KL is 0."""
    cfg = tiny_config(method, free_nats=0.0, distill=distill, grad_clip=1e9)
    agent = make_agent(cfg)
    trainer, behaviour = diswm.VideoTrainer(cfg, None, CPU), agent.behaviour
    with kept_gradients():
        metrics = agent.update(fake_batch(), cfg.eta, 0)
        trainer.update({key: fake_batch()[key] for key in ("image", "is_first")})
    got, named = gets_gradient([agent.model, behaviour.actor, behaviour.critic])
    unused = {name for name in named if ".below.prior_net." in name}
    assert got == named - unused and bool(unused) == (method == "apv")
    grads = [p.grad.norm() for p in agent.model.parameters() if p.grad is not None]
    norm = torch.stack(grads).norm()
    torch.testing.assert_close(norm, metrics["model_grad_norm"])  # none from the behaviour's
    for fixed in filter(None, [agent.teacher, behaviour.slow_critic]):
        assert all(p.grad is None for p in fixed.parameters())
    got, named = gets_gradient([trainer.model])
    assert got == named


weights = st.floats(0, 5).map(lambda x: round(x, 3))


@given(weights, weights, weights, weights, weights, st.sampled_from(["softmax", "gaussian"]))
def test_the_world_models_loss_is_the_weighted_sum_of_equation_5(
        alpha, beta, reward, discount, eta, mode):
    """Image + α KL + β disentangle + heads + η distill: β = 0, η = 0 remove exactly their terms."""
    cfg = tiny_config(alpha=alpha, beta=beta, reward_scale=reward, discount_scale=discount,
                      beta1=7.0, beta2=7.0, distill=mode)
    torch.manual_seed(0)
    model, batch = diswm.WorldModel(cfg, 2), diswm.to_device(fake_batch(2, 3), CPU)
    out = model(batch)
    teacher = noise_teacher(out)
    loss, m = model.loss(out, batch, teacher, eta)
    total = (m["image"] + alpha * m["kl_loss"] + beta * m["disentangle"] + reward * m["reward"]
             + discount * m["discount"] + eta * m["distill"])
    torch.testing.assert_close(loss, total)
    if mode == "softmax":
        student = Categorical(logits=out["code"]["embed"])
        oracle = kl_divergence(Categorical(logits=teacher["embed"]), student).sum(1).mean()
        torch.testing.assert_close(m["distill"], oracle)


@given(weights, weights)
def test_the_video_predictors_loss_is_the_weighted_sum_of_equation_2(beta1, beta2):
    """Image + β₁ KL + β₂ disentangle, with weights of its own."""
    model = diswm.VideoPredictor(tiny_config(beta1=beta1, beta2=beta2, alpha=7.0, beta=7.0))
    batch = diswm.to_device({key: fake_batch(2, 3)[key] for key in ("image", "is_first")}, CPU)
    loss, m = model.loss(model(batch), batch)
    torch.testing.assert_close(loss, m["image"] + beta1 * m["kl_loss"] + beta2 * m["disentangle"])


def test_the_terms_are_the_negative_log_likelihoods_of_equations_4_and_5():
    """½ squared error over pixels and reward; cross-entropy to the soft target γ (1 − terminal)."""
    torch.manual_seed(0)
    model, batch = diswm.WorldModel(tiny_config(), 2), diswm.to_device(fake_batch(2, 4), CPU)
    out = model(batch)
    terms = model.terms(out, batch)
    feat, constant = out["feat"], Normal(0.0, 1.0).log_prob(torch.zeros(()))
    image = (constant - Normal(model.decoder(feat), 1.0).log_prob(batch["image"])).sum((-3, -2, -1))
    reward = constant - Normal(model.reward(feat), 1.0).log_prob(batch["reward"])
    p, target = torch.sigmoid(model.discount(feat)), 0.99 * batch["discount"]
    entropy = -target * p.log() - (1 - target) * (1 - p).log()
    std = (out["code"]["logvar"] / 2).exp()
    disentangle = kl_divergence(Normal(out["code"]["mean"], std), Normal(0.0, 1.0)).sum(-1)
    oracles = dict(image=image, reward=reward, discount=entropy, disentangle=disentangle)
    for name, oracle in oracles.items():
        torch.testing.assert_close(terms[name], oracle, rtol=1e-4, atol=1e-5)


def test_the_autoencoder_has_the_papers_sizes_by_default():
    """The names and defaults that other code relies on: 20 latents, 64 × 64 pixels."""
    image = torch.zeros(2, 3, 3, 64, 64)
    mean, logvar = diswm.BetaVAEEncoder()(image)
    assert mean.shape == logvar.shape == (2, 3, 20)
    assert diswm.BetaVAEDecoder(250)(torch.zeros(2, 3, 250)).shape == image.shape
    assert sum(p.numel() for p in diswm.BetaVAEEncoder(z_dim=20, depth=32).parameters()) == 389_096


@given(seeds, st.sampled_from([(4, 2, 1), (4, 1, 0), (5, 2, 0), (6, 2, 0)]), st.integers(1, 5))
def test_a_deconvolution_is_torchs_with_all_its_gradients(seed, shape, size):
    """Summing the bias' gradient apart changes nothing, behind an ELU that works in place too."""
    torch.manual_seed(seed)
    ours, torchs = diswm.Deconvolution(3, 2, *shape), torch.nn.ConvTranspose2d(3, 2, *shape)
    torchs.load_state_dict(ours.state_dict())
    x, results = leaf(torch.randn(2, 3, size, size)), []
    for layer in (ours, torchs):
        out = torch.nn.functional.elu_(layer(x))
        gradients = torch.autograd.grad(out.square().sum(), [x, layer.weight, layer.bias])
        results.append((out.detach(), *gradients))
    torch.testing.assert_close(*results)


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
        patch.setattr(diswm, "gaussian_sample", lambda mean, std: mean + 0.3 * std)
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
            state = rssm.step(state, action[:, t], embed[:, t], first[:, t])
            assert close(state, pick(post, (slice(None), t)))
            assert close(rssm.prior(state["deter"]), pick(prior, (slice(None), t)))


def check_is_first_forgets_everything(seed=0, seam=3, kind="RSSM"):
    """From a seam on, a window gives the states of a window that starts there, action included."""
    rssm, embed, action, first = window(seed, kind=kind)
    first[:, seam] = True
    with no_noise():
        post, _ = rssm.observe(embed, action, first)
        action[:, seam] += 7  # of another episode
        alone, _ = rssm.observe(embed[:, seam:], action[:, seam:], first[:, seam:])
    assert close(pick(post, (slice(None), slice(seam, None))), alone)


@both_kinds
@given(seeds, st.integers(1, 5))
def test_is_first_forgets_the_state_and_the_previous_action(kind, seed, seam):
    """A window across a seam equals two windows."""
    check_is_first_forgets_everything(seed, seam, kind)


@both_kinds
@given(seeds, st.integers(1, 5))
def test_filtering_is_causal_and_priors_do_not_see_their_own_image(kind, seed, t):
    """Row t's image changes posteriors from t, priors from t + 1; row t's action both from t on."""
    rssm, embed, action, first = window(seed, kind=kind)
    other_embed, other_action = embed.clone(), action.clone()
    other_embed[:, t] += 3
    other_action[:, t] += 3
    with no_noise():
        states = rssm.observe(embed, action, first)
        by_image = rssm.observe(other_embed, action, first)
        by_action = rssm.observe(embed, other_action, first)

    def change(kind, other):  # first row that differs
        gap = (states[kind]["mean"] - other[kind]["mean"]).abs().amax((0, 2)) > 1e-6
        return gap.nonzero()[0].item() if gap.any() else len(gap)
    assert [change(0, by_image), change(1, by_image)] == [t, t + 1]
    assert [change(0, by_action), change(1, by_action)] == [t, t]


@both_kinds
@given(seeds, st.permutations(range(3)))
def test_permuting_the_batch_permutes_the_states(kind, seed, order):
    """Windows do not see each other."""
    rssm, embed, action, first = window(seed, kind=kind)
    first[1, 2] = True
    order = list(order)
    with no_noise():
        states = rssm.observe(embed, action, first)
        permuted = rssm.observe(embed[order], action[order], first[order])
    assert all(close(pick(a, order), b) for a, b in zip(states, permuted, strict=True))


def test_the_action_free_model_takes_no_actions():
    """Eq. (1): the same states whatever the batch says about actions; Eq. (4): not so."""
    cfg, batch = tiny_config(), diswm.to_device(fake_batch(2, 4), CPU)
    changed = batch | {"action": batch["action"] + 1}
    without = {key: batch[key] for key in ("image", "is_first")}
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
    gates = rssm.gru(torch.cat([x, state["deter"]], -1)).double().numpy()
    gates = (gates - gates.mean(-1, keepdims=True)) / np.sqrt(gates.var(-1, keepdims=True) + 1e-5)
    reset, candidate, update = np.split(gates, 3, -1)

    def sigmoid(value):
        return 1 / (1 + np.exp(-value))
    update = sigmoid(update - 1)
    expected = update * np.tanh(sigmoid(reset) * candidate) + (1 - update) * state["deter"].numpy()
    np.testing.assert_allclose(rssm.recur(state, action[:, 0]).numpy(), expected, atol=1e-5)


def test_latents_are_sampled_not_means():
    """The β-VAE's 𝐳 and the RSSM's z_t, as the paper writes; the published code takes means."""
    cfg, batch = tiny_config(), diswm.to_device(fake_batch(2, 3), CPU)
    for model in (diswm.VideoPredictor(cfg), diswm.WorldModel(cfg, 2)):
        one, two = model(batch), model(batch)
        assert torch.equal(one["code"]["mean"], two["code"]["mean"])
        assert not torch.allclose(one["code"]["embed"], two["code"]["embed"])
        assert not torch.allclose(one["post"]["stoch"], one["post"]["mean"])


# === Baselines: stack, intrinsic bonus, weights carried over ======================================

def check_stack_is_two_rssms(seed=0):
    """The state below is an action-free RSSM's of embed; the one above sees [embed, below]."""
    stack, embed, action, first = window(seed, kind="StackedRSSM")
    first[1, 3] = True
    with no_noise():
        post, prior = stack.observe(embed, action, first)
        below, _ = stack.below.observe(embed, None, first)
        feat = torch.cat([below["stoch"], below["deter"]], -1)
        above = diswm.RSSM(2, 4 + 3 + 5, stoch=3, deter=5, hidden=6)
        weights = {key: x for key, x in stack.state_dict().items() if "below" not in key}
        above.load_state_dict(weights)
        states = above.observe(torch.cat([embed, feat], -1), action, first)
    assert torch.allclose(post["below"], feat, atol=1e-6)
    assert close(states[0], post) and close(states[1], prior)


@given(seeds)
def test_the_stack_is_an_action_free_rssm_under_one_that_sees_its_states(seed):
    """APV, section 4.2: q(s_t | s_{t−1}, a_{t−1}, z_t) on top of q(z_t | z_{t−1}, o_t)."""
    check_stack_is_two_rssms(seed)


def test_imagination_goes_on_without_the_rssm_below():
    """Its video-only state cannot be imagined under actions; only the upper one is (APV)."""
    agent = make_agent(tiny_config("apv"))
    start = {key: torch.randn_like(x) for key, x in agent.model.rssm.initial(4).items()}
    other = start | {"below": torch.randn_like(start["below"])}
    with no_noise():
        feats, last, *_ = agent.behaviour.imagine(agent.model, start)
        again, same_last, *_ = agent.behaviour.imagine(agent.model, other)
    assert torch.equal(feats, again) and torch.equal(last, same_last)


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


def check_bonus_is_the_brute_force_one(seed=0, k=3, window=2, size=20, batch=2, length=5):
    """Bonus, queue and running mean over four batches; the queue overflows in the last ones."""
    torch.manual_seed(seed)
    bonus = diswm.IntrinsicBonus(6, k, window, size, dims=4, momentum=0.9)
    oracle = BonusOracle(bonus.projection, k, window, size, 0.9)
    for _ in range(4):
        feat = torch.randn(batch, length, 6)
        np.testing.assert_allclose(bonus(feat).numpy(), oracle(feat), rtol=1e-4, atol=1e-6)
        count = len(oracle.seen)
        np.testing.assert_allclose(bonus.queue[:count].numpy(), oracle.seen, rtol=1e-4, atol=1e-6)
        assert bonus.scale.item() == pytest.approx(oracle.scale, rel=1e-5)
        assert bonus.queue.shape == (size, 4) and not bonus.queue[count:].any()


@given(seeds, sizes, st.integers(1, 4), st.integers(1, 40), sizes, st.integers(4, 7))
def test_the_bonus_is_the_normalised_mean_distance_to_the_k_nearest_neighbours(
        seed, k, window, size, batch, length):
    """Of window means, projected, among the newest of the queue, the batch at hand included."""
    check_bonus_is_the_brute_force_one(seed, k, window, size, batch, length)


def test_the_bonus_keeps_its_digits_for_near_neighbours_far_from_zero():
    """A float32 matrix product would lose distances a thousand times smaller than the states."""
    torch.manual_seed(0)
    bonus = diswm.IntrinsicBonus(6, dims=4)
    oracle = BonusOracle(bonus.projection, 16, 5, 4096, 0.99)
    feat = 10 + 0.01 * torch.randn(6, 9, 6)
    np.testing.assert_allclose(bonus(feat).numpy(), oracle(feat), rtol=0.01)


def test_the_bonus_is_data_with_apvs_constants():
    """k 16, windows of 5, 4096 entries of 128, projection of std 1/128, momentum 0.99, weight 0.1;
    a window too short for one of 5 is one itself."""
    torch.manual_seed(0)
    bonus = diswm.IntrinsicBonus(250)
    assert (bonus.k, bonus.window, bonus.momentum) == (16, 5, 0.99)
    assert bonus.queue.shape == (4096, 128) and METHODS["apv"]["bonus"] == 0.1
    assert bonus.projection.std().item() == pytest.approx(1 / 128, rel=0.02)
    assert not list(bonus.parameters())
    reward = bonus(leaf(torch.randn(3, 9, 250)))
    assert reward.shape == (3, 5) and not reward.requires_grad
    assert bonus(torch.randn(2, 3, 250)).shape == (2, 1)


@pytest.mark.parametrize("carry_over", ["stack", "none"])
def test_the_bonus_is_added_to_the_rewards_target_and_the_last_rows_have_none(carry_over):
    """r + 0.1 · bonus of s_t below, for the rows that begin a window of 5; the others train no
    reward. Without a stack it looks at the model's own states."""
    agent, seen = make_agent(tiny_config("apv", carry_over=carry_over)), {}
    fresh, loss = copy.deepcopy(agent.model.bonus), agent.model.loss

    def spy(out, batch, teacher, eta):
        seen.update(out=out, reward=batch["reward"], terms=agent.model.terms(out, batch),
                    prediction=agent.model.reward(out["feat"])[:, :4])
        return loss(out, batch, teacher, eta)
    agent.model.loss, data = spy, fake_batch()
    agent.update(data, 0.0, 0)
    out, reward = seen["out"], seen["reward"]
    feat = out["post"]["below"] if carry_over == "stack" else out["feat"]
    expected = torch.from_numpy(data["reward"])[:, :4] + 0.1 * fresh(feat)
    torch.testing.assert_close(reward, expected)
    assert (expected > torch.from_numpy(data["reward"])[:, :4]).all()
    error = 0.5 * (seen["prediction"] - expected) ** 2
    torch.testing.assert_close(seen["terms"]["reward"], error)
    assert seen["terms"]["discount"].shape == (3, 8)


def test_no_actions_are_the_same_as_zero_actions():
    """Why dv2_finetune's video model, trained with zero actions, needs none: the same states, and
    no gradient at the actions' input weights, which therefore keep their initial values."""
    free, embed, action, first = window(0, action_dim=0)
    padded = diswm.RSSM(4, 4, stoch=3, deter=5, hidden=6)
    weights = free.state_dict()
    columns = torch.randn(6, 4)
    weights["inputs.0.weight"] = torch.cat([weights["inputs.0.weight"], columns], 1)
    padded.load_state_dict(weights)
    with no_noise():
        states, _ = padded.observe(embed, torch.zeros(3, 6, 4), first)
        assert close(states, free.observe(embed, None, first)[0])
    states["stoch"].sum().backward()
    assert not padded.inputs[0].weight.grad[:, 3:].any()
    assert padded.inputs[0].weight.grad[:, :3].any()


@pytest.mark.parametrize("src, dst, padded", [
    ("cheetah_run", "cartpole_swingup", 6), ("cartpole_swingup", "walker_walk", 6),
    ("cartpole_swingup", "reacher_easy", 2), ("walker_walk", "cheetah_run", 6)])
def test_dv2_finetune_pads_actions_to_the_larger_of_both_tasks(src, dst, padded):
    """Paper, appendix: "the maximum action space of both environments". The actor has its own."""
    own = TASK_ACTIONS[dst]
    agent = make_agent(tiny_config("dv2_finetune", src=src, dst=dst), own)
    assert agent.model.rssm.action_dim == padded and agent.action_dim == own
    assert agent.behaviour.actor.net[-1].out_features == 2 * own
    for method in METHODS.keys() - {"dv2_finetune"}:
        assert make_agent(tiny_config(method, src=src, dst=dst), own).model.rssm.action_dim == own


TASK_ACTIONS = dict(walker_walk=6, cartpole_swingup=1, reacher_easy=2, cheetah_run=6)


def check_padded_actions_never_leak():
    """Other weights at the padded entries change no metric, state or action, and stay untouched."""
    cfg = tiny_config("dv2_finetune", dst="reacher_easy")  # 2 actions of the 6 of cheetah_run
    batch, results = fake_batch(), []
    image = batch["image"][:, 0]
    for shift in (0, 100):
        agent = make_agent(cfg)
        weight = agent.model.rssm.inputs[0].weight
        with torch.no_grad():
            weight[:, cfg.stoch + 2:] = weight[:, cfg.stoch + 2:].flip(1) + shift
        before = weight[:, cfg.stoch + 2:].clone()
        torch.manual_seed(1)
        with kept_gradients():
            metrics = [agent.update(batch, 0.0, update) for update in range(2)]
        action, state = agent.act(image, np.zeros((3, 2), np.float32), None, explore=True)
        action, state = agent.act(image, action, state, explore=True)
        *_, log_prob, entropy, _ = agent.behaviour.imagine(agent.model, agent.model.rssm.initial(3))
        results.append(dict(metrics=metrics, action=action.tolist(), state=state,
                            imagined=dict(log_prob=log_prob, entropy=entropy)))
        assert action.shape == (3, 2) and not weight.grad[:, cfg.stoch + 2:].any()
        assert torch.equal(weight[:, cfg.stoch + 2:], before)
    assert_identical(*results)


def test_padded_actions_are_zero_in_the_model_and_reach_nothing_else():
    """Neither the env's actions nor log-probs, entropies, losses or weights know of them."""
    check_padded_actions_never_leak()


@pytest.mark.parametrize("method", METHODS)
def test_collecting_is_dreamerv2_whichever_method_asks_for_videos(method, monkeypatch):
    """One video set serves all methods: nothing of theirs may reach the agent that collects."""
    asked = []
    monkeypatch.setattr(diswm, "finetune", lambda cfg, *args: asked.append(cfg))
    for name in (method, "dreamerv2"):
        diswm.collect(tiny_config(name))
    assert asked[0] == asked[1] and asked[0].carry_over == "none" and asked[0].eta == 0


# === Replay =======================================================================================

def numbered_rows(first, length, terminal=False):
    """An episode whose rows carry their number, `first` … `first + length − 1`, in every array."""
    rows = []
    for n in range(first, first + length):
        image = np.full((64, 64, 3), n % 251, np.uint8)
        image[0, 0] = n // 251
        rows.append(make_row(image, np.array([n, -n], np.float32), n / 2,
                             terminal and n == first + length - 1, n == first))
    return rows


ROW_DTYPES = dict(image=np.uint8, action=np.float32, reward=np.float32, discount=np.float32,
                  is_first=np.bool_, is_terminal=np.bool_)  # issue 2: the arrays of an episode


ROWS = diswm.row_type(action_dim=2)


def rows_to_arrays(rows):
    """What a reader of the rows expects: dict of arrays (T, ...)."""
    return {key: np.array([row[key] for row in rows], dtype)
            for key, dtype in ROW_DTYPES.items()}


def assert_same(arrays, expected):
    """Equal keys, dtypes and values."""
    assert arrays.keys() == expected.keys()
    for key, value in expected.items():
        assert arrays[key].dtype == value.dtype and np.array_equal(arrays[key], value), key


class ReplayMachine(RuleBasedStateMachine):
    """Replay against a plain list of episodes: add, evict, sample, checkpoint, go back to it."""

    @initialize(capacity=st.integers(1, 30))
    def start(self, capacity):
        self.tmp = tempfile.TemporaryDirectory()
        self.capacity, self.count = capacity, 0
        self.replay, self.episodes = self.open(), []
        self.saved = self.replay.state_dict(), []

    def open(self):
        return Replay(Path(self.tmp.name) / "episodes", ROWS, self.capacity)

    @property
    def flat(self):
        return [row for episode in self.episodes for row in episode]

    @rule(length=st.integers(1, 9), terminal=st.booleans())
    def add(self, length, terminal):
        self.episodes.append(numbered_rows(self.count, length, terminal))
        self.replay.add(self.episodes[-1])
        self.count += length
        while len(self.flat) - len(self.episodes[0]) >= self.capacity:
            self.episodes.pop(0)

    @precondition(lambda self: self.episodes)
    @rule(data=st.data())
    def read_a_window(self, data):
        start = data.draw(st.integers(0, len(self.flat) - 1))
        length = data.draw(st.integers(1, len(self.flat) - start))
        expected = rows_to_arrays(self.flat[start:start + length])
        assert_same(self.replay.window(start, length), expected)

    @precondition(lambda self: self.episodes)
    @rule(data=st.data(), batch=st.integers(1, 4), seed=st.integers(0, 99))
    def draw_a_batch(self, data, batch, seed):
        length = data.draw(st.integers(1, len(self.flat)))
        windows = self.replay.sample(batch, length, np.random.default_rng(seed))
        numbers = [int(row["action"][0]) for row in self.flat]
        for b in range(batch):
            start = numbers.index(windows["action"][b, 0, 0])
            expected = rows_to_arrays(self.flat[start:start + length])
            expected["is_first"][0] = True
            assert_same({key: value[b] for key, value in windows.items()}, expected)

    @rule()
    def checkpoint(self):
        self.saved = self.replay.state_dict(), list(self.episodes)
        self.replay.prune()

    @rule()
    def go_back_to_checkpoint(self):
        """A run cut off before its next checkpoint: later episodes go, evicted ones come back."""
        self.replay = self.open()
        self.replay.load_state_dict(self.saved[0])
        self.episodes = list(self.saved[1])

    @invariant()
    def holds_the_same_rows(self):
        assert self.replay.rows == len(self.flat)
        assert len(self.replay.paths) == len(self.episodes)
        assert self.replay.paths == sorted(self.replay.paths)

    @invariant()
    def needs_every_episode_for_its_capacity(self):
        assert not self.episodes or self.replay.rows - len(self.episodes[0]) < self.capacity

    def teardown(self):
        if hasattr(self, "tmp"):
            self.tmp.cleanup()


def test_replay_agrees_with_a_list_of_episodes_through_any_history():
    """Windows, order, capacity, eviction, save and load, going back: DESIGN, "Replay"."""
    run_state_machine_as_test(ReplayMachine, settings=settings(
        settings.get_profile("diswm"), max_examples=40, stateful_step_count=25))


def test_replay_reaches_every_start_and_no_other(tmp_path):
    """An off-by-one in the sampler loses the newest row for ever: windows start anywhere."""
    replay = Replay(tmp_path, ROWS)
    replay.add(numbered_rows(0, 7))
    replay.add(numbered_rows(7, 6))
    batch = replay.sample(600, 4, np.random.default_rng(0))
    starts, counts = np.unique(batch["action"][:, 0, 0].astype(int), return_counts=True)
    assert starts.tolist() == list(range(13 - 4 + 1))
    assert counts.min() > 30  # uniform: 60 each


def test_replay_marks_seams_and_first_rows_of_windows(tmp_path):
    """Without a mark, the RSSM carries one episode's state into the next."""
    replay = Replay(tmp_path, ROWS)
    for first in (0, 5, 10):
        replay.add(numbered_rows(first, 5))
    batch = replay.sample(50, 8, np.random.default_rng(0))
    number = batch["action"][:, :, 0]
    assert np.array_equal(batch["is_first"][:, 1:], number[:, 1:] % 5 == 0)
    assert batch["is_first"][:, 0].all()
    assert not replay.window(1, 4)["is_first"].any()  # the stored rows stay as they were


def test_replay_files_are_arrays_that_numpy_opens_and_maps(tmp_path):
    """Issue 2: an episode is a file that np.load opens, with these six fields."""
    replay = Replay(tmp_path, ROWS)
    rows = numbered_rows(0, 4, terminal=True)
    replay.add(rows)
    for mode in (None, "r"):
        file = np.load(replay.paths[0], mmap_mode=mode, allow_pickle=False)
        assert_same({key: file[key] for key in file.dtype.names}, rows_to_arrays(rows))
    assert replay.window(3, 1)["discount"] == 0


def test_replay_never_deletes_what_the_last_checkpoint_needs(tmp_path):
    """Eviction drops an episode from the index; its file goes only after the next checkpoint."""
    replay = Replay(tmp_path, ROWS, capacity=4)
    for first in (0, 4, 8):
        replay.add(numbered_rows(first, 4))
    assert len(replay.paths) == 1 and len(list(tmp_path.glob("*.npy"))) == 3
    replay.prune()
    assert list(tmp_path.glob("*.npy")) == replay.paths


def test_replay_refuses_to_go_back_when_an_episode_is_missing(tmp_path):
    """A run whose episodes were deleted must not go on with fewer."""
    replay = Replay(tmp_path, ROWS)
    for first in (0, 4):
        replay.add(numbered_rows(first, 4))
    replay.paths[0].unlink()
    with pytest.raises(UserError, match="--fresh"):
        Replay(tmp_path, ROWS).load_state_dict(replay.state_dict())


class CountingEnv(gym.Env):
    """Pixel (0, 0) holds (step, code of the action, episode); reward of step n: n + action / 2."""

    def __init__(self, length, terminates):
        self.length, self.terminates, self.episode = length, terminates, 0
        self.observation_space = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def picture(self, action):
        image = np.zeros((64, 64, 3), np.uint8)
        image[0, 0] = self.count, round(float(action[0] + 1) * 100), self.episode
        return image

    def reset(self, *, seed=None, options=None):
        self.count, self.episode = 0, self.episode + 1
        return self.picture([-1]), {}

    def step(self, action):
        self.count += 1
        done = self.count == self.length
        return (self.picture(action), self.count + float(action[0]) / 2,
                done and self.terminates, done and not self.terminates, {})


def counting_trainer(cfg, folder, length, terminates=False):
    """The production trainer, playing CountingEnv through the production action repeat."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diswm, "config_env", lambda cfg, *args, **kwargs: diswm.ActionRepeat(
            CountingEnv(length, terminates), cfg.action_repeat))
        return make_trainer(cfg, folder)


@settings(max_examples=8)
@given(repeat=st.integers(1, 3), length=st.integers(9, 30), terminates=st.booleans())
def test_replay_rows_align_image_with_the_action_and_reward_that_led_to_it(
        repeat, length, terminates):
    """Row t: image[t], the action[t] and reward[t] that led to it; row 0 has zeros and is_first."""
    cfg = tiny_config("dreamerv2", action_repeat=repeat, steps=2 * length, prefill=5, train_every=9,
                      batch_length=3, switch=1.0)
    with tempfile.TemporaryDirectory() as folder:
        trainer = counting_trainer(cfg, folder, length, terminates)
        for _ in range(2):
            trainer.replay.add(trainer.play()[0][0])
        rows = trainer.replay.window(0, trainer.replay.rows)
    assert trainer.updates > 0  # the agent, not only prefill, has acted
    per_episode = -(-length // repeat) + 1
    assert len(rows["reward"]) == 2 * per_episode
    for row in range(2 * per_episode):
        t, last = row % per_episode, row % per_episode == per_episode - 1
        count, code, _ = rows["image"][row, 0, 0]
        action = rows["action"][row, 0]
        assert count == min(t * repeat, length)
        assert rows["is_first"][row] == (t == 0)
        assert rows["is_terminal"][row] == (last and terminates) == (rows["discount"][row] == 0)
        if t == 0:
            assert not rows["action"][row].any() and rows["reward"][row] == 0
        else:
            steps = np.arange((t - 1) * repeat + 1, count + 1)
            assert code == round(float(action + 1) * 100)
            assert np.isclose(rows["reward"][row], (steps + action / 2).sum(), atol=1e-4)


def test_evaluation_episodes_align_like_training_episodes():
    """Their rows make the evaluation video; their rewards sum to the return."""
    envs = gym.vector.SyncVectorEnv([lambda: diswm.ActionRepeat(CountingEnv(9, False), 2)])
    (episode, total, success), = diswm.play_episodes(envs, diswm.random_policy([0]), [0], "train")
    rows = rows_to_arrays(episode)
    assert success is None
    assert rows["image"][:, 0, 0, 0].tolist() == [0, 2, 4, 6, 8, 9]
    codes = np.round((rows["action"][1:, 0].astype(float) + 1) * 100)
    assert np.array_equal(rows["image"][1:, 0, 0, 1], codes)
    assert np.isclose(total, rows["reward"].sum()) and not rows["is_terminal"].any()


def test_random_actions_are_not_the_simulators_own_random_numbers():
    """The bug it kills: of the same seed, the first one told where Pusher's cylinder stands."""
    action, _ = diswm.random_policy([5])(None, np.zeros((1, 4)), None)
    same, _ = gym.utils.seeding.np_random(5)
    assert np.abs(action[0] - same.uniform(-1, 1, 4)).max() > 0.01


# === Environments =================================================================================

def roll(env, seed, steps=4, phase=None):
    """Reset and play seeded random actions → (observations, rewards)."""
    rng = np.random.default_rng(seed)
    observations, rewards = [env.reset(seed=seed, options=phase and dict(phase=phase))[0]], []
    for _ in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        observation, reward, *_ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
    return np.array(observations), np.array(rewards)


def closing_env(*args, **kwargs):
    """make_env in a with-statement."""
    return contextlib.closing(make_env(*args, **kwargs))


def materials(env):
    """RGB of all materials as the simulator has them now, (n, 3)."""
    return env.unwrapped.model.mat_rgba[:, :3].copy()


@pytest.mark.parametrize("task", PAPER_TASKS)
def test_every_task_of_the_paper_gives_64_by_64_pixels_and_bounded_actions(task):
    """Issue 2's task list, through the one adapter."""
    with closing_env(task) as env:
        observations, rewards = roll(env, 0, steps=2)
        assert env.action_space.low.min() == -1 and env.action_space.high.max() == 1
    assert observations.shape == (3, 64, 64, 3) and observations.dtype == np.uint8
    assert observations.std() > 5 and np.isfinite(rewards).all()
    assert (rewards >= 0).all() and (rewards <= 2).all()  # DMC: 0..1 per env step, repeat 2


FAMILIES = ("walker_walk", "pusher", "drawer_open", "FetchReach-v4", "HalfCheetah-v5")


@pytest.mark.parametrize(
    "task", [*FAMILIES, "cartpole_swingup", "drawer_close"])
@pytest.mark.filterwarnings("ignore:.*The environment .* is different from the unwrapped version.*")
def test_env_passes_gymnasiums_checker(task):
    """The stack is a gymnasium.Env: spaces, dtypes, seeding, return values."""
    with closing_env(task, time_limit=20) as env:
        check_env(env, skip_render_check=True, skip_close_check=True)


@pytest.mark.parametrize("task", [*FAMILIES, "quadruped_escape"])
def test_same_seed_gives_the_same_pixels_and_another_seed_others(task):
    """Whatever was played before. The published code leaves its colours unseeded; Meta-World
    ignores reset(seed); quadruped_escape has a new terrain, which only its own renderer shows."""
    with closing_env(task, phase="shifted") as one, closing_env(task, seed=3) as two:
        other = roll(two, 6, phase="eval")
        first, again = roll(one, 5), roll(two, 5, phase="shifted")
    assert np.array_equal(first[0], again[0]) and np.array_equal(first[1], again[1])
    assert not np.array_equal(first[0][0], other[0][0])


def looks(env):
    """All colours and materials that the simulator shows."""
    model = env.unwrapped.model
    return np.concatenate([model.mat_rgba.ravel(), model.geom_rgba.ravel(), model.geom_matid])


@pytest.mark.parametrize("task", FAMILIES)
def test_each_phase_looks_different_and_none_is_the_task_as_it_is(task):
    """Returning to `none` restores everything; `eval` differs where a task keeps it apart."""
    with closing_env(task, phase="none") as env:
        original, pictures = looks(env), {}
        for phase in (*diswm.PHASES[:3], "none"):
            pictures[phase] = env.reset(seed=3, options=dict(phase=phase))[0].astype(int)
            assert np.array_equal(looks(env), original) == (phase == "none")
    for one, two in (("train", "shifted"), ("train", "none"), ("shifted", "none")):
        assert np.abs(pictures[one] - pictures[two]).mean() > 2
    apart = np.abs(pictures["shifted"] - pictures["eval"]).mean()
    assert apart > 2 if task == "drawer_open" else apart == 0


def test_drawer_world_wears_grid_wood_and_metal_on_its_table_only():
    """Judged by colour: the grid is blue, the wood brown, the metal grey; the rest stays."""
    with closing_env("drawer_open") as env:
        views = [env.reset(seed=1, options=dict(phase=phase))[0].astype(int)
                 for phase in ("train", "shifted", "eval")]
    grid, wood, metal = (view[50:, 12:50].mean((0, 1)) for view in views)
    assert grid[2] > 1.3 * grid[0] and wood[0] > 1.3 * wood[2] and np.ptp(metal) < 0.1 * metal.max()
    arm = [view[30:36, :12] for view in views]
    assert max(np.abs(one - two).mean() for one in arm for two in arm) < 10


@pytest.mark.parametrize("task", ["drawer_open", "drawer_close", "FetchReach-v4"])
def test_first_picture_shows_what_the_reset_has_placed(task):
    """Meta-World moves the drawer without telling MuJoCo, and Fetch its goal: both were drawn
    where they had been before."""
    import mujoco
    with closing_env(task, phase="none") as env:
        for seed in range(3):
            picture = env.reset(seed=seed)[0].copy()
            mujoco.mj_forward(env.unwrapped.model, env.unwrapped.data)
            assert np.array_equal(picture, env.render())
        if task == "FetchReach-v4":
            goal = env.unwrapped.model.site("target0").id
            assert np.allclose(env.unwrapped.data.site_xpos[goal], env.unwrapped.goal)


def test_pusher_has_a_black_object_one_table_colour_and_one_arm_colour():
    """The published distractor."""
    arm = ("uar", "ua", "ef", "sp", "fa", "sl", "e1", "e2")
    with closing_env("pusher", pixels=False, color_step_std=0.2) as env:
        for seed in range(5):
            env.reset(seed=seed)
            env.step(env.action_space.sample())
            model = env.unwrapped.model
            colors = {tuple(model.geom(name).rgba[:3]) for name in arm}
            assert len(colors) == 1 and tuple(model.geom("table").rgba[:3]) not in colors
            assert not model.geom_rgba[model.body("object").geomadr[0], :3].any()
            assert (np.abs(np.array(*colors) - (0.7, 0.3, 0.5)) <= 0.2 + 1e-6).all()


@pytest.mark.parametrize("task", ["HalfCheetah-v5", "FetchReach-v4", "Hopper-v5"])
def test_distractor_of_any_mujoco_task_changes_the_colors_that_mujoco_uses(task):
    """geom_rgba hides the material's colour unless it is (.5, .5, .5, 1)."""
    with closing_env(task, phase="none") as env:
        model, picture = env.unwrapped.model, env.reset(seed=0)[0].astype(int)
        for geom in range(model.ngeom):
            used = model.geom_matid[geom] >= 0 and (model.geom_rgba[geom] == (.5, .5, .5, 1)).all()
            before = model.mat_rgba[model.geom_matid[geom]] if used else model.geom_rgba[geom]
            before = before.copy()
            env.reset(seed=0, options=dict(phase="train"))
            after = model.mat_rgba[model.geom_matid[geom]] if used else model.geom_rgba[geom]
            assert (before[:3] != after[:3]).any() and before[3] == after[3]
            env.reset(seed=0, options=dict(phase="none"))
        assert np.array_equal(env.reset(seed=0)[0], picture)


def test_zero_color_range_around_the_originals_changes_no_pixel():
    """--colors original --color-range 0 is the task as it is."""
    plain = dict(colors="original", color_range=0.0)
    with closing_env("walker_walk", phase="none") as none:
        expected = roll(none, 5)[0]
    with closing_env("walker_walk", phase="train", **plain) as zero:
        assert np.array_equal(roll(zero, 5)[0], expected)
    with closing_env("walker_walk", phase="train") as distracted:
        assert not np.array_equal(roll(distracted, 5)[0], expected)


@pytest.mark.parametrize("task", [*FAMILIES, "cartpole_swingup", "reacher_easy"])
def test_distractor_leaves_state_and_reward_bit_identical(task):
    """The distractor changes what is seen, not what happens: its random stream is its own."""
    with (closing_env(task, phase="none", pixels=False) as plain,
          closing_env(task, phase="train", pixels=False, color_step_std=0.2) as distracted,
          closing_env(task, phase="shifted") as seen):
        states, rewards = roll(plain, 7, steps=10)
        others, other_rewards = roll(distracted, 7, steps=10)
        _, seen_rewards = roll(seen, 7, steps=10)
        end = [env.unwrapped.data.qpos.tobytes() for env in (plain, distracted, seen)]
    assert states.tobytes() == others.tobytes()
    assert rewards.tobytes() == other_rewards.tobytes() == seen_rewards.tobytes()
    assert end[0] == end[1] == end[2]


@settings(max_examples=10)
@given(phase=st.sampled_from(["train", "shifted"]), half=st.floats(0.01, 0.6),
       seed=st.integers(0, 999), colors=st.sampled_from(["published", "original"]))
def test_colors_fill_the_box_of_their_phase(phase, half, seed, colors):
    """Boxes of ± range around (0.7, 0.3, 0.5) and (0.5, 0.7, 0.3), or around the originals."""
    with closing_env("walker_walk", phase="none", pixels=False) as env:
        original = materials(env)
    center = dict(train=(0.7, 0.3, 0.5), shifted=(0.5, 0.7, 0.3))[phase]
    if colors == "original":
        center = original if phase == "train" else np.roll(original, 1, -1)
    low, high = np.clip(center - np.float64(half), 0, 1), np.clip(center + np.float64(half), 0, 1)
    changes = dict(phase=phase, colors=colors, color_range=half)
    with closing_env("walker_walk", pixels=False, **changes) as env:
        draws = []
        for index in range(30):
            env.reset(seed=seed + index)
            draws.append(materials(env))
    draws = np.array(draws)
    assert (draws >= low - 1e-6).all() and (draws <= high + 1e-6).all()
    assert (np.ptp(draws, axis=0) > 0.5 * (high - low)).all()


def test_random_walk_stays_in_its_box_and_moves():
    """--color-step-std: colours walk every decision, clipped to the box of the episode's phase."""
    with closing_env("walker_walk", phase="train", pixels=False, color_step_std=0.2) as env:
        env.reset(seed=0)
        colors = [materials(env)]
        for _ in range(40):
            env.step(env.action_space.sample())
            colors.append(materials(env))
    colors = np.array(colors)
    assert (np.abs(colors - (0.7, 0.3, 0.5)) <= 0.2 + 1e-6).all()
    assert (colors[1:] != colors[:-1]).any((1, 2)).all()


def check_action_repeat_sums_rewards(task="walker_walk", repeat=2, seed=0):
    """make_env(action_repeat=n) against n plain steps of the simulator, for 12 decisions."""
    raw, rng = diswm.DMControlEnv(*TASKS[task]), np.random.default_rng(seed)
    with contextlib.closing(raw), closing_env(task, pixels=False, action_repeat=repeat) as env:
        raw.reset(seed=seed)
        env.reset(seed=seed)
        for _ in range(12):
            action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            observation, reward, *_, info = env.step(action)
            steps = [raw.step(action) for _ in range(repeat)]
            assert reward > 0 and np.isclose(reward, sum(step[1] for step in steps), rtol=1e-9)
            assert np.array_equal(observation, steps[-1][0])
            assert info["env_steps"] == repeat


@pytest.mark.parametrize("repeat", [1, 2, 5])
def test_action_repeat_sums_the_rewards_of_its_steps_once(repeat):
    """Published code: `reward += reward` doubles them; two wrappers apply the repeat twice."""
    check_action_repeat_sums_rewards(repeat=repeat, seed=repeat)


STEP = diswm.ActionRepeat.step


def doubled_reward(self, action):
    """Section 2, row 10: `reward += reward`."""
    observation, reward, *rest = STEP(self, action)
    return observation, reward + reward, *rest


def doubled_repeat(self, action):
    """Section 2, row 10: a second repeat around the first, of which nobody knows."""
    _, first, *_ = STEP(self, action)
    observation, second, *rest = STEP(self, action)
    return observation, first + second, *rest


def last_reward(self, action):
    """Only the last reward of the repeat counts."""
    for _ in range(self.n):
        result = self.env.step(action)
    return *result[:4], {"env_steps": self.n}


@pytest.mark.parametrize("bug", [doubled_reward, doubled_repeat, last_reward])
def test_planted_action_repeat_bug_is_noticed(bug, monkeypatch):
    """The check above bites."""
    monkeypatch.setattr(diswm.ActionRepeat, "step", bug)
    with pytest.raises(AssertionError):
        check_action_repeat_sums_rewards()


@pytest.mark.parametrize("task, given, limit", [
    ("walker_walk", 7, 7), ("walker_walk", 8, 8), ("walker_walk", 0, 1000), ("pusher", 0, 100),
    ("drawer_open", 0, 200), ("FetchReach-v4", 0, 50), ("HalfCheetah-v5", 0, 1000)])
def test_time_limit_counts_env_steps_and_is_no_terminal(task, given, limit):
    """Time limits, by default the task's own, truncate; a repeat that they cut short counts the
    steps that were made."""
    with closing_env(task, pixels=False, time_limit=given) as env:
        env.reset(seed=0)
        steps, done = 0, False
        while not done:
            *_, terminated, truncated, info = env.step(env.action_space.sample())
            steps, done = steps + info["env_steps"], terminated or truncated
    assert steps == limit and truncated and not terminated


def test_ten_envs_alive_at_once_do_not_mix_textures():
    """gymnasium's renderer forgets to switch GL contexts: one env gets the other's textures."""
    kinds = [*((task, "train") for task in FAMILIES), ("drawer_open", "eval"), ("pusher", "none"),
             ("walker_walk", "shifted"), ("cartpole_swingup", "none"), ("drawer_close", "shifted")]
    alone = []
    for task, phase in kinds:
        with closing_env(task, phase=phase) as env:
            alone.append(roll(env, 2, steps=2)[0])
    with contextlib.ExitStack() as stack:
        envs = [stack.enter_context(closing_env(task, phase=phase)) for task, phase in kinds]
        rngs, count = [np.random.default_rng(2) for _ in kinds], [0] * len(kinds)
        for env, frames in zip(envs, alone, strict=True):
            assert np.array_equal(env.reset(seed=2)[0], frames[0])
        for i in np.random.default_rng(0).permutation([*range(len(kinds))] * 2):
            action = rngs[i].uniform(-1, 1, envs[i].action_space.shape).astype(np.float32)
            count[i] += 1
            assert np.array_equal(envs[i].step(action)[0], alone[i][count[i]]), kinds[i]


class Reaching(CountingEnv):
    """Succeeds at its third step only, and says so as Meta-World or as Fetch does."""

    def __init__(self, key, length):
        super().__init__(length, terminates=False)
        self.key = key

    def step(self, action):
        *result, info = super().step(action)
        return *result, info | {self.key: float(self.count == 3)}


@pytest.mark.parametrize("key", ["success", "is_success"])
def test_success_reached_at_any_simulator_step_counts_for_the_episode(key):
    """Step 3 is the first of its decision's two; looking at the last step alone misses it."""
    for length, expected in ((10, True), (2, False)):
        envs = gym.vector.SyncVectorEnv([lambda n=length: diswm.ActionRepeat(Reaching(key, n), 2)])
        (_, _, success), = diswm.play_episodes(envs, diswm.random_policy([0]), [0], "train")
        assert success is expected


def vector_config(envs, **changes):
    """Random actions in the Pusher, by as many environments side by side."""
    return tiny_config("dreamerv2", dst="pusher", envs=envs, prefill=10**6, time_limit=12,
                       steps=10**6, **changes)


def test_parallel_envs_fill_the_replay_like_as_many_single_ones(tmp_path):
    """--envs 2 against --envs 1, bit for bit; two are processes of their own."""
    for envs in (1, 2):
        trainer = make_trainer(vector_config(envs), tmp_path / str(envs))
        with contextlib.closing(trainer.envs):
            for _ in range(4 // envs):
                for rows, *_ in trainer.play():
                    trainer.replay.add(rows)
                    trainer.episodes += 1
        assert (trainer.progress, trainer.decisions) == (48, 24)
    one, two = (sorted((tmp_path / name / "episodes").glob("*")) for name in "12")
    assert len(one) == 4 and [p.read_bytes() for p in one] == [p.read_bytes() for p in two]


class Ending(CountingEnv):
    """An episode's length depends on its seed: 4, 5, 6 or 7 steps."""

    def reset(self, *, seed=None, options=None):
        self.length = self.length if seed is None else 4 + seed % 4
        return super().reset(seed=seed, options=options)


@settings(max_examples=10)
@given(seed=st.integers(0, 99), every=st.integers(1, 5), count=st.integers(1, 4))
def test_parallel_episodes_end_one_by_one_and_updates_count_decisions(seed, every, count):
    """Rows of a finished environment are ignored; an update follows each train_every decisions,
    however many fall into one step of all environments."""
    seeds = [seed * count + i for i in range(count)]
    envs = gym.vector.SyncVectorEnv([lambda: diswm.ActionRepeat(Ending(4, True), 1)] * count)
    cfg, updates = tiny_config("dreamerv2", train_every=every, prefill=0, steps=10**6), []
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setattr(diswm, "config_envs", lambda *args, **kwargs: envs)
        patch.setattr(diswm, "episode_seed", lambda run, stream, index: seeds[index])
        trainer = make_trainer(cfg, folder)
        trainer.replay.add(numbered_rows(0, 20))
        trainer.updates = 1
        trainer.agent.update = lambda *args: updates.append(trainer.decisions) or dict(
            loss=torch.zeros(()))
        episodes = trainer.play()
    lengths = [4 + s % 4 for s in seeds]
    assert [len(rows) - 1 for rows, *_ in episodes] == lengths
    assert [rows[-1]["is_terminal"] for rows, *_ in episodes] == [True] * count
    assert trainer.decisions == trainer.progress == sum(lengths)
    assert len(updates) == sum(lengths) // every
    for rows, total, _ in episodes:
        assert [row["image"][0, 0, 0] for row in rows] == [*range(len(rows))]
        assert total == pytest.approx(sum(row["reward"] for row in rows))


def test_registered_ids_work_in_other_processes(tmp_path, task="drawer_open"):
    """gymnasium.make after `import diswm`, and AsyncVectorEnv under spawn; no GL error at exit,
    not even of an environment that is left open."""
    script = tmp_path / "user.py"
    script.write_text(f"""
import gymnasium
import numpy as np
import diswm

def make():
    import diswm
    return gymnasium.make("DisWM/{task}-v0", phase="shifted", size=32, action_repeat=3)

if __name__ == "__main__":
    env = make()
    expected, _ = env.reset(seed=5)
    assert expected.shape == (32, 32, 3) and env.spec.id == "DisWM/{task}-v0"
    assert env.step(env.action_space.sample())[-1]["env_steps"] == 3
    envs = gymnasium.vector.AsyncVectorEnv([make] * 2, context="spawn")
    assert np.array_equal(envs.reset(seed=[5, 6])[0][0], expected)
    envs.close()
""")
    done = subprocess.run([sys.executable, "-W", "ignore", script], capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [
                              str(Path(diswm.__file__).parent), os.environ.get("PYTHONPATH")]))})
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def switching_trainer(folder, **changes):
    """A real trainer whose midpoint, 50, falls into the middle of its third episode."""
    cfg = tiny_config("dreamerv2", steps=100, time_limit=20, prefill=1000, eval_every=1000,
                      eval_episodes=1, **changes)
    return make_trainer(cfg, folder)


def play_on(trainer, episodes=99):
    """Episodes as the training loop runs them → [(first step, phase, centre of the colours), …]."""
    seen = []
    while trainer.progress < trainer.total and len(seen) < episodes:
        start = trainer.progress
        trainer.replay.add(trainer.play()[0][0])
        trainer.episodes += 1
        env, = trainer.envs.envs
        seen.append((start, env.get_wrapper_attr("phase"), materials(env).mean(0)))
    return seen


def test_colors_switch_exactly_once_at_the_midpoint_of_a_live_run(tmp_path):
    """Section 2, row 9: it fires at half of the env steps and ends the running episode."""
    trainer = switching_trainer(tmp_path)
    with contextlib.closing(trainer.envs):
        seen = play_on(trainer)
    assert [(start, phase) for start, phase, _ in seen] == [
        (0, "train"), (20, "train"), (40, "train"),
        (50, "shifted"), (70, "shifted"), (90, "shifted")]
    for _, phase, color in seen:
        assert np.abs(color - diswm.COLOR_CENTERS[phase]).max() < 0.2  # the simulator's own colours


@pytest.mark.parametrize("cut", [2, 3, 4])
def test_color_switch_survives_a_resume(tmp_path, cut):
    """A switch that fires on `step == midpoint` is lost, or fires twice, when cut there."""
    trainers = [switching_trainer(tmp_path) for _ in range(2)]
    with contextlib.ExitStack() as stack:
        for trainer in trainers:
            stack.callback(trainer.envs.close)
        seen = play_on(trainers[0], cut)
        trainers[1].replay = Replay(tmp_path / "episodes")
        trainers[1].load_state_dict(trainers[0].state_dict())
        seen += play_on(trainers[1])
    assert [phase for _, phase, _ in seen] == ["train"] * 3 + ["shifted"] * 3


def test_switch_at_one_never_changes_the_colors(tmp_path):
    """Collect uses the `train` colours throughout."""
    trainer = switching_trainer(tmp_path, switch=1.0)
    with contextlib.closing(trainer.envs):
        assert {phase for _, phase, _ in play_on(trainer)} == {"train"}


# === Stage transitions ============================================================================

RUN = "runs/finetune/cheetah_run-walker_walk/diswm/seed0"


@pytest.fixture
def empty(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("argv, says", [
    (("finetune", "--dst", "walker_walk"), "python diswm.py pretrain --src cheetah_run"),
    (("finetune", "--dst", "walker_walk", "--method", "no_disentangle"),
     "python diswm.py pretrain --src cheetah_run --method no_disentangle"),
    (("finetune", "--dst", "walker_walk", "--method", "dv2_finetune"),
     "python diswm.py pretrain --src cheetah_run --method dv2_finetune"),
    (("finetune", "--dst", "walker_walk", "--method", "apv"),
     "python diswm.py pretrain --src cheetah_run --method apv"),
    (("pretrain", "--videos", "."), "python diswm.py collect"),
    (("evaluate", "--run", RUN), "checkpoint"),
    (("traverse", "--run", RUN), "checkpoint"),
    (("plot",), "python diswm.py finetune"),
], ids=lambda value: "-".join(value[:1]) if isinstance(value, tuple) else "")
def test_stage_refuses_to_start_without_the_one_before(argv, says, empty):
    """collect → pretrain → finetune → evaluate, traverse, plot: one line says what is missing."""
    refuse(*argv, *DEBUG, says=says)
    assert not list(empty.rglob("*.pt"))


def test_finetune_refuses_an_unfinished_teacher(teacher, tmp_path):
    """A pretraining that was cut off is no teacher; the message says what finishes it."""
    state = torch.load(teacher, weights_only=True)
    state["trainer"]["progress"] = 7
    torch.save(state, tmp_path / "half.pt")
    refuse("finetune", "--teacher", tmp_path / "half.pt", "--runs", tmp_path / "runs", *DEBUG,
           says=("7 of 20", "python diswm.py pretrain --src cheetah_run"))


def test_finetune_refuses_a_teacher_of_another_source(teacher, tmp_path):
    """The run's folder, and whether η waits, follow --src: it has to be the teacher's."""
    refuse("finetune", "--src", "pusher", "--teacher", teacher, "--runs", tmp_path, *DEBUG,
           says="add --src cheetah_run")


def test_missing_teacher_is_looked_for_and_made_in_the_same_runs(tmp_path):
    """The command that it names mends it, wherever the runs are."""
    refuse("finetune", "--runs", tmp_path, *DEBUG, says=f"--method diswm --runs {tmp_path}")


def test_distillation_refuses_an_encoder_without_latents(teacher, tmp_path):
    """Eq. (3) compares 20 latents with 20 latents."""
    refuse("finetune", "--encoder", "conv", "--teacher", teacher, "--runs", tmp_path, *DEBUG,
           says=("β-VAE", "--encoder beta_vae"))


def test_teacher_and_student_of_one_seed_start_apart(root, teacher, tmp_path, monkeypatch):
    """The bug it kills: with the same first weights, their latents were aligned one by one (r = .3
    after 1 000 updates of the teacher, .0 for any other seed) before Eq. (3) had done anything."""
    encoders = {}

    def note(trainer, run):
        model = trainer.agent.model if run.stage == "finetune" else trainer.model
        encoders.setdefault(run.stage, []).append(
            torch.cat([p.detach().flatten() for p in model.encoder.parameters() if p.ndim > 1]))
    monkeypatch.setattr(diswm, "train", note)
    videos = next((root / "runs/collect").rglob("episodes"))
    for runs in (tmp_path / "a", tmp_path / "b"):
        succeed("pretrain", "--videos", videos, "--runs", runs, *DEBUG)
        succeed("finetune", "--teacher", teacher, "--runs", runs, *DEBUG)
    (video, again), (agent, agent_again) = encoders["pretrain"], encoders["finetune"]
    assert torch.equal(video, again) and torch.equal(agent, agent_again)
    assert torch.cosine_similarity(video, agent, dim=0).abs() < 0.1


def test_one_whole_video_set_serves_other_seeds_and_other_pretrainings(root, tmp_path):
    """The bugs it kills: a pretraining with other latents was refused, as the collecting had been
    started with another z_dim; and one with another seed took an unfinished set."""
    shutil.copytree(root / "runs/collect", tmp_path / "collect")
    argv = ("pretrain", "--runs", tmp_path, *DEBUG, "--pretrain-updates", 2)
    said = succeed(*argv, "--z-dim", 10) + succeed(*argv, "--seed", 1)
    assert "collect dreamerv2" not in said
    checkpoint = tmp_path / COLLECTED / "checkpoint.pt"
    state = torch.load(checkpoint, weights_only=True)
    state["trainer"]["progress"] -= 50
    torch.save(state, checkpoint)
    assert "seed2/episodes" in succeed(*argv, "--seed", 2)


def test_evaluate_refuses_a_run_without_a_policy(teacher):
    """A video predictor cannot act."""
    refuse("evaluate", "--run", teacher.parent, says="finetune")


def test_finetune_refuses_a_policy_as_a_teacher(finished, tmp_path):
    """--teacher takes a pretrain checkpoint."""
    refuse("finetune", "--teacher", finished / "checkpoint.pt", "--runs", tmp_path / "runs", *DEBUG,
           says="python diswm.py pretrain --src cheetah_run")


@pytest.fixture(scope="session", params=["dv2_finetune", "apv"])
def carried(request, root, tmp_path_factory):
    """A method that carries weights over, and its finished pretraining."""
    runs = tmp_path_factory.mktemp(request.param)
    succeed("pretrain", "--src", "cheetah_run", "--method", request.param, "--runs", runs,
            "--videos", next((root / "runs/collect").rglob("episodes")), *DEBUG)
    return request.param, runs / f"pretrain/cheetah_run/{request.param}/seed0/checkpoint.pt"


def carried_command(carried, runs):
    """From 6 actions to 1."""
    method, video = carried
    return ("finetune", "--dst", "cartpole_swingup", "--method", method, "--teacher", video,
            "--runs", runs, *CUT_FLAGS)


def test_exactly_the_pretrained_weights_are_carried_over_and_the_rest_is_fresh(carried, tmp_path):
    """At update 0: encoder, image decoder and RSSM (in a stack, below) are the video predictor's;
    heads, actor, critic, RSSM above and input weights of actions are an untrained agent's."""
    interrupt(diswm.ActionRepeat, "step", 1, carried_command(carried, tmp_path))
    state = torch.load(next(tmp_path.rglob("checkpoint.pt")), weights_only=True)
    video = torch.load(carried[1], weights_only=True)["trainer"]["model"]
    fresh = make_agent(diswm.Config(**state["config"]), 1).state_dict()
    agent, below = state["trainer"]["agent"], "rssm.below." if carried[0] == "apv" else "rssm."
    video = {key.replace("rssm.", below): value for key, value in video.items()}
    assert video.keys() < agent["model"].keys()
    for key, value in agent["model"].items():
        source, width = fresh["model"][key].clone(), 0
        if key in video:
            width = video[key].shape[-1]
            source[..., :width] = video[key]
            assert width == value.shape[-1] or key == "rssm.inputs.0.weight"
        assert torch.equal(value, source), key
    assert_identical(agent["behaviour"], fresh["behaviour"])
    assert "teacher" not in agent


def test_run_that_carried_weights_over_resumes_bit_for_bit_without_the_pretraining(
        carried, tmp_path):
    """Weights, Adam, and APV's queue, projection and running mean are all in the checkpoint."""
    one, two, video = tmp_path / "one", tmp_path / "two", tmp_path / "video.pt"
    shutil.copy(carried[1], video)
    succeed(*carried_command(carried, one))
    argv = carried_command((carried[0], video), two)
    interrupt(diswm.ActionRepeat, "step", 90, argv)
    model = torch.load(next(two.rglob("checkpoint.pt")), weights_only=True)["trainer"]["agent"]
    saved = {key.removeprefix("bonus.") for key in model["model"] if key.startswith("bonus.")}
    if carried[0] == "apv":
        assert saved == {"queue", "filled", "projection", "scale"}
        assert model["model"]["bonus.filled"] > 0 and model["model"]["bonus.scale"] < 1
    video.unlink()
    succeed(*argv)
    assert_identical(*(everything(next(runs.rglob("seed0"))) for runs in (one, two)))


def test_pipeline_of_methods_that_carry_weights_over(carried):
    """pretrain → finetune → evaluate → traverse on real DMC, from 6 actions to 1; bench."""
    method, video = carried
    runs = video.parents[4]
    argv = ("finetune", "--dst", "cartpole_swingup", "--method", method, "--runs", runs, *DEBUG)
    assert str(video) in succeed(*argv, "--steps", 120)  # found by itself
    folder = runs / f"finetune/cheetah_run-cartpole_swingup/{method}/seed0"
    assert np.load(folder / "episodes/000000.npy")["action"].shape[1] == 1
    values = {key: value for row in read_rows(folder) for key, value in row.items()}
    assert "distill" not in values and np.isfinite(values["reward"])
    succeed("evaluate", "--run", folder)
    for run in (folder, video.parent):
        succeed("traverse", "--run", run)
        check_picture(run / "open_loop.png")
    assert "world_model" in succeed("bench", "--method", method, *DEBUG)


def test_carrying_over_refuses_what_does_not_fit(carried, teacher, tmp_path):
    """Another architecture is one line: a β-VAE's weights, or other sizes, with the way out."""
    argv = ("finetune", "--method", carried[0], "--runs", tmp_path, *DEBUG, "--teacher")
    refuse(*argv, teacher, says=("beta_vae", f"pretrain --src cheetah_run --method {carried[0]}"))
    refuse(*argv, carried[1], "--cnn-depth", 5, says=("another cnn_depth", "--cnn-depth 4"))
    refuse(*argv, carried[1], "--stoch", 7, says=("another stoch", "--stoch 6"))
    refuse(*argv, carried[1], "--eta", 0.1, says="no teacher")
    assert not list(tmp_path.rglob("*.pt"))


def test_a_teacher_may_also_give_its_weights(teacher, tmp_path):
    """Settings combine: distillation from β-VAE latents into a model that starts from them."""
    succeed("finetune", "--dst", "cartpole_swingup", "--carry-over", "stack", "--bonus", 0.1,
            "--teacher", teacher, "--runs", tmp_path, *DEBUG, "--steps", 120)
    folder = next(tmp_path.rglob("seed0"))
    assert any("distill" in row for row in read_rows(folder))
    succeed("traverse", "--run", folder)


def test_pretraining_sees_only_images_and_where_episodes_begin(root, tmp_path):
    """From collect to pretrain goes exactly the video: no action, no reward, whatever they are."""
    source = next((root / "runs/collect").rglob("episodes"))
    for path in source.glob("*.npy"):
        np.savez(tmp_path / path.stem, image=np.load(path)["image"])
    videos = [diswm.open_videos(folder, tmp_path / "cache") for folder in (source, tmp_path)]
    batches = [video.sample(4, 8, np.random.default_rng(0)) for video in videos]
    assert batches[0].keys() == {"image", "is_first"}
    assert_same(batches[0], batches[1])


def test_finetuning_takes_exactly_the_teachers_encoder_and_leaves_it_as_it_was(teacher, finished):
    """Section 2, row 2: the published code trains the teacher along. Its bytes must not change."""
    before = torch.load(teacher, weights_only=True)["trainer"]["model"]
    after = torch.load(finished / "checkpoint.pt", weights_only=True)["trainer"]["agent"]
    kept = after["teacher"]
    encoder = {key for key in before if key.startswith("encoder.")}
    assert {f"encoder.{key}" for key in kept} == encoder
    assert all(torch.equal(value, before[f"encoder.{key}"]) for key, value in kept.items())
    assert not any(torch.equal(value, after["model"][f"encoder.{key}"])
                   for key, value in kept.items() if key.endswith("weight"))


@settings(max_examples=10)
@given(prefill=st.integers(0, 25), first=st.integers(1, 4), every=st.integers(1, 6),
       delay=st.integers(0, 40), decay=st.integers(5, 60))
def test_prefill_then_first_updates_then_steady_state_on_a_live_eta(
        prefill, first, every, delay, decay):
    """The published schedule; η counts live decisions, prefill included (row 3)."""
    cfg = tiny_config("diswm", prefill=prefill, first_updates=first, train_every=every, steps=100,
                      eta_delay=delay, eta_decay=decay, eta=0.1, eta_end=0.01, batch_length=8)
    acted, calls = [], []
    with tempfile.TemporaryDirectory() as folder:
        trainer = counting_trainer(cfg, folder, length=20)
        act = trainer.agent.act
        trainer.agent.act = lambda *args, **kwargs: (
            acted.append(trainer.decisions) or act(*args, **kwargs))
        trainer.agent.update = lambda batch, eta, update: calls.append(
            (trainer.decisions, update, eta)) or dict(
                loss=torch.zeros(()))
        play_on_counting(trainer)
    # Nothing can be learnt before the first episode, of ten decisions, is in the replay.
    start = max(prefill, 11)
    due = [start] * first + [n for n in range(start + 1, 51) if n % every == 0]
    assert [decision for decision, _, _ in calls] == due
    assert [update for _, update, _ in calls] == list(range(len(due)))
    assert acted == list(range(prefill, 50))
    for decision, _, eta in calls:
        expected = 0 if decision < delay else max(0.1 * (1 - (decision - delay) / decay), 0.01)
        assert eta == pytest.approx(expected)


def play_on_counting(trainer):
    """Play a CountingEnv trainer to its end."""
    while trainer.progress < trainer.total:
        trainer.replay.add(trainer.play()[0][0])
        trainer.episodes += 1


# === Figures: what plot and traverse report =======================================================

def random_runs(seed, seeds_, steps=5):
    """Evaluation returns of some seeds at the same steps, as `plot` reads them from the logs."""
    returns = np.random.default_rng(seed).gamma(2, 50, (seeds_, steps))
    return [dict(zip(range(10, 10 * steps + 1, 10), run, strict=True)) for run in returns]


def sorted_middle(values):
    """Interquartile mean by hand: sort, drop a quarter (rounded down) at both ends, average."""
    drop = len(values) // 4
    return np.mean(sorted(values)[drop:len(values) - drop])


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_interval_is_that_of_all_possible_resamples(count):
    """rliable: percentiles of the interquartile mean over runs drawn with replacement."""
    runs = random_runs(count, count, steps=3)
    found = diswm.curve_figures(runs)
    for point, step in enumerate(runs[0]):
        returns = [run[step] for run in runs]
        every = [sorted_middle(draw) for draw in itertools.product(returns, repeat=count)]
        mean, low, high = (estimate[point] for estimate in found["curve"])
        assert mean == pytest.approx(sorted_middle(returns))
        # The exact 2.5 and 97.5 % points, give or take the bootstrap's own noise in probability.
        for end, share in ((low, 2.5), (high, 97.5)):
            below, above = np.percentile(
                every, [share - 0.4, share + 0.4], method="inverted_cdf")
            assert below - 1e-9 <= end <= above + 1e-9


def test_interquartile_mean_ignores_a_seed_that_went_wild():
    """Why not the mean: one of four seeds must not decide."""
    runs = [{10: value} for value in (1.0, 2.0, 4.0, 1000.0)]
    assert diswm.curve_figures(runs)["curve"][0] == [3.0]


def test_one_seed_has_no_interval():
    """A band around a single run would claim something that nobody measured."""
    found = diswm.curve_figures(random_runs(0, 1), switch=20)
    assert all(len(found[name]) == 1 for name in ("curve", *diswm.CURVE))


def test_area_final_and_switch_figures_are_those_worked_out_by_hand():
    """area: trapezia by the steps between first and last; unequal gaps must count as such."""
    runs = [{10: 0.0, 20: 10.0, 40: 20.0, 50: 60.0}, {10: 2.0, 20: 12.0, 40: 22.0, 50: 62.0}]
    found = diswm.curve_figures(runs, switch=25)
    assert found["area"][0] == pytest.approx((5 * 10 + 15 * 20 + 40 * 10) / 40 + 1)
    assert found["final"][0] == pytest.approx(31.0)
    assert (found["before"][0], found["after"][0]) == (11.0, 21.0)
    at_evaluation = diswm.curve_figures(runs, switch=40)  # evaluated in the old colours still
    assert (at_evaluation["before"][0], at_evaluation["after"][0]) == (21.0, 61.0)
    assert "before" not in diswm.curve_figures(runs) | diswm.curve_figures(runs, switch=50)


def test_curve_has_the_steps_that_all_seeds_have():
    """Runs of different lengths and evaluation intervals; without a common step there is none."""
    runs = [{10: 1.0, 20: 2.0, 30: 3.0}, {20: 4.0, 30: 5.0}, {30: 7.0, 20: 6.0, 25: 0.0}]
    found = diswm.curve_figures(runs)
    assert (found["seeds"], found["steps"]) == (3, [20, 30])
    assert found["curve"][0] == pytest.approx([4.0, 5.0])
    with pytest.raises(UserError, match="share no"):
        diswm.curve_figures([{10: 1.0}, {20: 1.0}])


def test_plot_writes_and_prints_the_figures_of_each_method(tmp_path):
    """curves.json beside the picture: tasks → method → figures, the switch read from the log."""
    for seed, offset in enumerate((0, 10)):
        folder = tmp_path / f"finetune/a-b/diswm/seed{seed}"
        folder.mkdir(parents=True)
        rows = [dict(step=step, phase="train" if step <= 20 else "shifted",
                     eval_return=step + offset) for step in (10, 20, 30, 40)]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    out = succeed("plot", "--runs", tmp_path)
    found = json.loads((tmp_path / "curves.json").read_text())["a-b"]["diswm"]
    assert (found["seeds"], found["switch"], found["steps"]) == (2, 20, [10, 20, 30, 40])
    assert found["final"] == [35.0, 30.0, 40.0] and found["area"] == [30.0, 25.0, 35.0]
    assert (found["before"][0], found["after"][0]) == (25.0, 35.0)
    assert "a-b: diswm, 2 seeds, final [35.0, 30.0, 40.0]" in out
    check_picture(tmp_path / "curves.png")
    refuse("plot", folder, folder.parent / "seed9", says="seed9/metrics.jsonl")
    succeed("plot", folder, "--out", folder)
    check_picture(folder / "curves.png")


def score(codes, factors):
    """The four scores, a latent's share of each factor (K, Z)."""
    return diswm.disentanglement(np.asarray(codes), np.asarray(factors))


def uniform_factors(count=3, rows=1200, seed=0):
    """Independent factors."""
    return np.random.default_rng(seed).uniform(-1, 1, (rows, count))


def check_permuted_factors_are_disentangled():
    """Codes that are the factors, in another order and scale, beside noise of no use."""
    factors = uniform_factors()
    noise = uniform_factors(2, seed=1)
    scores, share = score(np.hstack([factors[:, [2, 0, 1]] * [-9, 0.1, 1], noise]), factors)
    assert 0.9 < min(scores.values()) <= max(scores.values()) <= 1
    assert share.argmax(1).tolist() == [1, 2, 0] and share[:, 3:].max() < 0.02


def check_rotated_factors_are_entangled():
    """Every code is a mixture of all factors: all is known, nothing is separate."""
    factors = uniform_factors()
    rotation = np.array([[1, -2, 2], [2, -1, -2], [2, 2, 1]]) / 3
    scores, _ = score(factors @ rotation.T, factors)
    assert scores["informativeness"] > 0.8
    assert max(scores["disentanglement"], scores["completeness"]) < 0.4 and scores["mig"] < 0.15


def check_noise_informs_of_nothing():
    """R² is of held-out data: trees know their own noise by heart."""
    scores, share = score(uniform_factors(4, seed=1), uniform_factors())
    assert scores["informativeness"] == share.max() < 0.02 and scores["mig"] < 0.05


def check_duplicated_factor_lowers_completeness_and_mig():
    """Two codes of one factor: each has one factor still, but the factor has two."""
    factors = uniform_factors()
    alone, _ = score(factors, factors)
    noisy = factors + 0.05 * uniform_factors(seed=2), factors + 0.05 * uniform_factors(seed=3)
    twice, _ = score(np.hstack(noisy), factors)
    assert twice["disentanglement"] > 0.9 and twice["informativeness"] > 0.9
    assert twice["completeness"] < alone["completeness"] - 0.2
    assert twice["mig"] < 0.1 < 0.9 < alone["mig"]


def check_one_code_of_two_factors_is_not_disentangled():
    """Two factors in one code: complete, as each factor has one code, but not disentangled."""
    factors = uniform_factors(3)
    code = np.round(factors[:, :1] * 8) + factors[:, 1:2] * 0.4  # before and after the point
    scores, _ = score(np.hstack([code, factors[:, 2:]]), factors)
    assert scores["completeness"] > 0.8 > 0.75 > scores["disentanglement"]


METRICS = (check_permuted_factors_are_disentangled, check_rotated_factors_are_entangled,
           check_noise_informs_of_nothing, check_duplicated_factor_lowers_completeness_and_mig,
           check_one_code_of_two_factors_is_not_disentangled)


@pytest.mark.parametrize("check", METRICS, ids=lambda check: check.__name__.removeprefix("check_"))
def test_dci_and_mig_of_codes_whose_scores_are_known(check):
    """Eastwood & Williams (2018), Chen et al. (2018)."""
    check()


def test_constant_and_single_latents_have_scores():
    """A latent that β has switched off, or --z-dim 1, must not give NaN."""
    factors = uniform_factors(2)
    for codes in (np.zeros_like(factors), factors[:, :1]):
        scores, share = score(codes, factors)
        assert np.isfinite([*scores.values()]).all() and np.isfinite(share).all()


@pytest.fixture
def few_frames(monkeypatch):
    """Labelled sets of seconds."""
    monkeypatch.setattr(diswm, "FRAMES", 100)
    monkeypatch.setattr(diswm, "DECISIONS", 20)


def test_labelled_frames_know_the_colors_and_joints_that_they_show(few_frames):
    """A label one frame off would call any encoder entangled; check it against the pixels."""
    cfg = tiny_config(dst="cartpole_swingup")
    images, factors, names = diswm.labelled_frames(cfg)
    assert images.shape == (100, 64, 64, 3) and factors.shape == (100, len(names))
    assert {"floor colour (red)", "body colour (blue)", "slider", "hinge_1"} <= {*names}
    floor = images[:, 56:].mean((1, 2))                                       # below the cart
    for channel, color in enumerate(("red", "green", "blue")):
        label = factors[:, names.index(f"floor colour ({color})")]
        assert np.corrcoef(floor[:, channel], label)[0, 1] > 0.9
    colors = factors[:, [" colour " in name for name in names]]
    low, high = np.array(diswm.COLOR_CENTERS["train"]), np.array(diswm.COLOR_CENTERS["shifted"])
    low, high = np.minimum(low, high) - 0.2, np.maximum(low, high) + 0.2
    found = colors.reshape(100, -1, 3)
    assert (low - 1e-6 <= found).all() and (found <= high + 1e-6).all()
    assert len(np.unique(colors, axis=0)) == 100                              # each frame anew
    assert np.ptp(found, 0).min() > 0.45                                      # of both phases
    off_diagonal = np.corrcoef(colors.T)[~np.eye(colors.shape[1], dtype=bool)]
    assert np.abs(off_diagonal).max() < 0.5                                   # each by itself
    assert np.abs(factors[:, names.index("hinge_1")]).max() <= np.pi


def test_materials_that_do_not_show_are_no_factors(few_frames):
    """finger_spin has a target that is hidden: no latent can know its colour."""
    _, factors, names = diswm.labelled_frames(tiny_config(dst="finger_spin"))
    assert {name.split(" colour ")[0] for name in names if " colour " in name} == {
        "floor", "body", "effector", "decoration"}
    assert np.ptp(factors, 0).min() > 0


def test_start_encoder_is_the_first_checkpoint_bit_for_bit(teacher, tmp_path, monkeypatch):
    """--metrics builds it anew from the seed; it must be what finetune began with."""
    argv = cut_command(teacher, tmp_path)
    interrupt(diswm.ActionRepeat, "step", 10, argv)
    folder = next(tmp_path.rglob("checkpoint.pt")).parent
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)["trainer"]
    assert saved["progress"] == 0
    cfg, agent, _ = diswm.load_model(folder / "checkpoint.pt", CPU)
    seen = []
    monkeypatch.setattr(diswm, "labelled_frames", lambda cfg: (
        np.zeros((8, 64, 64, 3), np.uint8), uniform_factors(2, 8), ["a", "b"]))
    monkeypatch.setattr(diswm.BetaVAEEncoder, "forward", lambda self, image: (
        seen.append(self) or torch.zeros(len(image), 20), None))
    torch.manual_seed(1234)
    diswm.measure(cfg, agent.model, agent.teacher, tmp_path / "out.json")
    taught, start, end = seen
    assert (taught, end) == (agent.teacher, agent.model.encoder) and start is not end
    assert same(start, {key.removeprefix("encoder."): value for key, value
                        in saved["agent"]["model"].items() if key.startswith("encoder.")})


def test_traverse_measures_disentanglement_and_labels_the_picture(
        finished, teacher, few_frames, monkeypatch):
    """Real DMC: JSON of all encoders; rows by nats, each with the factor that it follows most."""
    drawn, draw = {}, diswm.draw_grid
    monkeypatch.setattr(diswm, "draw_grid", lambda pictures, rows, columns, path, title="": (
        drawn.update({path.name: rows}) or draw(pictures, rows, columns, path, title)))
    for folder, names in ((finished, ["teacher", "start", "end"]), (teacher.parent,
                                                                    ["start", "end"])):
        out = succeed("traverse", "--run", folder, "--metrics")
        result = json.loads((folder / "disentanglement.json").read_text())
        assert [*result] == ["task", "factors", *names]
        assert result["task"] == ("walker_walk" if folder == finished else "cheetah_run")
        share = np.array(result["end"]["share"])
        assert share.shape == (len(result["factors"]), 20)
        assert share.sum() / len(share) == pytest.approx(result["end"]["informativeness"], abs=0.01)
        assert all(f"{name} " in out for name in names) and "mig 0." in out
        rows = [row.split("  ") for row in drawn["traversal.png"]]
        nats = [float(row[1].removesuffix(" nats")) for row in rows]
        assert nats == sorted(nats, reverse=True)
        for latent, _, follows in rows:
            best = share[:, int(latent[1:])]
            assert follows == f"{result['factors'][best.argmax()]} {best.max():.2f}"
        check_picture(folder / "traversal.png", low=500)


def test_traverse_measures_what_its_flags_say(teacher, monkeypatch):
    """They override the run's own: a predictor of cheetahs, asked about walkers."""
    asked = []
    monkeypatch.setattr(diswm, "measure", lambda cfg, model, *args: (
        asked.extend([cfg, model.cfg]) or [""] * 20))
    succeed("traverse", "--metrics", "--run", teacher.parent, "--dst", "walker_walk", "--colors",
            "original")
    assert (asked[0].dst, asked[0].colors, asked[0].z_dim) == ("walker_walk", "original", 20)
    assert (asked[1].dst, asked[1].colors) == ("cheetah_run", "published")


def test_metrics_need_a_beta_vae(tmp_path):
    """DreamerV2's encoder has no latents of which to ask."""
    succeed("finetune", "--method", "dreamerv2", "--runs", tmp_path, *DEBUG, "--steps", 60,
            "--prefill", 60)
    refuse("traverse", "--metrics", "--run", next(tmp_path.rglob("seed0")), says="--metrics")


# === System: one whole pipeline ===================================================================

TERMS = {
    "image", "reward", "discount", "kl", "disentangle", "distill", "eta", "actor", "critic",
    "actor_entropy", "post_entropy", "prior_entropy", "model_grad_norm", "actor_grad_norm",
    "critic_grad_norm", "distill_grad_norm", "train_return", "eval_return", "rate", "seconds"}


def read_rows(folder):
    """metrics.jsonl as a list of dicts."""
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def check_picture(path, low=100):
    """The file opens as a picture of sane size that is not of one colour."""
    picture = iio.imread(path)
    assert min(picture.shape[:2]) >= low and max(picture.shape[:2]) < 4000 and picture.std() > 5


def test_pipeline_logs_every_loss_term_by_name(finished):
    """Issue 2, point 5. All numbers are finite, and η falls."""
    rows = read_rows(finished)
    values = {key: value for row in rows for key, value in row.items()}
    assert values.keys() >= TERMS
    assert all(np.isfinite(value).all() for row in rows for value in row.values()
               if not isinstance(value, str))
    eta = [row["eta"] for row in rows if "eta" in row]
    assert eta[0] > eta[-1] == pytest.approx(PRESETS["debug"].eta_end)


def test_pipeline_counts_env_steps_and_switches_once(finished):
    """Steps in logs are simulator steps: repeat × decisions; 300 of them, half in each phase."""
    rows = read_rows(finished)
    assert [row["step"] for row in rows] == [50, 100, 150, 200, 250, 300]
    assert all(row["step"] == 2 * row["decisions"] for row in rows)
    assert [row["phase"] for row in rows] == ["train"] * 3 + ["shifted"] * 3
    assert [row["step"] for row in rows if "eval_return" in row] == [100, 200, 300]
    assert [row["eval_step"] for row in rows if "eval_return" in row] == [100, 200, 300]


def test_pipeline_evaluates_draws_and_plots(finished, teacher, root):
    """pretrain → finetune → evaluate → traverse → plot on real DMC leaves files that open."""
    succeed("evaluate", "--run", finished)
    result = json.loads((finished / "evaluation.json").read_text())
    assert (result["task"], result["phase"], result["step"]) == ("walker_walk", "shifted", 300)
    assert len(result["returns"]) == 2
    assert result["mean"] == pytest.approx(np.mean(result["returns"]))
    assert result["std"] == pytest.approx(np.std(result["returns"])) and "random_mean" in result
    video = iio.imread(finished / "evaluation.mp4")
    assert video.shape[1:] == (256, 256, 3) and 24 <= len(video) <= 28 and video.std() > 5
    for folder in (finished, teacher.parent):
        succeed("traverse", "--run", folder)
        check_picture(folder / "traversal.png", low=500)
        check_picture(folder / "open_loop.png")
    succeed("plot", "--runs", root / "runs", "--out", root / "curves.png")
    check_picture(root / "curves.png")


def test_checkpoint_between_two_log_rows_holds_plain_numbers(root):
    """The bug it kills: they were tensors of the GPU, and on resuming of the CPU: not one mean."""
    videos = Replay(next((root / "runs/collect").rglob("episodes")))
    trainer = diswm.VideoTrainer(tiny_config(), videos, CPU)
    assert trainer.advance() is None
    row, = trainer.state_dict()["metrics"]
    assert {type(value) for value in row.values()} == {float}


def test_pipeline_continues_a_finished_run_by_doing_nothing(finished, root):
    """The same command run again resumes where it stopped: at the end."""
    before = {path: path.read_bytes() for path in finished.rglob("*.npy")}
    rows = read_rows(finished)
    succeed("finetune", "--dst", "walker_walk", "--runs", root / "runs", *DEBUG)
    assert read_rows(finished) == rows
    assert {path: path.read_bytes() for path in finished.rglob("*.npy")} == before


def test_fresh_starts_over_and_other_flags_are_refused(root, tmp_path):
    """A resumed run must not silently change what it computes."""
    argv = ("pretrain", "--src", "cheetah_run", "--runs", tmp_path, *DEBUG, "--videos",
            next((root / "runs/collect").rglob("episodes")), "--pretrain-updates", 2)
    succeed(*argv)
    refuse(*argv, "--beta2", 0.5, says=("beta2", "--fresh"))
    succeed(*argv, "--beta2", 0.5, "--fresh")


def test_fresh_loses_nothing_to_a_mistake(finished, teacher, tmp_path):
    """The bug it kills: the old run was gone before the new one's teacher was looked for."""
    run = tmp_path / FINETUNED
    shutil.copytree(finished, run)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    argv = ("finetune", "--runs", tmp_path, *DEBUG, "--fresh")
    refuse(*argv, "--teacher", tmp_path / "nope.pt", says="nope.pt")
    refuse(*argv, "--batch-size", 10**6, "--batch-length", 1000, "--teacher", teacher,
           says="memory")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diswm.mujoco, "Renderer", lambda *args: None.eglQueryString)
        refuse(*argv, "--teacher", teacher, says="cannot render")
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_episodes_without_their_checkpoint_are_not_learnt_from(finished, teacher, tmp_path):
    """The bug it kills: a run whose checkpoint was deleted began anew with the old episodes."""
    run = tmp_path / FINETUNED
    shutil.copytree(finished, run)
    (run / "checkpoint.pt").unlink()
    refuse("finetune", "--runs", tmp_path, *DEBUG, "--teacher", teacher,
           says=("no checkpoint", "--fresh"))
    assert len([*(run / "episodes").iterdir()]) == len([*(finished / "episodes").iterdir()])


@pytest.mark.parametrize("error", [
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB"),
    RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory")])
def test_too_little_memory_to_resume_is_not_called_a_damaged_checkpoint(
        error, finished, tmp_path, monkeypatch):
    """The bug it kills: the advice was --fresh, which would have deleted a good run."""
    run = tmp_path / FINETUNED
    shutil.copytree(finished, run)

    def fail(*args):
        raise error
    monkeypatch.setattr(diswm, "ActorCritic", fail)
    line = refuse("finetune", "--runs", tmp_path, *DEBUG, says="too large for the memory")
    assert "fresh" not in line


def test_videos_and_the_task_they_help_have_colours_of_their_own(tmp_path, monkeypatch):
    """The bug it kills: of one seed, a teacher's videos had the colours of its student's task."""
    played = []
    monkeypatch.setattr(diswm, "play_episodes", lambda envs, policy, seeds, *args: (
        played.append(seeds)))
    for dst in ("cheetah_run", "walker_walk"):
        trainer = counting_trainer(tiny_config("dreamerv2", dst=dst), tmp_path / dst, 9)
        for trainer.episodes in range(20):
            trainer.play()
    collected, played = played[:20], played[20:]
    assert not {*map(tuple, collected)} & {*map(tuple, played)}


@pytest.mark.parametrize("task", ["lqr_lqr_2_1", "lqr_lqr_6_2"])
def test_a_task_is_the_same_whenever_it_is_made(task):
    """lqr draws its springs and dampers as it is built, once from a random source of its own."""
    def states():
        with contextlib.closing(make_env(task, seed=3, pixels=False)) as env:
            return [env.step(np.ones(env.action_space.shape, np.float32))[0] for _ in range(5)]
    assert np.array_equal(states(), states())


def test_evaluate_plays_as_it_was_trained_but_for_what_it_is_given(finished, tmp_path):
    """The bug it kills: --eval-episodes was accepted, and the run's own number played."""
    run = tmp_path / FINETUNED
    shutil.copytree(finished, run)
    out = succeed("evaluate", "--run", run, "--eval-episodes", 3, "--colors", "original")
    assert "3 episodes each" in out
    assert len(json.loads((run / "evaluation.json").read_text())["returns"]) == 3


def test_evaluate_at_the_midpoint_has_the_colours_that_training_had(finished, tmp_path):
    """The episode that the switch ends, and its evaluation, have the first colours."""
    run = tmp_path / FINETUNED
    shutil.copytree(finished, run)
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    for step, phase in ((150, "train"), (152, "shifted")):
        state["trainer"]["progress"] = step
        torch.save(state, run / "checkpoint.pt")
        assert f"{phase} colours" in succeed("evaluate", "--run", run)


@pytest.mark.parametrize("method", ["dreamerv2", "no_distill"])
def test_methods_without_a_teacher_need_no_pretraining(method, tmp_path):
    """The baselines and ablations run through the same command."""
    succeed("finetune", "--method", method, "--runs", tmp_path, *DEBUG, "--steps", 120)
    values = {key for row in read_rows(next(tmp_path.rglob("seed0"))) for key in row}
    assert "distill" not in values and ("disentangle" in values) == (method != "dreamerv2")


def recompute(folder):
    """Returns of the episodes in <run>/evaluation, from the files alone."""
    returns = []
    for path in sorted((folder / "evaluation").glob("*.npy")):
        episode = np.load(path)
        assert episode["is_first"].tolist() == [True] + [False] * (len(episode) - 1)
        returns.append(episode["reward"].astype(float).sum())
    return returns


@pytest.mark.parametrize("task", ["pusher", "drawer_open"])
def test_cross_domain_pipeline_waits_with_distillation_and_evaluates(task, teacher, tmp_path):
    """The published delay is eta_decay decisions (60 of 100 here); drawers are judged
    on metal, which training never shows; the returns can be recomputed from the saved episodes."""
    succeed("finetune", "--dst", task, "--teacher", teacher, "--runs", tmp_path, *DEBUG,
            "--steps", 200, "--eval-every", 200)
    run = tmp_path / f"finetune/cheetah_run-{task}/diswm/seed0"
    rows = read_rows(run)
    assert json.loads((run / "config.json").read_text())["eta_delay"] == 60
    etas = {row["decisions"]: row["eta"] for row in rows if "eta" in row}
    assert etas[50] == 0 and etas[75] > 0 and etas[100] > 0
    drawer = task == "drawer_open"
    assert all(("train_success" in row) == drawer for row in rows)
    assert ("eval_success" in rows[-1]) == drawer
    (run / "evaluation").mkdir()
    (run / "evaluation/000007.npy").write_text("of an evaluation before")
    out = succeed("evaluate", "--run", run)
    result = json.loads((run / "evaluation.json").read_text())
    assert result["phase"] == ("eval" if drawer else "shifted")
    assert ("success" in result) == ("random_success" in result) == ("success" in out) == drawer
    assert recompute(run) == pytest.approx(result["returns"], rel=1e-6)
    assert f"return {np.mean(recompute(run)):.1f} ± {np.std(recompute(run)):.1f}" in out


@pytest.mark.parametrize("task, actions", [
    ("Hopper-v5", 3), ("FetchReach-v4", 4), ("cartpole_swingup", 1), ("humanoid_walk", 21)])
def test_tasks_with_early_ends_dict_observations_and_1_to_21_actions_train(task, actions, tmp_path):
    """Hopper falls: its last row is terminal and has discount 0. Fetch only counts its steps."""
    succeed("finetune", "--dst", task, "--method", "dreamerv2", "--runs", tmp_path, *DEBUG,
            "--steps", 160, "--eval-every", 80)
    run, = tmp_path.rglob("seed0")
    assert run.parent.parent.name == f"cheetah_run-{task}"
    assert read_rows(run)[-1]["updates"] > 0
    ends = []
    for episode in map(np.load, (run / "episodes").glob("*.npy")):
        assert episode["action"].shape[1] == actions
        assert (episode["discount"] == 1 - episode["is_terminal"]).all()
        assert not episode["is_terminal"][:-1].any()
        ends.append(bool(episode["is_terminal"][-1]))
    assert any(ends) == (task == "Hopper-v5")
    evaluated = [row for row in read_rows(run) if "eval_return" in row]
    assert [row["eval_step"] for row in evaluated] == [80, 160]  # due, and done soon after
    assert all(0 <= row["step"] - row["eval_step"] < 50 for row in evaluated)


def test_evaluation_files_and_returns_are_those_of_an_env_that_counts(tmp_path):
    """Rewards of CountingEnv are known: n + action / 2 at step n, summed over each decision."""
    cfg = tiny_config("dreamerv2", eval_episodes=3)
    trainer = counting_trainer(cfg, tmp_path, length=9)
    replay = Replay(tmp_path / "evaluation", ROWS)
    result = diswm.evaluate_agent(cfg, trainer.agent, trainer.envs, "train", replay)
    assert recompute(tmp_path) == pytest.approx(result["returns"])
    for index, total in enumerate(result["returns"]):
        held = np.repeat(np.load(replay.paths[index])["action"][1:, 0].astype(float), 2)[:9]
        assert total == pytest.approx(sum(range(1, 10)) + held.sum() / 2, abs=1e-5)


@pytest.mark.parametrize("tasks, title", [
    ("cheetah_run-walker_walk", "cheetah_run → walker_walk"),
    ("cheetah_run-FetchReach-v4", "cheetah_run → FetchReach-v4"),
    ("Hopper-v5-Walker2d-v5", "Hopper-v5 → Walker2d-v5")])
def test_plot_titles_name_both_tasks(tasks, title, tmp_path, monkeypatch):
    """Ids of Gymnasium have a hyphen of their own."""
    from matplotlib.axes import Axes
    titles, real = [], Axes.set
    monkeypatch.setattr(
        Axes, "set", lambda self, **values: titles.append(values["title"]) or real(self, **values))
    folder = tmp_path / tasks / "diswm" / "seed0"
    folder.mkdir(parents=True)
    (folder / "metrics.jsonl").write_text('{"step": 10, "eval_return": 1.0, "phase": "train"}\n')
    succeed("plot", folder, "--out", tmp_path / "curves.png")
    assert titles == [title]


def test_plot_joins_seeds_whose_episodes_end_early(tmp_path):
    """Where an episode may end any time, evaluations happen a few steps after they are due."""
    for seed, late in enumerate((12, 20)):
        folder = tmp_path / f"a-b/diswm/seed{seed}"
        folder.mkdir(parents=True)
        rows = [dict(step=step + late, eval_step=step, eval_return=1.0, phase="train")
                for step in (5000, 10000)]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    succeed("plot", *tmp_path.glob("*/*/*"), "--out", tmp_path / "curves.txt")  # always a PNG
    found = json.loads((tmp_path / "curves.json").read_text())["a-b"]["diswm"]
    assert (found["seeds"], found["steps"]) == (2, [5000, 10000])
    check_picture(tmp_path / "curves.png")


def test_plot_shows_returns_below_zero(tmp_path, monkeypatch):
    """The bug it kills: from 0 up, the pusher's curve, −300 … −72, was outside the picture."""
    from matplotlib.axes import Axes
    drawn, real = [], Axes.set
    monkeypatch.setattr(
        Axes, "set", lambda self, **values: drawn.append(self) or real(self, **values))
    for task, value in (("pusher", -300.0), ("walker_walk", 300.0)):
        folder = tmp_path / f"cheetah_run-{task}/diswm/seed0"
        folder.mkdir(parents=True)
        rows = [dict(step=step, eval_return=value / step, phase="train") for step in (1, 2)]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    succeed("plot", *tmp_path.glob("*/*/*"), "--out", tmp_path / "curves.png")
    lows = sorted(axes.get_ylim()[0] for axes in drawn)
    assert lows[0] < -300 and lows[1] == 0


def test_bench_reports_times_memory_and_parameters_as_one_json_object():
    """Issue 4: names with units; what the paper calls 5.8 M parameters is counted by part."""
    result = json.loads(succeed("bench", "--json", "--scaling", "--repeats", 1, *DEBUG))
    for name in ("train_step_s", "pretrain_step_s", "sample_ms", "peak_rss_mb"):
        assert result[name] > 0
    assert result["frame_ms"].keys() == result["decision_ms"].keys() >= {"pusher", "drawer_open"}
    assert all(ms > 0 for part in ("frame_ms", "decision_ms") for ms in result[part].values())
    params = result["params"]
    assert params.pop("total") == sum(params.values()) and "world_model" in params
    for name in ("batch_size_scaling", "horizon_scaling"):
        assert math.isfinite(result[name]["exponent"])
    assert {"device", "precision", "threads", "versions", "method", "batch_size"} <= result.keys()


def test_bench_prints_the_same_for_people():
    """Without --json, a line for each value, indented."""
    out = succeed("bench", "--repeats", 0, *DEBUG)  # at least one
    assert '\n  "train_step_s": ' in out and '\n    "total": ' in out
    assert "batch_size_scaling" not in out


def test_bf16_steps_like_fp32():
    """Issue 4: on real frames the loss agrees within 0.1 %, each module's gradient has a cosine of
    at least 0.9999. (The actor's and critic's losses are near zero, so only their gradients.)"""
    batch = fake_batch(8, 16, 6)
    with contextlib.closing(make_env("walker_walk", seed=0)) as env:
        env.action_space.seed(0)
        frames = [env.step(env.action_space.sample())[0] for _ in range(128)]
    batch["image"] = np.array(frames).reshape(8, 16, 64, 64, 3)

    def step(precision):
        cfg = dataclasses.replace(PRESETS["small"], precision=precision, device="cpu")
        torch.manual_seed(0)
        teacher = diswm.freeze(diswm.BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth))
        agent = diswm.Agent(cfg, 6, CPU, teacher)
        gradients = {}

        def keep(optimizer, loss, clip):
            gradient = torch.autograd.grad(loss, optimizer.weights)
            for p, g in zip(optimizer.weights, gradient, strict=True):
                gradients[p] = g.flatten().double()
            losses.append(loss.item())
            return torch.zeros(())
        losses, model, behaviour = [], agent.model, agent.behaviour
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(diswm.Adam, "minimize", keep)
            agent.update(batch, 0.1, 1)
        modules = dict(model.named_children(), actor=behaviour.actor, critic=behaviour.critic)
        return losses[0], {name: torch.cat([gradients[p] for p in module.parameters()])
                           for name, module in modules.items()}
    (loss, plain), (rounded_loss, rounded) = step("fp32"), step("bf16")
    assert rounded_loss != loss and rounded_loss == pytest.approx(loss, rel=1e-3)
    for name in plain:
        cosine = torch.cosine_similarity(plain[name], rounded[name], 0)
        assert cosine >= 0.9999, name


def test_doctor_renders_and_prints_versions(empty):
    """A frame of each family and phase, versions, device."""
    out = succeed("doctor", *DEBUG)
    assert all(text in out for text in ("python", "torch", "mujoco", "cpu"))
    check_picture(empty / "runs/doctor.png")


def test_doctor_names_each_family_that_fails_and_still_draws_the_others(empty, monkeypatch):
    """A missing package is one line with its mend, a grey row, and exit 1 at the end."""
    monkeypatch.setitem(sys.modules, "metaworld", None)  # as if it were not installed
    code, out, err = run_cli("doctor", *DEBUG)
    lines = [line for line in out.splitlines() if line.startswith("drawer_open:")]
    assert code == 1 and err.count("\n") == 1 and "drawer_open" in err and "pusher" not in err
    assert len(lines) == 1 and "pip install" in lines[0]
    check_picture(empty / "runs/doctor.png")


README = Path(diswm.__file__).with_name("README.md")


def readme_commands():
    """Every `python diswm.py …` in README.md's code blocks, in file order, as argv lists."""
    inside, commands = False, []
    for line in README.read_text().replace("\\\n", " ").splitlines():
        inside ^= line.startswith("```")
        if inside and line.strip().startswith("python diswm.py "):
            commands.append(shlex.split(line, comments=True)[2:])
    return commands


@pytest.mark.skipif(not README.exists(), reason="no README.md beside diswm.py")
def test_every_readme_command_runs(empty, few_frames):
    """In file order, in one folder, at debug size (also where the README gives a longer one)."""
    commands = readme_commands()
    assert len(commands) >= 5
    short = ("--steps", 200, "--collect-steps", 200, "--pretrain-updates", 5)
    for argv in commands:
        code, _, err = run_cli(*argv, *DEBUG, *short)
        assert code == 0, f"python diswm.py {' '.join(argv)}: {err}"


# === System: cut and resume =======================================================================

def patch_before_call(patch, owner, name, call, action):
    """From now on, `action` happens just before the `call`-th call of owner.name, counted from 1.
    Returns the count of calls, in a list."""
    original, count = getattr(owner, name), [0]

    @functools.wraps(original)
    def wrapper(*args, **kwargs):
        count[0] += 1
        if count[0] == call:
            action()
        return original(*args, **kwargs)

    patch.setattr(owner, name, wrapper)
    return count


def cut(patch, owner, name, call):
    """Ctrl-C at the `call`-th call of owner.name. Returns the count of calls, in a list."""
    def interrupt():
        raise KeyboardInterrupt
    return patch_before_call(patch, owner, name, call, interrupt)


COLLECTED = "collect/cheetah_run/dreamerv2/seed0"
PRETRAINED = "pretrain/cheetah_run/diswm/seed0"
FINETUNED = "finetune/cheetah_run-walker_walk/diswm/seed0"

# The switch, at 130, falls into an episode; so does no evaluation: they follow episodes 3 and 6.
CUT_FLAGS = (*DEBUG, "--steps", 260, "--eval-every", 120, "--slow-every", 4)


def cut_command(teacher, runs):
    """130 decisions: prefill 50, first updates at 50, slow copies at updates 0, 4, 8."""
    return ("finetune", "--dst", "walker_walk", "--teacher", teacher, "--runs", runs, *CUT_FLAGS)


def everything(run):
    """All that a run leaves behind and that must not depend on interruptions."""
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    rows = [{key: value for key, value in row.items() if key not in ("seconds", "rate")}
            for row in read_rows(run)]
    files = {path.name: path.read_bytes() for path in sorted((run / "episodes").glob("*"))}
    assert state["log"] == (run / "metrics.jsonl").read_text()
    return dict(trainer=state["trainer"], rows=rows, files=files)


def assert_identical(one, two, where=""):
    """Equal bit for bit, through dicts and lists."""
    assert type(one) is type(two), where
    if isinstance(one, dict):
        assert list(one) == list(two), where
        for key in one:
            assert_identical(one[key], two[key], f"{where}/{key}")
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(two), where
        for index, pair in enumerate(zip(one, two, strict=True)):
            assert_identical(*pair, f"{where}/{index}")
    elif isinstance(one, torch.Tensor):
        assert one.dtype == two.dtype and torch.equal(one, two), where
    else:
        assert one == two, where


@pytest.fixture(scope="session")
def uncut(teacher, tmp_path_factory):
    """What an uninterrupted finetuning leaves behind."""
    runs = tmp_path_factory.mktemp("uncut")
    succeed(*cut_command(teacher, runs))
    return everything(next(runs.rglob("seed0")))


def interrupt(owner, name, call, argv):
    """Run a command with a cut in it: it exits 130, in one line, and the cut really fell."""
    with pytest.MonkeyPatch.context() as patch:
        count = cut(patch, owner, name, call)
        code, _, err = run_cli(*argv)
    assert count[0] >= call, f"{name} was called only {count[0]} times"
    assert code == 130 and "Traceback" not in err and len(err.strip().splitlines()) == 1


CUTS = {
    "mid-episode in prefill": (diswm.ActionRepeat, "step", 40),
    "between the first updates": (diswm.Agent, "update", 2),
    "in the evaluation after the switch": (diswm.ActionRepeat, "step", 80),
    "after an episode, before it is in the replay": (diswm.Replay, "add", 3),
    "after the log row, before its checkpoint": (diswm.Run, "save", 4),
    "after a checkpoint, before old episodes go": (diswm.Replay, "prune", 2),
    "at the first decision in shifted colours": (diswm.ActionRepeat, "step", 116),
    "at a copy of the slow critic": (diswm.ActorCritic, "copy_critic", 3),
}


@pytest.mark.parametrize("where", CUTS)
def test_finetuning_cut_and_resumed_equals_an_uncut_run_bit_for_bit(
        where, teacher, uncut, tmp_path):
    """Weights, Adam, slow critic, replay files, log: wherever Ctrl-C falls."""
    argv = cut_command(teacher, tmp_path)
    interrupt(*CUTS[where], argv)
    succeed(*argv)
    assert_identical(everything(next(tmp_path.rglob("seed0"))), uncut)


@settings(max_examples=1)
@given(first=st.integers(1, 200), second=st.integers(1, 60))
def test_finetuning_cut_twice_anywhere_equals_an_uncut_run_bit_for_bit(
        teacher, uncut, first, second):
    """Resume of a resume: the episode index, not the process, seeds an episode."""
    with tempfile.TemporaryDirectory() as runs:
        argv = cut_command(teacher, runs)
        interrupt(diswm.ActionRepeat, "step", first, argv)
        with pytest.MonkeyPatch.context() as patch:
            cut(patch, diswm.ActionRepeat, "step", second)
            assert run_cli(*argv)[0] in (0, 130)  # 0: less was left than `second`
        succeed(*argv)
        assert_identical(everything(next(Path(runs).rglob("seed0"))), uncut)


@pytest.mark.parametrize("owner, name, call", [
    (diswm.VideoTrainer, "update", 3), (diswm.VideoTrainer, "update", 8), (diswm.Run, "save", 3)])
def test_pretraining_cut_and_resumed_equals_an_uncut_run_bit_for_bit(
        owner, name, call, root, tmp_path, monkeypatch):
    """Batches and noise follow from an update's number: only weights and Adam need saving."""
    monkeypatch.setattr(diswm.VideoTrainer, "chunk", 5)
    videos = next((root / "runs/collect").rglob("episodes"))
    argv = ("pretrain", "--videos", videos, *DEBUG, "--pretrain-updates", 12, "--runs")
    succeed(*argv, tmp_path / "one")
    interrupt(owner, name, call, (*argv, tmp_path / "two"))
    succeed(*argv, tmp_path / "two")
    one, two = (next((tmp_path / runs).rglob("seed0")) for runs in ("one", "two"))
    assert_identical(everything(two), everything(one))


def test_pretraining_sees_the_same_videos_whatever_the_chunk_of_its_log(
        root, tmp_path, monkeypatch):
    """How often a checkpoint is written must not change what is learnt."""
    videos, weights = next((root / "runs/collect").rglob("episodes")), []
    for chunk in (3, 100):
        monkeypatch.setattr(diswm.VideoTrainer, "chunk", chunk)
        succeed("pretrain", "--videos", videos, *DEBUG, "--pretrain-updates", 6, "--runs",
                tmp_path / str(chunk))
        path = next((tmp_path / str(chunk)).rglob("checkpoint.pt"))
        weights.append(torch.load(path, weights_only=True)["trainer"]["model"])
    assert_identical(*weights)


def start(argv):
    """A real process of a command line, whose output nobody reads."""
    return subprocess.Popen([sys.executable, diswm.__file__, *map(str, argv)],
                            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def kill_at(argv, run, moment, skip):
    """SIGKILL a real process in the (skip + 1)-th write of a "checkpoint" or "episode", or so many
    seconds after its run folder is locked. Returns what was written at its death: a file that the
    process left half done or had not yet put in its place, "between", or "finished"."""
    def unfinished():
        """Files being written, and when they last were; what earlier kills left keeps its time."""
        for path in run.rglob("*.tmp"):
            with contextlib.suppress(FileNotFoundError):
                yield path, path.stat().st_mtime_ns

    names, before = dict(checkpoint="checkpoint.pt.tmp", episode=".npy.tmp"), set(unfinished())
    process, begin, seen, inside = start(argv), None, -1, False
    while process.poll() is None:
        if moment in names:
            found = any(path.name.endswith(names[moment]) for path, _ in set(unfinished()) - before)
            seen, inside = seen + (found and not inside), found
            if seen == skip:
                break
        elif (run / "lock").exists():
            begin = begin or time.time()
            if time.time() > begin + moment:
                break
        time.sleep(0.0001)
    process.kill()
    _, err = process.communicate()
    assert process.returncode in (0, -signal.SIGKILL), err
    left = [f"{path.name} {path.stat().st_size} bytes" for path, _ in set(unfinished()) - before]
    return " ".join(left) or ("between" if process.returncode else "finished")


def kill_loop(argv, run, whole, moments, log):
    """Kill at each of the moments, resuming with the same command; then let it finish.
    Wherever a run got finished before its moment, it is compared, and begun again."""
    for moment, skip in moments:
        where = kill_at(argv, run, moment, skip)
        log.append(f"{argv[0]}, at {moment}: {where}")
        if where == "finished":
            assert_identical(everything(run), whole)
            shutil.rmtree(run)
    succeed(*argv)
    assert_identical(everything(run), whole)
    assert not list(run.rglob("*.tmp"))


def test_killed_process_resumes_bit_for_bit(tmp_path):
    """The short form of the kill loop: once in an episode's write, once in a checkpoint's."""
    log, argv = [], ("collect", *DEBUG, "--collect-steps", 150, "--runs")
    whole, run = (tmp_path / runs / COLLECTED for runs in ("whole", "killed"))
    succeed(*argv, tmp_path / "whole")
    kill_loop((*argv, tmp_path / "killed"), run, everything(whole),
              [("episode", 1), ("checkpoint", 1)], log)
    assert "npy.tmp" in log[0] or "pt.tmp" in log[1], log


@slow
def test_twenty_kills_of_collect_pretrain_and_finetune_change_nothing(teacher, root, tmp_path):
    """Issue 5: at least three in a checkpoint's write, three in an episode's, the others anywhere;
    weights, moments, replay, log equal those of the uninterrupted runs. pytest -rP shows where."""
    rng, log = np.random.default_rng(0), []
    videos = next((root / "runs/collect").rglob("episodes"))
    stages = {
        COLLECTED: ("collect", *DEBUG, "--collect-steps", 400),
        PRETRAINED: (
            "pretrain", *DEBUG, "--videos", videos, "--pretrain-updates", 350),
        FINETUNED: ("finetune", *DEBUG, "--teacher", teacher, "--steps", 400)}
    for folder, argv in stages.items():
        succeed(*argv, "--runs", tmp_path / "whole")
        whole = everything(tmp_path / "whole" / folder)
        moments = [("checkpoint", 1), ("checkpoint", 0), ("checkpoint", 2)]
        if argv[0] != "pretrain":
            moments += [("episode", 1), ("episode", 0), ("episode", 2)]
        moments += [(float(seconds), 0) for seconds in rng.uniform(0, 4, 9 - len(moments))]
        argv = (*argv, "--runs", tmp_path / "killed")
        kill_loop(argv, tmp_path / "killed" / folder, whole, rng.permutation(
            np.array(moments, object)).tolist(), log)
    print(*log, sep="\n")
    (tmp_path / "kills.log").write_text("\n".join(log))
    assert sum("finished" not in line for line in log) >= 20
    assert sum("pt.tmp" in line for line in log) >= 3
    assert sum("npy.tmp" in line for line in log) >= 3


def send(patch, owner, name, call, *numbers):
    """Send this process signals at the `call`-th call of owner.name."""
    original, count = getattr(owner, name), [0]

    @functools.wraps(original)
    def wrapper(*args, **kwargs):
        count[0] += 1
        for number in numbers if count[0] == call else ():
            signal.raise_signal(number)
        return original(*args, **kwargs)
    patch.setattr(owner, name, wrapper)


def test_signal_finishes_the_episode_saves_and_says_so(
        teacher, uncut, tmp_path, monkeypatch, capfd):
    """The run continues as if nothing had been; the handlers of before are there again."""
    argv = cut_command(teacher, tmp_path)
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        send(patch, diswm.ActionRepeat, "step", 40, signal.SIGTERM)
        refuse(*argv, code=143, says=("saved at 100 env steps", "the same command"))
    assert "finishing" in capfd.readouterr().err
    assert before == (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT))
    assert diswm.read_checkpoint(tmp_path / FINETUNED / "checkpoint.pt")["trainer"]["episodes"] == 2
    succeed(*argv)
    assert_identical(everything(tmp_path / FINETUNED), uncut)


def pretrain_command(root, runs, updates=12):
    """Pretraining from the videos that are there; a checkpoint every 5 updates in `brief`."""
    return ("pretrain", "--videos", root / "runs" / COLLECTED / "episodes", *DEBUG,
            "--pretrain-updates", updates, "--runs", runs)


@pytest.fixture
def brief(root, tmp_path, monkeypatch):
    """What an uninterrupted pretraining of 12 updates leaves behind, a row for each 5."""
    monkeypatch.setattr(diswm.VideoTrainer, "chunk", 5)
    succeed(*pretrain_command(root, tmp_path / "whole"))
    return everything(tmp_path / "whole" / PRETRAINED)


@pytest.mark.parametrize("numbers, code, saved", [
    ((signal.SIGTERM,), 143, 8), ((signal.SIGINT,), 130, 8),
    ((signal.SIGTERM, signal.SIGINT), 130, 5), ((signal.SIGINT, signal.SIGTERM), 143, 5)])
def test_one_signal_saves_after_this_update_and_a_second_stops_at_once(
        numbers, code, saved, root, brief, tmp_path, monkeypatch):
    """In the middle of a row of the log, whose mean then has the updates before the signal too."""
    argv = pretrain_command(root, tmp_path)
    with monkeypatch.context() as patch:
        send(patch, diswm.VideoTrainer, "update", 8, *numbers)
        assert run_cli(*argv)[0] == code
    state = diswm.read_checkpoint(tmp_path / PRETRAINED / "checkpoint.pt")
    assert state["trainer"]["progress"] == saved
    succeed(*argv)
    assert_identical(everything(tmp_path / PRETRAINED), brief)


@slow
@pytest.mark.parametrize("number, code", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signal_stops_a_real_process(number, code, teacher, uncut, tmp_path):
    """As `kill` and a terminal send them: two lines, no traceback."""
    argv = cut_command(teacher, tmp_path)
    process = start(argv)
    while not (tmp_path / FINETUNED / "metrics.jsonl").exists():
        time.sleep(0.01)
    process.send_signal(number)
    _, err = process.communicate()
    assert process.returncode == code
    assert [line.split()[0] for line in err.splitlines()] == ["finishing", "error:"]
    succeed(*argv)
    assert_identical(everything(tmp_path / FINETUNED), uncut)


def test_training_runs_in_a_thread_that_may_not_handle_signals(root, tmp_path):
    """As a library: only a main thread may set handlers."""
    argv = ("pretrain", "--videos", next((root / "runs/collect").rglob("episodes")), *DEBUG,
            "--pretrain-updates", 2, "--runs", tmp_path)
    codes = []
    thread = threading.Thread(target=lambda: codes.append(diswm.main(list(map(str, argv)))))
    thread.start()
    thread.join()
    assert codes == [0]


def test_second_process_on_a_run_is_refused_also_with_fresh(root, tmp_path):
    """Two writers would mix their logs and episodes. A process that dies frees the folder."""
    argv, run = pretrain_command(root, tmp_path, 10**6), tmp_path / PRETRAINED
    process = start(argv)
    while not (run / "checkpoint.pt").exists():
        time.sleep(0.01)
    for extra in (), ("--fresh",):
        refuse(*argv, *extra, says=("another process", str(run)))
    assert (run / "checkpoint.pt").exists()
    process.kill()
    process.communicate()
    succeed(*pretrain_command(root, tmp_path, 2), "--fresh")
    assert [row["update"] for row in read_rows(run)] == [2]


@pytest.fixture
def small_disk(tmp_path):
    """A real file system of 8 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", folder],
                          capture_output=True)
    if made.returncode:
        pytest.skip("mount is not permitted")
    yield folder
    subprocess.run(["umount", folder], check=True)


def fill(folder):
    """Leave no byte free."""
    with contextlib.suppress(OSError), open(folder / "filler", "wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))


@contextlib.contextmanager
def before_call(owner, name, call, action):
    """`action` happens within the block, just before the `call`-th call of owner.name."""
    with pytest.MonkeyPatch.context() as patch:
        count = patch_before_call(patch, owner, name, call, action)
        yield
    assert count[0] >= call


def test_full_disk_in_an_episode_loses_nothing(teacher, uncut, small_disk):
    """The run stops with one line, its last checkpoint loads, and with space it goes on."""
    argv, run = cut_command(teacher, small_disk), small_disk / FINETUNED
    with before_call(diswm.Replay, "add", 2, lambda: fill(small_disk)):
        refuse(*argv, says="No space left")
    assert diswm.read_checkpoint(run / "checkpoint.pt") and not list(run.rglob("*.tmp"))
    (small_disk / "filler").unlink()
    succeed(*argv)
    assert_identical(everything(run), uncut)


@pytest.mark.parametrize("owner, name, call", [
    (diswm.Run, "save", 3), (tensorboard.SummaryWriter, "add_scalar", 9), (os, "replace", 5)],
    ids=["config.json", "TensorBoard", "checkpoint"])
def test_full_disk_in_pretraining_loses_nothing(
        owner, name, call, root, brief, small_disk, monkeypatch):
    """Wherever it strikes; TensorBoard, which else writes every two minutes, does so soon."""
    argv, run = pretrain_command(root, small_disk), small_disk / PRETRAINED
    monkeypatch.setattr(tensorboard, "SummaryWriter", functools.partial(
        tensorboard.SummaryWriter, max_queue=1, flush_secs=0.1))
    with before_call(owner, name, call, lambda: fill(small_disk)):
        refuse(*argv, says="No space left")
    assert diswm.read_checkpoint(run / "checkpoint.pt") and not list(run.rglob("*.tmp"))
    (small_disk / "filler").unlink()
    succeed(*argv)
    assert_identical(everything(run), brief)


def test_row_of_the_log_whose_checkpoint_does_not_fit_is_there_once(root, brief, tmp_path):
    """A real limit on file sizes lets the log pass, and not the checkpoint that has the row too."""
    argv, run = pretrain_command(root, tmp_path), tmp_path / PRETRAINED
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))

    try:
        with before_call(diswm, "mean_metrics", 2, limit):
            code, _, err = run_cli(*argv)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 1 and "File too large" in err
    assert [row["update"] for row in read_rows(run)] == [5, 10]
    assert diswm.read_checkpoint(run / "checkpoint.pt")["trainer"]["progress"] == 5
    succeed(*argv)
    assert_identical(everything(run), brief)


@pytest.mark.parametrize("spoil_log", [
    lambda log: log.unlink(), lambda log: log.write_bytes(log.read_bytes()[:99]),
    lambda log: log.write_bytes(log.read_bytes() + b'{"step": 999}\n')],
    ids=["lost", "cut off", "a row too many"])
def test_log_is_the_checkpoints_whatever_became_of_the_file(
        spoil_log, root, brief, tmp_path, monkeypatch):
    """The checkpoint has the log: a run that goes on writes all of it again."""
    argv, run = pretrain_command(root, tmp_path), tmp_path / PRETRAINED
    with monkeypatch.context() as patch:
        send(patch, diswm.VideoTrainer, "update", 8, signal.SIGTERM)
        assert run_cli(*argv)[0] == 143
    spoil_log(run / "metrics.jsonl")
    succeed(*argv)
    assert_identical(everything(run), brief)


@slow
def test_ctrl_c_with_several_envs_ends_all_processes_without_a_traceback(tmp_path):
    """A terminal sends it to the whole group; the processes of --envs leave it to the first."""
    argv = ("finetune", "--dst", "pusher", "--method", "dreamerv2", "--runs", tmp_path, "--envs", 2,
            *DEBUG, "--steps", 10**6, "--prefill", 10**6)
    process = subprocess.Popen([sys.executable, diswm.__file__, *map(str, argv)], text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                               start_new_session=True)
    while "1,000,000" not in process.stdout.readline():
        assert process.poll() is None
    time.sleep(1)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err
    assert "the same command goes on" in err
    with pytest.raises(ProcessLookupError):  # soon nobody is left
        for _ in range(100):
            os.killpg(process.pid, 0)
            time.sleep(0.1)


@slow
def test_several_envs_in_an_unguarded_script_say_what_is_missing(tmp_path):
    """spawn imports the script again in each process, which then would start processes too."""
    script = tmp_path / "user.py"
    script.write_text(f"""
import sys
from dataclasses import replace
sys.path.insert(0, {str(Path(diswm.__file__).parent)!r})
import diswm
try:
    diswm.config_envs(replace(diswm.PRESETS["debug"], envs=2), "pusher")
except diswm.UserError as error:
    sys.exit(f"error: {{error}}")
""")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120)
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("error: ") and "__main__" in last and done.returncode == 1


# === System: bad input ============================================================================

@pytest.mark.parametrize("argv, says", [
    (("finetune", "--dst", "walker_wlak"), ("unknown", "walker_walk", "cartpole_swingup")),
    (("collect", "--src", "cheetah"), ("unknown", "cheetah_run")),
    (("finetune", "--no-such-flag", "1"), ("--no-such-flag", "--batch-size", "--preset")),
    (("finetune", "--preset", "huge"), ("huge", "paper", "small", "debug")),
    (("finetune", "--method", "ppo"), ("ppo", "dreamerv2", "no_distill")),
    (("finetune", "--steps", "0"), ("--steps", "1")),
    (("pretrain", "--pretrain-updates", "0"), ("--pretrain-updates",)),
    (("finetune", "--batch-size", "many"), ("--batch-size", "many")),
    (("finetune", "--colors", "pink"), ("pink", "published", "original")),
    (("frobnicate",), ("frobnicate", "pretrain", "finetune")),
], ids=lambda value: " ".join(value) if isinstance(value, tuple) and "-" in value[-1] else "")
def test_wrong_usage_exits_2_and_lists_what_exists(argv, says, empty):
    """Unknown task, flag, preset, method, command or value; nothing is written."""
    refuse(*argv, code=2, says=says)
    assert not list(empty.iterdir())


@pytest.mark.parametrize("task, says", [
    ("CartPole-v1", "CartPole-v1"), ("Blackjack-v1", "MuJoCo"), ("Pendulum-v1", "MuJoCo")])
def test_task_without_pixels_or_with_discrete_actions_is_one_line(task, says, empty):
    """Issue 3: one line, the mend, exit 1; and no half-made run."""
    refuse("finetune", "--dst", task, "--method", "dreamerv2", *DEBUG, says=(says, "choose"))
    assert not list(empty.rglob("*.pt"))


@pytest.mark.parametrize("near", ["FetchReach-v4", "HalfCheetah-v5", "drawer_open", "walker_walk"])
def test_misspelt_task_suggests_the_nearest_name(near, empty):
    """Over DMC, the Pusher, the drawers and the MuJoCo tasks of both Gymnasium packages."""
    refuse("finetune", "--dst", near.replace("e", "ee", 1) if "e" in near else near[:-1], *DEBUG,
           code=2, says=f"({near}")


def test_missing_texture_is_one_line(empty, monkeypatch, tmp_path):
    """A damaged installation of Meta-World."""
    import metaworld
    monkeypatch.setattr(metaworld, "__path__", [str(tmp_path)])
    refuse("finetune", "--dst", "drawer_open", "--method", "dreamerv2", *DEBUG,
           says=("drawer_open", "wood.png", "pip install"))


def test_source_equal_to_target_is_refused(root):
    """The teacher's task must differ from the target."""
    refuse("finetune", "--src", "cheetah_run", "--dst", "cheetah_run", "--runs",
           root / "runs", *DEBUG, says="cheetah_run")
    teacher = next((root / "runs/pretrain").rglob("checkpoint.pt"))
    refuse("finetune", "--src", "walker_walk", "--dst", "cheetah_run", "--teacher", teacher,
           "--runs", root / "runs", *DEBUG, says="cheetah_run")


def test_teacher_with_another_latent_size_is_refused(teacher, tmp_path):
    """Eq. (3) needs the same latents on both sides; the message says the way out."""
    refuse("finetune", "--teacher", teacher, "--z-dim", 7, "--runs", tmp_path, *DEBUG,
           says=("another z_dim", "--z-dim 20"))


def test_missing_teacher_file_is_refused(tmp_path):
    """--teacher with a path that is not there."""
    refuse("finetune", "--teacher", tmp_path / "no.pt", "--runs", tmp_path, *DEBUG, says="no.pt")


class Payload:
    """Unpickling it runs a shell command."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def test_checkpoint_with_a_payload_is_refused_and_not_executed(teacher, tmp_path):
    """A teacher from the internet must not run code."""
    marker, path = tmp_path / "executed", tmp_path / "evil.pt"
    state = torch.load(teacher, weights_only=True)
    torch.save(state | {"config": Payload(marker)}, path)
    with pytest.MonkeyPatch.context() as patch:  # not even with the variable that switches it on
        patch.delenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", raising=False)
        refuse("finetune", "--teacher", path, "--runs", tmp_path, *DEBUG,
               says="evil.pt")
    assert not marker.exists()
    torch.load(path, weights_only=False)
    assert marker.exists()  # the payload was a real one


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"hello\n" * 99, b"\x80\x04."],
                         ids=["empty", "broken zip", "text", "broken pickle"])
def test_file_that_is_no_checkpoint_is_refused(content, tmp_path):
    """Also a foreign file in the place of the run's own checkpoint."""
    (tmp_path / "checkpoint.pt").write_bytes(content)
    refuse("evaluate", "--run", tmp_path, says=("checkpoint.pt", "--fresh"))


def test_foreign_torch_files_are_refused(tmp_path):
    """A state_dict, a list, a tensor: loadable, but none of ours."""
    values = {"weight": torch.ones(2)}, [1, 2], torch.ones(3), {"config": 3}
    for index, value in enumerate(values):
        path = tmp_path / f"{index}.pt"
        torch.save(value, path)
        refuse("finetune", "--teacher", path, "--runs", tmp_path, *DEBUG, says=path.name)


@settings(max_examples=25)
@given(data=st.data())
def test_truncated_checkpoint_is_refused(teacher, data):
    """Whatever a cut-off copy holds, the error names the file."""
    whole = teacher.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cut.pt"
        path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
        with pytest.raises(UserError, match="cut.pt"):
            diswm.read_checkpoint(path)


@settings(max_examples=40)
@given(data=st.data())
def test_altered_checkpoint_is_refused_or_holds_the_same(teacher, data):
    """torch.load looks at no checksum: a flipped bit in a weight came through silently."""
    content, whole = bytearray(teacher.read_bytes()), diswm.read_checkpoint(teacher)
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bad.pt"
        path.write_bytes(content)
        try:
            state = diswm.read_checkpoint(path)
        except UserError as error:
            assert "bad.pt" in str(error)
        else:
            assert state["config"] == whole["config"]
            assert_identical(state["trainer"], whole["trainer"])


def inner_nodes(tree, path=()):
    """Paths to everything inside nested dicts and lists."""
    pairs = enumerate(tree) if isinstance(tree, list) else ()
    for key, value in tree.items() if isinstance(tree, dict) else pairs:
        yield (*path, key)
        yield from inner_nodes(value, (*path, key))


def spoil(state, data):
    """Remove or replace something in a loaded checkpoint."""
    paths = list(inner_nodes(state))
    short = [path for path in paths if len(path) < 4]  # else nearly all examples were in Adam
    *path, key = data.draw(st.sampled_from(short) | st.sampled_from(paths))
    for step in path:
        state = state[step]
    value = state[key]
    others = [None, "x", -1, 10**30, 0.5, float("nan"), [], {}, torch.ones(3), (1, 2), True]
    if isinstance(value, torch.Tensor):
        others += [value.double(), value.half(), value.to(torch.int8), value[None], value * np.nan]
    change = data.draw(st.sampled_from(range(-1, len(others))))
    if change < 0 and isinstance(state, dict):
        del state[key]
    else:
        state[key] = others[change]
    return path, key, change


def one_line_or_none(function, *args):
    """Whether a function that may raise UserError got through."""
    try:
        function(*args)
    except UserError as error:
        assert "checkpoint.pt" in str(error) and error.code == 1
        return False
    return True


@settings(max_examples=60)
@given(data=st.data())
def test_spoilt_checkpoint_of_a_video_predictor_is_one_line(teacher, root, data):
    """Missing keys, wrong types, shapes, dtypes and ranges, whatever then reads it."""
    with tempfile.TemporaryDirectory() as runs:
        run = Path(runs) / PRETRAINED
        run.mkdir(parents=True)
        state = torch.load(teacher, weights_only=True)
        spoil(state, data)
        torch.save(state, run / "checkpoint.pt")
        cfg = tiny_config(runs=runs, teacher=str(run / "checkpoint.pt"))
        one_line_or_none(diswm.find_teacher, cfg, CPU)
        one_line_or_none(diswm.load_model, run / "checkpoint.pt", CPU)
        code, _, err = run_cli(*pretrain_command(root, runs, 20))
        assert code == 0 or (code == 1 and err.startswith("error: ") and err.count("\n") == 1), err


@pytest.mark.parametrize("progress", [-1, 10**30])
def test_impossible_progress_is_one_line(progress, teacher, root, tmp_path):
    state = torch.load(teacher, weights_only=True)
    state["trainer"]["progress"] = progress
    (tmp_path / PRETRAINED).mkdir(parents=True)
    torch.save(state, tmp_path / PRETRAINED / "checkpoint.pt")
    refuse(*pretrain_command(root, tmp_path, 20), says="checkpoint.pt")


@settings(max_examples=60)
@given(data=st.data())
def test_spoilt_checkpoint_of_an_agent_is_one_line(finished, data):
    """What evaluate and traverse load."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder)
        state = torch.load(finished / "checkpoint.pt", weights_only=True)
        spoil(state, data)
        torch.save(state, run / "checkpoint.pt")
        one_line_or_none(diswm.load_model, run / "checkpoint.pt", CPU)


def test_a_number_beyond_64_bits_is_the_files_fault_and_not_the_memorys(finished, tmp_path):
    """torch's error ends in C++ frames with "std::allocator": that looked like a lack of memory."""
    state = torch.load(finished / "checkpoint.pt", weights_only=True)
    state["trainer"]["agent"]["action_dim"] = 10**30
    torch.save(state, tmp_path / "checkpoint.pt")
    assert not one_line_or_none(diswm.load_model, tmp_path / "checkpoint.pt", CPU)


@pytest.mark.parametrize("spoilt", ["model", "optimizer"])
@pytest.mark.parametrize("change", [
    lambda x: x.double(), lambda x: x[..., None], lambda x: x * np.nan],
    ids=["float64", "another shape", "NaN"])
def test_tensor_of_another_model_is_refused(spoilt, change, teacher, root, tmp_path):
    """torch casts any dtype."""
    state = torch.load(teacher, weights_only=True)
    part = state["trainer"][spoilt]
    part, key = (part, "encoder.net.0.weight") if spoilt == "model" else (part["mean"], "0")
    part[key] = change(part[key])
    (tmp_path / PRETRAINED).mkdir(parents=True)
    torch.save(state, tmp_path / PRETRAINED / "checkpoint.pt")
    refuse(*pretrain_command(root, tmp_path, 20), says="checkpoint.pt")


def test_checkpoint_whose_task_takes_other_actions_is_one_line(finished, tmp_path):
    """An altered `dst`: the policy's 6 actions must not reach a task of 1, or of 21."""
    state = torch.load(finished / "checkpoint.pt", weights_only=True)
    for task in ("cartpole_swingup", "humanoid_walk"):
        state["config"]["dst"] = task
        torch.save(state, tmp_path / "checkpoint.pt")
        refuse("evaluate", "--run", tmp_path, says=("6 actions", task))
    state["config"]["dst"] = "walker_wlak"
    torch.save(state, tmp_path / "checkpoint.pt")
    refuse("evaluate", "--run", tmp_path, code=2, says="walker_walk")


def test_model_too_large_for_the_memory_is_one_line_and_no_kill(tmp_path):
    """Sizes that no formula foresaw: an allocation fails, and not the machine's OOM killer."""
    def little_memory():
        resource.setrlimit(resource.RLIMIT_DATA, (3 * 2**29, 2**31))
    argv = [sys.executable, diswm.__file__, "collect", *DEBUG, "--deter", "5000", "--hidden",
            "5000", "--runs", str(tmp_path)]
    done = subprocess.run(argv, capture_output=True, text=True, preexec_fn=little_memory)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("error: too large for the memory")


def test_this_machines_memory_is_the_limit():
    """Set at the start of every command on a CPU; a lower one of the user's stays."""
    soft, _ = resource.getrlimit(resource.RLIMIT_DATA)
    diswm.prepare_machine(tiny_config())
    limit, _ = resource.getrlimit(resource.RLIMIT_DATA)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert 0 < limit <= memory and (soft < 0 or limit <= soft)


def test_no_path_in_a_checkpoint_is_followed(teacher, finished, tmp_path):
    """A stranger's checkpoint could else have any folder opened: traverse once read `videos`."""
    bait, opened, watching = tmp_path / "bait", [], [True]
    bait.mkdir()
    save_video(bait / "000000.npz", is_first=np.arange(12) == 0)
    for source in (teacher.parent, finished):
        run = tmp_path / source.relative_to(source.parents[3])
        shutil.copytree(source, run)
        state = torch.load(run / "checkpoint.pt", weights_only=True)
        state["config"] |= dict.fromkeys(("runs", "teacher", "videos"), str(bait))
        state["trainer"]["videos"] = str(bait)
        torch.save(state, run / "checkpoint.pt")
    sys.addaudithook(lambda event, args: opened.append(str(args[0])) if (
        watching and event in ("open", "os.listdir", "os.scandir")) else None)
    for command in ("traverse", "evaluate"):
        succeed(command, "--run", run)
    succeed("traverse", "--run", tmp_path / PRETRAINED)
    diswm.find_teacher(tiny_config(runs=str(tmp_path)), CPU)
    succeed("finetune", "--dst", "walker_walk", "--runs", tmp_path, *DEBUG)
    watching.clear()
    assert opened and not [path for path in opened if str(bait) in path]


def test_zip_bombs_are_refused_by_the_size_that_they_declare(teacher, tmp_path):
    """A gigabyte of zeros in a megabyte: neither an episode nor a checkpoint unpacks them."""
    (tmp_path / "videos").mkdir()
    with (zipfile.ZipFile(tmp_path / "videos/bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive,
          archive.open("image.npy", "w", force_zip64=True) as file):
        header = dict(descr="|u1", fortran_order=False, shape=(88_000, 64, 64, 3))
        np.lib.format.write_array_header_1_0(file, header)
        for _ in range(88):
            file.write(bytes(12_288_000))
    assert (tmp_path / "videos/bomb.npz").stat().st_size < 2e6
    with zipfile.ZipFile(teacher) as whole, zipfile.ZipFile(
            tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in whole.namelist():
            archive.writestr(name, whole.read(name))
    tracemalloc.start()
    refuse("pretrain", "--videos", tmp_path / "videos", "--runs", tmp_path, *DEBUG,
           says=("bomb.npz", "1,081,344,128 bytes"))
    with pytest.raises(UserError, match="bomb.pt"):
        diswm.read_checkpoint(tmp_path / "bomb.pt")
    assert tracemalloc.get_traced_memory()[1] < 1e8
    tracemalloc.stop()


def save_video(path, length=12, compressed=False, **changes):
    """A foreign episode, as the authors publish them: no is_first."""
    rng = np.random.default_rng(length)
    arrays = dict(image=rng.integers(0, 256, (length, 64, 64, 3), np.uint8),
                  action=np.zeros((length, 6), np.float32), reward=np.zeros(length, np.float32),
                  discount=np.ones(length, np.float32)) | changes
    (np.savez_compressed if compressed else np.savez)(path, **arrays)
    return arrays


@pytest.mark.parametrize("changes, says", [
    (dict(image=np.zeros((12, 64, 64, 3), np.float32)), "uint8"),
    (dict(image=np.zeros((12, 32, 32, 3), np.uint8)), "(12, 32, 32, 3)"),
    (dict(image=np.zeros((64, 64, 3), np.uint8)), "(64, 64, 3)"),
    (dict(image=np.array([{}, None], object)), "video"),
], ids=["float images", "32 by 32", "one image", "objects"])
@pytest.mark.parametrize("compressed", [False, True], ids=["plain", "compressed"])
def test_video_of_wrong_shape_or_dtype_is_refused(changes, says, compressed, tmp_path):
    """One line names the file and what is wrong with it."""
    save_video(tmp_path / "bad.npz", compressed=compressed, **changes)
    refuse("pretrain", "--videos", tmp_path, "--runs", tmp_path / "runs", *DEBUG,
           says=("bad.npz", says))


def test_video_without_images_is_refused(tmp_path):
    """An .npz of something else."""
    np.savez(tmp_path / "other.npz", observation=np.zeros(3))
    refuse("pretrain", "--videos", tmp_path, "--runs", tmp_path / "runs", *DEBUG,
           says=("other.npz", "image"))


@settings(max_examples=25)
@given(data=st.data(), compressed=st.booleans())
def test_truncated_video_is_refused(data, compressed):
    """Whatever a cut-off download holds, the error names the file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cut.npz"
        save_video(path, compressed=compressed)
        whole = path.read_bytes()
        path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
        with pytest.raises(UserError, match="cut.npz"):
            diswm.open_videos(folder, Path(folder) / "cache")


@settings(max_examples=40)
@given(data=st.data(), compressed=st.booleans())
def test_damaged_video_is_read_or_refused_but_never_a_traceback(data, compressed):
    """Flipped bytes anywhere, also inside compressed data and headers."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bad.npz"
        rows = 9
        save_video(path, rows, compressed, image=np.zeros((rows, 64, 64, 3), np.uint8))
        content = bytearray(path.read_bytes())
        for _ in range(data.draw(st.integers(1, 3))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        path.write_bytes(content)
        with contextlib.suppress(UserError):
            videos = diswm.open_videos(folder, Path(folder) / "cache")
            batch = videos.sample(2, videos.rows, np.random.default_rng(0))
            assert batch["image"].shape[2:] == (64, 64, 3)


def test_empty_video_folder_is_refused(tmp_path):
    """It says which command makes videos."""
    refuse("pretrain", "--videos", tmp_path, "--runs", tmp_path / "runs", *DEBUG,
           says=("no episodes", "python diswm.py collect"))


@pytest.mark.parametrize("length", [0, 5, 7])
def test_videos_shorter_than_one_window_are_refused(length, tmp_path):
    """Not a crash inside the sampler."""
    save_video(tmp_path / "short.npz", length)
    refuse("pretrain", "--videos", tmp_path, "--runs", tmp_path / "runs", *DEBUG)


def test_foreign_compressed_videos_are_unpacked_once_and_learnt_from(tmp_path):
    """Issue 2: the authors' episodes are a video set as they are."""
    folder = tmp_path / "videos"
    folder.mkdir()
    arrays = [save_video(folder / f"20220101T0000-{n}.npz", n, True) for n in (9, 12)]
    argv = ("pretrain", "--videos", folder, "--runs", tmp_path / "runs", *DEBUG,
            "--pretrain-updates", 2)
    succeed(*argv)
    cache = next((tmp_path / "runs").rglob("videos/*"))
    videos = Replay(cache)
    found = [videos.window(end - length, length) for end, length in
             zip(videos.ends, np.diff([0, *videos.ends]), strict=True)]
    assert {window["image"].tobytes() for window in found} == {a["image"].tobytes() for a in arrays}
    assert all(window["is_first"].tolist() == [True] + [False] * (len(window["is_first"]) - 1)
               for window in found)
    times = {path: path.stat().st_mtime_ns for path in cache.iterdir()}
    succeed(*argv)
    assert times == {path: path.stat().st_mtime_ns for path in cache.iterdir()}


def test_videos_in_fortran_order_or_of_both_kinds_are_learnt_from_as_they_are(tmp_path):
    """np.savez keeps that order: the mapped bytes would be another picture."""
    image = np.asfortranarray(save_video(tmp_path / "f.npz")["image"])
    save_video(tmp_path / "000000.npz", image=image)
    (tmp_path / "f.npz").unlink()
    Replay(tmp_path, ROWS).add(numbered_rows(0, 4))
    videos = diswm.open_videos(tmp_path, tmp_path / "cache")
    assert_same(videos.window(0, 4), {
        key: value for key, value in rows_to_arrays(numbered_rows(0, 4)).items()
        if key in videos.dtype.names})
    np.testing.assert_array_equal(videos.window(4, 12)["image"], image)
    assert videos.rows == 16


def test_a_video_that_changed_is_unpacked_again(tmp_path):
    """The cache must not answer with what the file was."""
    old = save_video(tmp_path / "a.npz")["image"]
    diswm.open_videos(tmp_path, tmp_path / "cache")
    save_video(tmp_path / "a.npz", image=255 - old)
    later = time.time() + 10
    os.utime(tmp_path / "a.npz", (later, later))
    videos = diswm.open_videos(tmp_path, tmp_path / "cache")
    np.testing.assert_array_equal(videos.window(0, len(old))["image"], 255 - old)


@pytest.mark.parametrize("field, says", [
    (("reward", np.float64), "reward is float64"), (("discount", np.float32, 2), "(2,)"),
    (("is_terminal", "<U1"), "is_terminal is <U1"), (("action", np.float32, 5), "(5,)"),
    (None, "shape")], ids=["dtype", "shape", "text", "another task's actions", "no rows"])
def test_altered_episode_of_a_run_is_one_line(field, says, finished, tmp_path):
    """Episodes are mapped, not parsed: what else would be read as numbers must not be."""
    run = tmp_path / FINETUNED
    shutil.copytree(finished, run)
    path = run / "episodes/000001.npy"
    fields = dict(diswm.row_type(6, 20).fields)
    types = {name: kind for name, (kind, *_) in fields.items()}
    types |= {field[0]: np.dtype(field[1:] if field[2:] else field[1])} if field else {}
    np.save(path, np.zeros(26 if field else 0, list(types.items())))
    argv = ("finetune", "--dst", "walker_walk", "--runs", tmp_path, *DEBUG)
    refuse(*argv, says=("000001.npy", says))
    refuse("traverse", "--run", run, says=("000001.npy", says))


@settings(max_examples=40)
@given(data=st.data())
def test_damaged_episode_of_ours_is_refused(data):
    """A byte flipped in the header or in any pixel, or any other length of the file."""
    with tempfile.TemporaryDirectory() as folder:
        replay = Replay(folder, ROWS)
        replay.add(numbered_rows(0, 3))
        whole = replay.paths[0].read_bytes()
        content = bytearray(whole)
        for _ in range(data.draw(st.integers(0, 3))):
            end = data.draw(st.sampled_from([256, len(content)]))
            content[data.draw(st.integers(0, end - 1))] = data.draw(st.integers(0, 255))
        length = data.draw(st.just(len(content)) | st.integers(0, len(content)))
        replay.paths[0].write_bytes(content[:length])
        if content[:length] == whole:
            assert Replay(folder, ROWS).window(0, 1)["image"].shape == (1, 64, 64, 3)
        else:
            with pytest.raises(UserError, match=replay.paths[0].name):
                Replay(folder, ROWS).window(0, 1)


def test_flipped_pixel_in_a_runs_episode_stops_it_and_removes_nothing(finished, tmp_path):
    """The checkpoint's own replay is trusted only as far as its checksums go."""
    run = tmp_path / FINETUNED
    shutil.copytree(finished, run)
    for path in (run / "episodes").glob("*.npy"):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    refuse("traverse", "--run", run, says=(".npy", "checksum"))
    assert len(list((run / "episodes").iterdir())) == len(
        list((finished / "episodes").iterdir()))


@pytest.mark.parametrize("command", ["collect", "pretrain", "finetune", "doctor"])
def test_runs_folder_that_cannot_be_written_is_one_line(command, tmp_path):
    """A file where a folder should be: as a read-only place looks to everyone, root included."""
    (tmp_path / "runs").write_text("in the way")
    refuse(command, "--runs", tmp_path / "runs", *DEBUG, says="runs")
    assert (tmp_path / "runs").read_text() == "in the way"


def test_read_only_runs_folder_is_one_line(tmp_path):
    """Permission denied; root gives up its right to write anywhere first."""
    caps = "-dac_override,-dac_read_search"
    user = ["setpriv", f"--bounding-set={caps}", f"--inh-caps={caps}"] if os.geteuid() == 0 else []
    if user and (not shutil.which("setpriv") or subprocess.run([*user, "true"]).returncode):
        pytest.skip("root may write anywhere")
    tmp_path.chmod(0o500)
    done = subprocess.run([*user, sys.executable, diswm.__file__, "collect", *DEBUG, "--runs",
                           tmp_path], capture_output=True, text=True)
    tmp_path.chmod(0o700)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("error: ") and "Permission denied" in done.stderr


@pytest.mark.parametrize("loss, term", [
    ("distillation_loss", "distill"), ("lambda_return", "actor"), ("rssm_kl_loss", "kl_loss")])
def test_nan_stops_the_run_and_leaves_the_checkpoint(loss, term, teacher, tmp_path):
    """A loss that is not a number exits 1, names itself, and is in no saved weight."""
    argv, real, calls = cut_command(teacher, tmp_path), getattr(diswm, loss), []

    def broken(*args, **kwargs):
        calls.append(loss)
        value = real(*args, **kwargs)
        if len(calls) < 4:
            return value
        return (value[0] * np.nan, value[1]) if isinstance(value, tuple) else value * np.nan

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diswm, loss, broken)
        refuse(*argv, says=("non-finite", term, "nonfinite.npz"))
    check_stopped_run(tmp_path / FINETUNED)


def check_stopped_run(run):
    """The batch is beside the log; the checkpoint is that of the last episode before, and sane."""
    with np.load(run / "nonfinite.npz") as batch:
        assert set(batch) == set(diswm.row_type(6, 20).names)
        assert batch["image"].shape == (3, 8, 64, 64, 3)
    state = diswm.read_checkpoint(run / "checkpoint.pt")["trainer"]
    assert state["progress"] == 130
    assert all(value.isfinite().all() for part in ("model", "behaviour")
               for value in state["agent"][part].values())


def test_nan_gradient_of_a_finite_loss_stops_the_run(teacher, uncut, tmp_path):
    """√0 is 0 and has an infinite slope: the loss does not show it. Then the run goes on."""
    argv, real, calls = cut_command(teacher, tmp_path), diswm.distillation_loss, []

    def steep(*args):
        calls.append(None)
        value = real(*args)
        return value + (value * 0).sqrt() if len(calls) == 4 else value

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diswm, "distillation_loss", steep)
        refuse(*argv, says=("non-finite model_grad_norm", "nonfinite.npz"))
    check_stopped_run(tmp_path / FINETUNED)
    succeed(*argv)
    assert_identical(everything(tmp_path / FINETUNED), uncut)


def save_rows(path, rows):
    """An episode as Replay.add writes it: an array and its checksum."""
    buffer = io.BytesIO()
    np.save(buffer, rows)
    path.write_bytes(buffer.getvalue() + zlib.crc32(buffer.getvalue()).to_bytes(4, "little"))


def test_nan_in_a_stored_reward_is_named_and_its_batch_kept(teacher, tmp_path):
    """As a faulty simulator leaves it: the message says reward, the dump shows the row."""
    argv, run = cut_command(teacher, tmp_path), tmp_path / FINETUNED
    interrupt(diswm.Replay, "add", 3, argv)
    for path in (run / "episodes").glob("*.npy"):
        episode = np.load(path)
        episode["reward"] *= np.nan
        save_rows(path, episode)
    refuse(*argv, says=("non-finite", "reward", "nonfinite.npz"))
    with np.load(run / "nonfinite.npz") as batch:
        assert np.isnan(batch["reward"]).any()


LOG_VALUES = (st.none() | st.booleans() | st.integers(-10, 10**400) | st.floats()
              | st.text(max_size=3) | st.lists(st.integers(0, 9), max_size=2))
LOG_NAMES = st.sampled_from(["step", "update", "eval_return", "eval_step", "phase", "x"])
LOG_ROWS = st.dictionaries(LOG_NAMES, LOG_VALUES) | LOG_VALUES | st.just({
    "step": 10, "phase": "train", "eval_return": 1.5})


@settings(max_examples=60)
@given(rows=st.lists(LOG_ROWS, max_size=4), garbage=st.binary(max_size=20) | st.just(b""))
@example(rows=[{"update": 1, "eval_return": 2.0}], garbage=b"")  # no phase
@example(rows=[{"step": 10, "phase": "a", "eval_return": 1.5}, {"update": 3}], garbage=b"")
def test_any_log_is_drawn_or_one_line(rows, garbage):
    """plot reads metrics.jsonl files of others: rows that are no objects, lack their step, …"""
    with tempfile.TemporaryDirectory() as runs:
        folder = Path(runs) / FINETUNED
        folder.mkdir(parents=True)
        content = b"".join(json.dumps(row).encode() + b"\n" for row in rows) + garbage
        (folder / "metrics.jsonl").write_bytes(content)
        code, _, err = run_cli("plot", "--runs", runs)
        assert (code, err) == (0, "") or (
            code == 1 and err.startswith("error: ") and err.count("\n") == 1), err


def test_row_being_written_is_left_out_of_the_plot(finished, tmp_path):
    """A live run, or one that was cut off; but a torn row in the middle is damage."""
    rows = (finished / "metrics.jsonl").read_bytes()
    (tmp_path / "metrics.jsonl").write_bytes(rows + rows[:99])
    assert diswm.read_log(tmp_path) == read_rows(finished)
    (tmp_path / "metrics.jsonl").write_bytes(rows[:99] + b"\n" + rows)
    with pytest.raises(UserError, match="metrics.jsonl"):
        diswm.read_log(tmp_path)


def test_config_json_is_for_people_and_never_read(finished, tmp_path):
    """The checkpoint holds the Config: garbage in config.json changes nothing."""
    run = tmp_path / FINETUNED
    shutil.copytree(finished, run)
    (run / "config.json").write_text("{garbage")
    succeed("finetune", "--dst", "walker_walk", "--runs", tmp_path, *DEBUG)
    succeed("traverse", "--run", run)
    assert (run / "config.json").read_text() == "{garbage"


FLAGS = ["--" + field.name.strip("_").replace("_", "-") for field in
         dataclasses.fields(diswm.Config) if field.name not in ("runs", "threads")]
WORDS = (st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=8)
         | st.integers().map(str) | st.floats().map(str)
         | st.sampled_from(["nan", "-inf", "1e999", "9" * 5000, "--", "-h-", "10" * 6, "0", "1"]))


@settings(max_examples=150)
@given(options=st.lists(st.tuples(st.sampled_from([*FLAGS, "--run", "--bogus", ""]), WORDS),
                        max_size=4))
def test_any_command_line_is_understood_or_one_line(options):
    """Random flags and values. What is understood ends where there is nothing to plot."""
    with tempfile.TemporaryDirectory() as runs:
        argv = [word for option in options for word in option]
        code, _, err = run_cli("plot", *argv, "--runs", runs)
        assert code in (1, 2) and err.startswith("error: ") and err.count("\n") == 1, err


@pytest.mark.parametrize("argv", [
    ("finetune", "--batch-size", 10**6), ("pretrain", "--batch-size", 10**6),
    ("bench", "--batch-size", 10**6, "--batch-length", 10**6)], ids=lambda argv: argv[0])
def test_more_memory_than_there_is_is_one_line(argv, root, tmp_path):
    """Not a traceback, and not the kernel's out-of-memory killer half an hour later."""
    refuse(*argv, *DEBUG, "--method", "dreamerv2", "--runs", tmp_path, "--videos",
           root / "runs" / COLLECTED / "episodes", says="memory")


def test_values_out_of_range_are_refused_before_anything_happens(empty):
    """99 999 999 threads end in a segmentation fault; NaN is less than nothing and more."""
    for flag, value in (("--threads", 99_999_999), ("--eta", "nan"), ("--gamma", 1.5),
                        ("--seed", -1), ("--model-lr", "inf"), ("--batch-size", 10**12)):
        refuse("finetune", flag, value, code=2, says=(flag, "from"))
    assert not list(empty.iterdir())


def test_stray_file_among_the_episodes_of_a_run_is_one_line(teacher, tmp_path):
    """Somebody's copy in episodes/ must not end in a traceback on resume."""
    argv = cut_command(teacher, tmp_path)
    interrupt(diswm.ActionRepeat, "step", 40, argv)
    episodes = next(tmp_path.rglob("episodes"))
    shutil.copy(episodes / "000000.npy", episodes / "copy.npy")
    code, _, err = run_cli(*argv)
    assert code == 0 or err.startswith("error: ")


# === The tests bite: a real bug put back makes its check fail =======

def free_nats_first(real):
    """Free nats on every step, before the mean."""
    def loss(post, prior, balance=0.8, free_nats=1.0):
        value = real(post, prior, balance, free_nats)[1]
        return value.clamp(min=free_nats).mean(), value
    return loss


def teacher_in_the_optimiser(real):
    """The published code: the teacher's gradients on, its weights in the model's optimiser."""
    def init(self, cfg, action_dim, device, teacher=None):
        real(self, cfg, action_dim, device, teacher)
        teacher.requires_grad_(True)
        self.model_adam = diswm.Adam(torch.nn.ModuleList([self.model, teacher]), cfg.model_lr)
    return init


def teacher_trained_too(real):
    """A distillation loss without the stop-gradient."""
    def loss(z_disen, z_task):
        log_p, log_q = z_disen.log_softmax(-1), z_task.log_softmax(-1)
        return (log_p.exp() * (log_p - log_q)).sum((-1, -2)).mean()
    return loss


def own_value(real):
    """v_t where v_{t+1} belongs."""
    return lambda r, v, d, b, l=0.95: real(r, torch.cat([v[:1], v[:-1]]), d, v[-1], l)


def seam_ignored(real):
    """`is_first` does nothing."""
    return lambda self, state, action, embed, first: real(self, state, action, embed, first & False)


returns_checks = check_lambda_return_is_the_n_step_mixture, check_behaviour_losses_are_appendix_b
distill_checks = check_distillation_scale, check_distillation_is_equation_3
BUGS = {  # name: what is patched, the bug, the checks that must fail
    "teacher in the optimiser": (
        "Agent.__init__", teacher_in_the_optimiser, check_teacher_is_frozen),
    "teacher not frozen": (
        "freeze", lambda real: lambda encoder: encoder, check_teacher_is_frozen),
    "teacher trained by the loss": (
        "distillation_loss", teacher_trained_too, check_no_gradient_reaches_the_teacher),
    "distillation averaged over time": (
        "distillation_loss", lambda real: lambda p, q: real(p, q) / p.shape[1], *distill_checks),
    "distillation in the wrong direction": (
        "distillation_loss", lambda real: lambda p, q: real(q, p), distill_checks[1]),
    "v_t for v_{t+1}": ("lambda_return", own_value, *returns_checks),
    "reversed returns": (
        "lambda_return", lambda real: lambda *args: real(*args).flip(0), *returns_checks),
    "free nats before the mean": (
        "rssm_kl_loss", free_nats_first, check_free_nats_act_on_the_mean),
    "KL balance the wrong way round": (
        "rssm_kl_loss", lambda real: lambda q, p, share, free: real(q, p, 1 - share, free),
        check_kl_gradient_is_split),
    "unclipped action": (
        "clip_action", lambda real: lambda action: action, check_actions_stay_inside_the_bounds),
    "eta stuck at its first step": (
        "eta_schedule", lambda real: lambda step, *args: real(0, *args),
        check_eta_falls_during_a_run),
    "state kept across a seam": ("RSSM.step", seam_ignored, check_is_first_forgets_everything),
}


@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_caught(bug, monkeypatch):
    """The real tests' checks pass, and each fails once the bug is in the production function."""
    name, plant, *checks = BUGS[bug]
    for check in checks:
        check()
    *owner, attribute = name.split(".")
    owner = getattr(diswm, owner[0]) if owner else diswm
    monkeypatch.setattr(owner, attribute, plant(getattr(owner, attribute)))
    for check in checks:
        with pytest.raises(AssertionError):
            check()
