"""DisWM: Disentangled World Models, the whole paper in one file.

    Wang et al., "Disentangled World Models: Learning to Transfer Semantic Knowledge from
    Distracting Videos for Reinforcement Learning", ICCV 2025. "Eq. (n)" is the paper's equation.

The idea. Videos of one task, in which the colours keep changing, are enough to learn *which things in
a picture vary independently*: a β-VAE inside an action-free video predictor finds latents for them.
An agent in a different task then learns its own world model from pixels, and its encoder is pulled
towards the frozen teacher's latents, strongly at first and ever less, while DreamerV2's actor-critic
learns behaviour inside that world model.

    collect    DreamerV2 in the distracting source task ──► episodes = the video set
    pretrain   videos ──► β-VAE video predictor, Eqs. (1), (2) ──► its encoder = the teacher
    finetune   target task ⇄ world model, Eqs. (4), (5) ◄── distillation, Eq. (3) ── teacher
               world model ──► imagination ──► actor, critic (appendix B)
    evaluate, traverse, plot    returns, latent traversals and open-loop predictions, learning curves

    python diswm.py pretrain --src cheetah_run     # collects first when there are no videos
    python diswm.py finetune --dst walker_walk

Symbols, as in the paper:

    o      image                        𝐳 (z)  β-VAE latent, 20 numbers      h (deter)  recurrent state
    a, r   action, reward               z_t (stoch)  stochastic state        s (feat)   [z_t, h_t]
    γ      discount                     q (post), p (prior)  of z_t          V          λ-return
    β, β₁, β₂, α, η  loss weights       π (actor), v (critic)                sg         stop-gradient

Shapes are written behind the lines where they change:

    B batch   T time in a window   H imagination horizon   Z latents   S stochastic   D deterministic
    A action  N = B·T imagined trajectories
"""

import argparse
import bisect
import contextlib
import ctypes
import dataclasses
import difflib
import io
import json
import math
import os
import pickle
import platform
import resource
import shutil
import statistics
import sys
import time
import weakref
import zipfile
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # unset on a headless machine, MuJoCo picks GLFW and dies

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn
from tqdm import tqdm

try:
    import mujoco
    from dm_control import suite
except (AttributeError, ImportError) as error:  # how a missing libEGL or libOSMesa shows
    sys.exit(f"error: MuJoCo cannot load OpenGL with MUJOCO_GL={os.environ['MUJOCO_GL']} ({error}); "
             "run: apt-get install libegl1 libgl1-mesa-dri   (or libosmesa6 and MUJOCO_GL=osmesa)")


class UserError(Exception):
    """A mistake that the user can mend: printed as one line; `code` is the exit status."""

    def __init__(self, message, code=1):
        super().__init__(message)
        self.code = code


# ======================================================================================================
# Config
# ======================================================================================================

def flag(default, help, *, low=None, choices=None, free=False):
    """A Config field that is also a command-line flag.

    low: smallest allowed value; choices: allowed values; free: may differ when a run is resumed,
    because it does not change what is computed.
    """
    return dataclasses.field(default=default, metadata=dict(help=help, low=low, choices=choices, free=free))


@dataclass(frozen=True)
class Config:
    """Everything that can be set; the defaults are the paper's (`--preset paper`).

    Each help text ends with the source: "table" is the paper's hyperparameter table, "published" the
    authors' configuration, "ours" a decision of this implementation. An *env step* is one simulator step, a
    *decision* one action of the agent, held for `action_repeat` env steps.
    """
    # What is run, and where it is kept.
    src: str = flag("cheetah_run", "task of the distracting videos (paper, Fig. 4a)")
    dst: str = flag("walker_walk", "target task (paper, Fig. 4a)")
    method: str = flag("diswm", "what is trained: the paper's method, a baseline or an ablation (paper)")
    seed: int = flag(0, "seed of everything random (ours)", low=0)
    runs: str = flag("runs", "folder of all runs (ours)", free=True)
    teacher: str = flag("", "checkpoint.pt of the teacher; empty: the --src teacher in --runs (ours)", free=True)
    videos: str = flag("", "folder of .npz episodes to pretrain on; empty: what collect made (ours)", free=True)

    # Environment (section 4, "Experimental Setups").
    action_repeat: int = flag(2, "env steps per decision (published)", low=1)
    time_limit: int = flag(0, "env steps per episode; 0: the task's own (ours)", low=0)
    colors: str = flag("published", "distractor colours: boxes around fixed centres, or around the original colours "
                       "(published; paper)", choices=("published", "original"))
    color_range: float = flag(0.2, "half width of a colour box, RGB in 0..1 (published)", low=0.0)
    color_step_std: float = flag(0.0, "std of the colours' random walk per decision; 0: fixed per episode (ours; "
                                 "published 0.2)", low=0.0)
    fast_render: bool = flag(False, "render without anti-aliasing, about twice as fast (ours)")

    # How long.
    steps: int = flag(1_000_000, "env steps of finetuning (paper)", low=1)
    collect_steps: int = flag(2_000_000, "env steps of collecting: 1M frames (paper)", low=1)
    pretrain_updates: int = flag(20_000, "updates of the video predictor (published)", low=1)
    prefill: int = flag(2500, "decisions with random actions before learning (published)", low=0)
    first_updates: int = flag(100, "updates right after prefill (published)", low=0)
    train_every: int = flag(5, "decisions per update (published)", low=1)
    switch: float = flag(0.5, "the colours change at this share of the steps; 1: never (paper)", low=0.0)
    eval_every: int = flag(10_000, "env steps between evaluations (published)", low=1)
    eval_episodes: int = flag(10, "episodes per evaluation (published)", low=1)
    replay_capacity: int = flag(1_000_000, "rows kept in the replay (published)", low=1)

    # World model, Eqs. (1), (2), (4), (5).
    encoder: str = flag("beta_vae", "image encoder and decoder (paper; conv is DreamerV2's)",
                        choices=("beta_vae", "conv"))
    z_dim: int = flag(20, "size of the β-VAE latent (table)", low=1)
    cnn_depth: int = flag(32, "channels of the first convolution (published)", low=1)
    stoch: int = flag(50, "size of the stochastic state (published)", low=1)
    deter: int = flag(200, "size of the deterministic state (published)", low=1)
    hidden: int = flag(200, "hidden units inside the RSSM (published)", low=1)
    units: int = flag(400, "hidden units of the heads, actor and critic (published)", low=1)
    batch_size: int = flag(50, "windows per batch, B (table)", low=1)
    batch_length: int = flag(50, "rows per window, T (table)", low=2)
    model_lr: float = flag(3e-4, "learning rate of the video predictor and the world model (table)", low=0.0)
    alpha: float = flag(1.0, "α, weight of the KL in Eq. (5) (table)", low=0.0)
    beta1: float = flag(1.0, "β₁, weight of the action-free KL in Eq. (2) (table)", low=0.0)
    beta: float = flag(0.015, "β, weight of the disentanglement loss in Eq. (5) (table)", low=0.0)
    beta2: float = flag(0.015, "β₂, weight of the disentanglement loss in Eq. (2) (table)", low=0.0)
    kl_balance: float = flag(0.8, "share of the KL's gradient that trains the prior (DreamerV2)", low=0.0)
    free_nats: float = flag(1.0, "nats below which the KL is not trained (published)", low=0.0)
    reward_scale: float = flag(2.0, "weight of the reward loss (published)", low=0.0)
    discount_scale: float = flag(1.0, "weight of the discount loss (ours)", low=0.0)

    # Distillation, Eq. (3). η counts decisions, prefill included.
    distill: str = flag("softmax", "KL between softmaxed latents, or between Gaussian posteriors (paper; ours)",
                        choices=("softmax", "gaussian"))
    eta: float = flag(0.1, "η at the start (table)", low=0.0)
    eta_end: float = flag(0.01, "η at the end (paper, section 3.4)", low=0.0)
    eta_decay: int = flag(50_000, "decisions: η = start · (1 − step / this), until it reaches its end (published)",
                          low=1)
    eta_delay: int = flag(0, "decisions before distillation starts; 50 000 across domains (published)", low=0)

    # Behaviour, appendix B.
    horizon: int = flag(15, "imagined transitions, H (table)", low=1)
    imagine_starts: int = flag(0, "posterior states to imagine from, drawn from the batch; 0: all (ours)", low=0)
    gamma: float = flag(0.99, "discount γ (table)", low=0.0)
    lambda_: float = flag(0.95, "λ of the λ-return (table)", low=0.0)
    rho: float = flag(1.0, "ρ: 1 dynamics backprop, 0 REINFORCE (published)", low=0.0)
    entropy_scale: float = flag(1e-4, "weight of the actor's entropy (published)", low=0.0)
    actor_lr: float = flag(8e-5, "learning rate of the actor (table)", low=0.0)
    critic_lr: float = flag(8e-5, "learning rate of the critic (table)", low=0.0)
    slow_every: int = flag(100, "updates between copies of the critic to the slow critic (published)", low=1)
    grad_clip: float = flag(100.0, "largest gradient norm of each optimiser (published)", low=0.0)

    # Machine.
    device: str = flag("auto", "auto, cpu or cuda (ours)", choices=("auto", "cpu", "cuda"), free=True)
    precision: str = flag("auto", "of convolutions and MLPs; auto: bf16 where the processor has it (ours)",
                          choices=("auto", "fp32", "bf16"), free=True)
    threads: int = flag(0, "CPU threads; 0: one per core (ours)", low=0, free=True)


PRESETS = {
    "paper": Config(),
    # The same algorithm for two CPU cores. With a batch five times smaller the model wants a larger learning
    # rate. η's clock shrinks with the run (a tenth) and η grows by 50 / 32, since Eq. (3) sums over the window.
    "small": Config(
        steps=100_000, collect_steps=20_000, pretrain_updates=1_000, prefill=1_000, fast_render=True,
        batch_size=16, batch_length=32, imagine_starts=256, model_lr=1e-3, cnn_depth=16, units=200,
        eta=0.156, eta_end=0.0156, eta_decay=5_000),
    # Seconds, for tests: everything happens, nothing is learnt.
    "debug": Config(
        steps=300, collect_steps=200, pretrain_updates=20, prefill=50, first_updates=2, train_every=10,
        eval_every=100, eval_episodes=2, time_limit=50, batch_size=3, batch_length=8, horizon=3,
        cnn_depth=4, stoch=6, deter=12, hidden=10, units=10, eta=0.6, eta_end=0.06, eta_decay=60,
        slow_every=5, threads=1),
}

# A method is a set of Config values and nothing else: all of them run through the same code.
METHODS = {
    "diswm": {},
    "no_distill": dict(eta=0.0, eta_end=0.0),                  # ablation: no latent distillation
    "no_disentangle": dict(beta=0.0, beta2=0.0),               # ablation: no β in either stage
    "dreamerv2": dict(encoder="conv", beta=0.0, beta2=0.0, eta=0.0, eta_end=0.0),
}


# ======================================================================================================
# Maths: pure functions of tensors
# ======================================================================================================

ACTION_LIMIT = 1 - 1e-6  # actions stay strictly inside (-1, 1)


def gaussian_kl(mean_p, std_p, mean_q, std_q):
    """KL[N(mean_p, std_p²) || N(mean_q, std_q²)] per dimension, nats; all arguments and the result (..., S)."""
    # log(σ_q / σ_p) + (σ_p² + (μ_p − μ_q)²) / (2 σ_q²) − ½
    return (std_q / std_p).log() + (std_p**2 + (mean_p - mean_q) ** 2) / (2 * std_q**2) - 0.5


def beta_vae_kl(mean, logvar):
    """The disentanglement loss of Eqs. (2), (5): KL[N(mean, exp(logvar)) || N(0, I)].

    mean, logvar: (..., Z). Returns (...,): nats, summed over the latent dimensions.
    """
    # ½ Σ (μ² + σ² − 1 − ln σ²)
    return 0.5 * (mean**2 + logvar.exp() - 1 - logvar).sum(-1)


def rssm_kl_loss(post, prior, balance=0.8, free_nats=1.0):
    """The KL loss between posterior and prior of Eqs. (2), (5), with DreamerV2's balancing and free nats.

        loss = balance · max(mean KL[sg(q) || p], free) + (1 − balance) · max(mean KL[q || sg(p)], free)

    post, prior: dicts with `mean` and `std`, (B, T, S). Returns (loss, value): a scalar and the plain KL, (B, T),
    in nats. Free nats act on the batch mean, as published; below them the loss is constant.
    """
    def kl(q, p):
        return gaussian_kl(q["mean"], q["std"], p["mean"], p["std"]).sum(-1)

    def fixed(dist):  # stop-gradient: this side is the target of the other
        return {"mean": dist["mean"].detach(), "std": dist["std"].detach()}

    value = kl(post, fixed(prior))                                            # (B, T), trains q
    prior_side = kl(fixed(post), prior).mean().clamp(min=free_nats)           # trains p
    post_side = value.mean().clamp(min=free_nats)
    return balance * prior_side + (1 - balance) * post_side, value


def distillation_loss(z_disen, z_task):
    """Latent distillation, Eq. (3): KL(z_disen || z_task) = Σ z_disen · log(z_disen / z_task).

    Both latents become probability vectors by a softmax over their dimensions, so that a shift of all dimensions
    by a constant changes nothing. z_disen (teacher), z_task: (B, T, Z), the samples. Returns a scalar in nats:
    summed over time, mean over the batch, the scale at which the paper's η was tuned.
    """
    log_teacher = z_disen.detach().log_softmax(-1)                            # the teacher is a fixed target
    log_task = z_task.log_softmax(-1)
    return (log_teacher.exp() * (log_teacher - log_task)).sum(-1).sum(-1).mean()


def gaussian_distillation_loss(teacher, task):
    """Eq. (3) between the two diagonal Gaussian posteriors instead (`--distill gaussian`, ours).

    teacher, task: dicts with `mean` and `logvar`, (B, T, Z). Same reduction as `distillation_loss`.
    """
    kl = gaussian_kl(teacher["mean"].detach(), (teacher["logvar"].detach() / 2).exp(),
                     task["mean"], (task["logvar"] / 2).exp())
    return kl.sum(-1).sum(-1).mean()


def eta_schedule(step, start=0.1, end=0.01, decay_steps=50_000, delay=0):
    """η after `step` agent decisions (section 3.4): 0 before `delay`, then falling linearly from start to end.

    It would reach 0 at delay + decay_steps, and rests at `end` from where it meets it (90 % of the way).
    """
    if step < delay:
        return 0.0
    # η = start · (1 − (step − delay) / decay), not below its end
    return max(start * (1 - (step - delay) / decay_steps), end)


def lambda_return(reward, value, discount, bootstrap, lambda_=0.95):
    """λ-target V_t (appendix B), the actor's objective and the critic's regression target.

        V_t = r_t + γ_t · ((1 − λ) · v_{t+1} + λ · V_{t+1}),    V_H = v_H = bootstrap

              t      0     1    …   H−1    H
         reward     r_0   r_1      r_{H−1}
          value     v_0   v_1      v_{H−1}  bootstrap
         return     V_0   V_1      V_{H−1}

    reward, value, discount: (H, ...) time-major; bootstrap: (...). Returns (H, ...).
    Differentiable in every argument: "dynamics backprop" flows through r, γ and v.
    """
    next_value = torch.cat([value[1:], bootstrap[None]])                      # v_{t+1}: (H, ...)
    returns, target = [], bootstrap
    for t in reversed(range(len(reward))):
        target = reward[t] + discount[t] * torch.lerp(next_value[t], target, lambda_)
        returns.append(target)
    return torch.stack(returns[::-1])                                         # back in time order


def squared_error(target, prediction):
    """−ln N(target; prediction, 1) without its constant ½ ln 2π, elementwise."""
    return 0.5 * (target - prediction) ** 2


def gaussian_sample(mean, std):
    """A reparameterised draw: the gradient reaches mean and std."""
    return mean + std * torch.randn_like(std)


def clip_action(action):
    """Clip into (-1, 1), passing the gradient straight through: a saturated action can still come back."""
    return action + (action.clamp(-ACTION_LIMIT, ACTION_LIMIT) - action).detach()


def normal_log_prob(x, mean, std):
    """ln N(x; mean, std²) summed over the last dimension, nats: (..., A) → (...,)."""
    return (-0.5 * ((x - mean) / std) ** 2 - std.log() - 0.5 * math.log(2 * math.pi)).sum(-1)


def normal_entropy(std):
    """Entropy of a diagonal normal, nats: (..., A) → (...,)."""
    return (std.log() + 0.5 * math.log(2 * math.pi * math.e)).sum(-1)


# ======================================================================================================
# Networks
# ======================================================================================================

def mlp(inputs, units, layers, outputs):
    """`layers` hidden layers of `units` with ELU, then a linear layer."""
    widths = [inputs] + [units] * layers
    hidden = [part for n, m in zip(widths, widths[1:], strict=False) for part in (nn.Linear(n, m), nn.ELU())]
    return nn.Sequential(*hidden, nn.Linear(widths[-1], outputs))


def bounded_std(x):
    """A standard deviation in (0.1, 2.1): 2 σ(x / 2) + 0.1."""
    return 2 * torch.sigmoid(x / 2) + 0.1


def kaiming(module):
    """Kaiming-normal weights and zero biases for the β-VAE's convolutions and linears (published)."""
    if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
        nn.init.kaiming_normal_(module.weight)
        nn.init.zeros_(module.bias)


def per_frame(net, x, dims):
    """Apply net to the last `dims` dimensions of x, with whatever stands before them as one batch."""
    lead = x.shape[: x.dim() - dims]
    return net(x.reshape(-1, *x.shape[x.dim() - dims:])).unflatten(0, lead)


def preprocess(image):
    """uint8 (..., 64, 64, 3) → float (..., 3, 64, 64) in [−0.5, 0.5]."""
    return image.movedim(-1, -3).float() / 255 - 0.5


class BetaVAEEncoder(nn.Module):
    """The β-VAE encoder e(o) of Eqs. (1), (4): image → mean and log-variance of the latent 𝐳."""

    def __init__(self, z_dim=20, depth=32):
        super().__init__()
        self.embed_dim = z_dim
        d = depth
        self.net = nn.Sequential(
            nn.Conv2d(3, d, 4, 2, 1), nn.ELU(),                               # 64 → 32
            nn.Conv2d(d, d, 4, 2, 1), nn.ELU(),                               # 16
            nn.Conv2d(d, 2 * d, 4, 2, 1), nn.ELU(),                           # 8
            nn.Conv2d(2 * d, 2 * d, 4, 2, 1), nn.ELU(),                       # 4
            nn.Conv2d(2 * d, 8 * d, 4), nn.ELU(),                             # 1
            nn.Flatten(), nn.Linear(8 * d, 2 * z_dim))
        self.apply(kaiming)

    def forward(self, image):
        """image (..., 3, 64, 64) → mean, logvar, each (..., Z), fp32."""
        return per_frame(self.net, image, 3).float().chunk(2, -1)


class BetaVAEDecoder(nn.Module):
    """The decoder of Eqs. (1), (4): feat → image mean, through a bottleneck as narrow as 𝐳 (published)."""

    def __init__(self, feat_dim, z_dim=20, depth=32):
        super().__init__()
        d = depth
        self.net = nn.Sequential(
            nn.Linear(feat_dim, z_dim), nn.ELU(), nn.Linear(z_dim, 8 * d), nn.ELU(),
            nn.Unflatten(-1, (8 * d, 1, 1)),
            nn.ConvTranspose2d(8 * d, 2 * d, 4), nn.ELU(),                    # 1 → 4
            nn.ConvTranspose2d(2 * d, 2 * d, 4, 2, 1), nn.ELU(),              # 8
            nn.ConvTranspose2d(2 * d, d, 4, 2, 1), nn.ELU(),                  # 16
            nn.ConvTranspose2d(d, d, 4, 2, 1), nn.ELU(),                      # 32
            nn.ConvTranspose2d(d, 3, 4, 2, 1))                                # 64
        self.apply(kaiming)

    def forward(self, feat):
        """feat (..., S + D) → (..., 3, 64, 64) in about [−0.5, 0.5], fp32."""
        return per_frame(self.net, feat, 1).float()


class ConvEncoder(nn.Module):
    """DreamerV2's encoder for the baselines: four convolutions, no distribution."""

    def __init__(self, depth=32):
        super().__init__()
        self.embed_dim = 32 * depth                                           # 8·depth channels of 2 × 2
        d = depth
        self.net = nn.Sequential(
            nn.Conv2d(3, d, 4, 2), nn.ELU(), nn.Conv2d(d, 2 * d, 4, 2), nn.ELU(),
            nn.Conv2d(2 * d, 4 * d, 4, 2), nn.ELU(), nn.Conv2d(4 * d, 8 * d, 4, 2), nn.ELU(), nn.Flatten())

    def forward(self, image):
        """image (..., 3, 64, 64) → embed (..., 32·depth), fp32."""
        return per_frame(self.net, image, 3).float()


class ConvDecoder(nn.Module):
    """DreamerV2's decoder for the baselines: kernels 5, 5, 6, 6."""

    def __init__(self, feat_dim, depth=32):
        super().__init__()
        d = depth
        self.net = nn.Sequential(
            nn.Linear(feat_dim, 32 * d), nn.Unflatten(-1, (32 * d, 1, 1)),
            nn.ConvTranspose2d(32 * d, 4 * d, 5, 2), nn.ELU(), nn.ConvTranspose2d(4 * d, 2 * d, 5, 2), nn.ELU(),
            nn.ConvTranspose2d(2 * d, d, 6, 2), nn.ELU(), nn.ConvTranspose2d(d, 3, 6, 2))

    def forward(self, feat):
        """feat (..., S + D) → (..., 3, 64, 64), fp32."""
        return per_frame(self.net, feat, 1).float()


class RSSM(nn.Module):
    """Recurrent state-space model with Gaussian states; with action_dim=0 the action-free one of Eq. (1).

        h_t = f(h_{t−1}, z_{t−1}, a_{t−1})      z_t ~ q(z_t | h_t, embed_t)      ẑ_t ~ p(ẑ_t | h_t)

    A state is a dict with `deter` h (..., D), `stoch` z, and the `mean` and `std` it was drawn from (..., S).

    What lines up in a window (also the rows of the replay):

           row t        0           1        …
        image           o_0         o_1
        action          0           a that led to o_1      (the paper's a_{t−1})
        reward          0           r that came with o_1
        is_first        1           0                      (forgets h, z *and* the action)
        post            s_0         s_1
    """

    def __init__(self, action_dim, embed_dim, stoch=50, deter=200, hidden=200):
        super().__init__()
        self.stoch_dim, self.deter_dim, self.action_dim = stoch, deter, action_dim
        self.inputs = nn.Sequential(nn.Linear(stoch + action_dim, hidden), nn.ELU())
        self.gru = nn.Linear(hidden + deter, 3 * deter)
        self.norm = nn.LayerNorm(3 * deter)
        self.prior_net = mlp(deter, hidden, 1, 2 * stoch)
        self.post_net = mlp(deter + embed_dim, hidden, 1, 2 * stoch)

    @staticmethod
    def feat(state):
        """What heads, actor and critic see: [z_t, h_t], (..., S + D)."""
        return torch.cat([state["stoch"], state["deter"]], -1)

    def initial(self, batch):
        """The zero state for a batch."""
        zeros = self.norm.weight.new_zeros
        sizes = dict(deter=self.deter_dim, stoch=self.stoch_dim, mean=self.stoch_dim, std=self.stoch_dim)
        return {key: zeros(batch, size) for key, size in sizes.items()}

    def recur(self, state, action):
        """h_t = f(h_{t−1}, z_{t−1}, a_{t−1}): a GRU cell with layer norm. action: (B, A), or None if action-free."""
        x = state["stoch"] if self.action_dim == 0 else torch.cat([state["stoch"], action], -1)
        deter = state["deter"]
        gates = self.norm(self.gru(torch.cat([self.inputs(x), deter], -1)).float())
        reset, candidate, update = gates.chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        return torch.lerp(deter, candidate, torch.sigmoid(update - 1))        # (B, D)

    def draw(self, net, inputs, deter):
        """A state around h_t: its distribution from `net`, and a sample."""
        mean, std = net(inputs).float().chunk(2, -1)
        std = bounded_std(std)
        return dict(deter=deter, mean=mean, std=std, stoch=gaussian_sample(mean, std))

    def prior(self, deter):
        """ẑ_t ~ p(ẑ_t | h_t)."""
        return self.draw(self.prior_net, deter, deter)

    def posterior(self, deter, embed):
        """z_t ~ q(z_t | h_t, embed_t); embed: (..., Z), the sampled β-VAE latent."""
        return self.draw(self.post_net, torch.cat([deter, embed], -1), deter)

    def step(self, state, action, embed, is_first):
        """One filtering step. is_first (B,): where true, the previous state and action are forgotten."""
        keep = 1 - is_first.to(embed.dtype)[:, None]
        state = {key: value * keep for key, value in state.items()}
        deter = self.recur(state, None if self.action_dim == 0 else action * keep)
        return self.posterior(deter, embed)

    def observe(self, embed, action, is_first):
        """Filter whole windows. embed (B, T, Z), action (B, T, A), is_first (B, T) → post, prior, (B, T, ·)."""
        state, states = self.initial(len(embed)), []
        for t in range(embed.shape[1]):
            state = self.step(state, None if self.action_dim == 0 else action[:, t], embed[:, t], is_first[:, t])
            states.append(state)
        post = {key: torch.stack([s[key] for s in states], 1) for key in state}
        return post, self.prior(post["deter"])                                # the priors of all steps at once


# ======================================================================================================
# Video predictor and world model
# ======================================================================================================

class VideoPredictor(nn.Module):
    """The action-free video prediction model of Eq. (1), trained by Eq. (2)."""

    def __init__(self, cfg, action_dim=0):
        super().__init__()
        if cfg.encoder == "beta_vae":
            self.encoder = BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth)
            self.decoder = BetaVAEDecoder(cfg.stoch + cfg.deter, cfg.z_dim, cfg.cnn_depth)
        else:
            self.encoder = ConvEncoder(cfg.cnn_depth)
            self.decoder = ConvDecoder(cfg.stoch + cfg.deter, cfg.cnn_depth)
        self.rssm = RSSM(action_dim, self.encoder.embed_dim, cfg.stoch, cfg.deter, cfg.hidden)
        self.cfg, self.kl_scale, self.beta = cfg, cfg.beta1, cfg.beta2

    def encode(self, image):
        """image (..., 3, 64, 64) → embed and code.

        For the β-VAE: embed is the sampled 𝐳 (..., Z), code its {mean, logvar}. DreamerV2's encoder has no code: {}.
        """
        if not isinstance(self.encoder, BetaVAEEncoder):
            return self.encoder(image), {}
        mean, logvar = self.encoder(image)
        return gaussian_sample(mean, (logvar / 2).exp()), dict(mean=mean, logvar=logvar)

    def forward(self, batch):
        """Filter a batch (`image` preprocessed) → dict with embed, code, post, prior, feat."""
        embed, code = self.encode(batch["image"])
        post, prior = self.rssm.observe(embed, batch.get("action"), batch["is_first"])
        return dict(embed=embed, code=code, post=post, prior=prior, feat=self.rssm.feat(post))

    def loss(self, out, batch):
        """Eq. (2) for the output `out` of forward. Returns (loss, metrics): nats, mean over batch and time."""
        cfg = self.cfg
        # −ln p(o_t | z_t): sum over pixels. The target stays fp32: rounding it to bf16 would shift the loss.
        image = squared_error(batch["image"], self.decoder(out["feat"])).sum((-3, -2, -1))      # (B, T)
        kl_loss, kl = rssm_kl_loss(out["post"], out["prior"], cfg.kl_balance, cfg.free_nats)    # kl: (B, T)
        loss = image.mean() + self.kl_scale * kl_loss
        metrics = dict(image=image.mean(), kl=kl.mean(), kl_loss=kl_loss,
                       post_entropy=normal_entropy(out["post"]["std"]).mean(),
                       prior_entropy=normal_entropy(out["prior"]["std"]).mean())
        if out["code"]:
            disentangle = beta_vae_kl(**out["code"]).mean()
            loss = loss + self.beta * disentangle
            metrics["disentangle"] = disentangle
        return loss, metrics


class WorldModel(VideoPredictor):
    """The action-conditioned world model of Eq. (4), trained by Eq. (5): Eq. (1) with actions and two heads."""

    def __init__(self, cfg, action_dim):
        super().__init__(cfg, action_dim)
        self.kl_scale, self.beta = cfg.alpha, cfg.beta
        self.reward = mlp(cfg.stoch + cfg.deter, cfg.units, 2, 1)
        self.discount = mlp(cfg.stoch + cfg.deter, cfg.units, 3, 1)

    def predict_reward(self, feat):
        """r̂: (..., S + D) → (...,), the mean of a unit Gaussian, fp32."""
        return self.reward(feat).squeeze(-1).float()

    def predict_discount(self, feat):
        """Logit of γ̂: (..., S + D) → (...,), fp32."""
        return self.discount(feat).squeeze(-1).float()

    def loss(self, out, batch, teacher=None, eta=0.0):
        """Eq. (5). teacher: {embed, mean, logvar} of the same images from the frozen teacher, or None."""
        cfg = self.cfg
        loss, metrics = super().loss(out, batch)
        reward = squared_error(batch["reward"], self.predict_reward(out["feat"])).mean()
        # DEVIATION: the discount head of Eq. (4) is trained; the published code switches it off.
        soft_target = cfg.gamma * batch["discount"]                           # γ · (1 − terminal)
        discount = F.binary_cross_entropy_with_logits(self.predict_discount(out["feat"]), soft_target)
        loss = loss + cfg.reward_scale * reward + cfg.discount_scale * discount
        metrics |= dict(reward=reward, discount=discount, eta=torch.tensor(eta))
        if teacher is not None:
            if cfg.distill == "softmax":
                distill = distillation_loss(teacher["embed"], out["embed"])
            else:
                distill = gaussian_distillation_loss(teacher, out["code"])
            loss = loss + eta * distill
            metrics["distill"] = distill
        return loss, metrics


# ======================================================================================================
# Actor-critic: behaviour learning in imagination, appendix B
# ======================================================================================================

class ActorCritic(nn.Module):
    """Actor π(a | s), critic v(s), and a slow copy of the critic that gives the targets."""

    def __init__(self, cfg, action_dim):
        super().__init__()
        feat_dim = cfg.stoch + cfg.deter
        self.cfg = cfg
        self.actor = mlp(feat_dim, cfg.units, 4, 2 * action_dim)
        self.critic = mlp(feat_dim, cfg.units, 3, 1)
        self.slow_critic = mlp(feat_dim, cfg.units, 3, 1)
        self.slow_critic.requires_grad_(False)                                # copied, never trained
        self.copy_critic()

    def copy_critic(self):
        """Slow critic ← critic."""
        self.slow_critic.load_state_dict(self.critic.state_dict())

    def policy(self, feat):
        """feat (..., S + D) → mean, std of the normal that actions are drawn from, (..., A); mean in (−1, 1)."""
        mean, std = self.actor(feat).float().chunk(2, -1)
        return torch.tanh(mean), bounded_std(std)

    def value(self, feat, slow=False):
        """v(s): (..., S + D) → (...,), fp32."""
        return (self.slow_critic if slow else self.critic)(feat).squeeze(-1).float()

    def imagine(self, model, start):
        """Follow the policy through the world model's prior for H transitions from N detached states.

              t        0     1    …   H−1    H
            feat      s_0   s_1      s_{H−1}  s_H       s_0 a posterior, the others imagined
          action      a_0   a_1      a_{H−1}            a_t is taken in s_t and leads to s_{t+1}
          reward      r_0   r_1      r_{H−1}            r̂(s_t)
        discount      γ_0   γ_1      γ_{H−1}            γ̂(s_t)

        Returns feats (H + 1, N, S + D), log_prob and entropy (H, N).
        """
        state, feats, log_probs, entropies = start, [model.rssm.feat(start)], [], []
        for _ in range(self.cfg.horizon):
            # The policy sees the state as given: its gradient comes from where its action leads.
            mean, std = self.policy(feats[-1].detach())
            raw = gaussian_sample(mean, std)
            log_probs.append(normal_log_prob(raw.detach(), mean, std))        # REINFORCE: a is data
            entropies.append(normal_entropy(std))
            state = model.rssm.prior(model.rssm.recur(state, clip_action(raw)))
            feats.append(model.rssm.feat(state))
        return torch.stack(feats), torch.stack(log_probs), torch.stack(entropies)

    def losses(self, model, start, start_discount):
        """Losses of actor and critic. start: dict of (N, ·) detached states; start_discount (N,): true γ_0.

        Returns (actor_loss, critic_loss, metrics). Their gradients must be taken for the actor's and the critic's
        parameters only: the graph runs through the world model, which is *not* trained here.
        """
        cfg = self.cfg
        feats, log_prob, entropy = self.imagine(model, start)
        reward = model.predict_reward(feats[:-1])                             # (H, N)
        discount = torch.sigmoid(model.predict_discount(feats[:-1]))
        discount = torch.cat([start_discount[None], discount[1:]])            # the first one is known
        value = self.value(feats, slow=True)                                  # (H + 1, N)
        target = lambda_return(reward, value[:-1], discount, value[-1], cfg.lambda_)
        # w_t = Π_{i<t} γ_i: how likely the episode still runs; a weight, not a thing to be optimised.
        weight = torch.cat([torch.ones_like(discount[:1]), discount[:-1]]).cumprod(0).detach()

        fixed_feats, fixed_target = feats[:-1].detach(), target.detach()      # regression, not control
        value = self.value(fixed_feats)
        critic_loss = (weight * squared_error(fixed_target, value)).mean()
        advantage = fixed_target - value.detach()                             # a weight of ln π, no path of its own
        # ρ V_t + (1 − ρ) ln π(a_t | s_t) sg(V_t − v(s_t)) + entropy
        objective = cfg.rho * target + (1 - cfg.rho) * log_prob * advantage + cfg.entropy_scale * entropy
        actor_loss = -(weight * objective).mean()
        return actor_loss, critic_loss, dict(
            actor=actor_loss, critic=critic_loss, actor_entropy=entropy.mean(), imagined_reward=reward.mean(),
            imagined_return=target.mean(), value=value.mean())


class Agent:
    """World model, actor-critic, frozen teacher and their optimisers: what a finetuning run trains and saves."""

    def __init__(self, cfg, action_dim, device, teacher=None):
        self.cfg, self.action_dim, self.device = cfg, action_dim, device
        self.model = WorldModel(cfg, action_dim).to(device)
        self.behaviour = ActorCritic(cfg, action_dim).to(device)
        self.teacher = teacher
        self.optimizers = dict(
            model=adam(self.model, cfg.model_lr),
            actor=adam(self.behaviour.actor, cfg.actor_lr),
            critic=adam(self.behaviour.critic, cfg.critic_lr))

    @torch.no_grad()
    def act(self, image, action, state, explore):
        """One decision. image: uint8 (N, 64, 64, 3); action: the previous one, (N, A); state: None at an episode's start.

        explore: sample the actor; else its mode, tanh(m). Returns action (numpy (N, A)) and the next state.
        """
        is_first = torch.full((len(image),), state is None, device=self.device)
        state = self.model.rssm.initial(len(image)) if state is None else state
        embed, _ = self.model.encode(preprocess(torch.as_tensor(image, device=self.device)))
        state = self.model.rssm.step(state, torch.as_tensor(action, device=self.device), embed, is_first)
        mean, std = self.behaviour.policy(self.model.rssm.feat(state))
        action = clip_action(gaussian_sample(mean, std) if explore else mean)
        return action.cpu().numpy(), state

    def update(self, batch, eta, update, probe=False):
        """One gradient step of everything on a batch of numpy arrays (B, T, ...). Returns metrics.

        update: index of this step; probe: also measure the distillation term's own gradient at the encoder.
        """
        batch = to_device(batch, self.device)
        with autocast(self.cfg, self.device):
            teacher = None
            if self.teacher is not None:
                with torch.no_grad():                                         # its knowledge is fixed (section 3.3)
                    mean, logvar = self.teacher(batch["image"])
                    teacher = dict(embed=gaussian_sample(mean, (logvar / 2).exp()), mean=mean, logvar=logvar)
            out = self.model(batch)
            model_loss, metrics = self.model.loss(out, batch, teacher, eta)
        if probe and teacher is not None:
            grads = torch.autograd.grad(eta * metrics["distill"], list(self.model.encoder.parameters()), retain_graph=True)
            metrics["distill_grad_norm"] = torch.stack([g.norm() for g in grads]).norm()
        metrics["model_grad_norm"] = gradient_step(self.optimizers["model"], model_loss, metrics, self.cfg.grad_clip)

        if update % self.cfg.slow_every == 0:
            self.behaviour.copy_critic()
        start = {key: value.detach().flatten(0, 1) for key, value in out["post"].items()}       # (N, ·): all states
        start_discount = self.cfg.gamma * batch["discount"].flatten()
        if self.cfg.imagine_starts:
            chosen = torch.randperm(len(start_discount), device=self.device)[: self.cfg.imagine_starts]
            start, start_discount = {key: value[chosen] for key, value in start.items()}, start_discount[chosen]
        with autocast(self.cfg, self.device):
            actor_loss, critic_loss, more = self.behaviour.losses(self.model, start, start_discount)
        metrics |= more
        for name, loss in (("actor", actor_loss), ("critic", critic_loss)):
            metrics[f"{name}_grad_norm"] = gradient_step(self.optimizers[name], loss, metrics, self.cfg.grad_clip)
        return {key: value.detach() for key, value in metrics.items()}

    def state_dict(self):
        """Everything that a step changes, and the teacher, so that a run needs no other file."""
        return dict(
            model=self.model.state_dict(), behaviour=self.behaviour.state_dict(),
            optimizers={name: optimizer.state_dict() for name, optimizer in self.optimizers.items()})

    def load_state_dict(self, state):
        """The inverse of state_dict (the teacher is given at construction)."""
        self.model.load_state_dict(state["model"])
        self.behaviour.load_state_dict(state["behaviour"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])


def adam(module, lr):
    """The paper's optimiser for a module's parameters."""
    return torch.optim.Adam(module.parameters(), lr=lr, eps=1e-5)


def gradient_step(optimizer, loss, metrics, clip):
    """Minimise loss over the optimiser's parameters, and only them. Returns the gradient norm before clipping.

    Raises UserError at a non-finite loss or gradient, before anything is changed.
    """
    parameters = optimizer.param_groups[0]["params"]
    optimizer.zero_grad()
    loss.backward(inputs=parameters)  # nothing else gets a gradient: the graph of the actor runs through the model
    norm = nn.utils.clip_grad_norm_(parameters, clip)
    if not torch.isfinite(loss + norm):
        bad = [key for key, value in metrics.items() if not torch.isfinite(value).all()]
        raise UserError(f"non-finite loss or gradient ({', '.join(bad) or 'gradient norm'}); nothing was saved over the last "
                        "checkpoint; try a smaller --model-lr, or --precision fp32")
    optimizer.step()
    return norm


def autocast(cfg, device):
    """bf16 around convolutions and MLPs; statistics, GRU state and losses are brought back to fp32 by hand."""
    return torch.autocast(device.type, torch.bfloat16, enabled=cfg.precision == "bf16")


def to_device(batch, device):
    """numpy arrays → tensors on the device, images preprocessed, flags as floats where they are multiplied."""
    batch = {key: torch.from_numpy(value).to(device, non_blocking=True) for key, value in batch.items()}
    return batch | {"image": preprocess(batch["image"])}


# ======================================================================================================
# Replay and video sets: episodes on disk
# ======================================================================================================

# One row of an episode: the image and what led to it (see RSSM for how rows line up).
ROW_DTYPES = dict(image=np.uint8, action=np.float32, reward=np.float32, discount=np.float32,
                  is_first=np.bool_, is_terminal=np.bool_)


def make_row(image, action, reward=0.0, terminal=False, first=False):
    """One row for an episode; the first one has a zero action and no reward."""
    return dict(image=image, action=action, reward=reward, discount=1.0 - terminal, is_first=first,
                is_terminal=terminal)


@contextlib.contextmanager
def atomic(path):
    """Write a file whole or not at all: yields a binary file that takes its place when the block ends well."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def npz_layout(path):
    """Where the arrays of an .npz lie in the file: {key: (byte offset, dtype, shape)}; offset None if compressed.

    Raises UserError for anything that is not a whole .npz of plain arrays.
    """
    layout = {}
    try:
        with zipfile.ZipFile(path) as archive, open(path, "rb") as file:
            for info in archive.infolist():
                with archive.open(info) as member:
                    np.lib.format.read_magic(member)
                    shape, fortran_order, dtype = np.lib.format.read_array_header_1_0(member)
                    header = member.tell()
                if fortran_order or dtype.hasobject:
                    raise ValueError(f"{info.filename} is not a plain array")
                file.seek(info.header_offset + 26)                            # behind the local header lie two lengths,
                name, extra = np.frombuffer(file.read(4), "<u2")              # then a name and an extra field
                stored = info.compress_type == zipfile.ZIP_STORED
                offset = info.header_offset + 30 + int(name) + int(extra) + header if stored else None
                layout[info.filename.removesuffix(".npy")] = (offset, dtype, shape)
    except (zipfile.BadZipFile, ValueError, EOFError, NotImplementedError) as error:
        raise UserError(f"{path} is not a readable episode ({error}); remove it and run the command again") from None
    return layout


def check_episode(path, layout, keys):
    """UserError unless the arrays `keys` are there, one row each, and images are uint8 (T, 64, 64, 3)."""
    for key in keys:
        if key not in layout:
            raise UserError(f"{path} has no '{key}' array; an episode needs {', '.join(keys)}")
    _, dtype, shape = layout["image"]
    if dtype != np.uint8 or len(shape) != 4 or shape[1:] != (64, 64, 3):
        raise UserError(f"{path}: image is {dtype} {shape}, but must be uint8 (T, 64, 64, 3)")
    for key in keys:
        if len(layout[key][2]) == 0 or layout[key][2][0] != shape[0]:
            raise UserError(f"{path}: '{key}' has shape {layout[key][2]} for {shape[0]} images")


class Replay:
    """Finished episodes, a file each, laid end to end; windows start uniformly anywhere.

    Only an index lives in memory; `sample` reads just the rows of its windows. A file is an uncompressed .npz:
    `np.load` opens it, and the rows of an array lie in it one after the other.

        episodes    ┌──────── 0 ────────┐┌──── 1 ────┐┌─────── 2 ──────
        rows        F . . . . . . . . . .F . . . . . .F . . . . . . . .      F: is_first
        a window                [. . . . . . F . . .]
    """

    def __init__(self, folder, capacity=None, keys=tuple(ROW_DTYPES)):
        self.folder, self.capacity, self.keys = Path(folder), capacity, keys
        self.paths, self.layouts, self.ends = [], [], []                      # ends: row behind each episode
        self.next_index = 0
        for path in sorted(self.folder.glob("*.npz")):
            self._append(path)

    @property
    def rows(self):
        """Number of rows of all episodes."""
        return self.ends[-1] if self.ends else 0

    def _append(self, path):
        layout = npz_layout(path)
        check_episode(path, layout, self.keys)
        self.paths.append(path)
        self.layouts.append(layout)
        self.ends.append(self.rows + layout["image"][2][0])
        self.next_index = len(self.paths) if not path.stem.isdigit() else int(path.stem) + 1

    def add(self, rows):
        """Append a finished episode (a list of `make_row`); drop the oldest ones beyond capacity from the index."""
        episode = {key: np.array([row[key] for row in rows], dtype) for key, dtype in ROW_DTYPES.items()}
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{self.next_index:06d}.npz"
        with atomic(path) as file:
            np.savez(file, **episode)
        self._append(path)
        while self.capacity and self.rows - self._length(0) >= self.capacity:
            length = self._length(0)
            del self.paths[0], self.layouts[0], self.ends[0]
            self.ends = [end - length for end in self.ends]

    def _length(self, index):
        return self.layouts[index]["image"][2][0]

    def prune(self):
        """Delete the files that the index has dropped: call it once a checkpoint no longer needs them."""
        kept = set(self.paths)
        for path in self.folder.glob("*.npz"):
            if path not in kept:
                path.unlink()

    def state_dict(self):
        """Which episodes there are: the names of the first and of the one to come."""
        return dict(first=int(self.paths[0].stem) if self.paths else self.next_index, next=self.next_index)

    def load_state_dict(self, state):
        """Go back to the episodes of `state`; files of later ones (a run cut off before its checkpoint) are deleted."""
        kept = [path for path in self.paths if state["first"] <= int(path.stem) < state["next"]]
        if len(kept) != state["next"] - state["first"]:
            raise UserError(f"{self.folder} holds {len(kept)} of the checkpoint's {state['next'] - state['first']} episodes; "
                            "start over with --fresh")
        self.paths, self.layouts, self.ends = [], [], []
        for path in kept:
            self._append(path)
        self.next_index = state["next"]
        self.prune()

    def window(self, start, length):
        """Rows start … start + length − 1 of all episodes laid end to end, as a dict of arrays (T, ...)."""
        pieces = {key: [] for key in self.keys}
        while length > 0:
            index = bisect.bisect_right(self.ends, start)
            row = start - (self.ends[index] - self._length(index))            # within its episode
            count = min(length, self._length(index) - row)
            with open(self.paths[index], "rb") as file:
                for key in self.keys:
                    offset, dtype, shape = self.layouts[index][key]
                    width = math.prod(shape[1:])
                    file.seek(offset + row * width * dtype.itemsize)
                    piece = np.fromfile(file, dtype, count * width)
                    pieces[key].append(piece.reshape(count, *shape[1:]))
            start, length = start + count, length - count
        return {key: np.concatenate(piece) for key, piece in pieces.items()}

    def sample(self, batch_size, length, rng):
        """A batch of windows: dict of arrays (B, T, ...). Each window's first row counts as `is_first`."""
        starts = rng.integers(0, self.rows - length + 1, batch_size)
        windows = [self.window(int(start), length) for start in starts]
        batch = {key: np.stack([window[key] for window in windows]) for key in self.keys}
        batch["is_first"][:, 0] = True
        return batch


VIDEO_KEYS = ("image", "is_first")  # all that a video predictor may see: no actions, no rewards


def open_videos(folder, cache):
    """A folder of .npz episodes → Replay of images. Foreign ones (compressed, or without is_first) are unpacked once.

    The authors' episodes hold `image` uint8 (T, 64, 64, 3), `action`, `reward`, `discount`. cache: where the
    unpacked copies go.
    """
    paths = sorted(Path(folder).glob("*.npz"))
    if not paths:
        raise UserError(f"no episodes (*.npz) in {folder}; run: python diswm.py collect --src TASK, or give --videos FOLDER")
    layouts = {path: npz_layout(path) for path in paths}
    for path, layout in layouts.items():
        check_episode(path, layout, ("image",))
    if all("is_first" in layout and layout["image"][0] is not None for layout in layouts.values()):
        return Replay(folder, keys=VIDEO_KEYS)
    cache.mkdir(parents=True, exist_ok=True)
    for path, layout in layouts.items():
        if not (cache / path.name).exists():
            with np.load(path, allow_pickle=False) as episode, atomic(cache / path.name) as file:
                np.savez(file, image=episode["image"], is_first=np.arange(layout["image"][2][0]) == 0)
    return Replay(cache, keys=VIDEO_KEYS)


# ======================================================================================================
# Environments
# ======================================================================================================

TASKS = {f"{domain}_{task}": (domain, task) for domain, task in suite.ALL_TASKS}

# Centres of the published colour boxes.
COLOR_CENTERS = dict(train=(0.7, 0.3, 0.5), shifted=(0.5, 0.7, 0.3))


class DMControlEnv(gym.Env):
    """One task of dm_control.suite as a gymnasium.Env with a flat state observation."""

    def __init__(self, domain, task):
        self.env = suite.load(domain, task, environment_kwargs=dict(flat_observation=True))
        spec, size = self.env.action_spec(), self.env.observation_spec()["observations"].shape
        self.action_space = gym.spaces.Box(spec.minimum.astype(np.float32), spec.maximum.astype(np.float32))
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, size, np.float64)

    @property
    def model(self):
        """The raw mujoco.MjModel."""
        return self.env.physics.model.ptr

    @property
    def data(self):
        """The raw mujoco.MjData."""
        return self.env.physics.data.ptr

    def reset(self, *, seed=None, options=None):
        """Start an episode; a seed determines all of it."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.task.random.seed(seed)
        return self.env.reset().observation["observations"], {}

    def step(self, action):
        """One simulator step. A time limit truncates; only a zero discount terminates."""
        step = self.env.step(action)
        terminated = step.last() and step.discount == 0
        return (step.observation["observations"], float(step.reward), terminated,
                step.last() and not terminated, {})

    def close(self):
        """Release the physics."""
        self.env.close()


class ActionRepeat(gym.Wrapper):
    """Hold each action for n simulator steps and sum their rewards; info["env_steps"] counts them."""

    def __init__(self, env, n):
        super().__init__(env)
        self.n = n

    def step(self, action):
        """Repeat until the episode ends."""
        total = 0.0
        for count in range(1, self.n + 1):
            obs, reward, terminated, truncated, info = self.env.step(action)
            total += reward
            if terminated or truncated:
                break
        return obs, total, terminated, truncated, info | {"env_steps": count}


def color_box(phase, original, colors="published", half_range=0.2):
    """The box that a phase draws its colours from: (low, high), each (n, 3) in 0..1.

    original: (n, 3), the materials' own colours. `shifted` around the original colours rotates their channels (ours).
    """
    if phase == "none":
        return original, original
    phase = "shifted" if phase == "eval" else phase                           # DMC keeps no phase apart
    if colors == "published":
        center = np.broadcast_to(COLOR_CENTERS[phase], original.shape)
    else:
        center = original if phase == "train" else np.roll(original, 1, -1)
    return np.clip(center - half_range, 0, 1), np.clip(center + half_range, 0, 1)


class ColorDistractor(gym.Wrapper):
    """Draw the colours of all materials anew in each episode, from a random stream of its own.

    Only what is rendered changes. reset(options={"phase": …}) moves to another phase from then on.
    """

    def __init__(self, env, phase, colors="published", half_range=0.2, step_std=0.0):
        super().__init__(env)
        self.phase, self.colors, self.half_range, self.step_std = phase, colors, half_range, step_std
        self.original = self.unwrapped.model.mat_rgba[:, :3].copy()
        self.rng = np.random.default_rng()

    def reset(self, *, seed=None, options=None):
        """New colours; a seed determines them, apart from the task's own random stream."""
        if seed is not None:
            self.rng = np.random.default_rng([seed, 1])
        self.phase = (options or {}).get("phase", self.phase)
        self.low, self.high = color_box(self.phase, self.original, self.colors, self.half_range)
        self.rgb = self.rng.uniform(self.low, self.high)
        self.unwrapped.model.mat_rgba[:, :3] = self.rgb
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        """An optional random walk inside the box."""
        if self.step_std > 0:
            self.rgb = np.clip(self.rgb + self.rng.normal(0, self.step_std, self.rgb.shape), self.low, self.high)
            self.unwrapped.model.mat_rgba[:, :3] = self.rgb
        return self.env.step(action)


class Pixels(gym.ObservationWrapper):
    """Replace the observation by what camera 0 sees, with a renderer of its own.

    mujoco.Renderer makes its GL context current before each use; env.render() of the simulators does not, and two
    of those in one process silently show each other's textures.
    """

    metadata = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"

    def __init__(self, env, size=64, fast=False):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        quality = self.unwrapped.model.vis.quality
        quality.shadowsize = 512          # 20–60 % of a frame for a mean difference below 0.2 / 255
        if fast:
            quality.offsamples = 0        # half of the rest, for 1–2 / 255: no anti-aliasing
        self.renderer = mujoco.Renderer(self.unwrapped.model, size, size)
        # At exit too: a renderer that is still open then prints GL errors.
        self.release = weakref.finalize(self, self.renderer.close)

    def observation(self, observation):
        """The picture of the current state, uint8 (size, size, 3)."""
        self.renderer.update_scene(self.unwrapped.data, camera=0)
        return self.renderer.render()

    def render(self):
        """The current picture."""
        return self.observation(None)

    def close(self):
        """Free the GL context, then the simulator."""
        self.release()
        super().close()


def make_env(task, *, phase="train", seed=0, action_repeat=2, time_limit=0, colors="published", color_range=0.2,
             color_step_std=0.0, fast_render=False, size=64, pixels=True):
    """The one env stack: simulator → rescaled actions → time limit → action repeat → colours → pixels.

    phase: "train", "shifted" (the colours after the midpoint), "eval" (those a finished run is judged in; on DMC the
    shifted ones) or "none" (the task's own). time_limit: simulator steps per episode, 0 for the task's own.
    pixels=False leaves the state observation and renders nothing. Returns a gymnasium.Env with actions in [−1, 1]
    and uint8 (size, size, 3) images. Raises UserError for an unknown task and when OpenGL is missing.
    """
    if task not in TASKS:
        near = difflib.get_close_matches(task, TASKS, 3)
        raise UserError(f"unknown task '{task}'" + (f", did you mean {' or '.join(near)}?" if near else "") +
                        f" There are: {', '.join(TASKS)}", code=2)
    if phase not in ("train", "shifted", "eval", "none"):
        raise UserError(f"unknown phase '{phase}'; there are: train, shifted, eval, none", code=2)
    env = DMControlEnv(*TASKS[task])
    env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    env = gym.wrappers.TimeLimit(env, time_limit or 1000)                     # all of DMC's own limits are 1000
    env = ActionRepeat(env, action_repeat)
    env = ColorDistractor(env, phase, colors, color_range, color_step_std)
    if pixels:
        try:
            env = Pixels(env, size, fast_render)
        except (AttributeError, ImportError, RuntimeError) as error:
            raise UserError(f"MuJoCo cannot render with MUJOCO_GL={os.environ['MUJOCO_GL']} ({error}); "
                            "run: python diswm.py doctor") from error
    env.reset(seed=seed)
    return env


def config_env(cfg, task, phase, **kwargs):
    """make_env with the values of a Config."""
    return make_env(task, phase=phase, action_repeat=cfg.action_repeat, time_limit=cfg.time_limit, colors=cfg.colors,
                    color_range=cfg.color_range, color_step_std=cfg.color_step_std, fast_render=cfg.fast_render, **kwargs)


def episode_seed(seed, stream, index):
    """A seed for one episode of a run: a function of the run's seed, the purpose and the episode's index."""
    return int(np.random.SeedSequence([seed, stream, index]).generate_state(1)[0])


TRAINING, EVALUATION = 0, 1  # streams of episode_seed


def play_episode(env, agent, seed, phase, keep=False):
    """One evaluation episode with the actor's mode (agent None: uniformly random actions).

    Returns (return, rows); rows are the episode as `make_row`s when `keep`, else empty.
    """
    rng = np.random.default_rng(seed)
    image, _ = env.reset(seed=seed, options=dict(phase=phase))
    action, state, total, done, rows = np.zeros(env.action_space.shape, np.float32), None, 0.0, False, []
    rows += [make_row(image, action, first=True)] * keep
    while not done:
        if agent is None:
            action = rng.uniform(-1, 1, action.shape).astype(np.float32)
        else:
            actions, state = agent.act(image[None], action[None], state, explore=False)
            action = actions[0]
        image, reward, terminated, truncated, _ = env.step(action)
        total, done = total + reward, terminated or truncated
        rows += [make_row(image, action, reward, terminated)] * keep
    return total, rows


# ======================================================================================================
# Runs: folders, checkpoints, logs
# ======================================================================================================

def run_folder(cfg, stage):
    """runs/<stage>/<tasks>/<method>/seed<k>: the same command finds its run again."""
    tasks = f"{cfg.src}-{cfg.dst}" if stage == "finetune" else cfg.src
    return Path(cfg.runs) / stage / tasks / cfg.method / f"seed{cfg.seed}"


def read_checkpoint(path):
    """Load a checkpoint without executing code. Raises UserError when it is missing or no checkpoint of ours."""
    if not Path(path).is_file():
        raise UserError(f"there is no checkpoint {path}")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        state["config"], state["stage"], state["trainer"], state["rng"], state["log_bytes"]
        known = {field.name for field in dataclasses.fields(Config)}
        state["config"] = Config(**{key: value for key, value in state["config"].items() if key in known})
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError, ValueError, AttributeError) as error:
        reason = str(error).splitlines()[0][:100] if str(error) else type(error).__name__
        raise UserError(f"{path} is not a DisWM checkpoint ({reason}); restore it, or start over with --fresh") from None
    return state


class Run:
    """A run's folder: one checkpoint, config.json, metrics.jsonl, TensorBoard events, progress."""

    def __init__(self, cfg, stage, fresh=False):
        self.cfg, self.stage, self.folder = cfg, stage, run_folder(cfg, stage)
        self.checkpoint, self.log_path = self.folder / "checkpoint.pt", self.folder / "metrics.jsonl"
        if fresh and self.folder.exists():
            shutil.rmtree(self.folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.state = read_checkpoint(self.checkpoint) if self.checkpoint.exists() else None
        if self.state:
            self._same_config(self.state["config"])

    def _same_config(self, saved):
        differ = [field.name for field in dataclasses.fields(Config) if not field.metadata["free"]
                  and getattr(saved, field.name) != getattr(self.cfg, field.name)]
        if differ:
            was = ", ".join(f"{name} {getattr(saved, name)} (now {getattr(self.cfg, name)})" for name in differ)
            raise UserError(f"{self.folder} was started with {was}; use the same flags to go on, --fresh to start "
                            "over, or another --runs folder")

    def save(self, trainer):
        """Write the checkpoint, whole or not at all."""
        cuda = torch.cuda.get_rng_state() if self.cfg.device == "cuda" else None
        state = dict(config=dataclasses.asdict(self.cfg), stage=self.stage, trainer=trainer.state_dict(),
                     rng=dict(cpu=torch.get_rng_state(), cuda=cuda),
                     log_bytes=self.log_path.stat().st_size if self.log_path.exists() else 0)
        buffer = io.BytesIO()  # so that a full disk shows as an OSError of the file, not inside torch
        torch.save(state, buffer)
        with atomic(self.checkpoint) as file:
            file.write(buffer.getbuffer())
        if not (self.folder / "config.json").exists():
            (self.folder / "config.json").write_text(json.dumps(state["config"], indent=2) + "\n")

    def restore(self, trainer):
        """Continue from the checkpoint: trainer, random numbers, and the log as it was then."""
        trainer.load_state_dict(self.state["trainer"])
        torch.set_rng_state(self.state["rng"]["cpu"])
        if self.state["rng"]["cuda"] is not None and self.cfg.device == "cuda":
            torch.cuda.set_rng_state(self.state["rng"]["cuda"])
        if self.log_path.exists():
            os.truncate(self.log_path, self.state["log_bytes"])               # rows after the checkpoint come again

    def log(self, row):
        """Append a row to metrics.jsonl."""
        with open(self.log_path, "a") as file:
            file.write(json.dumps(row) + "\n")


def train(trainer, run):
    """The one training loop: resume; then work, log, checkpoint, until the stage is done.

    A trainer has `progress` and `total` in `unit`s, `advance()` → a row of metrics, `state_dict`, `load_state_dict`.
    """
    from torch.utils.tensorboard import SummaryWriter                         # slow to import
    if run.state:
        run.restore(trainer)
        print(f"resuming {run.folder} at {trainer.progress:,} of {trainer.total:,} {trainer.unit}")
    else:
        run.save(trainer)
    began, first = time.time(), trainer.progress
    writer = SummaryWriter(run.folder, purge_step=trainer.progress + 1)
    bar = tqdm(total=trainer.total, initial=first, unit=f" {trainer.unit}", disable=None)     # only on a terminal
    with contextlib.closing(writer), bar:
        while trainer.progress < trainer.total:
            before = trainer.progress
            row = trainer.advance()
            rate = (trainer.progress - first) / (time.time() - began)
            row |= dict(rate=rate, seconds=time.time() - began)
            run.log(row)
            for key, value in row.items():
                if isinstance(value, (int, float)):
                    writer.add_scalar(key, value, trainer.progress)
            run.save(trainer)
            trainer.saved()
            bar.update(trainer.progress - before)
            shown = "  ".join(f"{key} {row[key]:.4g}" for key in trainer.shown if key in row)
            bar.set_postfix_str(shown)
            if bar.disable:
                eta = time.strftime("%H:%M:%S", time.gmtime((trainer.total - trainer.progress) / rate))
                print(f"{trainer.progress:,}/{trainer.total:,} {trainer.unit}  {shown}  "
                      f"{rate:.1f} {trainer.unit}/s  eta {eta}", flush=True)
    print(f"done: {run.folder}")


def mean_metrics(rows):
    """Average the metrics of several updates: list of dicts of 0-d tensors → dict of floats."""
    keys = {key for row in rows for key in row}
    return {key: torch.stack([row[key].cpu().float() for row in rows if key in row]).mean().item() for key in sorted(keys)}


# ======================================================================================================
# Stages
# ======================================================================================================

class VideoTrainer:
    """Stage 2, Algorithm 1 lines 4–8: the video predictor on distracting videos. Progress is in updates."""

    unit, shown = "updates", ("image", "kl", "disentangle")
    chunk = 100  # updates per log row and checkpoint

    def __init__(self, cfg, videos, device):
        self.cfg, self.videos, self.device = cfg, videos, device
        self.model = VideoPredictor(cfg).to(device)
        self.optimizer = adam(self.model, cfg.model_lr)
        self.progress, self.total = 0, cfg.pretrain_updates

    def update(self, batch):
        """One step of Eq. (2) on a batch of numpy arrays. Returns metrics."""
        batch = to_device(batch, self.device)
        with autocast(self.cfg, self.device):
            loss, metrics = self.model.loss(self.model(batch), batch)
        metrics["model_grad_norm"] = gradient_step(self.optimizer, loss, metrics, self.cfg.grad_clip)
        return {key: value.detach() for key, value in metrics.items()}

    def advance(self):
        """Some updates → a log row."""
        rows = []
        for _ in range(min(self.chunk, self.total - self.progress)):
            rng = np.random.default_rng([self.cfg.seed, self.progress])       # nothing to save: a batch has a number
            rows.append(self.update(self.videos.sample(self.cfg.batch_size, self.cfg.batch_length, rng)))
            self.progress += 1
        return dict(update=self.progress) | mean_metrics(rows)

    def saved(self):
        """Nothing to do once a checkpoint is written."""

    def state_dict(self):
        """Everything that an update changes."""
        return dict(model=self.model.state_dict(), optimizer=self.optimizer.state_dict(), progress=self.progress,
                    videos=str(self.videos.folder))

    def load_state_dict(self, state):
        """The inverse of state_dict."""
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.progress = state["progress"]


class AgentTrainer:
    """Stages 1 and 3, Algorithm 1 lines 9–25: an agent in an environment. Progress is in env steps.

    It works episode by episode, and a checkpoint falls between two of them: then no simulator state needs saving.
    """

    unit, shown = "env steps", ("train_return", "eval_return", "image", "reward", "kl", "eta")

    def __init__(self, cfg, folder, device, teacher=None):
        self.cfg = cfg
        self.env = config_env(cfg, cfg.dst, "train", seed=cfg.seed)
        self.eval_env = config_env(cfg, cfg.dst, "train", seed=cfg.seed)
        self.action_dim = self.env.action_space.shape[0]
        self.agent = Agent(cfg, self.action_dim, device, teacher)
        self.replay = Replay(folder / "episodes", cfg.replay_capacity)
        self.progress, self.total = 0, cfg.steps
        self.decisions = self.updates = self.episodes = 0
        self.switch_step = int(cfg.switch * cfg.steps)

    @property
    def phase(self):
        """The colours of an episode that starts now: they switch once, at the midpoint."""
        return "train" if self.progress < self.switch_step else "shifted"

    def eta(self):
        """η on the live clock of decisions, prefill included."""
        # DEVIATION: the published code copies the clock once, at construction, and so never anneals.
        cfg = self.cfg
        return eta_schedule(self.decisions, cfg.eta, cfg.eta_end, cfg.eta_decay, cfg.eta_delay)

    def updates_due(self):
        """How many updates follow the decision just made."""
        cfg = self.cfg
        if self.decisions < cfg.prefill or self.replay.rows < cfg.batch_length:
            return 0
        if self.updates == 0:
            return max(cfg.first_updates, 1)
        return int(self.decisions % cfg.train_every == 0)

    def learn(self):
        """The updates that are due. Returns their metrics."""
        rows = []
        for _ in range(self.updates_due()):
            rng = np.random.default_rng([self.cfg.seed, self.updates])        # nothing to save: a batch has a number
            batch = self.replay.sample(self.cfg.batch_size, self.cfg.batch_length, rng)
            rows.append(self.agent.update(batch, self.eta(), self.updates, probe=self.updates % 100 == 0))
            self.updates += 1
        return rows

    def play(self):
        """One training episode, learning on the way. Returns its rows and the metrics of its updates.

        It ends with the simulator's episode, at the colour switch, or with the run.
        """
        seed = episode_seed(self.cfg.seed, TRAINING, self.episodes)
        rng = np.random.default_rng(seed)                                     # of prefill's random actions
        limit = self.switch_step if self.progress < self.switch_step else self.total
        image, _ = self.env.reset(seed=seed, options=dict(phase=self.phase))
        action, state, done, metrics = np.zeros(self.action_dim, np.float32), None, False, []
        rows = [make_row(image, action, first=True)]
        while not done and self.progress < limit:
            if self.decisions < self.cfg.prefill:
                action = rng.uniform(-1, 1, self.action_dim).astype(np.float32)
            else:
                actions, state = self.agent.act(image[None], action[None], state, explore=True)
                action = actions[0]
            image, reward, terminated, truncated, info = self.env.step(action)
            rows.append(make_row(image, action, reward, terminated))
            done = terminated or truncated
            self.decisions += 1
            self.progress += info["env_steps"]
            metrics += self.learn()
        return rows, metrics

    def advance(self):
        """An episode, and an evaluation if one is due → a log row."""
        phase, before = self.phase, self.progress
        rows, metrics = self.play()
        self.replay.add(rows)
        self.episodes += 1
        row = dict(step=self.progress, decisions=self.decisions, updates=self.updates, episodes=self.episodes, phase=phase,
                   train_return=sum(row["reward"] for row in rows), train_length=len(rows) - 1) | mean_metrics(metrics)
        every = self.cfg.eval_every
        if self.progress // every > before // every or self.progress >= self.total:
            returns = evaluate_agent(self.cfg, self.agent, self.eval_env, phase)
            row |= dict(eval_return=statistics.fmean(returns), eval_std=statistics.pstdev(returns), eval_returns=returns)
        return row

    def saved(self):
        """A checkpoint is written: the episodes that only the last one needed can go."""
        self.replay.prune()

    def state_dict(self):
        """Everything that an episode changes."""
        counters = {name: getattr(self, name) for name in ("progress", "decisions", "updates", "episodes")}
        teacher = self.agent.teacher
        return dict(agent=self.agent.state_dict(), replay=self.replay.state_dict(), action_dim=self.action_dim,
                    teacher=teacher and dict(depth=teacher.net[0].out_channels, weights=teacher.state_dict()), **counters)

    def load_state_dict(self, state):
        """The inverse of state_dict (the teacher is given at construction)."""
        self.agent.load_state_dict(state["agent"])
        self.replay.load_state_dict(state["replay"])
        for name in ("progress", "decisions", "updates", "episodes"):
            setattr(self, name, state[name])


@contextlib.contextmanager
def random_numbers(seed):
    """Inside, torch draws from `seed`; outside, it goes on as if nothing had been drawn."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield


def evaluate_agent(cfg, agent, env, phase):
    """Returns of `eval_episodes` episodes; the same seeds every time, and training's random numbers untouched."""
    with random_numbers(cfg.seed):
        seeds = [episode_seed(cfg.seed, EVALUATION, index) for index in range(cfg.eval_episodes)]
        return [play_episode(env, agent, seed, phase)[0] for seed in seeds]


def freeze(encoder):
    """A teacher: no gradient, in no optimiser, evaluation mode."""
    # DEVIATION: the published code switches the teacher's gradients back on and trains it along.
    return encoder.eval().requires_grad_(False)


def saved_teacher(state, z_dim, device):
    """The frozen teacher encoder that a finetuning checkpoint carries, or None."""
    if state["teacher"] is None:
        return None
    teacher = BetaVAEEncoder(z_dim, state["teacher"]["depth"]).to(device)
    teacher.load_state_dict(state["teacher"]["weights"])
    return freeze(teacher)


def find_teacher(cfg, device):
    """The frozen encoder of the pretrained video predictor: --teacher, or the --src teacher of this method in --runs.

    Prefers the run's own seed, else takes the lowest. Raises UserError with the command that makes one.
    """
    if cfg.src == cfg.dst:
        raise UserError(f"source and target are both {cfg.src}; the teacher's videos must show another task: --src TASK")
    own = run_folder(cfg, "pretrain")
    found = [own / "checkpoint.pt"] + sorted(own.parent.glob("seed*/checkpoint.pt"))
    path = Path(cfg.teacher) if cfg.teacher else next((path for path in found if path.exists()), None)
    command = f"python diswm.py pretrain --src {cfg.src}" + (f" --method {cfg.method}" if cfg.method != "diswm" else "")
    if path is None:
        others = sorted({path.parts[-4] for path in (Path(cfg.runs) / "pretrain").glob(f"*/{cfg.method}/seed*/checkpoint.pt")})
        raise UserError(f"no teacher for {cfg.src} in {own.parent}; run: {command}" +
                        (f"   (or take one that exists: --src {others[0]})" if others else ""))
    state = read_checkpoint(path)
    saved = state["config"]
    if state["stage"] != "pretrain" or saved.encoder != "beta_vae":
        raise UserError(f"{path} is a {state['stage']} checkpoint with a {saved.encoder} encoder, not a β-VAE video predictor; "
                        f"run: {command}")
    if saved.src == cfg.dst:
        raise UserError(f"the teacher {path} saw videos of {cfg.dst}, the target task itself; give another --src")
    if saved.z_dim != cfg.z_dim:
        raise UserError(f"the teacher {path} has {saved.z_dim} latents and this run {cfg.z_dim}; add --z-dim {saved.z_dim}, or "
                        f"run: {command} --z-dim {cfg.z_dim}")
    if state["trainer"]["progress"] < saved.pretrain_updates:
        raise UserError(f"the teacher {path} is not finished ({state['trainer']['progress']} of {saved.pretrain_updates} "
                        f"updates); run: {command}")
    print(f"teacher: {path} ({saved.src}, {saved.pretrain_updates:,} updates)")
    teacher = VideoPredictor(saved)
    teacher.load_state_dict(state["trainer"]["model"])
    return freeze(teacher.encoder.to(device))


def collect(cfg, fresh=False):
    """Stage 1: DreamerV2 learns in the distracting source task; its replay is the video set. Returns its folder."""
    # The training colours throughout; every frame is kept.
    cfg = dataclasses.replace(cfg, dst=cfg.src, method="dreamerv2", steps=cfg.collect_steps, switch=1.0,
                              replay_capacity=max(cfg.replay_capacity, cfg.collect_steps), **METHODS["dreamerv2"])
    return train_agent(cfg, "collect", fresh) / "episodes"


def train_agent(cfg, stage, fresh):
    """Train an agent in `cfg.dst` until its steps are done, from where it stopped. Returns the run's folder."""
    run = Run(cfg, stage, fresh)
    device = torch.device(cfg.device)
    announce(cfg, stage, run.folder, frames=cfg.steps // cfg.action_repeat)
    teacher = None
    if cfg.eta > 0:
        teacher = saved_teacher(run.state["trainer"], cfg.z_dim, device) if run.state else find_teacher(cfg, device)
    torch.manual_seed(cfg.seed)
    trainer = AgentTrainer(cfg, run.folder, device, teacher)
    with contextlib.closing(trainer.env), contextlib.closing(trainer.eval_env):
        train(trainer, run)
    return run.folder


def pretrain(cfg, fresh=False):
    """Stage 2: the video predictor. Collects videos first when there are none."""
    run = Run(cfg, "pretrain", fresh)
    collected = run_folder(dataclasses.replace(cfg, method="dreamerv2"), "collect") / "checkpoint.pt"
    if cfg.videos:
        folder = Path(cfg.videos)
    else:
        others = sorted(collected.parent.parent.glob("seed*/checkpoint.pt"))
        if not collected.exists() and others:
            collected = others[0]                                             # one video set serves all seeds
            folder = collected.parent / "episodes"
        else:
            folder = collect(cfg)                                             # at once done when it is complete
    videos = open_videos(folder, run.folder / "videos")
    if videos.rows < cfg.batch_length:
        raise UserError(f"the videos in {folder} have {videos.rows} frames, fewer than one window of {cfg.batch_length}; collect more, "
                        "or lower --batch-length")
    print(f"videos: {folder} ({len(videos.paths):,} episodes, {videos.rows:,} frames)")
    announce(cfg, "pretrain", run.folder, frames=0)
    torch.manual_seed(cfg.seed)
    train(VideoTrainer(cfg, videos, torch.device(cfg.device)), run)
    return run.folder


def finetune(cfg, fresh=False):
    """Stage 3: distil, adapt, learn behaviour in the target task."""
    return train_agent(cfg, "finetune", fresh)


def announce(cfg, stage, folder, frames):
    """Say what is about to run, on what, what it needs, and where it goes."""
    disk = frames * 12_350 + 60e6                                             # 64·64·3 bytes of image and the rest of a row
    memory = 0.6e9 + cfg.batch_size * cfg.batch_length * cfg.cnn_depth * 22e3
    print(f"{stage}: {cfg.method}, {cfg.src} → {cfg.dst}, seed {cfg.seed}   device {cfg.device}, {cfg.precision}, "
          f"{torch.get_num_threads()} threads\n  needs about {disk / 1e9:.1f} GB of disk and {memory / 1e9:.1f} GB of memory"
          f"   results in {folder}", flush=True)


def load_agent(folder, device):
    """A finished or running agent from its run folder → (cfg, agent, trainer state)."""
    state = read_checkpoint(Path(folder) / "checkpoint.pt")
    if state["stage"] == "pretrain":
        raise UserError(f"{folder} is a video predictor and has no policy; evaluate a finetune run")
    cfg, trainer = dataclasses.replace(state["config"], device=device.type, precision="fp32"), state["trainer"]
    agent = Agent(cfg, trainer["action_dim"], device, saved_teacher(trainer, cfg.z_dim, device))
    agent.load_state_dict(trainer["agent"])
    return cfg, agent, trainer


def evaluate(folder, device, episodes=None):
    """Stage 4: play `episodes` episodes with the actor's mode, and as many with random actions.

    Writes evaluation.json and evaluation.mp4 (the first episode) into the run's folder. Returns the JSON object.
    """
    folder = Path(folder)
    cfg, agent, trainer = load_agent(folder, device)
    cfg = dataclasses.replace(cfg, eval_episodes=episodes or cfg.eval_episodes)
    phase = "shifted" if trainer["progress"] >= int(cfg.switch * cfg.steps) < cfg.steps else "train"
    with contextlib.closing(config_env(cfg, cfg.dst, phase)) as env:
        returns = evaluate_agent(cfg, agent, env, phase)
        with random_numbers(cfg.seed):
            _, rows = play_episode(env, agent, episode_seed(cfg.seed, EVALUATION, 0), phase, keep=True)
    with contextlib.closing(config_env(cfg, cfg.dst, phase, pixels=False)) as env:
        random = evaluate_agent(cfg, None, env, phase)
    result = dict(task=cfg.dst, phase=phase, step=trainer["progress"], episodes=len(returns), returns=returns,
                  mean=statistics.fmean(returns), std=statistics.pstdev(returns),
                  random_mean=statistics.fmean(random), random_std=statistics.pstdev(random))
    with atomic(folder / "evaluation.json") as file:
        file.write((json.dumps(result, indent=2) + "\n").encode())
    frames = np.stack([row["image"] for row in rows]).repeat(4, 1).repeat(4, 2)                 # 256 × 256
    iio.imwrite(folder / "evaluation.mp4", frames, fps=25)
    print(f"{cfg.dst}, {phase} colours, after {result['step']:,} env steps: return {result['mean']:.1f} ± {result['std']:.1f} "
          f"over {len(returns)} episodes   (random policy {result['random_mean']:.1f} ± {result['random_std']:.1f})\n"
          f"wrote {folder / 'evaluation.json'} and {folder / 'evaluation.mp4'}")
    return result


# ======================================================================================================
# Figures
# ======================================================================================================

TRAVERSAL_VALUES = (-9, -3, -2, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, 2, 3, 9)  # the prior's range, and the published ±9


def load_model(folder, device):
    """The video predictor or world model of a run, and the folder of the episodes it learnt from."""
    state = read_checkpoint(Path(folder) / "checkpoint.pt")
    if state["stage"] != "pretrain":
        _, agent, _ = load_agent(folder, device)
        return agent.model, Path(folder) / "episodes"
    model = VideoPredictor(state["config"]).to(device)
    model.load_state_dict(state["trainer"]["model"])
    return model, Path(state["trainer"]["videos"])


def to_picture(image):
    """float (..., 3, h, w) in [−0.5, 0.5] → uint8 (..., h, w, 3)."""
    return ((image.movedim(-3, -1) + 0.5).clamp(0, 1) * 255).round().byte().cpu().numpy()


@torch.no_grad()
def latent_traversal(model, batch, values=TRAVERSAL_VALUES):
    """Vary one latent at a time (paper, Fig. 5). batch: one window (1, T, ...), preprocessed.

    The last image of the window is encoded; for each latent i and value v, 𝐳 with z_i = v goes through the posterior
    (means, no noise) and the decoder. Returns pictures uint8 (Z, 1 + len(values), 64, 64, 3), the first column being the
    reconstruction, and each latent's KL in nats, averaged over the window, (Z,).
    """
    out = model(batch)
    z, deter = out["code"]["mean"][0, -1], out["post"]["deter"][0, -1]

    def decode(z):                                                            # (n, Z) → (n, 3, 64, 64)
        h = deter.expand(len(z), -1)
        state = model.rssm.posterior(h, z)
        return model.decoder(torch.cat([state["mean"], h], -1))

    count = len(z)
    varied = z.repeat(count, 1 + len(values), 1)                              # (Z, columns, Z)
    for i in range(count):
        varied[i, 1:, i] = torch.tensor(values, device=z.device)
    pictures = to_picture(decode(varied.flatten(0, 1))).reshape(count, 1 + len(values), 64, 64, 3)
    mean, logvar = out["code"]["mean"][0], out["code"]["logvar"][0]
    nats = beta_vae_kl(mean[..., None], logvar[..., None]).mean(0)            # (Z,)
    return pictures, nats.cpu().numpy()


@torch.no_grad()
def open_loop(model, batch, context=5):
    """Filter `context` images, then predict the rest without seeing it. batch: one window (1, T, ...), preprocessed.

    Actions are the window's own (none for a video predictor). Returns uint8 (3, T, 64, 64, 3): truth, model, error.
    """
    head = {key: value[:, :context] for key, value in batch.items()}
    out = model(head)
    state, feats = {key: value[:, -1] for key, value in out["post"].items()}, [out["feat"]]
    for t in range(context, batch["image"].shape[1]):
        state = model.rssm.prior(model.rssm.recur(state, batch["action"][:, t] if "action" in batch else None))
        feats.append(model.rssm.feat(state)[:, None])
    truth = batch["image"][0]
    prediction = model.decoder(torch.cat(feats, 1))[0].clamp(-0.5, 0.5)
    return np.stack([to_picture(truth), to_picture(prediction), to_picture((prediction - truth) / 2)])


def traverse(folder, device, seed=0):
    """Draw traversal.png (β-VAE models) and open_loop.png into a run's folder."""
    folder = Path(folder)
    model, episodes = load_model(folder, device)
    keys = VIDEO_KEYS if model.rssm.action_dim == 0 else (*VIDEO_KEYS, "action")
    replay = Replay(episodes, keys=keys)
    length = min(50, replay.rows)
    # The beginning of the last episode: the colours of now, and a policy that has learnt.
    start = ([0] + replay.ends)[-2]
    window = {key: value[None] for key, value in replay.window(start, min(length, replay.rows - start)).items()}
    batch = to_device(window, device)
    with random_numbers(seed):
        strip = open_loop(model, batch)
        plot_strip(strip[:, ::max(1, strip.shape[1] // 12)], folder / "open_loop.png", context=5)
        if batch["image"].shape[1] and isinstance(model.encoder, BetaVAEEncoder):
            pictures, nats = latent_traversal(model, batch)
            plot_traversal(pictures, nats, folder / "traversal.png")
            print(f"wrote {folder / 'traversal.png'}")
        else:
            print(f"{folder} has no β-VAE latents to traverse")
    print(f"wrote {folder / 'open_loop.png'}")


def pyplot():
    """matplotlib.pyplot, drawing into files."""
    import matplotlib                                                         # slow to import
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    return plt


def plot_traversal(pictures, nats, path):
    """A row per latent, most informative (highest KL) first; a column per value."""
    plt = pyplot()
    order = np.argsort(-nats)
    rows, columns = pictures.shape[:2]
    grid = pictures[order].transpose(0, 2, 1, 3, 4).reshape(rows * 64, columns * 64, 3)
    figure, axes = plt.subplots(figsize=(columns * 0.72 + 1.2, rows * 0.72 + 0.8))
    axes.imshow(grid)
    axes.set_yticks(np.arange(rows) * 64 + 32, [f"z{i}   {nats[i]:.2f} nats" for i in order])
    axes.set_xticks(np.arange(columns) * 64 + 32, ["recon.", *(f"{value:g}" for value in TRAVERSAL_VALUES)])
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.set_frame_on(False)
    figure.savefig(path, dpi=100, bbox_inches="tight")
    plt.close(figure)


def plot_strip(strip, path, context):
    """Truth, model and error over time."""
    plt = pyplot()
    count = strip.shape[1]
    figure, axes = plt.subplots(figsize=(count * 0.9 + 1, 3.2))
    axes.imshow(strip.transpose(0, 2, 1, 3, 4).reshape(3 * 64, count * 64, 3))
    axes.set_yticks([32, 96, 160], ["truth", "model", "error"])
    axes.set_xticks([])
    axes.set_title(f"open-loop prediction: the model sees the first {context} frames only", fontsize=10)
    axes.tick_params(length=0)
    axes.set_frame_on(False)
    figure.savefig(path, dpi=100, bbox_inches="tight")
    plt.close(figure)


def read_log(folder):
    """A run's metrics.jsonl → list of dicts; empty when there is none."""
    path = Path(folder) / "metrics.jsonl"
    try:
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    except ValueError as error:
        raise UserError(f"{path} is not a log of ours ({error}); remove it or start over with --fresh") from None


def plot(folders, path):
    """Learning curves: evaluation returns over env steps; per method the mean and the spread over seeds.

    folders: run folders …/<tasks>/<method>/seed<k>. Writes a PNG with one panel per pair of tasks.
    """
    curves = {}                                                               # {tasks: {method: [{step: return}]}}
    for folder in map(Path, folders):
        curve = {row["step"]: row["eval_return"] for row in read_log(folder) if "eval_return" in row}
        if curve:
            *_, tasks, method, _ = folder.resolve().parts
            curves.setdefault(tasks, {}).setdefault(method, []).append(curve)
    if not curves:
        raise UserError("no evaluations to plot; run: python diswm.py finetune --dst walker_walk")
    plt = pyplot()
    figure, panels = plt.subplots(1, len(curves), figsize=(5.5 * len(curves), 3.8), squeeze=False)
    for axes, (tasks, methods) in zip(panels[0], sorted(curves.items()), strict=True):
        for method, runs in sorted(methods.items()):
            steps = sorted(set.intersection(*map(set, runs)))
            values = np.array([[run[step] for step in steps] for run in runs])
            mean, spread = values.mean(0), values.std(0)
            line, = axes.plot(steps, mean, marker=".", label=f"{method} ({len(runs)} seeds)")
            axes.fill_between(steps, mean - spread, mean + spread, alpha=0.2, color=line.get_color(), lw=0)
        axes.set(title=tasks.replace("-", " → "), xlabel="env steps", ylabel="evaluation return", ylim=(0, None))
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=120, bbox_inches="tight")
    plt.close(figure)
    print(f"wrote {path}")


# ======================================================================================================
# Doctor and bench
# ======================================================================================================

def doctor(cfg):
    """Print versions and device, and render a frame of each env family in every phase into doctor.png."""
    print(f"python {platform.python_version()}  torch {torch.__version__}  mujoco {mujoco.__version__}  gymnasium "
          f"{gym.__version__}\ndevice {cfg.device}, {cfg.precision}, {torch.get_num_threads()} threads, "
          f"MUJOCO_GL={os.environ['MUJOCO_GL']}")
    phases, tasks, pictures = ("train", "shifted", "eval", "none"), ("walker_walk",), []
    for task in tasks:
        for phase in phases:
            try:
                with contextlib.closing(config_env(cfg, task, phase)) as env:
                    pictures.append(env.reset(seed=cfg.seed)[0])
            except UserError as error:
                raise UserError(f"{error.__cause__ or error}: OpenGL is missing. Run: apt-get install libegl1 libgl1-mesa-dri; "
                                "or: apt-get install libosmesa6 and export MUJOCO_GL=osmesa") from error
    sheet = np.stack(pictures).reshape(len(tasks), len(phases), 64, 64, 3).transpose(0, 2, 1, 3, 4)
    path = Path(cfg.runs) / "doctor.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, sheet.reshape(len(tasks) * 64, -1, 3).repeat(3, 0).repeat(3, 1))
    print(f"everything renders; wrote {path}: {', '.join(tasks)} in the phases {', '.join(phases)}")


def median_seconds(function, repeats=5):
    """Median wall time of a call, after one to warm up."""
    times = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return statistics.median(times[1:])


def parameter_counts(agent):
    """Numbers of parameters by part, and their total."""
    parts = dict(world_model=agent.model, teacher=agent.teacher, actor=agent.behaviour.actor,
                 critic=agent.behaviour.critic, slow_critic=agent.behaviour.slow_critic)
    counts = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items() if part}
    return counts | dict(total=sum(counts.values()))


def bench(cfg):
    """Time an update, a pretraining update, a batch, a frame and a decision; count parameters."""
    device, rng = torch.device(cfg.device), np.random.default_rng(0)
    teacher = freeze(BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth).to(device)) if cfg.eta > 0 else None
    with contextlib.closing(config_env(cfg, cfg.dst, "train")) as env:
        size = env.action_space.shape[0]
        agent = Agent(cfg, size, device, teacher)
        image, zeros = env.reset(seed=0)[0], np.zeros((1, size), np.float32)
        frame = median_seconds(env.render, 50)
        decision = median_seconds(lambda: env.step(agent.act(image[None], zeros, None, True)[0][0]), 50)
    shape = (cfg.batch_size, cfg.batch_length)
    batch = dict(image=rng.integers(0, 256, (*shape, 64, 64, 3), np.uint8), is_first=np.zeros(shape, bool),
                 action=rng.uniform(-1, 1, (*shape, size)).astype(np.float32), discount=np.ones(shape, np.float32),
                 reward=rng.uniform(0, 1, shape).astype(np.float32))
    trainer = VideoTrainer(cfg, None, device)
    pretrain_step = median_seconds(lambda: trainer.update({key: batch[key] for key in VIDEO_KEYS}))
    train_step = median_seconds(lambda: agent.update(batch, cfg.eta, 1))
    print(f"{cfg.dst}, batch {shape[0]} × {shape[1]}, {cfg.device} {cfg.precision}, {torch.get_num_threads()} threads")
    for name, value in parameter_counts(agent).items():
        print(f"  {name:14} {value:>10,} parameters")
    for name, value in (("train step", train_step), ("pretrain step", pretrain_step), ("frame", frame), ("decision", decision)):
        print(f"  {name:14} {value * 1e3:10.1f} ms")
    print(f"  peak memory    {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:10.0f} MiB")


# ======================================================================================================
# Command line
# ======================================================================================================

class Parser(argparse.ArgumentParser):
    """argparse whose errors are one line; an unknown flag or choice lists what exists."""

    def error(self, message):
        """Exit 2."""
        flags = " ".join(flag for action in self._actions for flag in action.option_strings if flag.startswith("--"))
        hint = f"; there are: {flags}" if "unrecognized" in message else f"; see: {self.prog} --help"
        self.exit(2, f"error: {message}{hint}\n")


def bounded(kind, low):
    """A parser for numbers of a type that are at least `low`."""
    def parse(text):
        value = kind(text)
        if low is not None and value < low:
            raise argparse.ArgumentTypeError(f"must be at least {low}")
        return value
    parse.__name__ = kind.__name__
    return parse


COMMANDS = dict(
    collect="learn in the distracting source task; the replay is the video set",
    pretrain="train the β-VAE video predictor on videos (collects them first if there are none)",
    finetune="distil, adapt and learn behaviour in the target task",
    evaluate="play episodes with a run's policy and with a random one; JSON and mp4",
    traverse="draw latent traversals and open-loop predictions of a run",
    plot="draw learning curves of runs",
    doctor="check rendering and versions",
    bench="time the steps, count the parameters")


def parse_args(argv):
    """The command line → (args, Config): preset, then the method's values, then the flags given."""
    parser = Parser(prog="diswm.py", description="Disentangled World Models. See the top of diswm.py.", allow_abbrev=False)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for name, help in COMMANDS.items():
        sub = commands.add_parser(name, help=help, description=help, allow_abbrev=False)
        sub.add_argument("--preset", choices=PRESETS, help="sizes of everything; default: paper on CUDA, else small")
        sub.add_argument("--fresh", action="store_true", help="start over instead of resuming")
        if name in ("evaluate", "traverse"):
            sub.add_argument("--run", required=True, help="folder of the run, runs/…/seed0")
        if name == "plot":
            sub.add_argument("run", nargs="*", help="folders of runs; default: all finetune runs")
            sub.add_argument("--out", default="", help="PNG to write; default: curves.png in --runs")
        for field in dataclasses.fields(Config):
            choices = METHODS if field.name == "method" else field.metadata["choices"]
            kind = dict(action=argparse.BooleanOptionalAction) if isinstance(field.default, bool) else dict(
                type=bounded(type(field.default), field.metadata["low"]), choices=choices,
                metavar=None if choices else type(field.default).__name__.upper())
            sub.add_argument("--" + field.name.strip("_").replace("_", "-"), dest=field.name, default=argparse.SUPPRESS,
                             help=f"{field.metadata['help']}; paper preset: {field.default}".replace("%", "%%"), **kind)
    args, unknown = parser.parse_known_args(argv)
    if unknown:
        commands.choices[args.command].error(f"unrecognized arguments: {' '.join(unknown)}")
    names = {field.name for field in dataclasses.fields(Config)}
    given = {key: value for key, value in vars(args).items() if key in names}
    preset = args.preset or ("paper" if torch.cuda.is_available() else "small")
    cfg = dataclasses.replace(PRESETS[preset], **METHODS[given.get("method", "diswm")] | given)
    if not args.preset and args.command in ("collect", "pretrain", "finetune"):
        print(f"preset {preset} (--preset chooses another: {', '.join(PRESETS)})")
    for task in {cfg.src, cfg.dst} - set(TASKS):
        make_env(task)                                                        # raises the error that lists the tasks
    return args, cfg


def resolve_machine(cfg):
    """Fill in device, precision and threads where they are "auto", and set torch up for them."""
    device = cfg.device if cfg.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("there is no CUDA device; use --device cpu")
    cpuinfo = Path("/proc/cpuinfo")
    native = "cuda" in device or cpuinfo.exists() and any(
        name in cpuinfo.read_text() for name in ("avx512_bf16", "amx_bf16"))
    precision = cfg.precision if cfg.precision != "auto" else "bf16" if native else "fp32"
    torch.set_num_threads(cfg.threads or os.cpu_count())
    if platform.system() == "Linux":
        # glibc gives large buffers back to the kernel each step and pays in page faults: 1.1–1.3× of a step.
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(-3, 1 << 30), libc.mallopt(-1, (1 << 31) - 1)            # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD
    return dataclasses.replace(cfg, device=device, precision=precision)


def run_command(argv):
    """Parse and run one command."""
    args, cfg = parse_args(argv)
    cfg = resolve_machine(cfg)
    device = torch.device(cfg.device)
    if args.command in ("collect", "pretrain", "finetune"):
        dict(collect=collect, pretrain=pretrain, finetune=finetune)[args.command](cfg, args.fresh)
    elif args.command == "evaluate":
        evaluate(args.run, device)
    elif args.command == "traverse":
        traverse(args.run, device)
    elif args.command == "plot":
        folders = args.run or sorted(Path(cfg.runs).glob("finetune/*/*/seed*"))
        plot(folders, Path(args.out or Path(cfg.runs) / "curves.png"))
    else:
        dict(doctor=doctor, bench=bench)[args.command](cfg)


def main(argv=None):
    """Run a command; a mistake of the user's is one line and exit code 1 or 2. Returns the exit code."""
    try:
        run_command(argv)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.code
    except OSError as error:
        print(f"error: {error.filename or 'file'}: {error.strerror or error}; the last checkpoint is whole: mend the cause and run "
              "the same command again", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted; the run is saved up to its last checkpoint: the same command goes on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
