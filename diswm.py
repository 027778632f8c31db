"""DisWM, the whole paper in one file: Wang et al., "Disentangled World Models: Learning to Transfer
Semantic Knowledge from Distracting Videos for Reinforcement Learning", ICCV 2025; its "Eq. (n)".

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
import bisect
import contextlib
import ctypes
import dataclasses
import difflib
import fcntl
import functools
import io
import json
import math
import multiprocessing
import os
import pickle
import platform
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
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

GL_HINT = ("run: apt-get install libegl1 libgl1 libgl1-mesa-dri, or libosmesa6 and export "
           "MUJOCO_GL=osmesa")
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

def flag(default, help, choices=None, *, low=0, high=10**12, free=False):
    """A Config field and its flag. low, high: of numbers; free: may change on resuming."""
    return dataclasses.field(default=default, metadata=locals())

@dataclass(frozen=True)
class Config:
    """All that can be set; the defaults are the paper's (`--preset paper`). Sources: "table" is its
    table of hyperparameters, "published" the authors' configuration, "ours" our choice. An *env
    step* is one of the simulator; a *decision* is an action held for `action_repeat` env steps."""
    # What is run, and where it is kept.
    src: str = flag("cheetah_run", "task of the distracting videos (paper, Fig. 4a)")
    dst: str = flag("walker_walk", "target task (paper, Fig. 4a)")
    method: str = flag("diswm", "the paper's method, a baseline or an ablation (paper)")
    seed: int = flag(0, "seed of everything random (ours)")
    runs: str = flag("runs", "folder of all runs (ours)", free=True)
    teacher: str = flag("", "teacher's checkpoint.pt; empty: the one for --src (ours)", free=True)
    videos: str = flag("", "folder of .npy, .npz videos; empty: collect's (ours)", free=True)
    # Environment (section 4).
    action_repeat: int = flag(2, "env steps per decision (published)", low=1)
    time_limit: int = flag(0, "env steps per episode; 0: the task's own (ours)")
    colors: str = flag("published", "boxes around fixed centres (published) or original colours "
                       "(paper)", ("published", "original"))
    color_range: float = flag(0.2, "half width of a colour box, RGB in 0..1 (published)", high=1)
    color_step_std: float = flag(0.0, "std of the colours' random walk per decision (ours)")
    fast_render: bool = flag(False, "no anti-aliasing, about twice as fast (ours)")
    envs: int = flag(1, "environments side by side, beyond one a process each (ours)", low=1)
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
                        ("beta_vae", "conv"))
    carry_over: str = flag("none", "where a video predictor's weights go: nowhere, into an agent's "
                           "model, below its RSSM (paper)", ("none", "weights", "stack"))
    bonus: float = flag(0.0, "weight of the intrinsic bonus in the reward's target (APV: 0.1)")
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
                        ("softmax", "gaussian"))
    eta: float = flag(0.1, "η at the start (table)")
    eta_end: float = flag(0.01, "η at the end (paper, section 3.4)")
    eta_decay: int = flag(50_000, "decisions in which η would fall to 0 (published)", low=1)
    eta_delay: int = flag(-1, "decisions before it; -1: eta_decay across domains, else 0 "
                          "(published)", low=-1)
    # Behaviour, appendix B.
    horizon: int = flag(15, "imagined transitions, H (table)", low=1, high=1_000)
    imagine_starts: int = flag(0, "states of a batch to imagine from; 0: all (ours)")
    gamma: float = flag(0.99, "discount γ (table)", high=1)
    lambda_: float = flag(0.95, "λ of the λ-return (table)", high=1)
    rho: float = flag(1.0, "ρ: 1 dynamics backprop, 0 REINFORCE (published)", high=1)
    entropy_scale: float = flag(1e-4, "weight of the actor's entropy (published)")
    tanh_scale: float = flag(0.0, "weight of m², tanh(m) being the actor's mean (ours, after HER)")
    actor_lr: float = flag(8e-5, "learning rate of the actor (table)", high=1)
    critic_lr: float = flag(8e-5, "learning rate of the critic (table)", high=1)
    slow_every: int = flag(100, "updates between copies to the slow critic (published)", low=1)
    grad_clip: float = flag(100.0, "largest gradient norm of each optimiser (published)")
    # Machine.
    device: str = flag("auto", "where it runs (ours)", ("auto", "cpu", "cuda"), free=True)
    precision: str = flag("auto", "of convolutions and MLPs; auto: bf16 where native (ours)",
                          ("auto", "fp32", "bf16"), free=True)
    threads: int = flag(0, "CPU threads; 0: one per core (ours)", high=1024, free=True)
    compile: bool = flag(False, "torch.compile model and imagination, for GPUs (ours)", free=True)

    def __post_init__(self):
        """Raises ValueError at wrong types and values out of range, also those of a checkpoint."""
        for field in dataclasses.fields(self):
            value, meta, kind = getattr(self, field.name), field.metadata, type(field.default)
            good = type(value) is kind or (kind is float and type(value) is int)
            good = good and (kind in (str, bool) or meta["low"] <= value <= meta["high"])  # not NaN
            if not good or value not in (meta["choices"] or [value]):
                want = meta["choices"] or f"{kind.__name__} from {meta['low']} to {meta['high']:,}"
                raise ValueError(f"--{field.name.replace('_', '-').strip('-')} {value}: not {want}")

PRESETS = {
    "paper": Config(),
    # The same algorithm for two CPU cores. A batch five times smaller wants a larger model_lr. η's
    # clock shrinks with the run (to a tenth), and η grows by 50 / 32 as Eq. (3) sums over time.
    "small": Config(steps=100_000, collect_steps=20_000, pretrain_updates=1_000, prefill=1_000,
                    fast_render=True, batch_size=16, batch_length=32, imagine_starts=256, units=200,
                    cnn_depth=16, model_lr=1e-3, eta=0.156, eta_end=0.0156, eta_decay=5_000),
    "debug": Config(  # seconds, for tests: everything happens, nothing is learnt
        steps=300, collect_steps=200, pretrain_updates=20, prefill=50, first_updates=2, threads=1,
        train_every=10, eval_every=100, eval_episodes=2, time_limit=50, batch_size=3, horizon=3,
        batch_length=8, cnn_depth=4, stoch=6, deter=12, hidden=10, units=10, eta=0.6, eta_end=0.06,
        eta_decay=60, slow_every=5),
}

DV2 = dict(encoder="conv", beta=0.0, beta2=0.0, eta=0.0, eta_end=0.0, carry_over="none", bonus=0.0)
METHODS = {  # sets of Config values and nothing else: all of them run through the same code
    "diswm": {},
    "no_distill": dict(eta=0.0, eta_end=0.0),        # ablation: no latent distillation
    "no_disentangle": dict(beta=0.0, beta2=0.0),     # ablation: no β in either stage
    "dreamerv2": DV2,  # DEVIATION: with Gaussian latents, also the next two (APV's are discrete)
    "dv2_finetune": DV2 | dict(carry_over="weights"),
    "apv": DV2 | dict(carry_over="stack", bonus=0.1),
}

# === Maths: pure functions of tensors =============================================================

def gaussian_kl(mean_p, std_p, mean_q, std_q):
    """KL[N(mean_p, std_p²) || N(mean_q, std_q²)] of each dimension, nats: (..., S) → (..., S)."""
    # ln(σ_q / σ_p) + (σ_p² + (μ_p − μ_q)²) / (2 σ_q²) − ½
    return (std_q / std_p).log() + (std_p**2 + (mean_p - mean_q)**2) / (2 * std_q**2) - 0.5

def beta_vae_kl(mean, logvar):
    """Disentanglement loss of Eqs. (2), (5): KL[N(mean, exp(logvar)) || N(0, I)].
    mean, logvar: (..., Z). Returns (...,), nats summed over the latent dimensions."""
    # DEVIATION: the published one adds 1e-6; this is exactly 0 at N(0, I).
    return 0.5 * (mean**2 + logvar.exp() - 1 - logvar).sum(-1)  # ½ Σ (μ² + σ² − 1 − ln σ²)

def rssm_kl_loss(post, prior, balance=0.8, free_nats=1.0):
    """KL of posterior and prior in Eqs. (2), (5), with DreamerV2's balancing and free nats.
        balance · max(mean KL[sg(q) || p], free) + (1 − balance) · max(mean KL[q || sg(p)], free)
    post, prior: dicts of `mean` and `std`, (B, T, S). Returns (loss, value): a scalar and the plain
    KL (B, T), nats. Free nats act on the batch mean, as published: below them it is constant."""
    q, p = ((dist["mean"], dist["std"]) for dist in (post, prior))
    sg_q, sg_p = ([x.detach() for x in side] for side in (q, p))              # the other's target
    value = gaussian_kl(*q, *sg_p).sum(-1)                                    # (B, T), trains q
    prior_side = gaussian_kl(*sg_q, *p).sum(-1).mean().clamp(min=free_nats)   # trains p
    return balance * prior_side + (1 - balance) * value.mean().clamp(min=free_nats), value

def distillation_loss(z_disen, z_task):
    """Latent distillation, Eq. (3): KL(z_disen || z_task) = Σ z_disen · ln(z_disen / z_task).
    Softmax over the latent dimensions makes probability vectors of both, so a constant added to all
    dimensions changes nothing. z_disen (the teacher's), z_task: samples, (B, T, Z). Returns a
    scalar, nats: summed over time, mean over the batch, the scale at which the paper tuned η."""
    log_disen, log_task = z_disen.detach().log_softmax(-1), z_task.log_softmax(-1)  # sg: a teacher
    return (log_disen.exp() * (log_disen - log_task)).sum((-2, -1)).mean()

def gaussian_distillation_loss(teacher, task):
    """Eq. (3) between the two Gaussian posteriors instead (ours), reduced like it.
    teacher, task: dicts of `mean` and `logvar`, (B, T, Z)."""
    (mean, std), student = ((code["mean"], (code["logvar"] / 2).exp()) for code in (teacher, task))
    return gaussian_kl(mean.detach(), std.detach(), *student).sum((-2, -1)).mean()

def eta_schedule(step, start=0.1, end=0.01, decay_steps=50_000, delay=0):
    """η after `step` decisions (section 3.4): 0 before `delay`, then linearly from start to end.
    The line would reach 0 at delay + decay_steps; η rests at `end` where it meets it."""
    return 0.0 if step < delay else max(start * (1 - (step - delay) / decay_steps), min(start, end))

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

def squared_error(target, prediction, dims=0):
    """−ln N(target; prediction, 1), summed over the last `dims` dimensions."""
    # DEVIATION: without the constant ½ ln 2π of each, which would hide the rest of a loss.
    error = F.mse_loss(prediction, target, reduction="none")
    return 0.5 * (error.flatten(-dims).sum(-1) if dims else error)

def gaussian_sample(mean, std):
    """A reparameterised draw: the gradient reaches mean and std."""
    return mean + std * torch.randn_like(std)

def clip_action(action, limit=1 - 1e-6):
    """Clip strictly into (−1, 1), gradient straight through: a saturated action can come back."""
    return action + (action.clamp(-limit, limit) - action).detach()

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
            for part in (layer(n, m, *shape), nn.ELU(inplace=True))]  # 19 % less memory at 50 × 50

def kaiming(module):
    """Kaiming-normal weights and zero biases, for the β-VAE only (published)."""
    if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
        nn.init.kaiming_normal_(module.weight)
        nn.init.zeros_(module.bias)

def preprocess(image):
    """uint8 (..., 64, 64, 3) → float (..., 3, 64, 64) in [−0.5, 0.5]"""
    return image.movedim(-1, -3).float().div_(255).sub_(0.5)

def latent_code(mean, logvar):
    """A draw of 𝐳 with its posterior: dict of `embed`, `mean`, `logvar`, (..., Z) each."""
    return dict(embed=gaussian_sample(mean, (logvar / 2).exp()), mean=mean, logvar=logvar)

class PerFrame(nn.Module):
    """Layers for the last `dims` dimensions; all before them are one batch. fp32 out.
    In the encoders and decoders, d is the number of channels of the image's convolution."""
    def __init__(self, dims, *layers):
        super().__init__()
        self.dims, self.net = dims, nn.Sequential(*layers)

    def forward(self, x):
        return self.net(x.flatten(0, -1 - self.dims)).float().unflatten(0, x.shape[:-self.dims])

    def encode(self, image):
        """→ dict of `embed`; a β-VAE's is a latent_code"""
        return dict(embed=self(image))

class MLP(PerFrame):
    """`layers` hidden layers with ELU, then a linear one, to a number (...,) or, given `outputs`,
    to a normal's mean and standard deviation in (0.1, 2.1), (..., outputs) each. fp32 out."""
    def __init__(self, inputs, units, layers, outputs=None):
        hidden = stack(nn.Linear, [inputs] + [units] * layers, [()] * layers)
        super().__init__(1, *hidden, nn.Linear(units, 2 * outputs if outputs else 1))
        self.outputs = outputs

    def forward(self, x):
        x = super().forward(x)
        if not self.outputs:
            return x.squeeze(-1)
        mean, std = x.chunk(2, -1)
        return mean, 2 * torch.sigmoid(std / 2) + 0.1

class BiasGradient(torch.autograd.Function):
    """The identity on a layer's output (N, C, H, W), bias included; gives the bias its gradient."""
    @staticmethod
    def forward(ctx, output, bias):
        ctx.mark_dirty(output)                                                # it is no copy
        return output

    @staticmethod
    def backward(ctx, gradient):
        return gradient, gradient.sum((0, 2, 3))

class Deconvolution(nn.ConvTranspose2d):
    """Its parent, but for who sums up the bias' gradient: oneDNN is slow at it, 3 % of a step, and
    slowest channels last. Kernel size, stride and padding are all that it takes."""
    def forward(self, x):
        bias = self.bias.detach()
        x = F.conv_transpose2d(x, self.weight, bias, self.stride, self.padding)
        return BiasGradient.apply(x, self.bias)

class BetaVAEEncoder(PerFrame):
    """β-VAE encoder of Eqs. (1), (4): image (..., 3, 64, 64) → mean, logvar of 𝐳, (..., Z)."""
    def __init__(self, z_dim=20, depth=32):
        d, shapes = depth, [(4, 2, 1)] * 4 + [(4,)]                           # 32, 16, 8, 4, 1
        super().__init__(3, *stack(nn.Conv2d, [3, d, d, 2 * d, 2 * d, 8 * d], shapes),
                         nn.Flatten(), nn.Linear(8 * d, 2 * z_dim))
        self.apply(kaiming)

    def forward(self, image):
        return super().forward(image).chunk(2, -1)

    def encode(self, image):
        return latent_code(*self(image))

class BetaVAEDecoder(PerFrame):
    """Decoder of Eqs. (1), (4): feat (..., S + D), a neck as narrow as 𝐳 → (..., 3, 64, 64)."""
    def __init__(self, feat_dim, z_dim=20, depth=32):
        d, shapes = depth, [(4,)] + [(4, 2, 1)] * 3                           # 4, 8, 16, 32, 64
        super().__init__(1, nn.Linear(feat_dim, z_dim), nn.ELU(), nn.Linear(z_dim, 8 * d), nn.ELU(),
                         nn.Unflatten(-1, (8 * d, 1, 1)),
                         *stack(Deconvolution, [8 * d, 2 * d, 2 * d, d, d], shapes),
                         Deconvolution(d, 3, 4, 2, 1))
        self.apply(kaiming)

def conv_encoder(d):
    """DreamerV2's encoder, for the baselines: image (..., 3, 64, 64) → embed (..., 32 d)."""
    convolutions = stack(nn.Conv2d, [3, d, 2 * d, 4 * d, 8 * d], [(4, 2)] * 4)
    return PerFrame(3, *convolutions, nn.Flatten())                           # 8 d of 2 × 2

def conv_decoder(feat_dim, d):
    """DreamerV2's decoder, for the baselines: feat (..., S + D) → (..., 3, 64, 64)."""
    shapes = [(5, 2), (5, 2), (6, 2)]                                         # 5, 13, 30, 64
    return PerFrame(1, nn.Linear(feat_dim, 32 * d), nn.Unflatten(-1, (32 * d, 1, 1)),
                    *stack(Deconvolution, [32 * d, 4 * d, 2 * d, d], shapes),
                    Deconvolution(d, 3, 6, 2))

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
          post       s_0    s_1"""
    def __init__(self, action_dim, embed_dim, stoch=50, deter=200, hidden=200):
        super().__init__()
        self.action_dim = action_dim
        self.sizes = dict(deter=deter, stoch=stoch, mean=stoch, std=stoch)
        self.inputs = nn.Sequential(nn.Linear(stoch + action_dim, hidden), nn.ELU())
        self.gru = nn.Linear(hidden + deter, 3 * deter)
        self.norm = nn.LayerNorm(3 * deter)
        self.prior_net = MLP(deter, hidden, 1, stoch)
        self.post_net = MLP(deter + embed_dim, hidden, 1, stoch)

    @staticmethod
    def feat(state):
        """What decoder, heads, actor and critic see: [z_t, h_t], (..., S + D)"""
        return torch.cat([state["stoch"], state["deter"]], -1)

    def initial(self, batch):
        """The zero state for a batch."""
        return {key: self.norm.weight.new_zeros(batch, size) for key, size in self.sizes.items()}

    def recur(self, state, action):
        """h_t = f(h_{t−1}, z_{t−1}, a_{t−1}): GRU, layer norm. Zeros pad an action too short."""
        x = torch.cat([state["stoch"], action], -1) if self.action_dim else state["stoch"]
        x = F.pad(x, (0, self.inputs[0].in_features - x.shape[-1]))
        gates = self.norm(self.gru(torch.cat([self.inputs(x), state["deter"]], -1)).float())
        reset, candidate, update = gates.chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        return torch.lerp(state["deter"], candidate, torch.sigmoid(update - 1))         # (B, D)

    def draw(self, net, inputs, deter):
        """A state around h_t: `net`'s distribution, a sample."""
        mean, std = net(inputs)
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

class StackedRSSM(RSSM):
    """APV's: it sees [embed_t, s_t of the action-free RSSM `below`], whose KL has weight 0 (APV).
    That s_t is part of a state too, as `below` (..., S + D); imagination goes on without it."""
    def __init__(self, action_dim, embed_dim, stoch=50, deter=200, hidden=200):
        super().__init__(action_dim, embed_dim + stoch + deter, stoch, deter, hidden)
        self.below = RSSM(0, embed_dim, stoch, deter, hidden)
        self.sizes["below"] = stoch + deter

    def step(self, state, action, embed, is_first):
        stoch, deter = state["below"].split([self.sizes["stoch"], self.sizes["deter"]], -1)
        below = self.feat(self.below.step(dict(stoch=stoch, deter=deter), None, embed, is_first))
        inputs = torch.cat([embed, below], -1)
        return super().step(state, action, inputs, is_first) | dict(below=below)

class IntrinsicBonus(nn.Module):
    """APV's reward for the unusual: mean distance to the k nearest among the latest states."""
    def __init__(self, feat_dim, k=16, window=5, size=4096, dims=128, momentum=0.99):
        super().__init__()
        self.k, self.window, self.momentum = k, window, momentum
        self.register_buffer("projection", torch.randn(feat_dim, dims) / dims)
        self.register_buffer("queue", torch.zeros(size, dims))                # newest first
        self.register_buffer("filled", torch.tensor(0))
        self.register_buffer("scale", torch.ones(()))                         # running mean of |x|

    @torch.no_grad()
    def forward(self, feat):
        """feat (B, T, S + D) → (B, T − window + 1): row t is of rows t … t + window − 1."""
        means = feat.unfold(1, min(self.window, feat.shape[1]), 1).mean(-1)
        x = (means @ self.projection).flatten(0, 1)
        self.queue = torch.cat([x, self.queue])[:len(self.queue)]             # x counts as seen
        self.filled += len(x)
        # By a matrix product, ten times faster; in fp32 its rounding would drown small distances.
        distance = torch.cdist(x.double(), self.queue[:self.filled].double()).float()
        nearest = distance.topk(min(self.k, distance.shape[1]), largest=False).values.mean(-1)
        self.scale.lerp_(nearest.mean(), 1 - self.momentum)
        return (nearest / (self.scale + 1e-8)).unflatten(0, means.shape[:2])

# === Video predictor and world model ==============================================================

class VideoPredictor(nn.Module):
    """The action-free video prediction model of Eq. (1), trained by Eq. (2)."""
    def __init__(self, cfg, action_dim=0):
        super().__init__()
        self.cfg, vae = cfg, cfg.encoder == "beta_vae"
        feat, d = cfg.stoch + cfg.deter, cfg.cnn_depth
        self.encoder = BetaVAEEncoder(cfg.z_dim, d) if vae else conv_encoder(d)
        self.decoder = BetaVAEDecoder(feat, cfg.z_dim, d) if vae else conv_decoder(feat, d)
        self.decoder.to(memory_format=torch.channels_last)                    # 5 % of a step
        rssm = StackedRSSM if action_dim and cfg.carry_over == "stack" else RSSM
        self.rssm = rssm(action_dim, cfg.z_dim if vae else 32 * d, cfg.stoch, cfg.deter, cfg.hidden)
        self.scales = dict(image=1.0, kl=cfg.beta1, disentangle=cfg.beta2)
        if cfg.compile:
            self.compile()

    def forward(self, batch):
        """Filter → dict of code (of encode), post, prior, feat."""
        # DEVIATION: published, a video predictor sees means of latents and actions that are zero.
        code = self.encoder.encode(batch["image"])
        post, prior = self.rssm.observe(code["embed"], batch.get("action"), batch["is_first"])
        return dict(code=code, post=post, prior=prior, feat=self.rssm.feat(post))

    def terms(self, out, batch):
        """Loss terms of each step, (B, T), nats, but for the KL."""
        # −ln p(o_t | z_t), summed over pixels. The target stays fp32: bf16 would shift the loss.
        image, code = squared_error(batch["image"], self.decoder(out["feat"]), 3), out["code"]
        vae = dict(disentangle=beta_vae_kl(code["mean"], code["logvar"])) if "mean" in code else {}
        return dict(image=image) | vae

    def loss(self, out, batch, teacher=None, eta=0.0):
        """Eq. (2), or (5) for a WorldModel, for the output of forward. Returns (loss, metrics).
        teacher: latent_code of the same images from the frozen teacher, or None."""
        cfg, code, terms = self.cfg, out["code"], self.terms(out, batch)
        loss, kl = rssm_kl_loss(out["post"], out["prior"], cfg.kl_balance, cfg.free_nats)
        metrics = dict(kl_loss=loss, kl=kl.mean(), eta=loss.new_full((), eta),
                       post_entropy=normal_entropy(out["post"]["std"]).mean(),
                       prior_entropy=normal_entropy(out["prior"]["std"]).mean())
        loss = self.scales["kl"] * loss
        for name, term in terms.items():
            metrics[name] = term.mean()
            loss = loss + self.scales[name] * metrics[name]
        if teacher is not None:
            distill = (gaussian_distillation_loss(teacher, code) if cfg.distill == "gaussian"
                       else distillation_loss(teacher["embed"], code["embed"]))
            loss, metrics["distill"] = loss + eta * distill, distill
        return loss, metrics

class WorldModel(VideoPredictor):
    """The world model of Eq. (4): Eq. (1) with actions, a reward and a discount head; Eq. (5)."""
    def __init__(self, cfg, action_dim):
        super().__init__(cfg, action_dim)
        self.scales = dict(image=1.0, kl=cfg.alpha, disentangle=cfg.beta, reward=cfg.reward_scale,
                           discount=cfg.discount_scale)
        self.reward = MLP(cfg.stoch + cfg.deter, cfg.units, 2)        # r̂, mean of a unit Gaussian
        self.discount = MLP(cfg.stoch + cfg.deter, cfg.units, 3)                  # the logit of γ̂
        self.bonus = IntrinsicBonus(cfg.stoch + cfg.deter) if cfg.bonus else None

    @torch.no_grad()
    def carry_over(self, video):
        """Take over a VideoPredictor's encoder, decoder and RSSM (in a stack, as the one below)."""
        # DEVIATION: it saw no actions. Zeros are as good, and train no input weights: these stay.
        own = nn.ModuleList([self.encoder, self.decoder, getattr(self.rssm, "below", self.rssm)])
        for weight, value in zip(own.parameters(), video.parameters(), strict=True):
            weight[..., :value.shape[-1]] = value

    def terms(self, out, batch):
        """Those of Eq. (2), the reward's and the discount's, (B, T) each."""
        feat = out["feat"][:, :batch["reward"].shape[1]]  # the last rows have no intrinsic bonus
        reward = squared_error(batch["reward"], self.reward(feat))
        # DEVIATION: the discount head of Eq. (4) is trained; the published code switches it off.
        logit, target = self.discount(out["feat"]), self.cfg.gamma * batch["discount"]
        discount = F.binary_cross_entropy_with_logits(logit, target, reduction="none")
        return super().terms(out, batch) | dict(reward=reward, discount=discount)

# === Actor-critic: behaviour learning in imagination, appendix B ==================================

class ActorCritic(nn.Module):
    """Actor π(a | s), critic v(s), and a slow copy of the critic that gives the targets."""
    def __init__(self, cfg, action_dim):
        super().__init__()
        self.cfg, feat_dim = cfg, cfg.stoch + cfg.deter
        self.actor = MLP(feat_dim, cfg.units, 4, action_dim)
        self.critic = MLP(feat_dim, cfg.units, 3)
        self.slow_critic = MLP(feat_dim, cfg.units, 3).requires_grad_(False)      # only copied
        self.copy_critic()

    def copy_critic(self):
        """Slow critic ← critic."""
        self.slow_critic.load_state_dict(self.critic.state_dict())

    def policy(self, feat):
        """→ mean in (−1, 1) and std of the normal of actions, and m = artanh(mean), (..., A)"""
        m, std = self.actor(feat)
        return torch.tanh(m), std, m

    def imagine(self, model, start):
        """Follow the policy through the world model's prior, H transitions from N states.
              t        0     1    …   H−1      H
            feat      s_0   s_1      s_{H−1}  s_H     s_0 a posterior, the others imagined
          action      a_0   a_1      a_{H−1}          a_t is taken in s_t and leads to s_{t+1}
          reward      r_0   r_1      r_{H−1}          r̂(s_t)
        discount      γ_0   γ_1      γ_{H−1}          γ̂(s_t)

        Returns feats s_0 … s_{H−1} (H, N, S + D), s_H (N, S + D), and, (H, N) each, log_probs,
        entropies and m², summed over A."""
        state, feats, log_probs, entropies, squares = start, [model.rssm.feat(start)], [], [], []
        for _ in range(self.cfg.horizon):
            # The policy takes its state as given; its gradient comes from where the action leads.
            mean, std, m = self.policy(feats[-1].detach())
            raw = gaussian_sample(mean, std)
            log_probs.append(normal_log_prob(raw.detach(), mean, std))        # REINFORCE: a is data
            entropies.append(normal_entropy(std))
            squares.append(m.square().sum(-1))
            # DEVIATION: the published "truncated" normal is not; here actions are clipped.
            state = model.rssm.prior(model.rssm.recur(state, clip_action(raw)))
            feats.append(model.rssm.feat(state))
        last = feats.pop()
        return torch.stack(feats), last, *map(torch.stack, (log_probs, entropies, squares))

    def losses(self, model, start, start_discount):
        """start: dict of (N, ·) detached states; start_discount (N,): their true γ_0.
        Returns (actor_loss, critic_loss, metrics). The actor's graph runs through the world model,
        which is *not* trained here: take gradients for the actor's own parameters only."""
        cfg = self.cfg
        feats, last, log_prob, entropy, square = self.imagine(model, start)
        reward = model.reward(feats)                                          # (H, N)
        discount = torch.sigmoid(model.discount(feats))
        discount = torch.cat([start_discount[None], discount[1:]])            # γ_0 is known
        slow, bootstrap = self.slow_critic(feats), self.slow_critic(last)
        # DEVIATION: the published λ-return comes out reversed in time.
        target = lambda_return(reward, slow, discount, bootstrap, cfg.lambda_)
        # w_t = Π_{i<t} γ_i: how likely the episode still runs. A weight, nothing to optimise.
        weight = torch.cat([torch.ones_like(discount[:1]), discount[:-1]]).cumprod(0).detach()
        value = self.critic(feats.detach())                                   # the model is fixed
        critic_loss = (weight * squared_error(target.detach(), value)).mean()  # sg(V_t)
        advantage = (target - value).detach()                                 # sg(V_t − v(s_t))
        # ρ V_t + (1 − ρ) ln π(a_t | s_t) sg(V_t − v(s_t)) + scale · H[a_t | s_t] − scale · m²
        # m² (ours, off by default) keeps the tanh from saturating, where it learns nothing.
        objective = (cfg.rho * target + (1 - cfg.rho) * log_prob * advantage
                     + cfg.entropy_scale * entropy - cfg.tanh_scale * square)
        actor_loss = -(weight * objective).mean()
        return actor_loss, critic_loss, dict(
            actor=actor_loss, critic=critic_loss, actor_entropy=entropy.mean(),
            actor_tanh=square.mean(), value=value.mean(), imagined_reward=reward.mean(),
            imagined_return=target.mean())

def freeze(encoder):
    """A teacher: evaluation mode, no gradient, in no optimiser."""
    # DEVIATION: the published code switches the teacher's gradients back on and trains it along.
    return encoder.eval().requires_grad_(False)

def autocast(cfg):  # 1.7× of a whole step at 50 × 50 on a CPU with native bf16
    """bf16 around convolutions and MLPs; statistics, GRU state, targets and losses are fp32."""
    return torch.autocast(cfg.device, torch.bfloat16, enabled=cfg.precision == "bf16")

def to_device(batch, device):
    """Numpy arrays → tensors on the device, images preprocessed. A GPU copies pinned memory."""
    batch = {key: torch.from_numpy(value) for key, value in batch.items()}
    if device.type == "cuda":
        batch = {key: value.pin_memory() for key, value in batch.items()}
    batch = {key: value.to(device, non_blocking=True) for key, value in batch.items()}
    return batch | {"image": preprocess(batch["image"])}

@functools.cache
def map_apart(size):
    """glibc: buffers from `size` bytes on get pages of their own, given back when they are freed.
    All large ones until the first update is over: small things that it makes to last would lie
    between them and keep them apart for good (2.8 GiB for 2.1 at 50 × 50). From then on none, as
    giving pages back and getting them anew each step is 1.9× of a step at 50 × 50."""
    if platform.libc_ver()[0] == "glibc":
        for option, value in ((-3, size), (-1, (1 << 31) - 1)):               # mmap's, trim's
            ctypes.CDLL("libc.so.6").mallopt(option, value)

def check_finite(metrics):
    """An update's metrics as floats: here, once an update, one waits for a GPU.
    Raises FloatingPointError, with the names of the first that are not finite, unless all are."""
    values = torch.stack([value.float() for value in metrics.values()]).tolist()
    metrics = dict(zip(metrics, values, strict=True))
    bad = [name for name, value in metrics.items() if not math.isfinite(value)]
    if bad:
        raise FloatingPointError(f"non-finite {', '.join(bad[:3])}")
    return metrics

class Saved:
    """What a checkpoint holds of an object: `parts`, which do so themselves, and `counters`."""
    def state_dict(self):
        parts = {name: getattr(self, name).state_dict() for name in self.parts}
        return parts | {name: getattr(self, name) for name in self.counters}

    def load_state_dict(self, state):
        for name in self.parts:
            getattr(self, name).load_state_dict(state[name])
        for name in self.counters:
            value, kind = state[name], type(getattr(self, name))
            # a count seeds numpy, which takes no negative, and TensorBoard's steps have 64 bits
            if type(value) is not kind or (kind is int and not 0 <= value < 2**62):
                raise TypeError(f"{name} is {value}")
            setattr(self, name, value)

class Adam(Saved):
    """The optimiser of a module's parameters (Kingma & Ba 2015), ε as published. Written out, as
    torch.optim's first step imports torch's compiler: 69 MiB, and 0.9 s."""
    parts, counters = ("mean", "square"), ("count",)

    def __init__(self, module, lr):
        self.lr, self.weights, self.count = lr, [*module.parameters()], 0
        def zeros():
            return nn.ParameterList(map(torch.zeros_like, self.weights)).requires_grad_(False)
        self.mean, self.square = zeros(), zeros()

    @torch.no_grad()
    def minimize(self, loss, clip, beta1=0.9, beta2=0.999, eps=1e-5):
        """A step down the gradient of loss by these parameters alone, whatever else it reaches: a
        gradient of a norm above `clip` is scaled down to it. Returns its norm before."""
        gradients = torch.autograd.grad(loss, self.weights, materialize_grads=True)
        norm = nn.utils.get_total_norm(gradients)
        scale = (clip / (norm + 1e-6)).clamp(max=1)
        self.count += 1
        correction1, correction2 = (1 - beta**self.count for beta in (beta1, beta2))
        for weight, gradient, mean, square in zip(
                self.weights, gradients, self.mean, self.square, strict=True):
            g = gradient * scale  # not in place: autograd may give one tensor to two weights
            mean.lerp_(g, 1 - beta1)                                          # E[g], from 0 on
            square.mul_(beta2).addcmul_(g, g, value=1 - beta2)                # E[g²], likewise
            std = (square.sqrt() / math.sqrt(correction2)).add_(eps)
            weight.addcdiv_(mean, std, value=-self.lr / correction1)
        return norm

class Agent(Saved):
    """World model, actor-critic, frozen teacher and optimisers: what an online run trains."""
    parts = ("model", "behaviour", "model_adam", "actor_adam", "critic_adam")
    counters = ("action_dim",)

    def __init__(self, cfg, action_dim, device, teacher=None):
        self.cfg, self.action_dim, self.device, self.teacher = cfg, action_dim, device, teacher
        self.model = WorldModel(cfg, padded_actions(cfg, action_dim)).to(device)
        self.behaviour = ActorCritic(cfg, action_dim).to(device)
        self.model_adam = Adam(self.model, cfg.model_lr)
        self.actor_adam = Adam(self.behaviour.actor, cfg.actor_lr)
        self.critic_adam = Adam(self.behaviour.critic, cfg.critic_lr)
        if teacher:
            self.parts += ("teacher",)                    # a run needs no other file to go on
        if cfg.compile:
            self.behaviour.imagine = torch.compile(self.behaviour.imagine)

    @torch.no_grad()
    def act(self, image, action, state, explore):
        """Decide. image: uint8 (N, 64, 64, 3); action: the previous one, (N, A); state: None first.
        explore: sample the actor, else take its mode. Returns action, numpy (N, A), and state."""
        is_first = torch.full((len(image),), state is None, device=self.device)
        state = self.model.rssm.initial(len(image)) if state is None else state
        image, action = (torch.as_tensor(x, device=self.device) for x in (image, action))
        embed = self.model.encoder.encode(preprocess(image))["embed"]
        state = self.model.rssm.step(state, action, embed, is_first)
        mean, std, _ = self.behaviour.policy(self.model.rssm.feat(state))
        return clip_action(gaussian_sample(mean, std) if explore else mean).cpu().numpy(), state

    @torch.no_grad()
    def taught(self, rows):
        """What the frozen teacher makes of an episode's images: {TEACHER: (T, Z)}, or {}."""
        if self.teacher is None:
            return {}
        image = torch.from_numpy(np.stack([row["image"] for row in rows])).to(self.device)
        code = self.teacher(preprocess(image))
        return {key: x.cpu().numpy() for key, x in zip(TEACHER, code, strict=True)}

    def update(self, batch, eta, update):
        """Algorithm 1, lines 12–18: one step of everything on numpy arrays (B, T, ...) → metrics.
        update: index of this step; each 100, distillation's own gradient is measured too."""
        cfg, clip, batch = self.cfg, self.cfg.grad_clip, to_device(batch, self.device)
        with autocast(cfg):
            out = self.model(batch)
        if self.model.bonus:                                                  # in fp32
            bonus = self.model.bonus(out["post"].get("below", out["feat"]))
            batch["reward"] = batch["reward"][:, :bonus.shape[1]] + cfg.bonus * bonus
        with autocast(cfg):
            # Kept beside the replay, which is right only as the teacher is frozen: 8 % of a step.
            teacher = latent_code(*(batch[key] for key in TEACHER)) if self.teacher else None
            loss, metrics = self.model.loss(out, batch, teacher, eta)
        if update % 100 == 0 and "distill" in metrics:                        # at the encoder
            grads = torch.autograd.grad(eta * metrics["distill"],
                                        [*self.model.encoder.parameters()], retain_graph=True)
            metrics["distill_grad_norm"] = nn.utils.get_total_norm(grads)
        metrics["model_grad_norm"] = self.model_adam.minimize(loss, clip)
        if update % cfg.slow_every == 0:
            self.behaviour.copy_critic()
        start = {key: x.detach().flatten(0, 1) for key, x in out["post"].items()}  # data here
        start["discount"] = cfg.gamma * batch["discount"].flatten()
        if cfg.imagine_starts:
            chosen = torch.randperm(len(start["discount"]), device=self.device)[:cfg.imagine_starts]
            start = {key: value[chosen] for key, value in start.items()}
        with autocast(cfg):
            actor, critic, more = self.behaviour.losses(self.model, start, start.pop("discount"))
        metrics |= more
        metrics["actor_grad_norm"] = self.actor_adam.minimize(actor, clip)
        metrics["critic_grad_norm"] = self.critic_adam.minimize(critic, clip)
        map_apart(1 << 30)
        return {key: value.detach() for key, value in metrics.items()}

# === Replay and video sets: episodes on disk ======================================================

# A row holds an image and what led to it (see RSSM for how rows line up).
VIDEO = np.dtype([("image", np.uint8, (64, 64, 3)), ("is_first", np.bool_)])
TEACHER = ("teacher_mean", "teacher_logvar")

def row_type(action_dim, z_dim=0):
    """A row of an agent's episode as a NumPy dtype; z_dim: with the TEACHER's code of its image.
    A video predictor may see what is in VIDEO and nothing else."""
    return np.dtype([*VIDEO.descr, ("action", np.float32, (action_dim,)), ("reward", np.float32),
                     ("discount", np.float32), ("is_terminal", np.bool_),
                     *((key, np.float32, (z_dim,)) for key in TEACHER if z_dim)])

def make_row(image, action, reward=0.0, terminal=False, first=False):
    """One row of an episode."""
    return dict(image=image, action=action, reward=reward, discount=1.0 - terminal, is_first=first,
                is_terminal=terminal)

def write_whole(path, content):
    """Write a file's bytes, all of them or, if that fails, none."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
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
        said = str(error).split("\n")[0]                 # C++ frames below it name allocators
        if re.search("(?i)alloc|out of memory|CUDA error", said):             # not the file's fault
            raise
        cause = f"{type(error).__name__}: {error}"[:120]
        raise UserError(f"{path} is no {kind} ({cause}); {remedy}") from None

def check_archive(path, limit):
    """Raise ValueError at a zip that was altered, or a bomb: it declares more bytes than limit."""
    with zipfile.ZipFile(path) as archive:
        size = sum(info.file_size for info in archive.infolist())
        if size > limit or archive.testzip():
            raise ValueError(f"altered, or a bomb: it would unpack to {size:,} bytes")

class Replay:
    """Finished episodes, a file each, laid end to end; windows start uniformly anywhere.
        episodes    ┌──────── 0 ────────┐┌──── 1 ────┐┌─────── 2 ──────
        rows        F . . . . . . . . . .F . . . . . .F . . . . . . . .      F: is_first
        a window                [. . . . . . F . . .]
    Only an index is in memory. A file is an array of rows that `np.load` opens: an episode's images
    are np.load(path)["image"]. Fields that are not in `dtype` are left unread."""
    def __init__(self, folder, dtype=VIDEO, capacity=None):
        self.folder, self.dtype, self.capacity = Path(folder), dtype, capacity
        self.checked, paths = set(), sorted(self.folder.glob("*.npy"))
        # All files: a checkpoint may need those that the ones after it pushed out.
        self._hold([(path, len(self.read(path, check=False))) for path in paths])
        last = self.paths[-1].stem if self.paths else ""
        self.next_index = int(last) + 1 if last.isdecimal() else 0

    def _hold(self, episodes):
        """Index (path, length) pairs."""
        self.episodes, self.paths = episodes, [path for path, _ in episodes]
        self.ends = np.cumsum([length for _, length in episodes], dtype=int).tolist()
        self.rows = self.ends[-1] if episodes else 0

    def read(self, path, check=True):
        """An episode's rows, mapped into memory. UserError unless it has the fields of `dtype` and,
        looked at once, the checksum that it was saved with."""
        with reading(path, f"episode with {', '.join(self.dtype.names)}", "remove it"):
            if check and path not in self.checked:
                content = path.read_bytes()
                if struct.pack("<I", zlib.crc32(content[:-4])) != content[-4:]:
                    raise ValueError("it was altered: its checksum is another")
                self.checked.add(path)
            rows = np.load(path, mmap_mode="r", allow_pickle=False)
            if rows.ndim != 1 or not len(rows):
                raise ValueError(f"its shape is {rows.shape}")
            for name in self.dtype.names:
                if rows.dtype[name] != self.dtype[name]:
                    raise ValueError(f"{name} is {rows.dtype[name]}, not {self.dtype[name]}")
        return rows

    def add(self, rows, **more):
        """Append a finished episode, a list of `make_row`; the oldest beyond capacity go.
        more: fields that these do not have, arrays (T, ...)."""
        episode, buffer = np.empty(len(rows), self.dtype), io.BytesIO()
        for name in self.dtype.names:
            episode[name] = more[name] if name in more else [row[name] for row in rows]
        np.save(buffer, episode)
        content, path = buffer.getvalue(), self.folder / f"{self.next_index:06d}.npy"
        self.folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, content + struct.pack("<I", zlib.crc32(content)))
        self._hold([*self.episodes, (path, len(rows))])
        while self.capacity and self.rows - self.ends[0] >= self.capacity:
            self._hold(self.episodes[1:])
        self.next_index += 1

    def prune(self):
        """Delete files not in the index, once no checkpoint needs them."""
        for path in set(self.folder.glob("*.npy")) - set(self.paths):
            path.unlink()

    def state_dict(self):
        """Which episodes there are: the first one and the next to come."""
        return dict(first=self.next_index - len(self.paths), next=self.next_index)

    def load_state_dict(self, state):
        """Return to those episodes; later ones, of a run cut off, go."""
        numbers, self.next_index = range(state["first"], state["next"]), state["next"]
        self._hold([(path, length) for path, length in self.episodes
                    if path.stem.isdecimal() and int(path.stem) in numbers])
        if len(self.paths) != len(numbers):
            raise UserError(f"{self.folder} lacks episodes of its checkpoint; start over: --fresh")
        self.prune()

    def window(self, start, length):
        """Rows start … start + length − 1: dict of (T, ...)"""
        pieces = []
        while length > 0:
            index = bisect.bisect_right(self.ends, start)
            rows = self.read(self.paths[index])[start - self.ends[index]:][:length]
            pieces.append(rows)
            start, length = start + len(rows), length - len(rows)
        return {key: np.concatenate([rows[key] for rows in pieces]) for key in self.dtype.names}

    def sample(self, batch_size, length, rng):
        """Dict of (B, T, ...); windows begin is_first."""
        starts = rng.integers(0, self.rows - length + 1, batch_size)
        windows = [self.window(int(start), length) for start in starts]
        batch = {key: np.stack([window[key] for window in windows]) for key in self.dtype.names}
        batch["is_first"][:, 0] = True
        return batch

def open_videos(folder, cache):
    """The episodes of a folder, *.npy of ours or anybody's *.npz, as a Replay of images. An .npz,
    the authors' are compressed, is unpacked into a folder of `cache`, once; not a zip bomb."""
    paths = sorted(Path(folder).resolve().glob("*.np[yz]"))
    if not paths:
        raise UserError(f"no episodes (*.npy, *.npz) in {folder}; run: python diswm.py collect "
                        "--src TASK")
    if all(path.suffix == ".npy" for path in paths):
        return Replay(folder)
    stamp = zlib.crc32(repr([(path, os.path.getmtime(path)) for path in paths]).encode())
    unpacked = Replay(cache / f"{stamp:08x}")                                 # of these very files
    for path in paths[len(unpacked.paths):]:
        with reading(path, "video", "remove it"):
            if path.suffix == ".npz":
                check_archive(path, max(2**30, 100 * os.path.getsize(path)))
            image = np.load(path, mmap_mode="r", allow_pickle=False)["image"]
            if image.dtype != np.uint8 or image.shape != (len(image) or 1, 64, 64, 3):
                raise ValueError(f"image is {image.dtype} {image.shape}, not uint8 (T, 64, 64, 3)")
        unpacked.add([dict(image=frame, is_first=t == 0) for t, frame in enumerate(image)])
    return unpacked

# === Environments =================================================================================

vars(np).setdefault("in1d", np.isin)  # NumPy 2.4 dropped it; dm_control's quadruped calls it
TASKS = {f"{domain}_{task}": (domain, task) for domain, task in suite.ALL_TASKS}
OTHER_TASKS = dict(pusher="pusher", drawer_open="drawer", drawer_close="drawer")
PHASES = ("train", "shifted", "eval", "none")
# DEVIATION: around these, as published; the paper says around the original ones.
COLOR_CENTERS = dict(train=(0.7, 0.3, 0.5), shifted=(0.5, 0.7, 0.3))
MATERIALS = dict(grid="floor", self="body")  # dm_control's names
TRAINING, EVALUATION, PRETRAINING, COLLECTING = 0, 1, 2, 3  # streams of episode_seed
if "DisWM/pusher-v0" not in gym.registry:  # a script imports itself, see its last lines
    for name in (*TASKS, *OTHER_TASKS):
        gym.register(f"DisWM/{name}-v0", "diswm:make_env", kwargs=dict(task=name))

def family(task):
    """"dmc", "pusher", "drawer" or "gymnasium": a transfer between two of them crosses domains."""
    return OTHER_TASKS.get(task, "dmc" if task in TASKS else "gymnasium")

def check_task(task):
    """Raise UserError with the nearest names unless there is such a task."""
    known = [*TASKS, *OTHER_TASKS]
    if task not in known and task not in gym.registry:
        with contextlib.suppress(ImportError), contextlib.redirect_stderr(io.StringIO()):
            import gymnasium_robotics  # noqa: F401  registers its tasks, and prints a notice
    if task not in known and task not in gym.registry:
        ids = [name for name, spec in gym.registry.items()
               if any(part in str(spec.entry_point) for part in ("mujoco.", "robotics"))]
        near = " or ".join(difflib.get_close_matches(task, known + ids)) or "none is similar"
        raise UserError(f"unknown '{task}' ({near}); there are: {', '.join(known)}, and the MuJoCo "
                        "tasks of gymnasium and gymnasium-robotics, like FetchReach-v4", code=2)

class DMControlEnv(gym.Env):
    """A task of dm_control.suite as a gymnasium.Env with a flat state, MuJoCo's model and data."""
    def __init__(self, domain, task):
        self.env = suite.load(domain, task, dict(random=0), dict(flat_observation=True))
        spec, size = self.env.action_spec(), self.env.observation_spec()["observations"].shape
        self.action_space = gym.spaces.Box(np.float32(spec.minimum), np.float32(spec.maximum))
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, size, np.float64)
        self.model, self.data = self.env.physics.model.ptr, self.env.physics.data.ptr

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.env.task.random.seed(seed)
        return self.env.reset().observation["observations"], {}

    def step(self, action):
        step = self.env.step(action)
        obs, terminated = step.observation["observations"], step.discount == 0  # 1 at a time limit
        return obs, float(step.reward), terminated, step.last() and not terminated, {}

def drawer_world(task):
    """DrawerWorld: Meta-World's task with three table tops; reset(options={"phase": …}) chooses."""
    import metaworld.env_dict  # takes a second
    path = metaworld.__path__[0] + "/assets/textures/"
    grid = dict(builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mark=mujoco.mjtMark.mjMARK_EDGE,
                rgb1=(0.1, 0.2, 0.3), rgb2=(0.2, 0.3, 0.4), width=300, height=300)
    tops = dict(train=grid, shifted={"file": path + "wood.png"}, eval={"file": path + "metal.png"})
    class DrawerWorld(metaworld.env_dict.ALL_V3_ENVIRONMENTS[task.replace("_", "-") + "-v3"]):
        def _initialize_simulation(self):
            spec = mujoco.MjSpec.from_file(self.fullpath)
            for phase, source in tops.items():
                spec.add_texture(name=phase, type=mujoco.mjtTexture.mjTEXTURE_2D, **source)
                material = spec.add_material(name=phase, texrepeat=(1, 1), texuniform=True)
                material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = phase
            model = spec.compile()
            return model, mujoco.MjData(model)

        def reset(self, *, seed=None, options=None):
            if seed is not None:
                self.seed(seed)                                               # reset ignores it
            top = self.model.body("tablelink").geomadr[0]                     # a box on the legs
            name = "table_wood" if options["phase"] == "none" else options["phase"]
            self.model.geom_matid[top] = self.model.mat(name).id
            result = super().reset()
            mujoco.mj_forward(self.model, self.data)  # else one sees the drawer where it was before
            return result
    env = DrawerWorld()
    # Its own benchmark sets a goal from a list; this draws one at each reset, from the seed.
    env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
    # DEVIATION: published from 0.96 above, where half of version 3's drawer is out of sight.
    env.mujoco_renderer.default_cam_config = dict(
        distance=1.2, azimuth=180, elevation=-90, lookat=(0, 0.62, 0))
    return env

def bare_simulator(task):
    """A task's simulator without wrappers → (env, simulator steps per episode)."""
    if task in TASKS:
        return DMControlEnv(*TASKS[task]), 1000
    if family(task) == "drawer":
        return drawer_world(task), 200
    if task == "pusher":                                                      # published
        above = dict(distance=2.0, azimuth=90, elevation=-90, lookat=(0, -0.5, 0.2))
        return gym.make("Pusher-v5", default_camera_config=above).unwrapped, 100
    return gym.make(task, disable_env_checker=True).unwrapped, gym.spec(task).max_episode_steps

class ActionRepeat(gym.Wrapper):
    """Hold an action for n simulator steps, sum the rewards; info["env_steps"] counts the steps.
    info["success"], where the task tells, is true if it was reached at any of them."""
    def __init__(self, env, n):
        super().__init__(env)
        self.n = n

    def step(self, action):
        # DEVIATION: the published code repeats in two wrappers (really 4) and doubles rewards.
        total, steps, terminated, truncated, reached = 0.0, 0, False, False, []
        while steps < self.n and not (terminated or truncated):
            obs, reward, terminated, truncated, info = self.env.step(action)
            total, steps = total + reward, steps + 1
            reached += [info[key] for key in ("success", "is_success") if key in info]
        info = info | {"env_steps": steps} | ({"success": any(reached)} if reached else {})
        return obs, total, terminated, truncated, info

def color_box(phase, original, colors="published", half_range=0.2):
    """What a phase draws colours from: (low, high), each (n, 3) in 0..1, like `original`.
    Around the original colours, `shifted` rotates their channels (ours)."""
    if phase == "none":
        return original, original
    center = original if phase == "train" else np.roll(original, 1, -1)
    if colors == "published":                                                 # no own one for eval
        center = np.broadcast_to(COLOR_CENTERS[phase.replace("eval", "shifted")], original.shape)
    return np.clip(center - half_range, 0, 1), np.clip(center + half_range, 0, 1)

def color_groups(task, model):
    """What the distractor colours: (name, RGBA array, rows that share a colour) of each group."""
    materials = [(MATERIALS.get(model.mat(i).name, model.mat(i).name), model.mat_rgba, [i])
                 for i in range(model.nmat)]
    if task in TASKS:
        return materials
    if family(task) == "drawer":
        return []                                                             # textures instead
    geoms = [(model.geom(i).name or f"geom {i}", model.geom_rgba, [i]) for i in range(model.ngeom)]
    if task == "pusher":                                                      # published
        arm = [model.geom(name).id for name in ("uar", "ua", "ef", "sp", "fa", "sl", "e1", "e2")]
        thing, table = model.body("object").geomadr[0], model.geom("table").id
        return [("object", model.geom_rgba, [thing]), geoms[table], ("arm", model.geom_rgba, arm)]
    # MuJoCo shows a geom's material where there is one and its own colour is the default.
    own = (model.geom_matid < 0) | (model.geom_rgba != (0.5, 0.5, 0.5, 1)).any(1)
    return [*(materials[i] for i in np.unique(model.geom_matid[~own])),
            *(geoms[i] for i in np.flatnonzero(own))]

class ColorDistractor(gym.Wrapper):
    """Each episode, draw the colours of groups from a random stream of their own.
    reset(options={"phase": …}) changes the phase from then on. Only what is rendered changes."""
    def __init__(self, env, task, phase, colors="published", half_range=0.2, step_std=0.0):
        super().__init__(env)
        self.phase, self.step_std, self.rng = phase, step_std, np.random.default_rng()
        self.groups = color_groups(task, self.unwrapped.model)
        self.original = [array[rows, :3] for _, array, rows in self.groups]   # copies
        original = np.array([rgb[0] for rgb in self.original]).reshape(-1, 3)
        tint = np.arange(len(original))[:, None] >= (task == "pusher")        # black: its object
        self.boxes = {p: tint * color_box(p, original, colors, half_range) for p in PHASES}

    def paint(self, colors):
        self.current = colors
        for (_, array, rows), color in zip(self.groups, colors, strict=True):
            array[rows, :3] = color

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng([seed, 1])
        options = {"phase": self.phase} | (options or {})
        self.phase = options["phase"]
        colors = self.rng.uniform(*self.boxes[self.phase])
        self.paint(self.original if self.phase == "none" else colors)
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        if self.step_std and self.phase != "none":
            walk = self.rng.normal(np.float32(self.current), self.step_std)   # as MuJoCo rounds
            self.paint(np.clip(walk, *self.boxes[self.phase]))
        return self.env.step(action)

class Pixels(gym.ObservationWrapper):
    """Observe what a camera sees, uint8 (size, size, 3). By mujoco.Renderer, since the simulators'
    render() keeps whichever GL context was last: two in a process show each other's textures."""
    metadata, render_mode = {"render_modes": ["rgb_array"]}, "rgb_array"

    def __init__(self, env, size=64, fast=False):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        model, dmc = self.unwrapped.model, isinstance(self.unwrapped, DMControlEnv)
        self.camera = 0 if dmc else mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
        if self.camera < 0:                                                   # gymnasium's rule
            self.camera = mujoco.MjvCamera()
            mujoco.mjv_defaultFreeCamera(model, self.camera)
            library = getattr(self.unwrapped, "mujoco_renderer", None)
            for key, value in (getattr(library, "default_cam_config", None) or {}).items():
                setattr(self.camera, key, value)
        # DEVIATION: shadows cost 20–60 % less of a frame, for a mean difference < 0.2 / 255.
        model.vis.quality.shadowsize = 512
        if fast:
            model.vis.quality.offsamples = 0  # half of the rest, for 1–2 / 255
        self.renderer = mujoco.Renderer(model, size, size)
        # DEVIATION: no mirroring floor: 12 % of a frame (17 ms in DrawerWorld), for < 0.6 / 255.
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        atexit.register(self.renderer.close)  # one that is open at exit prints GL errors

    def reset(self, *, seed=None, options=None):
        _, info = self.env.reset(seed=seed, options=options)
        for index in range(self.unwrapped.model.nhfield):                     # quadruped's terrain
            self.renderer._gl_context.make_current()
            mujoco.mjr_uploadHField(self.unwrapped.model, self.renderer._mjr_context, index)
        return self.render(), info

    def observation(self, observation=None):
        data = self.unwrapped.data
        if hasattr(self.unwrapped, "_render_callback"):                       # puts Fetch's goal
            warmstart = data.qacc_warmstart.copy()
            self.unwrapped._render_callback()
            data.qacc_warmstart[:] = warmstart  # else looking would change, in bits, what happens
        self.renderer.update_scene(data, camera=self.camera)
        return self.renderer.render()

    render = observation

    def close(self):
        atexit.unregister(self.renderer.close)
        self.renderer.close()
        super().close()

def make_env(task, *, phase="train", seed=0, action_repeat=2, time_limit=0, colors="published",
             color_range=0.2, color_step_std=0.0, fast_render=False, size=64, pixels=True):
    """The one env stack: simulator, actions in [−1, 1], time limit, action repeat, colours, pixels.
    task: of TASKS, OTHER_TASKS, or a Gymnasium id. phase: "train", "shifted" (after the midpoint),
    "eval" (drawers: metal; others: as shifted), "none" (the task's own look). time_limit: simulator
    steps, 0: the task's own. Returns a gymnasium.Env of uint8 (size, size, 3) images or, without
    pixels, flat states. UserError: unknown task or phase, no MuJoCo, discrete actions, no GL."""
    check_task(task)
    if phase not in PHASES:
        raise UserError(f"unknown phase '{phase}'; there are: {', '.join(PHASES)}", code=2)
    try:
        env, limit = bare_simulator(task)
    except (gym.error.Error, ImportError, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise UserError(f"{task} cannot be made ({reason}); run: pip install --force-reinstall -r "
                        "requirements.txt") from error
    has_model = isinstance(getattr(env, "model", None), mujoco.MjModel)
    if not (has_model and isinstance(env.action_space, gym.spaces.Box)):
        raise UserError(f"{task} has no MuJoCo model to render or no continuous actions; choose "
                        "another, such as HalfCheetah-v5")
    env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    env = gym.wrappers.TimeLimit(env, time_limit or limit or 1000)
    env = ActionRepeat(env, action_repeat)
    env = ColorDistractor(env, task, phase, colors, color_range, color_step_std)
    try:
        env = Pixels(env, size, fast_render) if pixels else gym.wrappers.FlattenObservation(env)
    except (AttributeError, ImportError, RuntimeError) as error:
        raise UserError(f"MuJoCo with MUJOCO_GL={os.environ['MUJOCO_GL']} cannot render "
                        f"({error}); {GL_HINT}") from error
    env.reset(seed=seed)
    return env

def config_env(cfg, task, phase, **kwargs):
    """make_env with the values of a Config."""
    if multiprocessing.parent_process():
        signal.signal(signal.SIGINT, signal.SIG_IGN)                          # one takes Ctrl-C
    names = "action_repeat", "time_limit", "colors", "color_range", "color_step_std", "fast_render"
    return make_env(task, phase=phase, **{name: getattr(cfg, name) for name in names}, **kwargs)

def config_envs(cfg, task, **kwargs):
    """cfg.envs of them as a gymnasium.vector.VectorEnv: one in this process, several in others."""
    make = [functools.partial(config_env, cfg, task, "train", **kwargs)] * cfg.envs
    if cfg.envs == 1:
        return gym.vector.SyncVectorEnv(make)
    try:
        return gym.vector.AsyncVectorEnv(make, context="spawn")               # EGL hangs in a fork
    except (EOFError, ConnectionError) as error:
        raise UserError("the processes of --envs did not start; in a script of your own, call this "
                        "under: if __name__ == '__main__'") from error

def padded_actions(cfg, action_dim):
    """Actions of a world model: the more of both tasks' where it carries weights over (paper)."""
    if cfg.carry_over != "weights":
        return action_dim
    with contextlib.closing(make_env(cfg.src, pixels=False)) as env:
        return max(action_dim, *env.action_space.shape)

def episode_seed(seed, stream, index):
    """Of the run's seed, the purpose and the index."""
    # DEVIATION: published colours and weights are unseeded, and the replay's sampler has seed 0.
    return int(np.random.SeedSequence([seed, stream, index]).generate_state(1)[0])

def initial_seed(cfg, model):
    """Of a model class's first weights. A teacher's are not its student's: else Eq. (3), which
    compares latents one by one, would find them aligned from the start."""
    return episode_seed(cfg.seed, PRETRAINING, 0) if model is VideoPredictor else cfg.seed

def play_episodes(envs, policy, seeds, phase, each=None):
    """Play an episode in each environment → [(rows of make_row, return, success or None), …].
    policy(images, actions, state) → (actions, state), of the previous actions and, at first, None.
    each(env_steps), of those that still play, follows each decision; if true, all are cut."""
    images, _ = envs.reset(seed=seeds, options=dict(phase=phase))
    actions, state = np.zeros(envs.action_space.shape, np.float32), None
    episodes = [[make_row(*pair, first=True)] for pair in zip(images, actions, strict=True)]
    playing, success = np.full(len(seeds), True), [None] * len(seeds)
    while playing.any():
        actions, state = policy(images, actions, state)
        images, rewards, terminated, truncated, info = envs.step(actions)
        for i in np.flatnonzero(playing):                                     # the rest start anew
            episodes[i].append(make_row(images[i], actions[i], rewards[i], bool(terminated[i])))
            if "success" in info:
                success[i] = bool(success[i] or info["success"][i])
        playing &= ~(terminated | truncated | bool(each and each(info["env_steps"][playing])))
    returns = [math.fsum(row["reward"] for row in rows) for rows in episodes]
    return list(zip(episodes, returns, success, strict=True))

def random_policy(seeds):
    """Uniform actions in [−1, 1], from a stream for each environment."""
    rngs = [np.random.default_rng([seed, 2]) for seed in seeds]               # not the simulator's
    return lambda images, actions, state: (
        np.array([rng.uniform(-1, 1, actions.shape[1:]) for rng in rngs], np.float32), None)

# === Runs: folders, checkpoints, logs, and the training loop ======================================

def run_folder(cfg, stage):
    """runs/<stage>/<tasks>/<method>/seed<k>, so that the same command finds its run again."""
    tasks = f"{cfg.src}-{cfg.dst}" if stage == "finetune" else cfg.src
    return Path(cfg.runs) / stage / tasks.replace("/", "_") / cfg.method / f"seed{cfg.seed}"

def read_checkpoint(path):
    """A checkpoint, loaded without executing code. UserError when it is missing or not ours.
    No path that stands in it is ever followed."""
    if not Path(path).exists():
        raise UserError(f"there is no checkpoint {path}; train that run first, for instance: "
                        "python diswm.py finetune --dst walker_walk")
    with reading(path):
        check_archive(path, os.path.getsize(path))  # torch.load looks at no checksum
        state = dict(torch.load(path, map_location="cpu", weights_only=True))
        state["config"] = Config(**state["config"])
        tensors = [x for x in tree_leaves(state["trainer"]) if isinstance(x, torch.Tensor)]
        if not all(x.dtype in (torch.float32, torch.int64) and x.isfinite().all() for x in tensors):
            raise ValueError("not all weights are finite float32")
        int(state["trainer"]["progress"])
        state["log"].encode()
        return {key: state[key] for key in ("config", "stage", "trainer", "log")}

MEMORY = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")  # this machine's, bytes

def memory_needed(cfg):
    """GB, as measured. Raises UserError where this machine has less."""
    channels, have = cfg.batch_size * cfg.batch_length * cfg.cnn_depth, MEMORY / 1e9
    memory = 0.8 + channels * (2.1e-5 if cfg.precision == "bf16" else 3.9e-5)
    if cfg.device == "cpu" and memory > have:
        raise UserError(f"needs about {memory:,.0f} GB of memory and this machine has {have:.0f}; "
                        "take a smaller --batch-size, --batch-length or --cnn-depth")
    return memory

class Run:
    """A run's folder: checkpoint.pt, config.json, metrics.jsonl, TensorBoard events."""
    def __init__(self, cfg, stage, fresh=False):
        if cfg.eta_delay < 0:
            cfg = replace(cfg, eta_delay=cfg.eta_decay * (family(cfg.src) != family(cfg.dst)))
        self.cfg, self.stage, self.folder = cfg, stage, run_folder(cfg, stage)
        self.checkpoint = self.folder / "checkpoint.pt"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.lock = open(self.folder / "lock", "w")  # noqa: SIM115, train() closes it
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # a process that dies lets go
        except BlockingIOError:
            raise UserError(f"another process is at work in {self.folder}; stop it first") from None
        whole = self.checkpoint.exists() and not fresh
        self.state = read_checkpoint(self.checkpoint) if whole else None
        self.log = self.state["log"] if self.state else ""
        old, new = vars(self.state["config"] if self.state else cfg), vars(cfg)
        differ = [f"{f.name} {old[f.name]} (now {new[f.name]})" for f in dataclasses.fields(cfg)
                  if old[f.name] != new[f.name] and not f.metadata["free"]]
        if differ:
            raise UserError(f"{self.folder} was started with {', '.join(differ)}; use the same "
                            "flags, or --fresh to start over, or another --runs")
        frames = 0 if stage == "pretrain" else cfg.steps // cfg.action_repeat
        disk, memory = 0.1 + frames * 12.35e-6, memory_needed(cfg)            # GB; a row is 12.3 kB
        print(f"{stage} {cfg.method}, {cfg.src} → {cfg.dst}, seed {cfg.seed}, on {cfg.device} with "
              f"{cfg.precision} and {torch.get_num_threads()} threads\n  needs about {disk:.1f} GB "
              f"of disk and {memory:.1f} GB of memory; results go to {self.folder}", flush=True)

    def clear(self):
        """What --fresh replaces goes, late: nothing is lost to a mistake in the command."""
        for path in set(self.folder.iterdir()) - {self.folder / "lock", self.folder / "videos"}:
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def save(self, trainer):
        """Write config and log, for people, and the checkpoint, which holds them too."""
        buffer = io.BytesIO()  # a full disk is then an OSError of the file, not one inside torch
        torch.save(dict(config=vars(self.cfg), stage=self.stage, trainer=trainer.state_dict(),
                        log=self.log), buffer)
        write_whole(self.folder / "config.json", json.dumps(vars(self.cfg), indent=2).encode())
        write_whole(self.folder / "metrics.jsonl", self.log.encode())
        write_whole(self.checkpoint, buffer.getbuffer())

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
    """The one training loop: resume; then work, log, checkpoint, from `progress` to `total` in
    `unit`s. trainer.advance() does some → a row of the log or None; `batch`: the latest."""
    from torch.utils.tensorboard import SummaryWriter  # slow to import
    if run.state:
        with reading(run.checkpoint):
            trainer.load_state_dict(run.state["trainer"])
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
                run.log += json.dumps(row) + "\n"
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
    """The average of several updates' metrics: list of dicts of scalars → dict of floats."""
    names = sorted({name for row in rows for name in row})
    return {name: np.mean([row[name] for row in rows if name in row]) for name in names}

class VideoTrainer(Saved):
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
        norm = self.optimizer.minimize(loss, self.cfg.grad_clip)
        map_apart(1 << 30)
        return {key: value.detach() for key, value in metrics.items()} | {"model_grad_norm": norm}

    def advance(self):
        """An update → after every `chunk` of them, and at the end, a row of the log."""
        cfg, rng = self.cfg, np.random.default_rng([self.cfg.seed, self.progress])
        torch.manual_seed(rng.integers(2**63))            # so there is no random state to save
        self.batch = self.videos.sample(cfg.batch_size, cfg.batch_length, rng)
        self.metrics.append(check_finite(self.update(self.batch)))
        self.progress += 1
        if self.progress % self.chunk and self.progress < self.total:
            return None
        row, self.metrics = dict(update=self.progress) | mean_metrics(self.metrics), []
        return row

class AgentTrainer(Saved):
    """Stages 1 and 3, Algorithm 1 lines 9–25: an agent in an environment. Progress in env steps.
    It works episode by episode. A checkpoint falls between two of them, so no simulator or
    recurrent state is in it; the colours, η and all seeds follow from the counters."""
    unit, shown = "env steps", ("train_return", "eval_return", "image", "reward", "kl", "eta")
    parts, counters = ("agent", "replay"), ("progress", "decisions", "updates", "episodes")

    def __init__(self, cfg, envs, folder, device, teacher=None):
        self.cfg, self.envs = cfg, envs
        self.agent = Agent(cfg, envs.single_action_space.shape[0], device, teacher)
        rows = row_type(self.agent.action_dim, cfg.z_dim if teacher else 0)
        self.replay = Replay(folder / "episodes", rows, cfg.replay_capacity)
        self.progress = self.decisions = self.updates = self.episodes = 0
        self.total, self.switch_step = cfg.steps, int(cfg.switch * cfg.steps)

    def learn(self, env_steps):
        """The updates due after a decision in each environment that plays → is the phase over?"""
        cfg, before = self.cfg, self.decisions
        self.decisions += len(env_steps)
        self.progress += int(env_steps.sum())
        due = self.decisions // cfg.train_every - before // cfg.train_every
        if self.decisions < cfg.prefill or self.replay.rows < cfg.batch_length:
            due = 0
        elif not self.updates:
            due = cfg.first_updates
        # DEVIATION: η follows the live clock; the published one is copied once and never anneals.
        eta = eta_schedule(self.decisions, cfg.eta, cfg.eta_end, cfg.eta_decay, cfg.eta_delay)
        for _ in range(due):
            rng = np.random.default_rng([cfg.seed, self.updates])
            self.batch = self.replay.sample(cfg.batch_size, cfg.batch_length, rng)
            self.metrics.append(check_finite(self.agent.update(self.batch, eta, self.updates)))
            self.updates += 1
        return self.progress >= self.limit

    def play(self):
        """An episode in each environment, learning on the way → see play_episodes.
        It ends with the simulator's, at the colour switch, or with the run."""
        cfg, self.metrics, count = self.cfg, [], self.envs.num_envs
        stream = COLLECTING if cfg.src == cfg.dst else TRAINING               # of other colours
        seeds = [episode_seed(cfg.seed, stream, self.episodes + i) for i in range(count)]
        torch.manual_seed(seeds[0])  # of all noise until the next: no random state to save
        random, actor = random_policy(seeds), functools.partial(self.agent.act, explore=True)
        self.phase, self.limit = "shifted", self.total
        if self.progress < self.switch_step:  # the colours switch once, at the midpoint
            self.phase, self.limit = "train", self.switch_step
        def policy(*args):
            return (random if self.decisions < cfg.prefill else actor)(*args)
        return play_episodes(self.envs, policy, seeds, self.phase, self.learn)

    def advance(self):
        """An episode in each environment, and an evaluation when one is due → a row of the log."""
        cfg, start = self.cfg, self.progress
        self.replay.prune()           # a checkpoint was written: what only the one before needed
        episodes = self.play()
        self.episodes += len(episodes)
        rows, returns, success = zip(*episodes, strict=True)
        for episode in rows:
            self.replay.add(episode, **self.agent.taught(episode))
        row = dict(step=self.progress, phase=self.phase, train_return=np.mean(returns),
                   train_length=np.mean([len(episode) - 1 for episode in rows]))
        row |= mean_metrics(self.metrics) | {key: getattr(self, key) for key in self.counters[1:]}
        row |= {} if None in success else dict(train_success=np.mean(success))
        due = self.progress - self.progress % cfg.eval_every
        if self.progress >= self.total or due > start:
            result = evaluate_agent(cfg, self.agent, self.envs, self.phase)
            row["eval_return"] = result.pop("mean")
            row["eval_step"] = self.total if self.progress >= self.total else due
            row |= {f"eval_{key}": value for key, value in result.items()}
        return row

def evaluate_agent(cfg, agent, envs, phase, replay=None):
    """Play `eval_episodes` episodes into the replay, the same seeds every time; agent None: random.
    Returns their phase, training's but for drawers' table top that is never trained on; mean, list
    and standard deviation of their returns and, where the task tells, the share that succeeded."""
    played, count = [], envs.num_envs
    # DEVIATION: the paper does not say in which colours; here, in those that training is in.
    phase = "eval" if family(cfg.dst) == "drawer" else phase
    torch.manual_seed(cfg.seed)
    for first in range(0, cfg.eval_episodes, count):
        seeds = [episode_seed(cfg.seed, EVALUATION, first + i) for i in range(count)]
        policy = functools.partial(agent.act, explore=False) if agent else random_policy(seeds)
        episodes = play_episodes(envs, policy, seeds, phase)[:cfg.eval_episodes - first]
        played += [result for _, *result in episodes]
        for rows, *_ in episodes if replay else ():
            replay.add(rows)
    returns, success = ([*column] for column in zip(*played, strict=True))
    result = dict(phase=phase, mean=np.mean(returns), returns=returns, std=np.std(returns))
    return result if None in success else result | dict(success=np.mean(success))

# === Stages =======================================================================================

def load_model(path, device):
    """The model of a checkpoint → (its cfg on `device`, Agent or VideoPredictor, the checkpoint)"""
    state = read_checkpoint(path)
    auto = dict(device=device.type, precision="fp32", compile=False)
    cfg, trainer = replace(state["config"], **auto), state["trainer"]
    with reading(path):
        if state["stage"] == "pretrain":
            model, weights = VideoPredictor(cfg).to(device), trainer["model"]
        else:
            weights = trainer["agent"]
            depth = len(weights["teacher"]["net.0.bias"]) if "teacher" in weights else 0
            teacher = freeze(BetaVAEEncoder(cfg.z_dim, depth).to(device)) if depth else None
            model = Agent(cfg, weights["action_dim"], device, teacher)
        model.load_state_dict(weights)
    return cfg, model, state

def find_teacher(cfg, device):
    """A video predictor to learn from: --teacher, or the one of --src and this method.
    Prefers the run's own seed, else the first. Raises UserError with the command that makes one."""
    own = run_folder(cfg, "pretrain")
    found = [own / "checkpoint.pt", *sorted(own.parent.glob("seed*/checkpoint.pt"))]
    path = Path(cfg.teacher) if cfg.teacher else next(filter(Path.exists, found), None)
    runs = f" --runs {cfg.runs}" * (cfg.runs != Config.runs)
    command = ("run, with the same --preset: python diswm.py pretrain "
               f"--src {cfg.src} --method {cfg.method}{runs}")
    if cfg.src == cfg.dst:
        raise UserError(f"source and target are both {cfg.src}; choose another --src")
    if path is None:
        raise UserError(f"no teacher in {own.parent}; {command}")
    saved, model, state = load_model(path, device)
    done = state["trainer"]["progress"]
    if state["stage"] != "pretrain" or saved.encoder != ("beta_vae" if cfg.eta else cfg.encoder):
        raise UserError(f"{path} is a {saved.encoder} {state['stage']} run, no teacher; {command}")
    if cfg.eta and cfg.encoder != "beta_vae":
        raise UserError("Eq. (3) wants a β-VAE's latents; add --encoder beta_vae, or --eta 0")
    if saved.src == cfg.dst:
        raise UserError(f"{path} saw videos of the target, {cfg.dst}; choose another --src")
    if saved.src != cfg.src:  # the run's folder and η's delay follow it
        raise UserError(f"{path} saw videos of {saved.src}; add --src {saved.src}")
    carried = ("cnn_depth", "stoch", "deter", "hidden") if cfg.carry_over != "none" else ()
    for name in ("z_dim", *carried):
        if (size := getattr(saved, name)) != getattr(cfg, name):
            raise UserError(f"{path} has another {name}; add --{name.replace('_', '-')} {size}")
    if done < saved.pretrain_updates:
        raise UserError(f"{path} is not finished ({done} of {saved.pretrain_updates}); {command}")
    print(f"teacher: {path} ({saved.src}, {done:,} updates)")
    return model

def finished(folder):
    """Has a run there come to its end?"""
    if not (folder / "checkpoint.pt").exists():
        return False
    state = read_checkpoint(folder / "checkpoint.pt")
    return int(state["trainer"]["progress"]) >= state["config"].steps

def collect(cfg, fresh=False):
    """Learn in the distracting source task; the replay is the video set (stage 1, DreamerV2)."""
    # The training colours throughout, and every frame is kept.
    cfg = replace(cfg, dst=cfg.src, method="dreamerv2", steps=cfg.collect_steps, switch=1.0,
                  replay_capacity=10 * cfg.collect_steps, **METHODS["dreamerv2"])
    return finetune(cfg, fresh, "collect")

def pretrain(cfg, fresh=False):
    """Train the β-VAE video predictor (stage 2; collects videos first if there are none)."""
    cfg = replace(cfg, dst=cfg.src)
    run, folder = Run(cfg, "pretrain", fresh), Path(cfg.videos)
    if not cfg.videos:
        own = run_folder(replace(cfg, method="dreamerv2"), "collect")
        # One video set serves all seeds; without a whole one, the own is begun or finished.
        whole = filter(finished, [own, *sorted(own.parent.glob("seed*"))])
        folder = (next(whole, None) or collect(cfg)) / "episodes"
    videos = open_videos(folder, run.folder / "videos")
    if videos.rows < cfg.batch_length:
        raise UserError(f"{folder} has {videos.rows} frames, less than one window of "
                        f"{cfg.batch_length}; collect more, or lower --batch-length")
    print(f"videos: {folder}, {len(videos.paths):,} episodes, {videos.rows:,} frames")
    last = videos.read(videos.paths[-1])
    for stale in set((run.folder / "videos").glob("*")) - {videos.folder}:    # as files changed
        shutil.rmtree(stale)
    if fresh:
        run.clear()
    seen = Replay(run.folder / "episodes")                                    # for traverse
    if not seen.paths:
        seen.add(last)
    torch.manual_seed(initial_seed(cfg, VideoPredictor))
    train(VideoTrainer(cfg, videos, torch.device(cfg.device)), run)

def finetune(cfg, fresh=False, stage="finetune"):
    """Distil, adapt and learn behaviour in the target task (stage 3).
    Goes on from where it stopped; also what collect does. Returns the run's folder."""
    run, device, video, teacher = Run(cfg, stage, fresh), torch.device(cfg.device), None, None
    if run.state:
        teacher = load_model(run.checkpoint, device)[1].teacher
    elif cfg.eta > 0 or cfg.carry_over != "none":
        video = find_teacher(cfg, device)
        teacher = freeze(video.encoder) if cfg.eta > 0 else None
    with contextlib.closing(config_envs(run.cfg, run.cfg.dst)) as envs:
        if fresh:
            run.clear()
        torch.manual_seed(initial_seed(cfg, WorldModel))
        trainer = AgentTrainer(run.cfg, envs, run.folder, device, teacher)
        if trainer.replay.rows and not run.state:
            raise UserError(f"{run.folder} has episodes and no checkpoint; start over with --fresh")
        if video and cfg.carry_over != "none":
            trainer.agent.model.carry_over(video)
        train(trainer, run)
    return run.folder

def evaluate(cfg, folder):
    """Play episodes with a run's policy and with a random one; JSON and mp4 (stage 4).
    The actor's mode acts. Writes evaluation.json, its episodes, and the first as evaluation.mp4."""
    map_apart(1 << 30)                          # as no update comes first: 1.5 ms of a decision
    _, agent, state = load_model(folder / "checkpoint.pt", torch.device(cfg.device))
    step = state["trainer"]["progress"]
    if not isinstance(agent, Agent):
        raise UserError(f"{folder} is a video predictor without a policy; give a finetune run")
    switched = cfg.steps > int(cfg.switch * cfg.steps) < step                 # as while it trained
    phase, result = "shifted" if switched else "train", dict(task=cfg.dst, step=step)
    shutil.rmtree(folder / "evaluation", ignore_errors=True)
    replay, said = Replay(folder / "evaluation", row_type(agent.action_dim)), []
    for name, policy in (("", agent), ("random_", None)):                  # which need not see
        with contextlib.closing(config_envs(cfg, cfg.dst, pixels=bool(policy))) as envs:
            if envs.single_action_space.shape != (agent.action_dim,):
                raise UserError(f"{folder} has {agent.action_dim} actions, unlike {cfg.dst}; give "
                                "another --dst, or train it again with --fresh: it was altered")
            more = evaluate_agent(cfg, policy, envs, phase, replay if policy else None)
        result |= {name + key: value for key, value in more.items()}
        success = f", success {more['success']:.0%}" if "success" in more else ""
        said.append(f"{more['mean']:.1f} ± {more['std']:.1f}{success}")
    frames = replay.window(0, replay.ends[0])["image"].repeat(4, 1).repeat(4, 2)
    iio.imwrite(folder / "evaluation.mp4", frames, fps=25)                    # 256 × 256
    (folder / "evaluation.json").write_text(json.dumps(result, indent=2) + "\n")
    print(f"{cfg.dst}, {result['phase']} colours, after {step:,} env steps: return {said[0]}; "
          f"random policy: {said[1]}; {cfg.eval_episodes} episodes each\n"
          f"wrote evaluation.json, evaluation.mp4 and evaluation/*.npy in {folder}")

# === Figures ======================================================================================

TRAVERSAL = (-9, -3, -2, -1, 0, 1, 2, 3, 9)  # the prior's range, and the published ±9
FRAMES, DECISIONS = 2000, 50  # that disentanglement is measured on; of an episode
CURVE = ("final", "area", "before", "after")  # what plot prints

def to_picture(image):
    """float (..., 3, h, w) in [−0.5, 0.5] → uint8 (..., h, w, 3)"""
    return ((image.movedim(-3, -1) + 0.5).clamp(0, 1) * 255).round().byte().cpu().numpy()

@torch.no_grad()
def latent_traversal(model, batch):
    """Vary one latent at a time (paper, Fig. 5) in the first image of a window (1, T, ...) → uint8
    (Z, 1 + values, 64, 64, 3), first the reconstruction; each latent's mean KL, nats, (Z,)."""
    out = model(batch)
    mean, logvar = out["code"]["mean"][0], out["code"]["logvar"][0]           # (T, Z)
    latents = torch.arange(mean.shape[1])
    z = mean[0].repeat(len(latents), 1 + len(TRAVERSAL), 1)                   # (Z, 1 + values, Z)
    z[latents, 1:, latents] = z.new_tensor(TRAVERSAL)
    deter = out["post"]["deter"][0, 0].expand(*z.shape[:2], -1)               # 𝐳 is all it knows
    feat = torch.cat([model.rssm.posterior(deter, z)["mean"], deter], -1)
    kl = beta_vae_kl(mean[..., None], logvar[..., None])                      # (T, Z): of each
    return to_picture(model.decoder(feat)), kl.mean(0).cpu().numpy()

@torch.no_grad()
def open_loop(model, batch, context=5):
    """Filter `context` images of one window (1, T, ...), predict the others from its actions alone.
    Returns uint8 (3, T, 64, 64, 3): truth, model, error."""
    out = model({key: value[:, :context] for key, value in batch.items()})
    state, feats = {key: value[:, -1] for key, value in out["post"].items()}, [out["feat"]]
    for t in range(context, batch["image"].shape[1]):
        action = batch["action"][:, t] if "action" in batch else None
        state = model.rssm.prior(model.rssm.recur(state, action))
        feats.append(model.rssm.feat(state)[:, None])
    truth, prediction = batch["image"][0], model.decoder(torch.cat(feats, 1))[0].clamp(-0.5, 0.5)
    return to_picture(torch.stack([truth, prediction, (prediction - truth) / 2]))

def labelled_frames(cfg):
    """Random episodes of `cfg.dst` whose colours are drawn anew for each frame, each channel by
    itself from the union of both phases' intervals. Returns images, uint8 (N, 64, 64, 3), factors
    (N, K): colours that show, joint positions, m, and angles, rad, in (−π, π]; and their names."""
    images, factors, ends, rng = [], [], [], np.random.default_rng(cfg.seed)
    with config_env(cfg, cfg.dst, "none") as env:
        model, data, painter = env.unwrapped.model, env.unwrapped.data, env.env
        boxes, count = [painter.boxes[phase] for phase in PHASES[:2]], len(painter.groups)
        def rendered(colors):
            painter.paint(colors)
            return env.render()
        *lit, dark = map(rendered, np.eye(count + 1, count))                  # one white, none
        shown = [i for i, image in enumerate(lit) if (image != dark).any()]
        for index in range(FRAMES):
            if index % DECISIONS == 0 or any(ends):
                env.reset(seed=episode_seed(cfg.seed, EVALUATION, index))
            painter.paint(rng.uniform(np.min(boxes, 0)[0], np.max(boxes, 0)[1]))
            image, _, *ends, _ = env.step(rng.uniform(-1, 1, env.action_space.shape))
            images.append(image)
            factors.append([*painter.current[shown].flat, *data.qpos])
    groups, rgb = [painter.groups[i][0] for i in shown], ("red", "green", "blue")
    names = [f"{group} colour ({channel})" for group in groups for channel in rgb]
    names += [f"{joint.name} {i}".removesuffix(" 0")
              for joint in map(model.joint, range(model.njnt)) for i in range(len(joint.qpos0))]
    names, factors = np.array(names), np.array(factors)
    angles = 3 * len(shown) + model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]
    factors[:, angles] = np.angle(np.exp(1j * factors[:, angles]))
    varies = np.ptp(factors, 0) > 0
    return np.array(images), factors[:, varies], names[varies].tolist()

def disentanglement(codes, factors):
    """DCI (Eastwood & Williams 2018) and MIG (Chen et al. 2018, 20 bins), 1 is best; codes (N, Z),
    factors (N, K). Gradient boosting gives importance and, on the last quarter, held out, the R² of
    `informativeness`. Returns a dict of scores, and each latent's share of each R², (K, Z)."""
    from scipy.stats import entropy  # slow to import
    from sklearn.ensemble import GradientBoostingRegressor
    n, importance, r2, mutual = len(codes) * 3 // 4, [], [], []
    for factor in factors.T:
        trees = GradientBoostingRegressor(random_state=0).fit(codes[:n], factor[:n])
        importance.append(trees.feature_importances_ + 1e-12)
        r2.append([max(0.0, trees.score(codes[n:], factor[n:]))])
        tables = [np.histogram2d(factor, code, 20)[0] for code in codes.T]
        # I = H(factor) + H(code) − H(both); the first is in all of them, so not in their gap.
        shared = [entropy(table.sum(0)) - entropy(table.ravel()) for table in tables]
        mutual.append(np.sort(shared) / entropy(tables[0].sum(1)))
    of_latents = 1 - entropy(importance, base=max(2, factors.shape[1]), axis=0)       # (Z,)
    of_factors = 1 - entropy(importance, base=max(2, codes.shape[1]), axis=1)         # (K,)
    return dict(disentanglement=np.average(of_latents, weights=np.sum(importance, 0)),
                completeness=of_factors.mean(), informativeness=np.mean(r2),
                mig=np.ptp(np.array(mutual)[:, -2:], 1).mean()), np.multiply(importance, r2)

@torch.no_grad()
def measure(cfg, model, teacher, path):
    """Score encoders, print and write JSON. Returns what each latent of the model follows most."""
    images, factors, names = labelled_frames(cfg)
    torch.manual_seed(initial_seed(model.cfg, type(model)))                   # as training began
    start = type(model)(model.cfg, model.rssm.action_dim).to(cfg.device).encoder
    encoders = (dict(teacher=teacher) if teacher else {}) | dict(start=start, end=model.encoder)
    frames, result = torch.from_numpy(images).split(100), dict(task=cfg.dst, factors=names)
    for name, encoder in encoders.items():
        codes = torch.cat([encoder(preprocess(part.to(cfg.device)))[0].cpu() for part in frames])
        scores, share = disentanglement(codes.numpy(), factors)
        result[name] = scores | dict(share=share.tolist())
        print(f"{name:8}", *(f"{key} {value:.3f}" for key, value in scores.items()), sep="  ")
    path.write_text(json.dumps(result, indent=2) + "\n")
    return [f"{names[row.argmax()]} {row.max():.2f}" for row in share.T]

def draw_grid(pictures, rows, columns, path, title=""):
    """pictures (rows, columns, 64, 64, 3) as one labelled PNG."""
    from matplotlib.figure import Figure  # slow to import
    r, c = pictures.shape[:2]
    axes = Figure(figsize=(c * 0.75 + 1, r * 0.75 + 0.5)).subplots()
    axes.imshow(pictures.swapaxes(1, 2).reshape(r * 64, c * 64, 3))
    axes.set(title=title, frame_on=False, yticks=np.arange(r) * 64 + 32, yticklabels=rows,
             xticks=np.arange(c) * 64 + 32, xticklabels=columns)
    axes.tick_params(length=0, labeltop=True, labelbottom=False)
    axes.figure.savefig(path, dpi=100, bbox_inches="tight")
    print(f"wrote {path}")

def traverse(cfg, folder, metrics=False):
    """Draw latent traversals and open-loop predictions of a run, from the last of its episodes."""
    device, fields, teacher = torch.device(cfg.device), VIDEO, None
    _, model, _ = load_model(folder / "checkpoint.pt", device)
    if isinstance(model, Agent):
        fields, teacher, model = row_type(model.action_dim), model.teacher, model.model
    replay = Replay(folder / "episodes", fields)
    traversable = model.cfg.encoder == "beta_vae" and not isinstance(model.rssm, StackedRSSM)
    if metrics and not traversable:
        raise UserError(f"{folder} has no β-VAE latents to measure; traverse it without --metrics")
    if not replay.rows:
        raise UserError(f"no episodes in {replay.folder}; nothing to draw from")
    # From the middle of the last episode: the colours of the end, and a pose that is not the start.
    rows = replay.read(replay.paths[-1])
    rows = rows[len(rows) // 2:][:50]
    batch = to_device({key: np.array(rows[key])[None] for key in replay.dtype.names}, device)
    batch["is_first"][:, 0] = True
    torch.manual_seed(cfg.seed)
    strip = open_loop(model, batch)
    draw_grid(strip[:, ::4], ("truth", "model", "error"), range(0, strip.shape[1], 4),
              folder / "open_loop.png", "open-loop prediction: frames 5 … are predicted, not seen")
    if traversable:
        pictures, nats = latent_traversal(model, batch)
        order, path = np.argsort(-nats), folder / "disentanglement.json"      # informative first
        follows = measure(cfg, model, teacher, path) if metrics else [""] * len(nats)
        draw_grid(pictures[order], [f"z{i}  {nats[i]:.2f} nats  {follows[i]}" for i in order],
                  ["recon.", *TRAVERSAL], folder / "traversal.png")

def read_log(folder):
    """A run's metrics.jsonl → list of dicts. A line without its end, of a live run, is left out."""
    path = folder / "metrics.jsonl"
    with reading(path, "log of ours", "remove it"):
        rows = [json.loads(line) for line in path.read_bytes().split(b"\n")[:-1]]
        for row in rows:
            step = row["step" if "phase" in row else "update"]                # an agent's or not
            known = type(row.get("phase", "")) is str
            figures = step, row.get("eval_return", 0), row.get("eval_step", 0)
            if not (known and math.isfinite(sum(figures))):
                raise ValueError(f"step {step}")
    return rows

def curve_figures(runs, switch=None):
    """Interquartile means over seeds with bootstrap 95 % intervals, as rliable defines them.
    runs: {env step: evaluation return} of each seed; the steps that all share count. Returns
    [iqm, low, high], or [iqm] of one seed, of the curve, the mean of its last three points, its
    area by its length in steps, and the points just before and after the env step `switch`."""
    from scipy.stats import bootstrap, trim_mean  # slow to import
    steps = sorted(set.intersection(*map(set, runs)))
    if not steps:
        raise UserError("the seeds of a method share no evaluation step; name fewer runs to plot")
    values = np.array([[run[step] for step in steps] for run in runs])        # (seeds, steps)
    area = np.trapezoid(values, steps) / (steps[-1] - steps[0]) if steps[1:] else values[:, 0]
    figures = dict(curve=values, final=values[:, -3:].mean(1), area=area)
    if switch and steps[0] <= switch < steps[-1]:
        after = np.searchsorted(steps, switch, "right")
        figures |= dict(before=values[:, after - 1], after=values[:, after])
    iqm = functools.partial(trim_mean, proportiontocut=0.25)
    for name, values in figures.items():
        interval = bootstrap([values], iqm, n_resamples=50_000, batch=5000, method="percentile",
                             rng=0).confidence_interval if len(runs) > 1 else ()
        figures[name] = [estimate.tolist() for estimate in (iqm(values), *interval)]
    return dict(seeds=len(runs), steps=steps, switch=switch) | figures

def plot(cfg, folders, path):
    """Draw learning curves of runs.
    …/<tasks>/<method>/seed<k>; prints `curve_figures` and writes them beside the picture, JSON."""
    from matplotlib.figure import Figure  # slow to import
    curves, switches = {}, {}                 # {tasks: {method: [{step: return}]}}, {tasks: step}
    logs = sorted(Path(cfg.runs).glob("finetune/*/*/seed*/metrics.jsonl"))
    for folder in folders or [log.parent for log in logs]:
        rows = [row for row in read_log(folder) if "phase" in row]
        evaluated = [row for row in rows if "eval_return" in row]
        if curve := {row.get("eval_step", row["step"]): row["eval_return"] for row in evaluated}:
            tasks, method, _ = folder.resolve().parts[-3:]
            curves.setdefault(tasks, {}).setdefault(method, []).append(curve)
            last = {row["phase"]: row["step"] for row in rows}                # of each phase
            switches |= {tasks: last["train"]} if len(last) > 1 else {}
    if not curves:
        raise UserError("no evaluations to plot; run: python diswm.py finetune --dst walker_walk")
    figure, path = Figure(figsize=(5.5 * len(curves), 3.8)), path or Path(cfg.runs) / "curves"
    path = (path / "curves" if path.is_dir() else path).with_suffix(".png")
    panels = figure.subplots(1, len(curves), squeeze=False)[0]
    for axes, (tasks, methods) in zip(panels, curves.items(), strict=True):
        for method, runs in sorted(methods.items()):
            figures = methods[method] = curve_figures(runs, switches.get(tasks))
            (mean, *interval), steps = figures["curve"], figures["steps"]
            label = f"{method}, {len(runs)} seed{'s' if interval else ''}"
            line, = axes.plot(steps, mean, marker=".", label=label)
            if interval:
                axes.fill_between(steps, *interval, alpha=0.2, color=line.get_color())
            print(f"{tasks}: {label}", *(f"{name} {np.round(figures[name], 1).tolist()}"
                                         for name in CURVE if name in figures), sep=", ")
        if tasks in switches:
            axes.axvline(switches[tasks], color="gray", ls=":", label="the colours change")
        axes.set(title=re.sub(r"-(?!v\d)", " → ", tasks),                     # Hopper-v5
                 ylim=(min(0, axes.get_ylim()[0]), None),                     # pusher's are below
                 xlabel="env steps", ylabel="evaluation return")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)  # hides no curve
        axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100, bbox_inches="tight")
    path.with_suffix(".json").write_text(json.dumps(curves, indent=2) + "\n")
    print(f"wrote {path} and {path.stem}.json")

# === Doctor and bench =============================================================================

FAMILIES = ("walker_walk", "pusher", "drawer_open", "FetchReach-v4", "HalfCheetah-v5")

def machine(cfg):
    """What runs here, and on what."""
    versions = {m.__name__: m.__version__ for m in (torch, mujoco, gym, np)}
    return dict(device=cfg.device, precision=cfg.precision, threads=torch.get_num_threads(),
                gl=os.environ["MUJOCO_GL"], versions=versions | dict(python=sys.version.split()[0]))

def doctor(cfg):
    """Check rendering and versions.
    doctor.png: a frame of each family in each phase. Raises UserError, last, if one fails."""
    print(json.dumps(machine(cfg), indent=2))
    failed, path = [], Path(cfg.runs) / "doctor.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures = np.full((len(FAMILIES), len(PHASES), 64, 64, 3), 128, np.uint8)  # grey: has failed
    for row, task in zip(pictures, FAMILIES, strict=True):
        try:
            with config_env(cfg, task, "none") as env:
                row[:] = [env.reset(seed=cfg.seed, options=dict(phase=p))[0] for p in PHASES]
        except UserError as error:
            print(f"{task}: {error}")
            failed.append(task)
    draw_grid(pictures, FAMILIES, PHASES, path)
    if failed:
        raise UserError(f"{', '.join(failed)} cannot be rendered; the causes stand above")

def median_s(function, repeats):
    """Median wall time of a call, after one to warm up."""
    return np.median(timeit.repeat(function, number=1, repeat=repeats + 1)[1:])

def bench(cfg, as_json=False, scaling=False, repeats=5):
    """Time the steps, count the parameters.
    scaling: also an update at four batch sizes and horizons, and the exponent of its growth."""
    memory_needed(cfg)                                                        # or an error
    device, rng, result = torch.device(cfg.device), np.random.default_rng(0), machine(cfg)
    result |= {name: getattr(cfg, name) for name in ("method", "batch_size", "batch_length")}
    teacher = freeze(BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth).to(device)) if cfg.eta else None
    with config_env(cfg, cfg.dst, "none", pixels=False) as env:
        dims, = env.action_space.shape
    agent = Agent(cfg, dims, device, teacher)
    def update_s(learner, *args):
        data = replay.sample(learner.cfg.batch_size, learner.cfg.batch_length, rng)
        return median_s(lambda: check_finite(learner.update(data, *args)), max(1, repeats))
    with tempfile.TemporaryDirectory() as folder:
        replay = Replay(folder, row_type(dims, cfg.z_dim if teacher else 0))
        rows = [make_row(rng.integers(0, 256, (64, 64, 3), np.uint8), rng.uniform(-1, 1, dims))
                for _ in range(max(1000, cfg.batch_length))]
        replay.add(rows, **agent.taught(rows))
        del rows                                                              # 12 MB of the peak
        result["train_step_s"] = update_s(agent, cfg.eta, 1)
        result["peak_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        draw = functools.partial(replay.sample, cfg.batch_size, cfg.batch_length, rng)
        result["sample_ms"] = 1e3 * median_s(draw, 20)
        result["pretrain_step_s"] = update_s(VideoTrainer(cfg, None, device))
        for name in ("batch_size", "horizon") if scaling else ():
            sizes = [math.ceil(getattr(cfg, name) * part / 4) for part in (1, 2, 3, 4)]
            agents = [Agent(replace(cfg, **{name: size}), dims, device, teacher) for size in sizes]
            times = [update_s(each, cfg.eta, 1) for each in agents]
            growth = dict(exponent=float(np.polyfit(np.log(sizes), np.log(times), 1)[0]))
            result[f"{name}_scaling"] = dict(zip(map(str, sizes), times, strict=True)) | growth
    parts = dict(agent.behaviour.named_children(), world_model=agent.model, teacher=teacher)
    counts = {name: sum(p.numel() for p in m.parameters()) for name, m in parts.items() if m}
    result |= dict(params=counts | dict(total=sum(counts.values())), frame_ms={}, decision_ms={})
    for task in FAMILIES:
        with config_env(cfg, task, "train") as env:
            agent = Agent(cfg, *env.action_space.shape, device, teacher)
            seen = env.render()[None], np.zeros((1, agent.action_dim), np.float32), None
            result["frame_ms"][task] = 1e3 * median_s(env.render, 50)
            result["decision_ms"][task] = 1e3 * median_s(
                lambda env=env, agent=agent, seen=seen: env.step(agent.act(*seen, True)[0][0]), 50)
    print(json.dumps(result, indent=None if as_json else 2))

# === Command line =================================================================================

FRESH = {"--fresh": dict(action="store_true", help="start over instead of resuming")}
RUN = {"--run": dict(type=Path, required=True, help="folder of a run: runs/…/seed0")}
COMMANDS = dict(  # and the flags that their functions take after cfg, in that order
    collect=FRESH, pretrain=FRESH, finetune=FRESH, evaluate=RUN,
    traverse=RUN | {"--metrics": dict(action="store_true", help="also measure disentanglement")},
    plot={"run": dict(type=Path, nargs="*", help="folders of runs; default: all finetune runs"),
          "--out": dict(type=Path, help="PNG to write; default: curves.png in --runs")},
    doctor={},
    bench={"--json": dict(action="store_true", help="print one JSON object"),
           "--scaling": dict(action="store_true", help="how an update's cost grows"),
           "--repeats": dict(type=int, default=5, help="updates to take the median of")})

class Parser(argparse.ArgumentParser):
    """argparse whose errors are one line; that of an unknown flag lists what exists."""
    def error(self, message):
        flags = " ".join(a.option_strings[0] for a in self._actions[1:] if a.option_strings)
        hint = f"there are: {flags}" if "unrecognized" in message else f"see: {self.prog} --help"
        raise UserError(f"{message}; {hint}", code=2)

def parse_args(argv):
    """The command line → (function, Config, more arguments). Config: preset, then method, flags."""
    parser = Parser(prog="diswm.py", description="Disentangled World Models.", allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    fields = dataclasses.fields(Config)
    for name, own in COMMANDS.items():
        help = (globals()[name].__doc__ or name).split("\n")[0]              # -OO has none
        sub = commands.add_parser(name, help=help, description=help, allow_abbrev=False)
        sub.add_argument("--preset", choices=PRESETS, help="default: paper on CUDA, else small")
        for flag, options in (FRESH | own).items():
            sub.add_argument(flag, **options)
        for field in fields:
            meta, kind = field.metadata, type(field.default)
            choices = METHODS if field.name == "method" else meta["choices"]
            options = dict(action=argparse.BooleanOptionalAction) if kind is bool else dict(
                choices=choices, type=kind, metavar=None if choices else kind.__name__.upper())
            sub.add_argument("--" + field.name.strip("_").replace("_", "-"), dest=field.name,
                             default=argparse.SUPPRESS, **options,
                             help=f"{meta['help']}; paper preset: {field.default!r}")
    args, unknown = parser.parse_known_args(argv)
    args, sub, own = vars(args), commands.choices[args.command], COMMANDS[args.command]
    if unknown:
        sub.error(f"unrecognized arguments: {' '.join(unknown)}")
    given = {key: value for key, value in args.items() if key in Config.__dataclass_fields__}
    preset = args["preset"] or ("paper" if torch.cuda.is_available() else "small")
    if "--run" in own:  # as it was trained, but for what is given
        saved = read_checkpoint(args["run"] / "checkpoint.pt")["config"]
        known = {f.name: getattr(saved, f.name) for f in fields if not f.metadata["free"]}
    else:
        known = METHODS[given.get("method", "diswm")]
    try:
        cfg = replace(PRESETS[preset], **known | given)
    except ValueError as error:
        sub.error(str(error))
    if not args["preset"] and "--fresh" in own:
        print(f"preset {preset}; --preset chooses another: {', '.join(PRESETS)}")
    check_task(cfg.src)
    check_task(cfg.dst)
    return globals()[args["command"]], cfg, [args[flag.strip("-")] for flag in own]

def prepare_machine(cfg):
    """Decide what is "auto", and set torch up. Returns the Config with the decisions."""
    device = cfg.device.replace("auto", "cuda" if torch.cuda.is_available() else "cpu")
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("there is no CUDA device; use --device cpu")
    native = (torch.cuda.is_bf16_supported(including_emulation=False) if device == "cuda"
              else torch.cpu.get_capabilities().get("avx512_bf16"))
    precision = cfg.precision.replace("auto", "bf16" if native else "fp32")
    torch.set_num_threads(cfg.threads or len(os.sched_getaffinity(0)))
    if device == "cpu":  # what is too large fails as an error, and is not killed
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = MEMORY if soft == resource.RLIM_INFINITY else min(soft, MEMORY)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    map_apart(1 << 16)
    return replace(cfg, device=device, precision=precision)

def main(argv=None):
    """Run a command. A user's mistake is one line and exit code 1 or 2. Returns the exit code."""
    try:
        command, cfg, own = parse_args(argv)
        command(prepare_machine(cfg), *own)
        return 0
    except UserError as error:
        message, code = str(error), error.code
    except OSError as error:
        message, code = (f"{error.filename or 'output'}: {error.strerror or error}; mend that and "
                         "run the same command again, the last checkpoint is whole"), 1
    except (MemoryError, RuntimeError) as error:
        causes = repr((error, error.__context__))  # torch.save hides a MemoryError behind its own
        if not re.search("(?i)alloc|memory|overflow", causes):
            raise
        message, code = f"too large for the memory: {error}"[:200], 1
    except KeyboardInterrupt:
        message, code = "interrupted; the same command goes on from the last checkpoint", 130
    print("error:", " ".join(message.split()), file=sys.stderr)
    return code

if __name__ == "__main__":
    from diswm import main  # so that the processes of --envs find everything by its name
    sys.stdout.reconfigure(errors="backslashreplace")  # a Latin-1 terminal has no β
    sys.exit(main())
