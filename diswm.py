"""DisWM: Disentangled World Models, the whole paper in one file.

    Wang et al., "Disentangled World Models: Learning to Transfer Semantic Knowledge from
    Distracting Videos for Reinforcement Learning", ICCV 2025. "Eq. (n)" is the paper's equation.

Videos of one task whose colours keep changing are enough to learn *which things in a picture vary
independently*: a β-VAE inside an action-free video predictor finds latents for them. An agent in a
different task learns its own world model, its encoder pulled towards the frozen teacher's latents,
strongly at first and ever less, while DreamerV2's actor-critic learns behaviour in imagination.

    collect    DreamerV2 in the distracting source task ──► episodes = the video set
    pretrain   videos ──► β-VAE video predictor, Eqs. (1), (2) ──► its encoder = the teacher
    finetune   target task ⇄ world model, Eqs. (4), (5) ◄── distillation, Eq. (3) ── teacher
               world model ──► imagination ──► actor, critic (appendix B)
    evaluate, traverse, plot    returns; latent traversals, open-loop predictions; learning curves

    python diswm.py pretrain --src cheetah_run     # collects first when there are no videos
    python diswm.py finetune --dst walker_walk

Symbols, and their names in the code:

    o      image                  𝐳 (z, embed)  β-VAE latent, 20 of them  h (deter)  recurrent state
    a, r   action, reward         z_t (stoch)   stochastic state           s (feat)   [z_t, h_t]
    γ      discount               q (post), p (prior)  of z_t              V          λ-return
    β, β₁, β₂, α, η  loss weights π (actor), v (critic)                    sg         stop-gradient

    B batch  T time in a window  H imagination horizon  Z latents  S stochastic  D deterministic
    A action  N imagined trajectories: B·T, or as many as are drawn from them
"""

import argparse
import atexit
import contextlib
import ctypes
import dataclasses
import difflib
import fcntl
import io
import json
import math
import os
import pickle
import platform
import re
import resource
import shutil
import signal
import statistics
import struct
import sys
import time
import timeit
import tokenize
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # unset on a headless machine, MuJoCo picks GLFW and dies

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn
from torch.utils._pytree import tree_leaves
from tqdm import tqdm

GL_HINT = "run: apt-get install libegl1 libgl1-mesa-dri, or libosmesa6 and export MUJOCO_GL=osmesa"
try:
    import mujoco
    from dm_control import suite
except (AttributeError, ImportError) as error:  # how a missing libEGL or libOSMesa shows
    sys.exit(f"error: MuJoCo with MUJOCO_GL={os.environ['MUJOCO_GL']}: {error}; {GL_HINT}")

class UserError(Exception):
    """A mistake that the user can mend: printed as one line; `code` is the exit status."""

    def __init__(self, message, code=1):
        super().__init__(message)
        self.code = code

# === Config =======================================================================================

def flag(default, help, *, low=0, high=10**12, choices=None, free=False):
    """A Config field and its flag. low, high: of numbers; free: may change on resuming."""
    meta = dict(help=help, low=low, high=high, choices=choices, free=free)
    return dataclasses.field(default=default, metadata=meta)

@dataclass(frozen=True)
class Config:
    """Everything that can be set; the defaults are the paper's (`--preset paper`).
    Sources: "table" is the paper's hyperparameter table, "published" the authors' configuration,
    "ours" a choice of this implementation. An *env step* is one simulator step; a *decision* is one
    action of the agent, held for `action_repeat` env steps."""
    # What is run, and where it is kept.
    src: str = flag("cheetah_run", "task of the distracting videos (paper, Fig. 4a)")
    dst: str = flag("walker_walk", "target task (paper, Fig. 4a)")
    method: str = flag("diswm", "the paper's method, a baseline or an ablation (paper)")
    seed: int = flag(0, "seed of everything random (ours)")
    runs: str = flag("runs", "folder of all runs (ours)", free=True)
    teacher: str = flag("", "teacher's checkpoint.pt; empty: the one for --src (ours)", free=True)
    videos: str = flag("", "folder of .npz videos; empty: what collect made (ours)", free=True)
    # Environment (section 4).
    action_repeat: int = flag(2, "env steps per decision (published)", low=1)
    time_limit: int = flag(0, "env steps per episode; 0: the task's own (ours)")
    colors: str = flag("published", "colour boxes around fixed centres, or the original colours "
                       "(published; paper)", choices=("published", "original"))
    color_range: float = flag(0.2, "half width of a colour box, RGB in 0..1 (published)", high=1)
    color_step_std: float = flag(0.0, "std of the colours' random walk per decision (ours)")
    fast_render: bool = flag(False, "no anti-aliasing, about twice as fast (ours)")
    # How long.
    steps: int = flag(1_000_000, "env steps of finetuning (paper)", low=1)
    collect_steps: int = flag(2_000_000, "env steps of collecting: 1M frames (paper)", low=1)
    pretrain_updates: int = flag(20_000, "updates of the video predictor (published)", low=1)
    prefill: int = flag(2500, "decisions at random before learning (published)")
    first_updates: int = flag(100, "updates right after prefill (published)", low=1)
    train_every: int = flag(5, "decisions per update (published)", low=1)
    switch: float = flag(0.5, "share of steps after which the colours change; 1: never (paper)")
    eval_every: int = flag(10_000, "env steps between evaluations (published)", low=1)
    eval_episodes: int = flag(10, "episodes per evaluation (published)", low=1)
    replay_capacity: int = flag(1_000_000, "rows kept in the replay (published)", low=1)
    # World model, Eqs. (1), (2), (4), (5).
    encoder: str = flag("beta_vae", "image encoder and decoder; conv: DreamerV2's (paper)",
                        choices=("beta_vae", "conv"))
    z_dim: int = flag(20, "size of the β-VAE latent (table)", low=1, high=10_000)
    cnn_depth: int = flag(32, "channels of the first convolution (published)", low=1, high=1000)
    stoch: int = flag(50, "size of the stochastic state (published)", low=1, high=10_000)
    deter: int = flag(200, "size of the deterministic state (published)", low=1, high=10_000)
    hidden: int = flag(200, "hidden units inside the RSSM (published)", low=1, high=10_000)
    units: int = flag(400, "hidden units of heads and actor-critic (published)", low=1, high=10_000)
    batch_size: int = flag(50, "windows per batch, B (table)", low=1, high=10**6)
    batch_length: int = flag(50, "rows per window, T (table)", low=2, high=10**6)
    model_lr: float = flag(3e-4, "learning rate of video predictor and world model (table)", high=1)
    alpha: float = flag(1.0, "α, weight of the KL in Eq. (5) (table)")
    beta1: float = flag(1.0, "β₁, weight of the action-free KL in Eq. (2) (table)")
    beta: float = flag(0.015, "β, weight of the disentanglement loss in Eq. (5) (table)")
    beta2: float = flag(0.015, "β₂, weight of the disentanglement loss in Eq. (2) (table)")
    kl_balance: float = flag(0.8, "share of the KL that trains the prior (DreamerV2)", high=1)
    free_nats: float = flag(1.0, "nats below which the KL is not trained (published)")
    reward_scale: float = flag(2.0, "weight of the reward loss (published)")
    discount_scale: float = flag(1.0, "weight of the discount loss (ours)")
    # Distillation, Eq. (3). Its clock counts decisions, prefill included.
    distill: str = flag("softmax", "Eq. (3) of softmaxed or of Gaussian latents (paper; ours)",
                        choices=("softmax", "gaussian"))
    eta: float = flag(0.1, "η at the start (table)")
    eta_end: float = flag(0.01, "η at the end (paper, section 3.4)")
    eta_decay: int = flag(50_000, "decisions in which η would fall to 0 (published)", low=1)
    eta_delay: int = flag(0, "decisions before it; 50 000 across domains (published)")
    # Behaviour, appendix B.
    horizon: int = flag(15, "imagined transitions, H (table)", low=1, high=1_000)
    imagine_starts: int = flag(0, "states of a batch to imagine from; 0: all (ours)")
    gamma: float = flag(0.99, "discount γ (table)", high=1)
    lambda_: float = flag(0.95, "λ of the λ-return (table)", high=1)
    rho: float = flag(1.0, "ρ: 1 dynamics backprop, 0 REINFORCE (published)", high=1)
    entropy_scale: float = flag(1e-4, "weight of the actor's entropy (published)")
    actor_lr: float = flag(8e-5, "learning rate of the actor (table)", high=1)
    critic_lr: float = flag(8e-5, "learning rate of the critic (table)", high=1)
    slow_every: int = flag(100, "updates between copies to the slow critic (published)", low=1)
    grad_clip: float = flag(100.0, "largest gradient norm of each optimiser (published)")
    # Machine.
    device: str = flag("auto", "where it runs (ours)", choices=("auto", "cpu", "cuda"), free=True)
    precision: str = flag("auto", "of convolutions and MLPs; auto: bf16 where native (ours)",
                          choices=("auto", "fp32", "bf16"), free=True)
    threads: int = flag(0, "CPU threads; 0: one per core (ours)", high=1024, free=True)

    def __post_init__(self):
        """Raises ValueError at wrong types and values out of range, also those of a checkpoint."""
        for field in dataclasses.fields(self):
            value, meta, kind = getattr(self, field.name), field.metadata, type(field.default)
            good = type(value) is kind or (kind is float and type(value) is int)
            if good and kind in (int, float):
                good = meta["low"] <= value <= meta["high"]                   # which no NaN is
            if not good or value not in (meta["choices"] or [value]):
                want = meta["choices"] or f"{kind.__name__} from {meta['low']} to {meta['high']:,}"
                raise ValueError(f"--{field.name.replace('_', '-').strip('-')} {value}: not {want}")

PRESETS = {
    "paper": Config(),
    # The same algorithm for two CPU cores. A batch five times smaller wants a larger model_lr. η's
    # clock shrinks with the run (to a tenth), and η grows by 50 / 32 as Eq. (3) sums over time.
    "small": Config(
        steps=100_000, collect_steps=20_000, pretrain_updates=1_000, prefill=1_000,
        fast_render=True, batch_size=16, batch_length=32, imagine_starts=256, model_lr=1e-3,
        cnn_depth=16, units=200, eta=0.156, eta_end=0.0156, eta_decay=5_000),
    # Seconds, for tests: everything happens, nothing is learnt.
    "debug": Config(
        steps=300, collect_steps=200, pretrain_updates=20, prefill=50, first_updates=2,
        train_every=10, eval_every=100, eval_episodes=2, time_limit=50, batch_size=3,
        batch_length=8, horizon=3, cnn_depth=4, stoch=6, deter=12, hidden=10, units=10, eta=0.6,
        eta_end=0.06, eta_decay=60, slow_every=5, threads=1),
}

# A method is a set of Config values and nothing else: all of them run through the same code.
METHODS = {
    "diswm": {},
    "no_distill": dict(eta=0.0, eta_end=0.0),        # ablation: no latent distillation
    "no_disentangle": dict(beta=0.0, beta2=0.0),     # ablation: no β in either stage
    "dreamerv2": dict(encoder="conv", beta=0.0, beta2=0.0, eta=0.0, eta_end=0.0),
}

# === Maths: pure functions of tensors =============================================================

ACTION_LIMIT = 1 - 1e-6  # actions stay strictly inside (−1, 1)

def gaussian_kl(mean_p, std_p, mean_q, std_q):
    """KL[N(mean_p, std_p²) || N(mean_q, std_q²)] of each dimension, nats: (..., S) → (..., S)."""
    # ln(σ_q / σ_p) + (σ_p² + (μ_p − μ_q)²) / (2 σ_q²) − ½
    return (std_q / std_p).log() + (std_p**2 + (mean_p - mean_q)**2) / (2 * std_q**2) - 0.5

def beta_vae_kl(mean, logvar):
    """Disentanglement loss of Eqs. (2), (5): KL[N(mean, exp(logvar)) || N(0, I)].
    mean, logvar: (..., Z). Returns (...,), nats summed over the latent dimensions."""
    # ½ Σ (μ² + σ² − 1 − ln σ²)
    return 0.5 * (mean**2 + logvar.exp() - 1 - logvar).sum(-1)

def rssm_kl_loss(post, prior, balance=0.8, free_nats=1.0):
    """KL of posterior and prior in Eqs. (2), (5), with DreamerV2's balancing and free nats.
        balance · max(mean KL[sg(q) || p], free) + (1 − balance) · max(mean KL[q || sg(p)], free)
    post, prior: dicts of `mean` and `std`, (B, T, S). Returns (loss, value): a scalar and the plain
    KL (B, T), nats. Free nats act on the batch mean, as published: below them it is constant."""

    def kl(q, p):
        return gaussian_kl(q["mean"], q["std"], p["mean"], p["std"]).sum(-1)

    def sg(dist):  # this side is the target of the other
        return {"mean": dist["mean"].detach(), "std": dist["std"].detach()}
    value = kl(post, sg(prior))                                               # (B, T), trains q
    prior_side = kl(sg(post), prior).mean().clamp(min=free_nats)              # trains p
    return balance * prior_side + (1 - balance) * value.mean().clamp(min=free_nats), value

def distillation_loss(z_disen, z_task):
    """Latent distillation, Eq. (3): KL(z_disen || z_task) = Σ z_disen · ln(z_disen / z_task).
    Softmax over the latent dimensions makes probability vectors of both, so a constant added to all
    dimensions changes nothing. z_disen (the teacher's), z_task: samples, (B, T, Z). Returns a
    scalar, nats: summed over time, mean over the batch, the scale at which the paper tuned η."""
    log_disen = z_disen.detach().log_softmax(-1)                              # the teacher is fixed
    log_task = z_task.log_softmax(-1)
    return (log_disen.exp() * (log_disen - log_task)).sum((-2, -1)).mean()

def gaussian_distillation_loss(teacher, task):
    """Eq. (3) between the two Gaussian posteriors instead (ours), reduced like it.
    teacher, task: dicts of `mean` and `logvar`, (B, T, Z)."""
    kl = gaussian_kl(teacher["mean"].detach(), (teacher["logvar"].detach() / 2).exp(),
                     task["mean"], (task["logvar"] / 2).exp())
    return kl.sum((-2, -1)).mean()

def eta_schedule(step, start=0.1, end=0.01, decay_steps=50_000, delay=0):
    """η after `step` decisions (section 3.4): 0 before `delay`, then linearly from start to end.
    The line would reach 0 at delay + decay_steps; η rests at `end` where it meets it."""
    return 0.0 if step < delay else max(start * (1 - (step - delay) / decay_steps), end)

def lambda_return(reward, value, discount, bootstrap, lambda_=0.95):
    """λ-target V_t (appendix B), the actor's objective and the critic's regression target.
        V_t = r_t + γ_t · ((1 − λ) · v_{t+1} + λ · V_{t+1}),    V_H = v_H = bootstrap

              t      0     1    …   H−1    H
         reward     r_0   r_1      r_{H−1}
          value     v_0   v_1      v_{H−1}  bootstrap
         return     V_0   V_1      V_{H−1}
    reward, value, discount: (H, ...) time-major; bootstrap: (...). Returns (H, ...).
    Differentiable in every argument: "dynamics backprop" flows through r, γ and v."""
    next_value = torch.cat([value[1:], bootstrap[None]])                      # v_{t+1}: (H, ...)
    returns, target = [], bootstrap
    for t in reversed(range(len(reward))):
        target = reward[t] + discount[t] * torch.lerp(next_value[t], target, lambda_)
        returns.append(target)
    return torch.stack(returns[::-1])                                         # back in time order

def squared_error(target, prediction):
    """−ln N(target; prediction, 1), less ½ ln 2π, elementwise."""
    return 0.5 * F.mse_loss(prediction, target, reduction="none")

def gaussian_sample(mean, std):
    """A reparameterised draw: the gradient reaches mean and std."""
    return mean + std * torch.randn_like(std)

def clip_action(action):
    """Clip into (−1, 1) with a straight-through gradient: a saturated action can come back."""
    return action + (action.clamp(-ACTION_LIMIT, ACTION_LIMIT) - action).detach()

def normal_log_prob(x, mean, std):
    """ln N(x; mean, std²), summed over the last dimension, nats: (..., A) → (...,)."""
    return (-0.5 * ((x - mean) / std)**2 - std.log() - 0.5 * math.log(2 * math.pi)).sum(-1)

def normal_entropy(std):
    """Entropy of a diagonal normal, nats: (..., A) → (...,)."""
    return (std.log() + 0.5 * math.log(2 * math.pi * math.e)).sum(-1)

# === Networks =====================================================================================

def stack(layer, sizes, shapes):
    """Layers from size to size, each with ELU behind; shapes: (kernel, stride, padding) of each."""
    return [part for n, m, shape in zip(sizes[:-1], sizes[1:], shapes, strict=True)
            for part in (layer(n, m, *shape), nn.ELU())]

def mlp(inputs, units, layers, outputs):
    """`layers` hidden layers with ELU, then a linear one."""
    hidden = stack(nn.Linear, [inputs] + [units] * layers, [()] * layers)
    return nn.Sequential(*hidden, nn.Linear(units, outputs))

def bounded_std(x):
    """A standard deviation in (0.1, 2.1): 2 σ(x / 2) + 0.1."""
    return 2 * torch.sigmoid(x / 2) + 0.1

def kaiming(module):
    """Kaiming-normal weights and zero biases, for the β-VAE only (published)."""
    if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
        nn.init.kaiming_normal_(module.weight)
        nn.init.zeros_(module.bias)

def preprocess(image):
    """uint8 (..., 64, 64, 3) → float (..., 3, 64, 64) in [−0.5, 0.5]"""
    return image.movedim(-1, -3).float() / 255 - 0.5

class PerFrame(nn.Module):
    """`self.net` applied to the last `dims` dimensions; all before them are one batch. fp32 out."""
    dims = 3

    def forward(self, x):
        lead = x.shape[:x.dim() - self.dims]
        return self.net(x.reshape(-1, *x.shape[len(lead):])).float().unflatten(0, lead)

class BetaVAEEncoder(PerFrame):
    """β-VAE encoder of Eqs. (1), (4): image (..., 3, 64, 64) → mean, logvar of 𝐳, (..., Z)."""

    def __init__(self, z_dim=20, depth=32):
        super().__init__()
        self.embed_dim, d = z_dim, depth
        shapes = [(4, 2, 1)] * 4 + [(4,)]                                     # 32, 16, 8, 4, 1
        convolutions = stack(nn.Conv2d, [3, d, d, 2 * d, 2 * d, 8 * d], shapes)
        self.net = nn.Sequential(*convolutions, nn.Flatten(), nn.Linear(8 * d, 2 * z_dim))
        self.apply(kaiming)

    def forward(self, image):
        return super().forward(image).chunk(2, -1)

class BetaVAEDecoder(PerFrame):
    """Decoder of Eqs. (1), (4): feat (..., S + D), a neck as narrow as 𝐳 → (..., 3, 64, 64)."""
    dims = 1

    def __init__(self, feat_dim, z_dim=20, depth=32):
        super().__init__()
        d = depth
        self.net = nn.Sequential(
            nn.Linear(feat_dim, z_dim), nn.ELU(), nn.Linear(z_dim, 8 * d), nn.ELU(),
            nn.Unflatten(-1, (8 * d, 1, 1)), *stack(
                nn.ConvTranspose2d, [8 * d, 2 * d, 2 * d, d, d], [(4,)] + [(4, 2, 1)] * 3),
            nn.ConvTranspose2d(d, 3, 4, 2, 1))                                # 4, 8, 16, 32, 64
        self.apply(kaiming)

class ConvEncoder(PerFrame):
    """DreamerV2's encoder, for the baselines: image (..., 3, 64, 64) → embed (..., 32·depth)."""

    def __init__(self, depth=32):
        super().__init__()
        self.embed_dim, d = 32 * depth, depth                                 # 8·depth of 2 × 2
        convolutions = stack(nn.Conv2d, [3, d, 2 * d, 4 * d, 8 * d], [(4, 2)] * 4)
        self.net = nn.Sequential(*convolutions, nn.Flatten())

class ConvDecoder(PerFrame):
    """DreamerV2's decoder, for the baselines: feat (..., S + D) → (..., 3, 64, 64)."""
    dims = 1

    def __init__(self, feat_dim, depth=32):
        super().__init__()
        d = depth
        self.net = nn.Sequential(
            nn.Linear(feat_dim, 32 * d), nn.Unflatten(-1, (32 * d, 1, 1)), *stack(
                nn.ConvTranspose2d, [32 * d, 4 * d, 2 * d, d], [(5, 2), (5, 2), (6, 2)]),
            nn.ConvTranspose2d(d, 3, 6, 2))                                   # 5, 13, 30, 64

class RSSM(nn.Module):
    """Recurrent state-space model, Gaussian; action_dim=0 makes it the action-free one of Eq. (1).
        h_t = f(h_{t−1}, z_{t−1}, a_{t−1})    z_t ~ q(z_t | h_t, embed_t)    ẑ_t ~ p(ẑ_t | h_t)
    A state: dict of `deter` h (..., D), `stoch` z, and the `mean`, `std` it came from (..., S).
    What lines up in a window, which is also how the replay stores it:
          row t       0      1      …
         image       o_0    o_1
        action        0      a that led to o_1     (the paper's a_{t−1})
        reward        0      r that came with o_1
      is_first        1      0                     (forgets h, z *and* the action)
          post       s_0    s_1
    """

    def __init__(self, action_dim, embed_dim, stoch=50, deter=200, hidden=200):
        super().__init__()
        self.action_dim, self.sizes = action_dim, dict(deter=deter, stoch=stoch, mean=stoch,
                                                       std=stoch)
        self.inputs = nn.Sequential(nn.Linear(stoch + action_dim, hidden), nn.ELU())
        self.gru = nn.Linear(hidden + deter, 3 * deter)
        self.norm = nn.LayerNorm(3 * deter)
        self.prior_net = mlp(deter, hidden, 1, 2 * stoch)
        self.post_net = mlp(deter + embed_dim, hidden, 1, 2 * stoch)

    @staticmethod
    def feat(state):
        """What decoder, heads, actor and critic see: [z_t, h_t], (..., S + D)"""
        return torch.cat([state["stoch"], state["deter"]], -1)

    def initial(self, batch):
        """The zero state for a batch."""
        return {key: self.norm.weight.new_zeros(batch, size) for key, size in self.sizes.items()}

    def recur(self, state, action):
        """h_t = f(h_{t−1}, z_{t−1}, a_{t−1}): GRU, layer norm."""
        x = torch.cat([state["stoch"], action], -1) if self.action_dim else state["stoch"]
        gates = self.norm(self.gru(torch.cat([self.inputs(x), state["deter"]], -1)).float())
        reset, candidate, update = gates.chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        return torch.lerp(state["deter"], candidate, torch.sigmoid(update - 1))         # (B, D)

    def draw(self, net, inputs, deter):
        """A state around h_t: `net`'s distribution, a sample."""
        mean, std = net(inputs).float().chunk(2, -1)
        std = bounded_std(std)
        return dict(deter=deter, mean=mean, std=std, stoch=gaussian_sample(mean, std))

    def prior(self, deter):
        """ẑ_t ~ p(ẑ_t | h_t)"""
        return self.draw(self.prior_net, deter, deter)

    def posterior(self, deter, embed):
        """z_t ~ q(z_t | h_t, embed_t)"""
        return self.draw(self.post_net, torch.cat([deter, embed], -1), deter)

    def step(self, state, action, embed, is_first):
        """One filtering step; where is_first (B,) is set, state and action are forgotten."""
        keep = 1 - is_first.to(embed.dtype)[:, None]
        state = {key: value * keep for key, value in state.items()}
        return self.posterior(self.recur(state, action * keep if self.action_dim else None), embed)

    def observe(self, embed, action, is_first):
        """Filter windows: (B, T, Z), (B, T, A), (B, T) → post, prior, dicts of (B, T, ·)."""
        state, states = self.initial(len(embed)), []
        for t in range(embed.shape[1]):
            previous = action[:, t] if self.action_dim else None
            states.append(state := self.step(state, previous, embed[:, t], is_first[:, t]))
        post = {key: torch.stack([s[key] for s in states], 1) for key in state}
        return post, self.prior(post["deter"])                                # all steps at once

# === Video predictor and world model ==============================================================

class VideoPredictor(nn.Module):
    """The action-free video prediction model of Eq. (1), trained by Eq. (2)."""

    def __init__(self, cfg, action_dim=0):
        super().__init__()
        self.cfg, feat_dim = cfg, cfg.stoch + cfg.deter
        if cfg.encoder == "beta_vae":
            self.encoder = BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth)
            self.decoder = BetaVAEDecoder(feat_dim, cfg.z_dim, cfg.cnn_depth)
        else:
            self.encoder = ConvEncoder(cfg.cnn_depth)
            self.decoder = ConvDecoder(feat_dim, cfg.cnn_depth)
        self.rssm = RSSM(action_dim, self.encoder.embed_dim, cfg.stoch, cfg.deter, cfg.hidden)
        self.scales = dict(image=1.0, kl=cfg.beta1, disentangle=cfg.beta2)

    def encode(self, image):
        """image (..., 3, 64, 64) → (embed, code).
        β-VAE: a sample of 𝐳 (..., Z), and its dict of mean and logvar. DreamerV2's encoder: {}."""
        if isinstance(self.encoder, BetaVAEEncoder):
            mean, logvar = self.encoder(image)
            return gaussian_sample(mean, (logvar / 2).exp()), dict(mean=mean, logvar=logvar)
        return self.encoder(image), {}

    def forward(self, batch):
        """Filter → dict of embed, code, post, prior, feat."""
        embed, code = self.encode(batch["image"])
        post, prior = self.rssm.observe(embed, batch.get("action"), batch["is_first"])
        return dict(embed=embed, code=code, post=post, prior=prior, feat=self.rssm.feat(post))

    def terms(self, out, batch):
        """Loss terms of each step, (B, T), nats, but for the KL."""
        # −ln p(o_t | z_t), summed over pixels. The target stays fp32: bf16 would shift the loss.
        error = squared_error(batch["image"], self.decoder(out["feat"]))
        terms = dict(image=error.sum((-3, -2, -1)))
        return terms | (dict(disentangle=beta_vae_kl(**out["code"])) if out["code"] else {})

    def loss(self, out, batch, teacher=None, eta=0.0):
        """Eq. (2), or (5) for a WorldModel, for the output of forward. Returns (loss, metrics).
        teacher: dict of embed, mean, logvar of the same images from the frozen teacher, or None."""
        cfg, terms = self.cfg, self.terms(out, batch)
        loss, kl = rssm_kl_loss(out["post"], out["prior"], cfg.kl_balance, cfg.free_nats)
        metrics = dict(kl_loss=loss, kl=kl.mean(), eta=torch.tensor(eta),
                       post_entropy=normal_entropy(out["post"]["std"]).mean(),
                       prior_entropy=normal_entropy(out["prior"]["std"]).mean())
        loss = self.scales["kl"] * loss
        for name, term in terms.items():
            metrics[name] = term.mean()
            loss = loss + self.scales[name] * metrics[name]
        if teacher is not None:
            distill = (distillation_loss(teacher["embed"], out["embed"]) if cfg.distill == "softmax"
                       else gaussian_distillation_loss(teacher, out["code"]))
            loss, metrics["distill"] = loss + eta * distill, distill
        return loss, metrics

class WorldModel(VideoPredictor):
    """The world model of Eq. (4): Eq. (1) with actions, a reward and a discount head; Eq. (5)."""

    def __init__(self, cfg, action_dim):
        super().__init__(cfg, action_dim)
        self.scales = dict(image=1.0, kl=cfg.alpha, disentangle=cfg.beta, reward=cfg.reward_scale,
                           discount=cfg.discount_scale)
        self.reward = mlp(cfg.stoch + cfg.deter, cfg.units, 2, 1)
        self.discount = mlp(cfg.stoch + cfg.deter, cfg.units, 3, 1)

    def predict_reward(self, feat):
        """r̂, the mean of a unit Gaussian: (..., S + D) → (...,)"""
        return self.reward(feat).squeeze(-1).float()

    def predict_discount(self, feat):
        """The logit of γ̂: (..., S + D) → (...,)"""
        return self.discount(feat).squeeze(-1).float()

    def terms(self, out, batch):
        """Those of Eq. (2), the reward's and the discount's, (B, T) each."""
        reward = squared_error(batch["reward"], self.predict_reward(out["feat"]))
        # DEVIATION: the discount head of Eq. (4) is trained; the published code switches it off.
        logit, target = self.predict_discount(out["feat"]), self.cfg.gamma * batch["discount"]
        discount = F.binary_cross_entropy_with_logits(logit, target, reduction="none")
        return super().terms(out, batch) | dict(reward=reward, discount=discount)

# === Actor-critic: behaviour learning in imagination, appendix B ==================================

class ActorCritic(nn.Module):
    """Actor π(a | s), critic v(s), and a slow copy of the critic that gives the targets."""

    def __init__(self, cfg, action_dim):
        super().__init__()
        self.cfg, feat_dim = cfg, cfg.stoch + cfg.deter
        self.actor = mlp(feat_dim, cfg.units, 4, 2 * action_dim)
        self.critic = mlp(feat_dim, cfg.units, 3, 1)
        self.slow_critic = mlp(feat_dim, cfg.units, 3, 1).requires_grad_(False)   # only copied
        self.copy_critic()

    def copy_critic(self):
        """Slow critic ← critic."""
        self.slow_critic.load_state_dict(self.critic.state_dict())

    def policy(self, feat):
        """→ mean in (−1, 1) and std of the normal of actions, (..., A)"""
        mean, std = self.actor(feat).float().chunk(2, -1)
        return torch.tanh(mean), bounded_std(std)

    def value(self, feat, slow=False):
        """v(s): (..., S + D) → (...,)"""
        return (self.slow_critic if slow else self.critic)(feat).squeeze(-1).float()

    def imagine(self, model, start):
        """Follow the policy through the world model's prior, H transitions from N states.
              t        0     1    …   H−1      H
            feat      s_0   s_1      s_{H−1}  s_H     s_0 a posterior, the others imagined
          action      a_0   a_1      a_{H−1}          a_t is taken in s_t and leads to s_{t+1}
          reward      r_0   r_1      r_{H−1}          r̂(s_t)
        discount      γ_0   γ_1      γ_{H−1}          γ̂(s_t)

        Returns feats (H + 1, N, S + D), log_probs and entropies (H, N)."""
        state, feats, log_probs, entropies = start, [model.rssm.feat(start)], [], []
        for _ in range(self.cfg.horizon):
            # The policy takes its state as given; its gradient comes from where the action leads.
            mean, std = self.policy(feats[-1].detach())
            raw = gaussian_sample(mean, std)
            log_probs.append(normal_log_prob(raw.detach(), mean, std))        # REINFORCE: a is data
            entropies.append(normal_entropy(std))
            # DEVIATION: the published "truncated" normal is not; here actions are clipped.
            state = model.rssm.prior(model.rssm.recur(state, clip_action(raw)))
            feats.append(model.rssm.feat(state))
        return torch.stack(feats), torch.stack(log_probs), torch.stack(entropies)

    def losses(self, model, start, start_discount):
        """start: dict of (N, ·) detached states; start_discount (N,): their true γ_0.
        Returns (actor_loss, critic_loss, metrics). The actor's graph runs through the world model,
        which is *not* trained here: take gradients for the actor's own parameters only."""
        cfg = self.cfg
        feats, log_prob, entropy = self.imagine(model, start)
        reward = model.predict_reward(feats[:-1])                             # (H, N)
        discount = torch.sigmoid(model.predict_discount(feats[:-1]))
        discount = torch.cat([start_discount[None], discount[1:]])            # γ_0 is known
        slow = self.value(feats, slow=True)                                   # (H + 1, N)
        # DEVIATION: the published λ-return comes out reversed in time.
        target = lambda_return(reward, slow[:-1], discount, slow[-1], cfg.lambda_)
        # w_t = Π_{i<t} γ_i: how likely the episode still runs. A weight, nothing to optimise.
        weight = torch.cat([torch.ones_like(discount[:1]), discount[:-1]]).cumprod(0).detach()
        regression = target.detach()                                          # sg(V_t)
        value = self.value(feats[:-1].detach())                               # the model is fixed
        critic_loss = (weight * squared_error(regression, value)).mean()
        advantage = regression - value.detach()                               # sg(V_t − v(s_t))
        # ρ V_t + (1 − ρ) ln π(a_t | s_t) sg(V_t − v(s_t)) + scale · H[a_t | s_t]
        objective = (cfg.rho * target + (1 - cfg.rho) * log_prob * advantage
                     + cfg.entropy_scale * entropy)
        actor_loss = -(weight * objective).mean()
        return actor_loss, critic_loss, dict(
            actor=actor_loss, critic=critic_loss, actor_entropy=entropy.mean(), value=value.mean(),
            imagined_reward=reward.mean(), imagined_return=target.mean())

def freeze(encoder):
    """A teacher: evaluation mode, no gradient, in no optimiser."""
    # DEVIATION: the published code switches the teacher's gradients back on and trains it along.
    return encoder.eval().requires_grad_(False)

class Adam(torch.optim.Adam):
    """The optimiser of a module's parameters (published)."""

    def __init__(self, module, lr):
        super().__init__(module.parameters(), lr=lr, eps=1e-5)

    def load_state_dict(self, state):
        """The moments; the rest is the Config's. Torch itself would take another model's."""
        super().load_state_dict(dict(state, param_groups=self.state_dict()["param_groups"]))
        for p in self.param_groups[0]["params"] if self.state else ():
            if [x.shape for x in self.state[p].values()] != [(), p.shape, p.shape]:
                raise ValueError("the optimiser's moments are another model's")

def autocast(cfg):
    """bf16 around convolutions and MLPs; statistics, GRU state, targets and losses are fp32."""
    # 1.5× of a whole step on a CPU with native bf16.
    return torch.autocast(cfg.device, torch.bfloat16, enabled=cfg.precision == "bf16")

def to_device(batch, device):
    """Numpy arrays → tensors on the device, images preprocessed."""
    batch = {key: torch.from_numpy(value).to(device) for key, value in batch.items()}
    return batch | {"image": preprocess(batch["image"])}

def gradient_step(optimizer, loss, metrics, clip):
    """Minimise loss over the optimiser's own parameters. Returns the gradient norm before clipping.
    Raises FloatingPointError at a non-finite loss or gradient, before it changes anything."""
    parameters = optimizer.param_groups[0]["params"]
    optimizer.zero_grad()
    loss.backward(inputs=parameters)  # the actor's graph runs through the model, which gets none
    norm = nn.utils.clip_grad_norm_(parameters, clip)
    if not torch.isfinite(loss + norm):
        bad = [key for key, value in metrics.items() if not torch.isfinite(value).all()]
        raise FloatingPointError(f"non-finite {', '.join(bad) or f'gradient, its norm is {norm}'}")
    optimizer.step()
    return norm

class Agent:
    """World model, actor-critic, frozen teacher and optimisers: what an online run trains."""

    def __init__(self, cfg, action_dim, device, teacher=None):
        self.cfg, self.action_dim, self.device, self.teacher = cfg, action_dim, device, teacher
        self.model = WorldModel(cfg, action_dim).to(device)
        self.behaviour = ActorCritic(cfg, action_dim).to(device)
        self.optimizers = dict(model=Adam(self.model, cfg.model_lr),
                               actor=Adam(self.behaviour.actor, cfg.actor_lr),
                               critic=Adam(self.behaviour.critic, cfg.critic_lr))

    @torch.no_grad()
    def act(self, image, action, state, explore):
        """Decide. image: uint8 (N, 64, 64, 3); action: the previous one, (N, A); state: None first.
        explore: sample the actor, else take its mode. Returns action, numpy (N, A), and state."""
        is_first = torch.full((len(image),), state is None, device=self.device)
        state = self.model.rssm.initial(len(image)) if state is None else state
        embed, _ = self.model.encode(preprocess(torch.as_tensor(image, device=self.device)))
        action = torch.as_tensor(action, device=self.device)
        state = self.model.rssm.step(state, action, embed, is_first)
        mean, std = self.behaviour.policy(self.model.rssm.feat(state))
        return clip_action(gaussian_sample(mean, std) if explore else mean).cpu().numpy(), state

    def teach(self, image):
        """What the frozen teacher sees: embed, mean, logvar; or None."""
        if self.teacher is None:
            return None
        with torch.no_grad():                                                 # its knowledge stays
            mean, logvar = self.teacher(image)
            return dict(embed=gaussian_sample(mean, (logvar / 2).exp()), mean=mean, logvar=logvar)

    def update(self, batch, eta, update, probe=False):
        """Algorithm 1, lines 12–18: one step of everything on numpy arrays (B, T, ...) → metrics.
        update: index of this step. probe: measure distillation's own gradient at the encoder."""
        cfg, batch = self.cfg, to_device(batch, self.device)
        optimizers, clip = self.optimizers, self.cfg.grad_clip
        with autocast(cfg):
            out = self.model(batch)
            loss, metrics = self.model.loss(out, batch, self.teach(batch["image"]), eta)
        if probe and "distill" in metrics:
            grads = torch.autograd.grad(eta * metrics["distill"],
                                        [*self.model.encoder.parameters()], retain_graph=True)
            metrics["distill_grad_norm"] = torch.stack([grad.norm() for grad in grads]).norm()
        metrics["model_grad_norm"] = gradient_step(optimizers["model"], loss, metrics, clip)
        if update % cfg.slow_every == 0:
            self.behaviour.copy_critic()
        # Imagine from the posteriors of the batch, which are data here.
        start = {key: value.detach().flatten(0, 1) for key, value in out["post"].items()}
        start["discount"] = cfg.gamma * batch["discount"].flatten()
        if cfg.imagine_starts:
            chosen = torch.randperm(len(start["discount"]), device=self.device)[:cfg.imagine_starts]
            start = {key: value[chosen] for key, value in start.items()}
        with autocast(cfg):
            *losses, more = self.behaviour.losses(self.model, start, start.pop("discount"))
        metrics |= more
        for name, loss in zip(("actor", "critic"), losses, strict=True):
            metrics[f"{name}_grad_norm"] = gradient_step(optimizers[name], loss, metrics, clip)
        return {key: value.detach() for key, value in metrics.items()}

    def state_dict(self):
        return dict(model=self.model.state_dict(), behaviour=self.behaviour.state_dict(),
                    optimizers={name: opt.state_dict() for name, opt in self.optimizers.items()})

    def load_state_dict(self, state):
        self.model.load_state_dict(state["model"])
        self.behaviour.load_state_dict(state["behaviour"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])

# === Replay and video sets: episodes on disk ======================================================

# A row holds an image and what led to it (see RSSM for how rows line up).
ROW = dict(image=np.uint8, action=np.float32, reward=np.float32, discount=np.float32,
           is_first=np.bool_, is_terminal=np.bool_)
VIDEO_KEYS = ("image", "is_first")  # all that a video predictor may see

def make_row(image, action, reward=0.0, terminal=False, first=False):
    """One row of an episode."""
    return dict(image=image, action=action, reward=reward, discount=1.0 - terminal, is_first=first,
                is_terminal=terminal)

@contextlib.contextmanager
def atomic(path):
    """Yield a binary file that takes its place whole, when the block ends well, or not at all."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)

# What zipfile, numpy and torch raise at files that were cut off, altered, or never theirs.
DAMAGED = (zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError,
           pickle.UnpicklingError, ValueError, TypeError, LookupError, EOFError, RuntimeError,
           OverflowError, SyntaxError, AttributeError)

@contextlib.contextmanager
def reading(path, kind="checkpoint of ours", remedy="restore it, or start over with --fresh"):
    """What damaged or foreign content raises becomes one line that names the file."""
    try:
        yield
    except DAMAGED as error:
        cause = f"{type(error).__name__}: {error}"[:120]
        raise UserError(f"{path} is no {kind} ({cause}); {remedy}") from None

def npz_layout(path, keys, plain=True):
    """Where the arrays of an .npz lie in the file: {key: (offset, dtype, shape)}, bytes.
    The offset of an array that is compressed, or in Fortran's order, is None. Raises UserError
    unless `keys` are arrays as make_row has them, a row for each image uint8 (64, 64, 3); `plain`:
    and have an offset. Nothing is unpacked: a zip bomb is refused by the size that it declares."""
    layout, damage = {}, reading(path, f"episode with {', '.join(keys)}", "remove it")
    with damage, zipfile.ZipFile(path) as archive, open(path, "rb") as file:
        for info in archive.infolist():
            if info.file_size > max(2**30, 100 * info.compress_size):
                raise ValueError(f"{info.filename} would unpack to {info.file_size:,} bytes")
            with archive.open(info) as member:
                np.lib.format.read_magic(member)
                shape, fortran, dtype = np.lib.format.read_array_header_1_0(member)
                header = member.tell()
            file.seek(info.header_offset + 26)       # the local header, 30 bytes, ends in
            start = info.header_offset + 30 + int(np.frombuffer(file.read(4), "<u2").sum())
            mapped = info.compress_type == zipfile.ZIP_STORED and not fortran  # two lengths
            end = start + (info.file_size if mapped else info.compress_size)
            if (info.file_size != header + math.prod(shape) * dtype.itemsize
                    or end > os.fstat(file.fileno()).st_size):
                raise ValueError(f"{info.filename} is cut off, or no plain array")
            name = info.filename.removesuffix(".npy")
            layout[name] = start + header if mapped else None, dtype, shape
        length = len(range(layout["image"][2][0]))
        for key in keys:
            offset, dtype, shape = layout[key]
            row = dict(image=(64, 64, 3), action=shape[1:2]).get(key, ())
            if dtype != ROW[key] or shape != (length, *row) or not length:
                raise ValueError(f"{key} is {dtype} {shape}, not {np.dtype(ROW[key])} (T, *{row})")
            if plain and offset is None:
                raise ValueError(f"{key} is compressed, which only --videos may be")
    return layout

class Replay:
    """Finished episodes, a file each, laid end to end; windows start uniformly anywhere.

    Only an index is in memory; `sample` maps the rows of its windows. `np.load` opens a file; it
    is not compressed, so the rows of an array follow each other in it.
        episodes    ┌──────── 0 ────────┐┌──── 1 ────┐┌─────── 2 ──────
        rows        F . . . . . . . . . .F . . . . . .F . . . . . . . .      F: is_first
        a window                [. . . . . . F . . .]
    """

    def __init__(self, folder, capacity=None, keys=tuple(ROW)):
        # All files at first: a checkpoint may need those that the ones after it pushed out.
        self.folder, self.capacity, self.keys = Path(folder), None, keys
        self._hold([(path, npz_layout(path, keys)) for path in sorted(self.folder.glob("*.npz"))])
        self.capacity = capacity
        last = self.paths[-1].stem if self.paths else ""
        self.next_index = int(last) + 1 if last.isdecimal() else 0

    def _hold(self, episodes):
        """Index (path, layout) pairs, less the oldest beyond capacity."""
        lengths = [layout["image"][2][0] for _, layout in episodes]
        while self.capacity and sum(lengths[1:]) >= self.capacity:
            del episodes[0], lengths[0]
        self.episodes, self.ends = episodes, np.cumsum(lengths).tolist()
        self.paths, self.rows = [path for path, _ in episodes], sum(lengths)

    def add(self, rows):
        """Append a finished episode, a list of `make_row`."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{self.next_index:06d}.npz"
        with atomic(path) as file:
            np.savez(file, **{key: np.array([r[key] for r in rows], ROW[key]) for key in ROW})
        self._hold([*self.episodes, (path, npz_layout(path, self.keys))])
        self.next_index += 1

    def prune(self):
        """Delete files not in the index, once no checkpoint needs them."""
        for path in set(self.folder.glob("*.npz")) - set(self.paths):
            path.unlink()

    def state_dict(self):
        """Which episodes there are: the first one and the next to come."""
        first = int(self.paths[0].stem) if self.paths else self.next_index
        return dict(first=first, next=self.next_index)

    def load_state_dict(self, state):
        """Return to those episodes; later ones, of a run cut off, go."""
        numbers, self.next_index = range(state["first"], state["next"]), state["next"]
        self._hold([(path, layout) for path, layout in self.episodes
                    if path.stem.isdecimal() and int(path.stem) in numbers])
        if len(self.paths) != len(numbers):
            raise UserError(f"{self.folder} lacks episodes of its checkpoint; start over: --fresh")
        self.prune()

    def window(self, start, length):
        """Rows start … start + length − 1: dict of (T, ...)"""
        pieces = {key: [] for key in self.keys}
        while length > 0:
            index = np.searchsorted(self.ends, start, "right")
            count = min(length, self.ends[index] - start)
            path, layout = self.episodes[index]
            row = start - self.ends[index] + layout["image"][2][0]            # within the episode
            for key in self.keys:
                offset, dtype, shape = layout[key]
                pieces[key].append(np.memmap(path, dtype, "r", offset, shape)[row:row + count])
            start, length = start + count, length - count
        return {key: np.concatenate(piece) for key, piece in pieces.items()}

    def sample(self, batch_size, length, rng):
        """Dict of (B, T, ...); windows begin is_first."""
        starts = rng.integers(0, self.rows - length + 1, batch_size)
        windows = [self.window(int(start), length) for start in starts]
        batch = {key: np.stack([window[key] for window in windows]) for key in self.keys}
        batch["is_first"][:, 0] = True
        return batch

def open_videos(folder, cache):
    """The .npz episodes of a folder as a Replay of images.
    Foreign ones (the authors' are compressed and lack is_first) are unpacked into `cache`, once."""
    paths = sorted(Path(folder).glob("*.npz"))
    layouts = {path: npz_layout(path, ("image",), plain=False) for path in paths}
    if not layouts:
        raise UserError(f"no episodes (*.npz) in {folder}; run: python diswm.py collect --src TASK")
    if all("is_first" in layout and layout["image"][0] for layout in layouts.values()):
        return Replay(folder, keys=VIDEO_KEYS)
    cache.mkdir(parents=True, exist_ok=True)
    for path in layouts:
        if not (cache / path.name).exists():
            with reading(path, "video", "remove it"), np.load(path, allow_pickle=False) as episode:
                image = episode["image"]
            with atomic(cache / path.name) as file:
                np.savez(file, image=np.ascontiguousarray(image),
                         is_first=np.arange(len(image)) == 0)
    return Replay(cache, keys=VIDEO_KEYS)

# === Environments =================================================================================

TASKS = {f"{domain}_{task}": (domain, task) for domain, task in suite.ALL_TASKS}
PHASES = ("train", "shifted", "eval", "none")
COLOR_CENTERS = dict(train=(0.7, 0.3, 0.5), shifted=(0.5, 0.7, 0.3))  # published
TRAINING, EVALUATION = 0, 1  # streams of episode_seed

class DMControlEnv(gym.Env):
    """A task of dm_control.suite as a gymnasium.Env with a flat state observation."""

    def __init__(self, domain, task):
        self.env = suite.load(domain, task, environment_kwargs=dict(flat_observation=True))
        spec, size = self.env.action_spec(), self.env.observation_spec()["observations"].shape
        self.action_space = gym.spaces.Box(np.float32(spec.minimum), np.float32(spec.maximum))
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, size, np.float64)

    def __getattr__(self, name):
        # The raw mujoco.MjModel and MjData, under the names that gymnasium's MuJoCo tasks use.
        if name in ("model", "data"):
            return getattr(self.env.physics, name).ptr
        raise AttributeError(name)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.env.task.random.seed(seed)
        return self.env.reset().observation["observations"], {}

    def step(self, action):
        """A time limit truncates, only a zero discount terminates."""
        step = self.env.step(action)
        obs, terminated = step.observation["observations"], step.last() and step.discount == 0
        return obs, float(step.reward), terminated, step.last() and not terminated, {}

class ActionRepeat(gym.Wrapper):
    """Hold an action for n simulator steps, sum the rewards; info["env_steps"] counts the steps."""

    def __init__(self, env, n):
        super().__init__(env)
        self.n = n

    def step(self, action):
        """Stops early where the episode ends."""
        # DEVIATION: the published code repeats in two wrappers (really 4) and doubles rewards.
        total, steps, terminated, truncated = 0.0, 0, False, False
        while steps < self.n and not (terminated or truncated):
            obs, reward, terminated, truncated, info = self.env.step(action)
            total, steps = total + reward, steps + 1
        return obs, total, terminated, truncated, info | {"env_steps": steps}

def color_box(phase, original, colors="published", half_range=0.2):
    """What a phase draws colours from: (low, high), each (n, 3) in 0..1, like `original`.
    Around the original colours, `shifted` rotates their channels (ours)."""
    if phase == "none":
        return original, original
    phase = "shifted" if phase == "eval" else phase                           # DMC keeps none apart
    if colors == "published":
        center = np.broadcast_to(COLOR_CENTERS[phase], original.shape)
    else:
        center = original if phase == "train" else np.roll(original, 1, -1)
    return np.clip(center - half_range, 0, 1), np.clip(center + half_range, 0, 1)

class ColorDistractor(gym.Wrapper):
    """Each episode, draw the colours of all materials from a random stream of their own.
    reset(options={"phase": …}) changes the phase from then on. Only what is rendered changes."""

    def __init__(self, env, phase, colors="published", half_range=0.2, step_std=0.0):
        super().__init__(env)
        self.phase, self.colors = phase, colors
        self.half_range, self.step_std = half_range, step_std
        self.original = self.unwrapped.model.mat_rgba[:, :3].copy()
        self.rng = np.random.default_rng()

    def reset(self, *, seed=None, options=None):
        """New colours; a seed determines them."""
        if seed is not None:
            self.rng = np.random.default_rng([seed, 1])
        self.phase = (options or {}).get("phase", self.phase)
        self.box = color_box(self.phase, self.original, self.colors, self.half_range)
        self.unwrapped.model.mat_rgba[:, :3] = self.rng.uniform(*self.box)
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        """Optionally, the colours walk at random within the box."""
        rgb = self.unwrapped.model.mat_rgba[:, :3]
        if self.step_std:
            rgb[:] = np.clip(rgb + self.rng.normal(0, self.step_std, rgb.shape), *self.box)
        return self.env.step(action)

class Pixels(gym.ObservationWrapper):
    """Observe what camera 0 sees, uint8 (size, size, 3), through a renderer of one's own.
    mujoco.Renderer makes its GL context current before each use; the simulators' render() does not,
    and then two of them in one process silently show each other's textures."""
    metadata, render_mode = {"render_modes": ["rgb_array"]}, "rgb_array"

    def __init__(self, env, size=64, fast=False):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        quality = self.unwrapped.model.vis.quality
        quality.shadowsize = 512          # 20–60 % of a frame, for a mean difference < 0.2 / 255
        if fast:
            quality.offsamples = 0        # half of the rest, for 1–2 / 255
        self.renderer = mujoco.Renderer(self.unwrapped.model, size, size)
        atexit.register(self.renderer.close)  # one that is open at exit prints GL errors

    def observation(self, observation):
        self.renderer.update_scene(self.unwrapped.data, camera=0)
        return self.renderer.render()

    def render(self):
        return self.observation(None)

    def close(self):
        """Free the GL context, then the simulator."""
        atexit.unregister(self.renderer.close)
        self.renderer.close()
        super().close()

def make_env(task, *, phase="train", seed=0, action_repeat=2, time_limit=0, colors="published",
             color_range=0.2, color_step_std=0.0, fast_render=False, size=64, pixels=True):
    """The one env stack: simulator, actions in [−1, 1], time limit, action repeat, colours, pixels.
    phase: "train", "shifted" (colours after the midpoint), "eval" (those that a finished run is
    judged in; on DMC the shifted ones) or "none" (the task's own). time_limit: simulator steps, 0
    for the task's own. pixels=False leaves the state observation and renders nothing. Returns a
    gymnasium.Env of uint8 (size, size, 3) images. UserError: unknown task or phase, no OpenGL."""
    if task not in TASKS or phase not in PHASES:
        wrong, known = (task, TASKS) if task not in TASKS else (phase, PHASES)
        near = " or ".join(difflib.get_close_matches(wrong, known)) or "none is similar"
        raise UserError(f"unknown '{wrong}' ({near}); there are: {', '.join(known)}", code=2)
    env = gym.wrappers.RescaleAction(DMControlEnv(*TASKS[task]), np.float32(-1), np.float32(1))
    env = ActionRepeat(gym.wrappers.TimeLimit(env, time_limit or 1000), action_repeat)  # DMC's 1000
    env = ColorDistractor(env, phase, colors, color_range, color_step_std)
    if pixels:
        try:
            env = Pixels(env, size, fast_render)
        except (AttributeError, ImportError, RuntimeError) as error:
            raise UserError(f"MuJoCo with MUJOCO_GL={os.environ['MUJOCO_GL']} cannot render "
                            f"({error}); {GL_HINT}") from error
    env.reset(seed=seed)
    return env

def config_env(cfg, task, phase, **kwargs):
    """Make_env with the values of a Config."""
    return make_env(task, phase=phase, action_repeat=cfg.action_repeat, time_limit=cfg.time_limit,
                    colors=cfg.colors, color_range=cfg.color_range, fast_render=cfg.fast_render,
                    color_step_std=cfg.color_step_std, **kwargs)

def episode_seed(seed, stream, index):
    """Of the run's seed, the purpose and the index."""
    return int(np.random.SeedSequence([seed, stream, index]).generate_state(1)[0])

def play_episode(env, policy, seed, phase, each=None):
    """Play one episode → its rows (see make_row).
    policy(image, action, state) → (action, state), given the previous action and, at first, None.
    each(info) is called after each decision; the episode is cut where it returns true."""
    image, _ = env.reset(seed=seed, options=dict(phase=phase))
    action, state, done = np.zeros(env.action_space.shape, np.float32), None, False
    rows = [make_row(image, action, first=True)]
    while not done:
        action, state = policy(image, action, state)
        image, reward, terminated, truncated, info = env.step(action)
        rows.append(make_row(image, action, reward, terminated))
        done = bool(each and each(info)) or terminated or truncated
    return rows

def random_policy(env, seed):
    """Uniform actions in [−1, 1]"""
    rng = np.random.default_rng(seed)
    return lambda image, action, state: (rng.uniform(-1, 1, action.shape).astype(np.float32), None)

def agent_policy(agent, explore):
    """The agent's actor: sampled when exploring, else its mode."""

    def policy(image, action, state):
        actions, state = agent.act(image[None], action[None], state, explore)
        return actions[0], state
    return policy

# === Runs: folders, checkpoints, logs, and the training loop ======================================

def run_folder(cfg, stage):
    """runs/<stage>/<tasks>/<method>/seed<k>, so that the same command finds its run again."""
    tasks = f"{cfg.src}-{cfg.dst}" if stage == "finetune" else cfg.src
    return Path(cfg.runs) / stage / tasks / cfg.method / f"seed{cfg.seed}"

def read_checkpoint(path):
    """A checkpoint, loaded without executing code. UserError when it is missing or not ours.
    No path that stands in it is ever followed."""
    if not Path(path).exists():
        raise UserError(f"there is no checkpoint {path}; train that run first, for instance: "
                        "python diswm.py finetune --dst walker_walk")
    with reading(path), zipfile.ZipFile(path) as archive:
        # torch.load would unpack a bomb, and looks at no checksum.
        packed = sum(info.file_size for info in archive.infolist()) > os.path.getsize(path)
        if packed or archive.testzip():
            raise ValueError("compressed, or altered")
        state = torch.load(path, map_location="cpu", weights_only=True)
        state["config"] = Config(**state["config"])
        tensors = [x for x in tree_leaves(state["trainer"]) if isinstance(x, torch.Tensor)]
        if not all(x.dtype == torch.float32 and x.isfinite().all() for x in tensors):
            raise ValueError("not all weights are finite float32")
        int(state["trainer"]["progress"])
        return dict(state) | {key: state[key] for key in ("stage", "trainer", "rng", "log_bytes")}

class Run:
    """A run's folder: checkpoint.pt, config.json, metrics.jsonl, TensorBoard events."""

    def __init__(self, cfg, stage, fresh=False):
        self.cfg, self.stage, self.folder = cfg, stage, run_folder(cfg, stage)
        self.checkpoint = self.folder / "checkpoint.pt"
        self.log_path = self.folder / "metrics.jsonl"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.lock = open(self.folder / "lock", "w")  # noqa: SIM115, train() closes it
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # a process that dies lets go
        except BlockingIOError:
            raise UserError(f"another process is at work in {self.folder}; stop it first") from None
        for path in set(self.folder.iterdir()) - {self.folder / "lock"} if fresh else ():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        self.state = read_checkpoint(self.checkpoint) if self.checkpoint.exists() else None
        old = self.state["config"] if self.state else cfg
        differ = [f"{field.name} {getattr(old, field.name)} (now {getattr(cfg, field.name)})"
                  for field in dataclasses.fields(Config) if not field.metadata["free"]
                  and getattr(old, field.name) != getattr(cfg, field.name)]
        if differ:
            raise UserError(f"{self.folder} was started with {', '.join(differ)}; use the same "
                            "flags, or --fresh to start over, or another --runs")

    def save(self, trainer):
        """Write the checkpoint, whole or not at all."""
        config, cpu = dataclasses.asdict(self.cfg), torch.get_rng_state()
        cuda = torch.cuda.get_rng_state() if self.cfg.device == "cuda" else None
        log_bytes = self.log_path.stat().st_size if self.log_path.exists() else 0
        buffer = io.BytesIO()  # a full disk is then an OSError of the file, not one inside torch
        torch.save(dict(config=config, stage=self.stage, trainer=trainer.state_dict(),
                        rng=dict(cpu=cpu, cuda=cuda), log_bytes=log_bytes), buffer)
        with atomic(self.folder / "config.json") as file:
            file.write(json.dumps(config, indent=2).encode())
        with atomic(self.checkpoint) as file:
            file.write(buffer.getbuffer())

    def restore(self, trainer):
        """Trainer, random numbers, and the log as it was then."""
        with reading(self.checkpoint):
            trainer.load_state_dict(self.state["trainer"])
            torch.set_rng_state(self.state["rng"]["cpu"])
            if self.state["rng"]["cuda"] is not None and self.cfg.device == "cuda":
                torch.cuda.set_rng_state(self.state["rng"]["cuda"])
            if self.log_path.exists():
                if not 0 <= self.state["log_bytes"] <= self.log_path.stat().st_size:
                    raise ValueError(f"{self.log_path.name} is shorter than it was then")
                os.truncate(self.log_path, self.state["log_bytes"])          # the rest comes again

@contextlib.contextmanager
def stop_requests():
    """Yield a list that gets the first SIGTERM or Ctrl-C; a second one exits at once."""
    received = []

    def note(number, frame):
        received.append(number)
        if len(received) > 1:
            raise SystemExit(128 + number)
        os.write(2, b"finishing this episode or update, then saving; again to stop now\n")
    with contextlib.ExitStack() as handlers:
        for number in (signal.SIGTERM, signal.SIGINT):
            with contextlib.suppress(ValueError):             # a thread may not have handlers
                handlers.callback(signal.signal, number, signal.signal(number, note))
        yield received

def train(trainer, run):
    """The one training loop: resume; then work, log, checkpoint, until the Trainer's total."""
    from torch.utils.tensorboard import SummaryWriter  # slow to import
    if run.state:
        run.restore(trainer)
        print(f"resuming at {trainer.progress:,} of {trainer.total:,} {trainer.unit}", flush=True)
    else:
        run.save(trainer)
    began, first = time.time(), trainer.progress
    bar = tqdm(total=trainer.total, initial=first, unit=f" {trainer.unit}", disable=None)
    with run.lock, stop_requests() as stop, bar, contextlib.closing(
            SummaryWriter(run.folder, purge_step=first + 1)) as writer:
        while trainer.progress < trainer.total and not stop:
            try:
                row = trainer.advance()
            except FloatingPointError as error:
                np.savez(batch := run.folder / "nonfinite.npz", **trainer.batch)
                raise UserError(f"{error}, from {batch}; the last checkpoint is kept. Try --fresh "
                                "with a smaller --model-lr, or --precision fp32") from None
            bar.update(trainer.progress - bar.n)
            if row:
                seconds = time.time() - began
                row |= dict(seconds=seconds, rate=(trainer.progress - first) / seconds)
                with open(run.log_path, "a") as file:
                    file.write(json.dumps(row) + "\n")
                    file.flush()
                    os.fsync(file)                       # before the checkpoint that counts on it
                for key, value in row.items():
                    if isinstance(value, (int, float)):
                        writer.add_scalar(key, value, trainer.progress)
                shown = "  ".join(f"{key} {row[key]:.4g}" for key in trainer.shown if key in row)
                bar.set_postfix_str(shown, refresh=False)
            if row or stop:
                run.save(trainer)
            if row and bar.disable:                                           # not a terminal
                left = tqdm.format_interval((trainer.total - trainer.progress) / row["rate"])
                print(f"{trainer.progress:,}/{trainer.total:,} {trainer.unit}  {shown}  "
                      f"{row['rate']:.1f} {trainer.unit}/s  ETA {left}", flush=True)
    if stop:
        raise UserError(f"stopped by {signal.Signals(stop[0]).name}, saved at {trainer.progress:,} "
                        f"{trainer.unit}; the same command goes on from there", 128 + stop[0])
    print(f"done: {run.folder}")

def mean_metrics(rows):
    """The average of several updates' metrics: list of dicts of scalar tensors → dict of floats."""
    names = sorted({name for row in rows for name in row})
    return {name: torch.stack([row[name] for row in rows if name in row]).float().mean().item()
            for name in names}

class Trainer:
    """Work for train(): `progress` to `total` in `unit`s; advance() does some → a row of metrics or
    None. What changes: `parts` that have a state_dict, and `counters`; `batch`: the latest."""
    counters = ("progress",)

    def state_dict(self):
        parts = {name: getattr(self, name).state_dict() for name in self.parts}
        return parts | {name: getattr(self, name) for name in self.counters}

    def load_state_dict(self, state):
        for name in self.parts:
            getattr(self, name).load_state_dict(state[name])
        for name in self.counters:
            if type(state[name]) is not type(getattr(self, name)):
                raise TypeError(f"{name} is {state[name]}")
            setattr(self, name, state[name])

class VideoTrainer(Trainer):
    """Stage 2, Algorithm 1 lines 4–8: the video predictor. Progress is in updates."""
    unit, shown, parts = "updates", ("image", "kl", "disentangle"), ("model", "optimizer")
    counters, chunk = ("progress", "metrics"), 100                            # updates per log row

    def __init__(self, cfg, videos, device):
        self.cfg, self.videos, self.device = cfg, videos, device
        self.model = VideoPredictor(cfg).to(device)
        self.optimizer = Adam(self.model, cfg.model_lr)
        self.progress, self.metrics, self.total = 0, [], cfg.pretrain_updates

    def update(self, batch):
        """One step of Eq. (2) on numpy arrays (B, T, ...) → metrics."""
        batch = to_device(batch, self.device)
        with autocast(self.cfg):
            loss, metrics = self.model.loss(self.model(batch), batch)
        norm = gradient_step(self.optimizer, loss, metrics, self.cfg.grad_clip)
        return {key: value.detach() for key, value in metrics.items()} | {"model_grad_norm": norm}

    def advance(self):
        """An update → after every `chunk` of them, and at the end, a row of the log."""
        cfg, rng = self.cfg, np.random.default_rng([self.cfg.seed, self.progress])  # not saved
        self.batch = self.videos.sample(cfg.batch_size, cfg.batch_length, rng)
        self.metrics.append(self.update(self.batch))
        self.progress += 1
        if self.progress % self.chunk and self.progress < self.total:
            return None
        row, self.metrics = dict(update=self.progress) | mean_metrics(self.metrics), []
        return row

class AgentTrainer(Trainer):
    """Stages 1 and 3, Algorithm 1 lines 9–25: an agent in an environment. Progress in env steps.
    It works episode by episode. A checkpoint falls between two of them, so no simulator or
    recurrent state is in it; the colours, η and all seeds follow from the counters."""
    unit, shown = "env steps", ("train_return", "eval_return", "image", "reward", "kl", "eta")
    parts, counters = ("agent", "replay"), ("progress", "decisions", "updates", "episodes")

    def __init__(self, cfg, folder, device, teacher=None):
        self.cfg = cfg
        self.env, self.eval_env = (config_env(cfg, cfg.dst, "train") for _ in range(2))
        self.agent = Agent(cfg, self.env.action_space.shape[0], device, teacher)
        self.replay = Replay(folder / "episodes", cfg.replay_capacity)
        self.progress = self.decisions = self.updates = self.episodes = 0
        self.total, self.switch_step = cfg.steps, int(cfg.switch * cfg.steps)

    @property
    def phase(self):
        """The colours of an episode that starts now: they switch once, at the midpoint."""
        return "train" if self.progress < self.switch_step else "shifted"

    def updates_due(self):
        """How many updates follow the decision just made."""
        cfg = self.cfg
        if self.decisions < cfg.prefill or self.replay.rows < cfg.batch_length:
            return 0
        return int(self.decisions % cfg.train_every == 0) if self.updates else cfg.first_updates

    def learn(self):
        """Do the updates that are due → a list of their metrics."""
        cfg, metrics = self.cfg, []
        # DEVIATION: η follows the live clock; the published one is copied once and never anneals.
        eta = eta_schedule(self.decisions, cfg.eta, cfg.eta_end, cfg.eta_decay, cfg.eta_delay)
        for _ in range(self.updates_due()):
            rng = np.random.default_rng([cfg.seed, self.updates])             # nothing to save
            self.batch = self.replay.sample(cfg.batch_size, cfg.batch_length, rng)
            probe = self.updates % 100 == 0
            metrics.append(self.agent.update(self.batch, eta, self.updates, probe))
            self.updates += 1
        return metrics

    def play(self):
        """A training episode, learning on the way → its rows, and the metrics of its updates.
        It ends with the simulator's episode, at the colour switch, or with the run."""
        cfg, metrics = self.cfg, []
        seed = episode_seed(cfg.seed, TRAINING, self.episodes)
        random, actor = random_policy(self.env, seed), agent_policy(self.agent, explore=True)
        limit = self.switch_step if self.progress < self.switch_step else self.total
        def policy(*args):
            return (random if self.decisions < cfg.prefill else actor)(*args)
        def each(info):
            self.decisions += 1
            self.progress += info["env_steps"]
            metrics.extend(self.learn())
            return self.progress >= limit
        return play_episode(self.env, policy, seed, self.phase, each), metrics

    def advance(self):
        """An episode, and an evaluation when one is due → a row of the log."""
        cfg, phase, before = self.cfg, self.phase, self.progress
        self.replay.prune()           # a checkpoint was written: what only the one before needed
        rows, metrics = self.play()
        self.replay.add(rows)
        self.episodes += 1
        total = math.fsum(row["reward"] for row in rows)
        row = dict(step=self.progress, phase=phase, train_return=total, train_length=len(rows) - 1)
        row |= mean_metrics(metrics) | {name: getattr(self, name) for name in self.counters[1:]}
        due = self.progress // cfg.eval_every > before // cfg.eval_every
        if due or self.progress >= self.total:
            returns, _ = evaluate_agent(cfg, self.agent, self.eval_env, phase)
            row |= dict(eval_return=statistics.fmean(returns), eval_returns=returns,
                        eval_std=statistics.pstdev(returns))
        return row

    def state_dict(self):
        """And the teacher, so that the run needs no other file."""
        teacher = self.agent.teacher
        if teacher:
            teacher = dict(depth=teacher.net[0].out_channels, weights=teacher.state_dict())
        return super().state_dict() | dict(teacher=teacher, action_dim=self.agent.action_dim)

def evaluate_agent(cfg, agent, env, phase):
    """Play `eval_episodes` episodes, the same seeds every time; agent None: random actions.
    Returns their returns and the first one's rows. Training's random numbers stay untouched."""
    returns, first = [], None
    with torch.random.fork_rng():
        torch.manual_seed(cfg.seed)
        for index in range(cfg.eval_episodes):
            seed = episode_seed(cfg.seed, EVALUATION, index)
            policy = agent_policy(agent, explore=False) if agent else random_policy(env, seed)
            rows = play_episode(env, policy, seed, phase)
            returns.append(math.fsum(row["reward"] for row in rows))
            first = first or rows
    return returns, first

# === Stages =======================================================================================

def announce(cfg, stage, folder, frames):
    """What runs, on what, its needs and folder."""
    disk = 0.1 + frames * 12.35e-6                                            # GB; a row is 12.3 kB
    memory = 0.95 + cfg.batch_size * cfg.batch_length * cfg.cnn_depth * 3.2e-5  # measured
    have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    if cfg.device == "cpu" and memory > have:
        raise UserError(f"needs about {memory:,.0f} GB of memory and this machine has {have:.0f}; "
                        "take a smaller --batch-size, --batch-length or --cnn-depth")
    print(f"{stage} {cfg.method}, {cfg.src} → {cfg.dst}, seed {cfg.seed}, on {cfg.device} with "
          f"{cfg.precision} and {torch.get_num_threads()} threads\n  needs about {disk:.1f} GB of "
          f"disk and {memory:.1f} GB of memory; results go to {folder}", flush=True)

def train_agent(cfg, stage, fresh):
    """Train an agent in `cfg.dst` from where it stopped. Returns the run's folder."""
    run, device, teacher = Run(cfg, stage, fresh), torch.device(cfg.device), None
    if cfg.eta > 0:
        saved = run.state and run.state["trainer"]
        teacher = saved_teacher(saved, cfg, device) if saved else find_teacher(cfg, device)
    announce(cfg, stage, run.folder, cfg.steps // cfg.action_repeat)
    torch.manual_seed(cfg.seed)
    trainer = AgentTrainer(cfg, run.folder, device, teacher)
    with contextlib.closing(trainer.env), contextlib.closing(trainer.eval_env):
        train(trainer, run)
    return run.folder

def collect(cfg, fresh=False):
    """Stage 1: DreamerV2 learns in the distracting source task; its replay is the video set."""
    # The training colours throughout, and every frame is kept.
    cfg = replace(cfg, dst=cfg.src, method="dreamerv2", steps=cfg.collect_steps, switch=1.0,
                  replay_capacity=10 * cfg.collect_steps, **METHODS["dreamerv2"])
    return train_agent(cfg, "collect", fresh)

def pretrain(cfg, fresh=False):
    """Stage 2: the video predictor. Collects videos first when there are none."""
    cfg = replace(cfg, dst=cfg.src)
    run, folder = Run(cfg, "pretrain", fresh), Path(cfg.videos)
    if not cfg.videos:
        own = run_folder(replace(cfg, method="dreamerv2"), "collect")
        others = [path.parent for path in sorted(own.parent.glob("seed*/checkpoint.pt"))]
        # One video set serves all seeds; an unfinished one is finished.
        folder = (collect(cfg) if own in others or not others else others[0]) / "episodes"
    videos = open_videos(folder, run.folder / "videos")
    if videos.rows < cfg.batch_length:
        raise UserError(f"{folder} has {videos.rows} frames, less than one window of "
                        f"{cfg.batch_length}; collect more, or lower --batch-length")
    print(f"videos: {folder}, {len(videos.paths):,} episodes, {videos.rows:,} frames")
    announce(cfg, "pretrain", run.folder, 0)
    torch.manual_seed(cfg.seed)
    train(VideoTrainer(cfg, videos, torch.device(cfg.device)), run)

def finetune(cfg, fresh=False):
    """Stage 3: distil, adapt, learn behaviour in the target task."""
    train_agent(cfg, "finetune", fresh)

def find_teacher(cfg, device):
    """The frozen encoder of a video predictor: --teacher, or the one of --src and this method.
    Prefers the run's own seed, else the first. Raises UserError with the command that makes one."""
    own = run_folder(cfg, "pretrain")
    found = [own / "checkpoint.pt", *sorted(own.parent.glob("seed*/checkpoint.pt"))]
    path = Path(cfg.teacher) if cfg.teacher else next((p for p in found if p.exists()), None)
    command = f"run: python diswm.py pretrain --src {cfg.src} --method {cfg.method}"
    if cfg.src == cfg.dst:
        raise UserError(f"source and target are both {cfg.src}; choose another --src")
    if path is None:
        others = {p.parts[-4] for p in own.parent.parent.parent.glob(f"*/{cfg.method}/*/*.pt")}
        raise UserError(f"no teacher in {own.parent}; {command}"
                        + (f" (or take one that exists: --src {min(others)})" if others else ""))
    state = read_checkpoint(path)
    saved, done = state["config"], state["trainer"]["progress"]
    if state["stage"] != "pretrain" or saved.encoder != "beta_vae":
        raise UserError(f"{path} is a {saved.encoder} {state['stage']} run, no teacher; {command}")
    if saved.src == cfg.dst:
        raise UserError(f"{path} saw videos of the target, {cfg.dst}; choose another --src")
    if (z := saved.z_dim) != cfg.z_dim:
        raise UserError(f"{path} has {z} latents, this run {cfg.z_dim}; add --z-dim {z}")
    if done < saved.pretrain_updates:
        raise UserError(f"{path} is not finished ({done} of {saved.pretrain_updates}); {command}")
    print(f"teacher: {path} ({saved.src}, {done:,} updates)")
    with reading(path):
        model = VideoPredictor(saved)
        model.load_state_dict(state["trainer"]["model"])
    return freeze(model.encoder.to(device))

def saved_teacher(trainer, cfg, device):
    """The frozen teacher that an agent's checkpoint carries, or None."""
    if not trainer["teacher"]:
        return None
    teacher = BetaVAEEncoder(cfg.z_dim, trainer["teacher"]["depth"]).to(device)
    teacher.load_state_dict(trainer["teacher"]["weights"])
    return freeze(teacher)

def load_model(folder, device):
    """A run's model from its checkpoint → (cfg, Agent or VideoPredictor, the trainer's state)."""
    state = read_checkpoint(Path(folder) / "checkpoint.pt")
    cfg, trainer = replace(state["config"], device=device.type, precision="fp32"), state["trainer"]
    with reading(Path(folder) / "checkpoint.pt"):
        if state["stage"] == "pretrain":
            model, weights = VideoPredictor(cfg).to(device), trainer["model"]
        else:
            model = Agent(cfg, trainer["action_dim"], device, saved_teacher(trainer, cfg, device))
            weights = trainer["agent"]
        model.load_state_dict(weights)
    return cfg, model, trainer

def evaluate(folder, device, episodes=None):
    """Stage 4: episodes with the actor's mode, and as many with random actions.
    Writes evaluation.json, and the first episode as evaluation.mp4, into the run's folder."""
    folder = Path(folder)
    cfg, agent, trainer = load_model(folder, device)
    if not isinstance(agent, Agent):
        raise UserError(f"{folder} is a video predictor without a policy; give a finetune run")
    cfg = replace(cfg, eval_episodes=episodes or cfg.eval_episodes)
    switched = trainer["progress"] >= int(cfg.switch * cfg.steps) < cfg.steps
    result = dict(task=cfg.dst, phase="shifted" if switched else "train", step=trainer["progress"])
    for name, policy in (("", agent), ("random_", None)):
        # Nobody looks at what the random policy sees.
        with contextlib.closing(config_env(cfg, cfg.dst, "train", pixels=bool(policy))) as env:
            returns, rows = evaluate_agent(cfg, policy, env, result["phase"])
        result |= {f"{name}returns": returns, f"{name}mean": statistics.fmean(returns),
                   f"{name}std": statistics.pstdev(returns)}
        if policy:
            frames = np.stack([row["image"] for row in rows]).repeat(4, 1).repeat(4, 2)
            iio.imwrite(folder / "evaluation.mp4", frames, fps=25)            # 256 × 256
    (folder / "evaluation.json").write_text(json.dumps(result, indent=2) + "\n")
    print("{task}, {phase} colours, after {step:,} env steps: return {mean:.1f} ± {std:.1f}; "
          "random policy: {random_mean:.1f} ± {random_std:.1f};".format(**result),
          f"{len(returns)} episodes each\nwrote evaluation.json and evaluation.mp4 in {folder}")

# === Figures ======================================================================================

TRAVERSAL = (-9, -3, -2, -1, 0, 1, 2, 3, 9)  # the prior's range, and the published ±9

def to_picture(image):
    """float (..., 3, h, w) in [−0.5, 0.5] → uint8 (..., h, w, 3)"""
    return ((image.movedim(-3, -1) + 0.5).clamp(0, 1) * 255).round().byte().cpu().numpy()

@torch.no_grad()
def latent_traversal(model, batch):
    """Vary one latent at a time (paper, Fig. 5). batch: one window (1, T, ...), preprocessed.
    𝐳 of the first image, with z_i = v, goes through posterior (mean) and decoder: without a past,
    all that the model knows is 𝐳. Returns pictures, uint8 (Z, 1 + values, 64, 64, 3), first the
    reconstruction; and each latent's KL in nats, averaged over the window, (Z,)."""
    out = model(batch)
    mean, logvar = (out["code"][key][0] for key in ("mean", "logvar"))        # (T, Z)
    values, size = torch.tensor(TRAVERSAL, device=mean.device), mean.shape[-1]
    z = mean[0].repeat(size, 1 + len(values), 1)                             # (Z, 1 + values, Z)
    z[torch.arange(size), 1:, torch.arange(size)] = values.to(z.dtype)
    deter = out["post"]["deter"][0, 0].expand(*z.shape[:2], -1)
    state = model.rssm.posterior(deter, z)
    pictures = to_picture(model.decoder(torch.cat([state["mean"], deter], -1)))
    return pictures, beta_vae_kl(mean[..., None], logvar[..., None]).mean(0).cpu().numpy()

@torch.no_grad()
def open_loop(model, batch, context=5):
    """Filter `context` images, predict the others unseen. batch: one window (1, T, ...).
    The actions are the window's own. Returns uint8 (3, T, 64, 64, 3): truth, model, error."""
    out = model({key: value[:, :context] for key, value in batch.items()})
    state, feats = {key: value[:, -1] for key, value in out["post"].items()}, [out["feat"]]
    for t in range(context, batch["image"].shape[1]):
        action = batch["action"][:, t] if "action" in batch else None
        state = model.rssm.prior(model.rssm.recur(state, action))
        feats.append(model.rssm.feat(state)[:, None])
    truth, prediction = batch["image"][0], model.decoder(torch.cat(feats, 1))[0].clamp(-0.5, 0.5)
    return np.stack([to_picture(x) for x in (truth, prediction, (prediction - truth) / 2)])

def draw_grid(pictures, rows, columns, path, title=""):
    """pictures (rows, columns, 64, 64, 3) as one labelled PNG."""
    from matplotlib.figure import Figure  # slow to import
    r, c = pictures.shape[:2]
    axes = Figure(figsize=(c * 0.75 + 1, r * 0.75 + 0.5)).subplots()
    axes.imshow(pictures.transpose(0, 2, 1, 3, 4).reshape(r * 64, c * 64, 3))
    axes.set_yticks(np.arange(r) * 64 + 32, rows)
    axes.set_xticks(np.arange(c) * 64 + 32, columns)
    axes.tick_params(length=0, labeltop=True, labelbottom=False)
    axes.set(title=title, frame_on=False)
    axes.figure.savefig(path, dpi=100, bbox_inches="tight")
    print(f"wrote {path}")

def traverse(folder, device, videos=""):
    """Draw traversal.png (for models with β-VAE latents) and open_loop.png into a run's folder.
    Episodes: `videos`, else the run's, else those collected beside it: none that a checkpoint,
    which may be a stranger's, could name."""
    folder = Path(folder)
    cfg, model, _ = load_model(folder, device)
    online, (*_, source, _, _) = isinstance(model, Agent), ("", "", *folder.resolve().parts)
    places = [folder / "videos",
              *(folder / "../../../..").glob(f"collect/{source}/*/seed*/episodes")]
    place = Path(videos) if videos else next(filter(Path.exists, places), places[0])
    replay = Replay(folder / "episodes") if online else Replay(place, keys=VIDEO_KEYS)
    model = model.model if online else model
    if not replay.rows:
        raise UserError(f"no episodes in {replay.folder}; nothing to draw from (see --videos)")
    # From the middle of the last episode: the colours of the end, and a pose that is not the start.
    start = ([0, *replay.ends][-2] + replay.rows) // 2
    window = replay.window(start, min(50, replay.rows - start))
    window["is_first"][0] = True
    batch = to_device({key: value[None] for key, value in window.items()}, device)
    with torch.random.fork_rng():
        torch.manual_seed(cfg.seed)
        strip = open_loop(model, batch)
        frames = range(0, strip.shape[1], 4)
        draw_grid(strip[:, ::4], ("truth", "model", "error"), frames, folder / "open_loop.png",
                  "open-loop prediction: frames 5 … are predicted, not seen")
        if cfg.encoder == "beta_vae":
            pictures, nats = latent_traversal(model, batch)
            order = np.argsort(-nats)                                         # informative first
            draw_grid(pictures[order], [f"z{i}  {nats[i]:.2f} nats" for i in order],
                      ["recon.", *TRAVERSAL], folder / "traversal.png")

def read_log(folder):
    """A run's metrics.jsonl → list of dicts; empty when there is none.
    A last line without its end is left out: it is being written, or was cut off."""
    path = Path(folder) / "metrics.jsonl"
    with reading(path, "log of ours", "remove it"):
        lines = path.read_bytes().split(b"\n")[:-1] if path.exists() else []
        rows = [json.loads(line) for line in lines]
        for row in rows:
            step = row["step" if type(row.get("phase")) is str else "update"]
            if not math.isfinite(step + row.get("eval_return", 0)):
                raise ValueError(f"step {step}")
    return rows

def plot(folders, path):
    """Evaluation returns of runs …/<tasks>/<method>/seed<k>: mean and spread over seeds."""
    from matplotlib.figure import Figure  # slow to import
    curves, switches = {}, {}                 # {tasks: {method: [{step: return}]}}, {tasks: step}
    for folder in map(Path, folders):
        rows = read_log(folder)
        curve = {row["step"]: row["eval_return"] for row in rows if "eval_return" in row}
        if curve:
            *_, tasks, method, _ = folder.resolve().parts
            curves.setdefault(tasks, {}).setdefault(method, []).append(curve)
            last = {row["phase"]: row["step"] for row in rows}                # of each phase
            if len(last) > 1:
                switches[tasks] = last["train"]
    if not curves:
        raise UserError("no evaluations to plot; run: python diswm.py finetune --dst walker_walk")
    figure = Figure(figsize=(5.5 * len(curves), 3.8))
    panels = figure.subplots(1, len(curves), squeeze=False)[0]
    for axes, (tasks, methods) in zip(panels, curves.items(), strict=True):
        for method, runs in sorted(methods.items()):
            steps = sorted(set.intersection(*map(set, runs)))
            values = np.array([[run[step] for step in steps] for run in runs])
            mean, spread = values.mean(0), values.std(0)
            line, = axes.plot(steps, mean, marker=".", label=f"{method}, {len(runs)} seed(s)")
            color = line.get_color()
            axes.fill_between(steps, mean - spread, mean + spread, alpha=0.2, color=color)
        if tasks in switches:
            axes.axvline(switches[tasks], color="gray", ls=":", label="the colours change")
        axes.set(title=tasks.replace("-", " → "), xlabel="env steps", ylabel="evaluation return",
                 ylim=(0, None))
        axes.legend()
        axes.grid(alpha=0.3)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100, bbox_inches="tight")
    print(f"wrote {path}")

# === Doctor and bench =============================================================================

def doctor(cfg):
    """Print versions and device; render a frame of each env family in each phase to doctor.png."""
    print(f"python {platform.python_version()}  torch {torch.__version__}  mujoco "
          f"{mujoco.__version__}  gymnasium {gym.__version__}\n{cfg.device}, {cfg.precision}, "
          f"{torch.get_num_threads()} threads, MUJOCO_GL={os.environ['MUJOCO_GL']}")
    pictures = []
    for phase in PHASES:
        with contextlib.closing(config_env(cfg, cfg.dst, phase)) as env:
            pictures.append(env.reset(seed=cfg.seed)[0])
    Path(cfg.runs).mkdir(parents=True, exist_ok=True)
    draw_grid(np.array([pictures]), [cfg.dst], PHASES, Path(cfg.runs) / "doctor.png")

def median_ms(function, repeats=5):
    """Median wall time of a call, after one to warm up."""
    return 1e3 * statistics.median(timeit.repeat(function, number=1, repeat=repeats + 1)[1:])

def parameter_counts(agent):
    """Numbers of parameters by part, and in total."""
    parts = dict(world_model=agent.model, teacher=agent.teacher, actor=agent.behaviour.actor,
                 critic=agent.behaviour.critic, slow_critic=agent.behaviour.slow_critic)
    counts = {name: sum(p.numel() for p in m.parameters()) for name, m in parts.items() if m}
    return counts | dict(total=sum(counts.values()))

def bench(cfg):
    """Count parameters; time an update, a pretraining update, a frame and a decision."""
    device, rng = torch.device(cfg.device), np.random.default_rng(0)
    shape = cfg.batch_size, cfg.batch_length
    teacher = freeze(BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth).to(device)) if cfg.eta else None
    with contextlib.closing(config_env(cfg, cfg.dst, "train")) as env:
        agent = Agent(cfg, env.action_space.shape[0], device, teacher)
        policy, image = agent_policy(agent, explore=True), env.render()
        zeros = np.zeros(agent.action_dim, np.float32)
        times = dict(frame=median_ms(env.render, 50),
                     decision=median_ms(lambda: env.step(policy(image, zeros, None)[0]), 50))
    videos = dict(image=rng.integers(0, 256, (*shape, 64, 64, 3), np.uint8),
                  is_first=np.zeros(shape, bool))
    batch = videos | {key: np.ones(shape, np.float32) for key in ("reward", "discount")}
    batch["action"] = rng.uniform(-1, 1, (*shape, agent.action_dim)).astype(np.float32)
    times["pretrain step"] = median_ms(lambda: VideoTrainer(cfg, None, device).update(videos))
    times["train step"] = median_ms(lambda: agent.update(batch, cfg.eta, 1))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{cfg.dst}, batch {shape[0]} × {shape[1]}, {cfg.device}, {cfg.precision}, "
          f"{torch.get_num_threads()} threads",
          *(f"{name:14}{count:>11,} parameters" for name, count in parameter_counts(agent).items()),
          *(f"{name:14}{value:>11.1f} ms" for name, value in times.items()),
          f"{'peak memory':14}{peak:>11.0f} MiB", sep="\n  ")

# === Command line =================================================================================

COMMANDS = dict(
    collect="learn in the distracting source task; the replay is the video set",
    pretrain="train the β-VAE video predictor (collects videos first if there are none)",
    finetune="distil, adapt and learn behaviour in the target task",
    evaluate="play episodes with a run's policy and with a random one; JSON and mp4",
    traverse="draw latent traversals and open-loop predictions of a run",
    plot="draw learning curves of runs",
    doctor="check rendering and versions",
    bench="time the steps, count the parameters")

class Parser(argparse.ArgumentParser):
    """argparse whose errors are one line; that of an unknown flag lists what exists."""

    def error(self, message):
        flags = " ".join(a.option_strings[0] for a in self._actions[1:] if a.option_strings)
        hint = f"there are: {flags}" if "unrecognized" in message else f"see: {self.prog} --help"
        self.exit(2, " ".join(f"error: {message}; {hint}".split()) + "\n")

def add_config_flags(parser):
    """A flag for every field of Config; only those given end up in the namespace."""
    for field in dataclasses.fields(Config):
        meta, kind = field.metadata, type(field.default)
        choices = METHODS if field.name == "method" else meta["choices"]
        options = dict(action=argparse.BooleanOptionalAction) if kind is bool else dict(
            choices=choices, type=kind, metavar=None if choices else kind.__name__.upper())
        parser.add_argument("--" + field.name.strip("_").replace("_", "-"), dest=field.name,
                            default=argparse.SUPPRESS, **options,
                            help=f"{meta['help']}; paper preset: {field.default or 'none'}")

def parse_args(argv):
    """The command line → (args, Config): a preset, then the method's values, then flags given."""
    parser = Parser(prog="diswm.py", description="Disentangled World Models.", allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, help in COMMANDS.items():
        sub = commands.add_parser(name, help=help, description=help, allow_abbrev=False)
        sub.add_argument("--preset", choices=PRESETS, help="default: paper on CUDA, else small")
        sub.add_argument("--fresh", action="store_true", help="start over instead of resuming")
        if name in ("evaluate", "traverse"):
            sub.add_argument("--run", required=True, help="folder of a run: runs/…/seed0")
        if name == "plot":
            sub.add_argument("run", nargs="*", help="folders of runs; default: all finetune runs")
            sub.add_argument("--out", help="PNG to write; default: curves.png in --runs")
        add_config_flags(sub)
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        commands.choices[args.command].error(f"unrecognized arguments: {' '.join(unknown)}")
    given = {key: value for key, value in vars(args).items() if key in Config.__dataclass_fields__}
    preset = args.preset or ("paper" if torch.cuda.is_available() else "small")
    try:
        cfg = replace(PRESETS[preset], **METHODS[given.get("method", "diswm")] | given)
    except ValueError as error:
        commands.choices[args.command].error(str(error))
    if not args.preset and args.command in ("collect", "pretrain", "finetune"):
        print(f"preset {preset}; --preset chooses another: {', '.join(PRESETS)}")
    for task in {cfg.src, cfg.dst} - set(TASKS):
        make_env(task)                                                        # lists what exists
    return args, cfg

def prepare_machine(cfg):
    """Decide what is "auto", and set torch up. Returns the Config with the decisions."""
    gpu = torch.cuda.is_available()
    device = cfg.device if cfg.device != "auto" else "cuda" if gpu else "cpu"
    if device == "cuda" and not gpu:
        raise UserError("there is no CUDA device; use --device cpu")
    cpuinfo = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    native = device == "cuda" or "avx512_bf16" in cpuinfo or "amx_bf16" in cpuinfo
    precision = cfg.precision if cfg.precision != "auto" else "bf16" if native else "fp32"
    torch.set_num_threads(cfg.threads or os.cpu_count())
    if platform.libc_ver()[0] == "glibc":
        # Large buffers go back to the kernel each step otherwise: 1.9× of a step at 50 × 50.
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(-3, 1 << 30)                                             # mmap threshold
        libc.mallopt(-1, (1 << 31) - 1)                                       # trim threshold
    return replace(cfg, device=device, precision=precision)

def run_command(argv):
    args, cfg = parse_args(argv)
    cfg, command = prepare_machine(cfg), globals()[args.command]
    if command in (collect, pretrain, finetune):
        command(cfg, args.fresh)
    elif command is evaluate:
        evaluate(args.run, torch.device(cfg.device))
    elif command is traverse:
        traverse(args.run, torch.device(cfg.device), cfg.videos)
    elif command is plot:
        runs = Path(cfg.runs)
        plot(args.run or sorted(runs.glob("finetune/*/*/seed*")), args.out or runs / "curves.png")
    else:
        command(cfg)

def main(argv=None):
    """Run a command. A user's mistake is one line and exit code 1 or 2. Returns the exit code."""
    try:
        run_command(argv)
        return 0
    except UserError as error:
        message, code = str(error), error.code
    except OSError as error:
        message, code = (f"{error.filename or 'output'}: {error.strerror or error}; mend that and "
                         "run the same command again, the last checkpoint is whole"), 1
    except (MemoryError, RuntimeError) as error:
        if not re.search("(?i)alloc|memory|overflow", repr(error)):
            raise
        message, code = f"too large for the memory: {error}"[:200], 1
    except KeyboardInterrupt:
        message, code = "interrupted; the same command goes on from the last checkpoint", 130
    print("error:", " ".join(message.split()), file=sys.stderr)
    return code

if __name__ == "__main__":
    sys.stdout.reconfigure(errors="backslashreplace")  # a Latin-1 terminal has no β
    sys.exit(main())
