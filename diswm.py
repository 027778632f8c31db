"""DisWM in one file: Wang et al., "Disentangled World Models: Learning to Transfer Semantic
Knowledge from Distracting Videos for Reinforcement Learning", ICCV 2025.

Videos of a task whose colours keep changing are enough to learn *what varies independently*:
a β-VAE inside an action-free video predictor finds latents for it. An agent in another task
learns a world model whose encoder is pulled towards the frozen teacher's latents, strongly
at first, then less. DreamerV2's actor-critic learns in imagination.

    collect    DreamerV2 in the distracting source task ──► episodes = the video set
    pretrain   videos ──► β-VAE video predictor, Eqs. (1), (2) ──► its encoder = the teacher
    finetune   target task ⇄ world model, Eqs. (4), (5) ◄── distillation, Eq. (3) ── teacher
               world model ──► imagination ──► actor, critic (appendix B)
    evaluate, traverse    returns; latent traversals, open-loop predictions

    o     image            𝐳 (z, embed)  β-VAE latent, 20 of them    h (deter)  recurrent state
    a, r  action, reward   z_t (stoch)   stochastic state            s (feat)   [z_t, h_t]
    γ     discount         q (post), p (prior)  of z_t               V          λ-return
    β, β₁, β₂, α, η  loss weights        π (actor), v (critic)       sg         stop-gradient
    B batch, T time, H horizon, N trajectories; Z latents, S stochastic, D deterministic, A action
"""

import argparse
import atexit
import contextlib
import ctypes
import fcntl
import hashlib
import importlib
import inspect
import io
import json
import logging
import math
import os
import re
import shutil
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

os.environ["MUJOCO_GL"] = os.environ.get("MUJOCO_GL", "").strip().lower() or "egl"

import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn
from torch.distributions import Normal, kl_divergence
from tqdm import tqdm

GL = f"MUJOCO_GL={os.environ['MUJOCO_GL']}"
GL_REMEDY = "export MUJOCO_GL=egl; bash run_all.sh test"
log = logging.getLogger("diswm")  # only the command line prints
Normal.set_default_validate_args(False)  # that would wait for a GPU

class UserError(Exception):
    """What the user can mend: one line on the command line, and exit code 1."""

class UsageError(UserError):
    """A wrong flag, value or task: the exit code is 2."""

class OpenGLError(SystemExit, UserError):
    """Of the import: one line and no traceback, even uncaught."""

@contextlib.contextmanager
def reading(path, kind, remedy="start over with --fresh"):
    """What foreign files and libraries raise becomes one line."""
    try:
        yield
    except Exception as error:
        if type(error) in (UserError, MemoryError):  # but a Config's UsageError is wrapped
            raise
        cause = f"{type(error).__name__}: {error}".split("\n")[0][:120]
        raise UserError(f"{path} is no {kind} ({cause}); {remedy}") from error

try:
    import mujoco
    importlib.reload(mujoco.gl_context)  # an earlier import did not see MUJOCO_GL
    from dm_control import suite
except (AttributeError, ImportError, RuntimeError) as error:
    raise OpenGLError(f"error: {GL}: {error}; {GL_REMEDY}") from error
PROCESS = os.getpid()
VERSIONS = {m.__name__: m.__version__ for m in (torch, mujoco, gym, np)}
mujoco.Renderer._gl_context = mujoco.Renderer._mjr_context = None  # one that fails can close

# === Config ===
@dataclass(frozen=True)
class Config:
    """The comments are the flags' help. Values are the paper's (table) or, unmarked, the published
    configuration's. A *decision* is an action, held for `action_repeat` env steps."""
    # --- run: what, where it is kept, how long
    preset: str = "paper"  # sizes; without CUDA: small (ours)
    src: str = "cheetah_run"  # task of the distracting videos (paper)
    dst: str = "walker_walk"  # target task (paper)
    method: str = "diswm"  # the paper's method, a baseline or an ablation (paper)
    seed: int = 0  # seed of everything random (ours)
    tag: str = ""  # sets a run of other settings apart (ours)
    runs: str = "runs"  # folder of all runs (ours)
    teacher: str = ""  # its checkpoint.pt; empty: the one of --src (ours)
    videos: str = ""  # folder of episodes, *.npy; empty: collect's (ours)
    steps: int = 1_000_000  # env steps of finetuning (paper)
    collect_steps: int = 2_000_000  # env steps of collecting: 1M frames (paper)
    pretrain_updates: int = 20_000  # updates of the video predictor
    switch: float = 0.5  # share of steps before the colours change; 1: never (paper)
    # --- environment (section 4)
    action_repeat: int = 2  # env steps per decision
    time_limit: int = 0  # env steps per episode; 0: the task's own (ours)
    colors: str = "published"  # around fixed centres or the original colours (paper)
    color_range: float = 0.2  # half width of a box, RGB in 0..1
    fast_render: bool = False  # no anti-aliasing, twice as fast (ours)
    camera: str = ""  # by name; empty: one that shows the task (ours)
    # --- acting, and how often to learn
    prefill: int = 2500  # decisions at random before learning, at least: whole episodes
    first_updates: int = 100  # updates right after prefill
    train_every: int = 5  # decisions per update
    eval_every: int = 10_000  # env steps between evaluations
    eval_episodes: int = 10  # episodes per evaluation
    # --- models: video predictor and world model
    cnn_depth: int = 32  # channels of the first convolution
    stoch: int = 50  # size of the stochastic state
    deter: int = 200  # size of the deterministic state
    hidden: int = 200  # hidden units inside the RSSM
    batch_size: int = 50  # windows per batch, B (table)
    batch_length: int = 50  # rows per window, T (table)
    model_lr: float = 3e-4  # learning rate of both models (table)
    kl_balance: float = 0.8  # share of the KL that trains the prior (DreamerV2)
    free_nats: float = 1.0  # nats below which the KL is not trained
    grad_clip: float = 100.0  # largest gradient norm of an optimiser
    # --- methods: what makes them
    encoder: str = "beta_vae"  # and decoder; conv: DreamerV2's (paper)
    carry_over: str = "none"  # weights: start from the video model's; stack: on its RSSM (paper)
    bonus: float = 0.0  # weight of the intrinsic bonus in the reward (APV: 0.1)
    z_dim: int = 20  # size of the β-VAE latent (table)
    beta: float = 0.015  # β, weight of the disentanglement loss in Eq. (5) (table)
    beta1: float = 1.0  # β₁, weight of the action-free KL in Eq. (2) (table)
    beta2: float = 0.015  # β₂, weight of the disentanglement loss in Eq. (2) (table)
    # --- distillation, Eq. (3); its clock counts all decisions
    eta: float = 0.1  # η at the start (table)
    eta_end: float = 0.01  # η at the end (paper, section 3.4)
    eta_decay: int = 50_000  # decisions in which η would fall to 0
    eta_delay: int = -1  # decisions before that; -1: eta_decay across domains, else 0
    # --- behaviour and rewards, Eq. (5), appendix B
    alpha: float = 1.0  # α, weight of the KL in Eq. (5) (table)
    reward_scale: float = 2.0  # weight of the reward loss
    units: int = 400  # hidden units of heads, actor and critic
    horizon: int = 15  # imagined transitions, H (table)
    imagine_starts: int = 0  # states of a batch to imagine from; 0: all (ours)
    gamma: float = 0.99  # discount γ (table)
    lambda_: float = 0.95  # λ of the λ-return (table)
    actor: str = "squashed"  # tanh of a normal (ours); clipped: a normal around tanh
    rho: float = 1.0  # ρ: 1 dynamics backprop, 0 REINFORCE
    entropy_scale: float = 1e-3  # weight of the actor's entropy; published: 1e-4 (ours)
    actor_lr: float = 8e-5  # learning rate of the actor (table)
    critic_lr: float = 8e-5  # learning rate of the critic (table)
    slow_every: int = 100  # updates between copies of the critic
    # --- machine
    device: str = "auto"  # where it runs (ours)
    precision: str = "auto"  # of convolutions and MLPs; auto: bf16 where native (ours)
    threads: int = 0  # CPU threads; 0: one per core (ours)
    wandb: str = ""  # project to log to as well, after: pip install wandb (ours)

    def __post_init__(self):
        """Refuse values that are unknown, too low or too high."""
        for name, value in vars(self).items():
            if name in CHOICES and value not in CHOICES[name]:
                raise UsageError(f"{flag_name(name)} {value}: not of {', '.join(CHOICES[name])}")
            low = LOWEST.get(name, 1 if type(value) is int else 0)
            high = 1 if name in ("gamma", "lambda_", "kl_balance", "rho") else 1e18
            if type(value) in (int, float) and not low <= value <= high:  # nor NaN
                raise UsageError(f"{flag_name(name)} {value}: not from {low} to {high:g}")

LOWEST = dict(seed=0, time_limit=0, prefill=0, imagine_starts=0, threads=0, eta_delay=-1,
              batch_length=2)  # else 1 for a whole number, 0 for others
CHOICES = dict(colors=("published", "original"), encoder=("beta_vae", "conv"),
               carry_over=("none", "weights", "stack"), actor=("squashed", "clipped"),
               device=("auto", "cpu", "cuda"), precision=("auto", "fp32", "bf16"))
MAY_CHANGE = ("preset", "runs", "teacher", "videos", "device", "precision", "threads",
              "switch", "steps", "collect_steps", "pretrain_updates", "eval_episodes", "wandb")

def flag_name(name):
    """lambda_ → --lambda"""
    return "--" + name.strip("_").replace("_", "-")

PRESETS = {
    "paper": Config(),
    # Smaller batches want larger rates. Eq. (3) sums over 32 rows, not 50; η also falls in prefill.
    "small": Config(
        preset="small", steps=100_000, collect_steps=20_000, pretrain_updates=1_000, cnn_depth=16,
        fast_render=True, batch_size=16, batch_length=32, imagine_starts=256, units=200,
        model_lr=1e-3, actor_lr=2e-4, critic_lr=2e-4, eta=0.156, eta_end=0.0156, eta_decay=7_500),
    "debug": Config(  # seconds, for tests: nothing is learnt
        preset="debug", steps=300, collect_steps=200, pretrain_updates=20, prefill=50,
        first_updates=2, threads=1, train_every=10, eval_every=100, eval_episodes=2,
        time_limit=50, batch_size=3, batch_length=8, horizon=3, cnn_depth=4, stoch=6, deter=12,
        hidden=10, units=10, eta=0.6, eta_end=0.06, eta_decay=60, slow_every=5),
}
NO_DISTILL, NO_BETA = dict(eta=0.0, eta_end=0.0), dict(beta=0.0, beta2=0.0)
# DEVIATION: Gaussian latents in all methods; those of DreamerV2 and APV were discrete.
DV2 = NO_DISTILL | NO_BETA | dict(encoder="conv", carry_over="none", bonus=0.0)
METHODS = dict(  # sets of Config values; all run through the same code
    diswm={}, no_distill=NO_DISTILL, no_disentangle=NO_BETA, dreamerv2=DV2,
    dv2_finetune=DV2 | dict(carry_over="weights"), apv=DV2 | dict(carry_over="stack", bonus=0.1))
CHOICES |= dict(preset=PRESETS, method=METHODS)

# === Tasks and distractors (sections 2 and 4) ===
vars(np).setdefault("in1d", np.isin)  # dm_control's, dropped by NumPy
TASKS = {f"{domain}_{task}": (domain, task) for domain, task in suite.ALL_TASKS
         if domain != "lqr"}  # whose actions have no bounds
OTHER_TASKS = dict(pusher="pusher", drawer_open="drawer", drawer_close="drawer")
PHASES = ("train", "shifted", "eval", "none")  # half 1, half 2, on metal, the task's own colours
# DEVIATION: as published; the paper says around the original ones.
COLOR_CENTERS = dict(train=(0.7, 0.3, 0.5), shifted=(0.5, 0.7, 0.3), eval=(0.5, 0.7, 0.3))

def family(task):
    """"dmc", "pusher", "drawer" or "gymnasium": the domain that a task is of."""
    return OTHER_TASKS.get(task, "dmc" if task in TASKS else "gymnasium")

def check_task(task):
    """Raise UsageError unless there is such a task."""
    if task in TASKS or task in OTHER_TASKS:
        return
    with contextlib.redirect_stderr(io.StringIO()):  # it prints a notice
        import gymnasium_robotics  # noqa: F401  registers its tasks
    if task not in gym.registry or task.startswith("DisWM/"):
        raise UsageError(f"unknown task '{task}'; there are: {' '.join(TASKS | OTHER_TASKS)}")

class DMControlEnv(gym.Env):
    """A task of dm_control.suite, with nothing observed."""
    def __init__(self, domain, task):
        self.env = suite.load(domain, task, dict(random=0, time_limit=math.inf))
        self.env.physics._make_rendering_contexts = lambda: None  # they spoil ours
        self.model, self.data = self.env.physics.model.ptr, self.env.physics.data.ptr
        self.metadata = dict(render_fps=1 / self.env.control_timestep())
        if domain in ("acrobot", "ball_in_cup", "fish", "pendulum", "swimmer"):
            self.model.cam_fovy *= 0.82  # closer, else < 1 % of the picture moves
        spec = self.env.action_spec()
        self.action_space = gym.spaces.Box(np.float32(spec.minimum), np.float32(spec.maximum))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.env.task.random.seed(seed)
        self.env.reset()
        return None, {}

    def step(self, action):
        step = self.env.step(action)
        terminated = step.discount == 0  # 1 at a time limit
        return None, float(step.reward), terminated, step.last() and not terminated, {}

def drawer_world(task):
    """Meta-World's task, whose table top reset(options={"phase": …}) chooses."""
    import metaworld.env_dict  # takes a second
    textures = metaworld.__path__[0] + "/assets/textures/"
    grid = dict(builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mark=mujoco.mjtMark.mjMARK_EDGE,
                rgb1=(0.1, 0.2, 0.3), rgb2=(0.2, 0.3, 0.4), width=300, height=300)
    table_tops = dict(train=grid, shifted=dict(file=textures + "wood.png"),
                      eval=dict(file=textures + "metal.png"))
    class DrawerWorld(metaworld.env_dict.ALL_V3_ENVIRONMENTS[task.replace("_", "-") + "-v3"]):
        def _initialize_simulation(self):
            spec = mujoco.MjSpec.from_file(self.fullpath)
            for phase, source in table_tops.items():
                spec.add_texture(name=phase, type=mujoco.mjtTexture.mjTEXTURE_2D, **source)
                material = spec.add_material(name=phase, texrepeat=(1, 1), texuniform=True)
                material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = phase
            model = spec.compile()
            return model, mujoco.MjData(model)

        def reset(self, *, seed=None, options=None):
            if seed is not None:
                self.seed(seed)  # reset ignores it
            top = self.model.body("tablelink").geomadr[0]  # a box on the legs
            name = options["phase"].replace("none", "table_wood")
            self.model.geom_matid[top] = self.model.mat(name).id
            result = super().reset()
            mujoco.mj_forward(self.model, self.data)  # else it is drawn where it was
            return result

    env = DrawerWorld()
    # Draw a goal at each reset; its own benchmark sets one of a list.
    env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
    env.max_path_length = math.inf  # make_env limits the time
    return env

def bare_simulator(task):
    """A task's bare simulator → (env, simulator steps per episode)."""
    if task in TASKS:
        return DMControlEnv(*TASKS[task]), 1000
    if family(task) == "drawer":
        return drawer_world(task), 200
    name = task.replace("pusher", "Pusher-v5")
    env = gym.make(name, disable_env_checker=True).unwrapped
    return env, gym.spec(name).max_episode_steps or 1000

CAMERAS = dict(  # a task's beginning → a camera's name or a free one's values
    quadruped="y", dog_fetch="y-axis", cartpole_three_poles="lookatcart",
    PointMaze=dict(elevation=-90),  # else its walls hide it
    Reacher=dict(distance=0.65, elevation=-90, lookat=(0, 0, 0)),
    InvertedDoublePendulum=dict(distance=4, elevation=-10, lookat=(0, 0, 0.6)),
    pusher=dict(distance=2, elevation=-90, lookat=(0, -0.5, 0.2)),  # as published
    # DEVIATION: published from 0.96 above, which cuts this drawer off.
    drawer=dict(distance=1.2, azimuth=180, elevation=-90, lookat=(0, 0.62, 0)))

def find_camera(env, task, name):
    """The named one, that of CAMERAS, dm_control's first or gymnasium's choice."""
    names = [env.model.camera(i).name for i in range(env.model.ncam)]
    if name and name not in names:
        raise UserError(f"no camera '{name}'; {task} has: {', '.join(names) or 'none'}")
    views = [CAMERAS[start] for start in CAMERAS if task.startswith(start)]
    views += [other for other in names if task in TASKS or other == "track"]
    view = name or (views or [{}])[0]
    if view in names:
        return view
    camera, own = mujoco.MjvCamera(), vars(getattr(env, "mujoco_renderer", env))
    mujoco.mj_kinematics(env.model, env.data)
    values = dict(lookat=np.median(env.data.geom_xpos, 0), distance=env.model.stat.extent)
    for field, value in (values | (own.get("default_cam_config") or {}) | view).items():
        setattr(camera, field, value)
    return camera

def color_box(phase, original, colors="published", half_range=0.2):
    """A phase's colours: (low, high), both like `original` (n, 3), 0..1."""
    center = original if phase == "train" else np.roll(original, 1, -1)  # (ours)
    if colors == "published":
        center = np.broadcast_to(COLOR_CENTERS[phase], original.shape)
    return np.clip(center - half_range, 0, 1), np.clip(center + half_range, 0, 1)

def color_groups(task, model):
    """Of each group: an RGBA array and its rows that share a colour."""
    if family(task) == "drawer":
        return []  # textures instead
    if task in TASKS:
        return [(model.mat_rgba, [i]) for i in range(model.nmat)]
    if task == "pusher":  # as published: object, table, arm
        arm = [model.geom(name).id for name in ("uar", "ua", "ef", "sp", "fa", "sl", "e1", "e2")]
        groups = [model.body("object").geomadr[0]], [model.geom("table").id], arm
        return [(model.geom_rgba, rows) for rows in groups]
    own = (model.geom_matid < 0) | (model.geom_rgba != (0.5, 0.5, 0.5, 1)).any(1)  # no material
    materials = [(model.mat_rgba, [i]) for i in np.unique(model.geom_matid[~own])]
    return materials + [(model.geom_rgba, [i]) for i in np.flatnonzero(own)]

class DistractingEnv(gym.Wrapper):
    """A simulator in new colours each episode, by the phase in reset's options."""
    render_mode = "rgb_array"
    spec = property(lambda self: self.unwrapped.spec)  # of make_env

    def __init__(self, env, task, phase, *, action_repeat=2, colors="published",
                 color_range=0.2, fast_render=False, camera="", size=64):
        super().__init__(env)
        model, self.data = self.unwrapped.model, self.unwrapped.data
        self.phase, self.action_repeat = phase, action_repeat
        fps = env.metadata.get("render_fps", 25) / action_repeat  # decisions a second
        self.metadata = dict(render_modes=["rgb_array"], render_fps=fps)
        self.groups = color_groups(task, model)
        self.original = [array[rows, :3] for array, rows in self.groups]  # copies
        original = np.array([rgb[0] for rgb in self.original]).reshape(-1, 3)
        self.boxes = {p: color_box(p, original, colors, color_range) for p in COLOR_CENTERS}
        if task == "pusher":  # its object is black
            self.boxes = {p: np.array(box) * [[0], [1], [1]] for p, box in self.boxes.items()}
        self.camera = find_camera(self.unwrapped, task, camera)
        self.observation_space = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        # DEVIATION: small shadow maps, no mirrors: fast, < 0.6 / 255.
        model.vis.quality.shadowsize = 512
        if fast_render:
            model.vis.quality.offsamples = 0  # half of the rest, for 1–2 / 255
        self.renderer = mujoco.Renderer(model, size, size)  # env.render() mixes textures
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self.renderer._scene_option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = 0  # rays
        atexit.register(self.renderer.close)  # else errors at exit

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng([seed, 1])  # not the simulator's
        phase = (options or {}).get("phase", self.phase)
        if phase not in PHASES:
            raise UsageError(f"unknown phase '{phase}'; there are: {', '.join(PHASES)}")
        self.phase, colors = phase, self.original
        if phase != "none":
            colors = self.rng.uniform(*self.boxes[phase])
        for (array, rows), color in zip(self.groups, colors, strict=True):
            array[rows, :3] = color
        mujoco.mj_resetData(self.unwrapped.model, self.data)  # a hand's leaves some
        _, info = self.env.reset(seed=seed, options=dict(phase=phase))
        for index in range(self.unwrapped.model.nhfield):
            self.renderer._gl_context.make_current()  # quadruped's terrain is new
            mujoco.mjr_uploadHField(self.unwrapped.model, self.renderer._mjr_context, index)
        return self.render(), info

    def step(self, action):
        # DEVIATION: published, 4 steps and doubled rewards.
        total, steps, over, reached = 0.0, 0, False, []
        while steps < self.action_repeat and not over:
            _, reward, terminated, truncated, info = self.env.step(action)
            total, steps, over = total + reward, steps + 1, terminated or truncated
            reached += [info[key] for key in ("success", "is_success") if key in info]
        success = dict(success=any(reached)) if reached else {}
        info = info | success | dict(env_steps=steps)
        return self.render(), total, terminated, truncated, info

    def render(self):
        if hasattr(self.unwrapped, "_render_callback"):  # puts Fetch's goal
            warmstart = self.data.qacc_warmstart.copy()
            self.unwrapped._render_callback()
            self.data.qacc_warmstart[:] = warmstart  # to look changes nothing
        self.renderer.update_scene(self.data, camera=self.camera)
        return self.renderer.render()

    def close(self):
        atexit.unregister(self.renderer.close)
        self.renderer.close()
        super().close()

def make_env(task, *, phase="train", seed=0, time_limit=0, render_mode=None, **settings):
    """Actions in [−1, 1], uint8 images. time_limit: simulator steps; 0: the task's own."""
    check_task(task)
    if os.getpid() != PROCESS:
        raise UserError('OpenGL hangs in a forked process; use context="spawn"')
    with reading(task, f"MuJoCo task with continuous actions, or {GL} fails", GL_REMEDY):
        env, limit = bare_simulator(task)
        env = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
        env = gym.wrappers.TimeLimit(env, time_limit or limit)
        env = DistractingEnv(env, task, phase, **settings)
    env.reset(seed=seed)
    return env

ENVIRONMENT = ("action_repeat", "time_limit", "colors", "color_range", "fast_render", "camera")
for name in (*TASKS, *OTHER_TASKS):
    gym.register(f"DisWM/{name}-v0", f"{__name__}:make_env", kwargs=dict(task=name))

def config_env(cfg, task):
    """make_env with the values of a Config."""
    return make_env(task, **{name: getattr(cfg, name) for name in ENVIRONMENT})

# === Episodes and the replay buffer ===
VIDEO_ROW = np.dtype([("image", np.uint8, (64, 64, 3)), ("is_first", np.bool_)])
IMPORT = "run: python results/import_videos.py FROM TO"

def agent_row(action_dim):
    """A row of an agent's episode as a NumPy dtype; videos have image and is_first alone.
           row t       0     1      …
           image      o_0   o_1
          action       0    the a that led to o_1     (the paper's a_{t−1})
          reward       0    the r that came with o_1
        discount       1    0 if o_1 is terminal, which a time limit is not
        is_first       1    0"""
    return np.dtype([*VIDEO_ROW.descr, ("action", np.float32, (action_dim,)),
                     ("reward", np.float32), ("discount", np.float32)])

class Episode:
    """An episode that is being played, in rows of `agent_row`."""
    def __init__(self, env, seed, phase):
        image, _ = env.reset(seed=seed, options=dict(phase=phase))
        self.env, self.over, self.success, self.total = env, False, None, 0.0
        env.action_space.seed(seed + 2**32)  # not the simulator's
        action = np.zeros(env.action_space.shape, np.float32)
        self.rows = [dict(image=image, action=action, reward=0.0, discount=1.0, is_first=True)]

    def step(self, action):
        """Act, and store what comes of it. Returns the number of env steps."""
        image, reward, terminated, truncated, info = self.env.step(action)
        self.rows.append(dict(image=image, action=action, reward=reward,
                              discount=1.0 - terminated, is_first=False))
        self.over, self.total = terminated or truncated, self.total + float(reward)
        self.success = self.success or info.get("success")
        return info["env_steps"]

def write_whole(path, content):
    """Write a file's bytes, all of them or, if that fails, none."""
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_bytes(content)
    os.replace(temporary, path)

class Replay:
    """Finished episodes, a file each, laid end to end; windows start uniformly anywhere.
        episodes    ┌──────── 0 ────────┐┌──── 1 ────┐┌─────── 2 ──────
        rows        F . . . . . . . . . .F . . . . . .F . . . . . . . .      F: is_first
        a window                [. . . . . . F . . .]
    The images are np.load(path)["image"]. Fields not in `dtype` are left unread."""
    def __init__(self, folder, dtype=VIDEO_ROW, device="cpu"):
        self.folder, self.dtype, self.paths, self.bounds = Path(folder), dtype, [], [0]
        self.device, self.copies, self.thread, self.ahead = device, [], ThreadPoolExecutor(1), {}
        for path in sorted(self.folder.glob("*.npy")):
            self.append(path)

    def append(self, path):
        """Index an episode on disk; copy it to a GPU with room. bounds[i]: the rows before it."""
        rows = self.read(path)
        self.paths.append(path)
        self.bounds.append(self.bounds[-1] + len(rows))
        if self.device != "cpu":
            self.copies.append({name: torch.from_numpy(rows[name].copy()).to(self.device)
                                for name in self.dtype.names})
            if torch.cuda.mem_get_info()[0] < 4e9:  # bytes, which an update may need
                self.device, self.copies = "cpu", []

    def read(self, path):
        """An episode's rows, mapped into memory. UserError at wrong fields."""
        with reading(path, f"episode with {', '.join(self.dtype.names)}", IMPORT):
            rows = np.load(path, mmap_mode="r", allow_pickle=False)
            good = all(rows.dtype[name] == self.dtype[name] for name in self.dtype.names)
            if not good or rows.ndim != 1 or len(rows) == 0:
                raise ValueError(f"its rows are {rows.dtype} {rows.shape}")
            return rows

    def add(self, rows):
        """Append a finished episode, a list of dicts with the fields of `dtype`."""
        fields, file = self.dtype.names, io.BytesIO()
        rows = [tuple(row[name] for name in fields) for row in rows]
        np.save(file, np.array(rows, self.dtype))
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{len(self.paths):06d}.npy"
        write_whole(path, file.getbuffer())
        self.append(path)

    def keep(self, count):
        """Return to the first episodes; later ones, of a run cut off, go."""
        if [path.stem for path in self.paths[:count]] != [f"{i:06d}" for i in range(count)]:
            raise UserError(f"{self.folder} lacks episodes; start over with --fresh")
        for path in self.paths[count:]:
            path.unlink(missing_ok=True)
        del self.paths[count:], self.bounds[count + 1:], self.copies[count:]

    def window(self, start, length):
        """Rows start … start + length − 1: a dict of them for each episode in turn"""
        while length > 0:
            index = np.searchsorted(self.bounds, start, side="right") - 1
            rows = self.copies[index] if self.copies else self.read(self.paths[index])
            first = start - self.bounds[index]
            count = min(length, self.bounds[index + 1] - start)
            yield {name: rows[name][first:first + count] for name in self.dtype.names}
            start, length = start + count, length - count

    def sample(self, batch_size, length, seed):
        """Dict of (B, T, ...); windows begin is_first, where the RSSM forgets."""
        rng = np.random.default_rng(seed)
        starts = rng.integers(0, self.bounds[-1] - length + 1, batch_size)
        pieces = [piece for start in starts for piece in self.window(start, length)]
        batch, join = {}, torch.cat if self.copies else np.concatenate
        for name in self.dtype.names:
            rows = join([piece[name] for piece in pieces])
            batch[name] = rows.reshape(batch_size, length, *rows.shape[1:])
        batch["is_first"][:, 0] = True
        return batch

    def batch(self, cfg, index):
        """The batch of an update. From the disk, a thread draws the next one for a GPU."""
        size, next_key = (cfg.batch_size, cfg.batch_length), (index + 1, self.bounds[-1])
        ahead = self.ahead.get((index, self.bounds[-1]))  # None if an episode came in between
        batch = ahead.result() if ahead else self.sample(*size, [cfg.seed, index])
        if cfg.device == "cuda" and not self.copies:
            self.ahead = {next_key: self.thread.submit(self.sample, *size, [cfg.seed, index + 1])}
        return batch

# === Maths: pure functions of tensors ===
def beta_vae_kl(mean, logvar):
    """Disentanglement loss of Eqs. (2), (5): KL[N(mean, exp(logvar)) || N(0, I)].
    mean, logvar: (..., Z). Returns (...,), nats summed over the latent dimensions."""
    # ½ Σ (μ² + σ² − 1 − ln σ²)
    # DEVIATION: the published one adds 1e-6; this is exactly 0 at N(0, I).
    return 0.5 * (mean**2 + logvar.exp() - 1 - logvar).sum(-1)

def rssm_kl_loss(post, prior, balance=0.8, free_nats=1.0):
    """KL of posterior and prior in Eqs. (2), (5), with DreamerV2's balancing and free nats.
        balance · max(mean KL[sg(q) || p], free) + (1 − balance) · max(mean KL[q || sg(p)], free)
    post, prior: dicts of `mean` and `std`, (B, T, S) → (scalar loss, plain KL (B, T)), nats."""
    q, p = Normal(post["mean"], post["std"]), Normal(prior["mean"], prior["std"])
    sg_q, sg_p = (Normal(x.mean.detach(), x.stddev.detach()) for x in (q, p))
    prior_side = kl_divergence(sg_q, p).sum(-1)  # (B, T), trains p
    value = kl_divergence(q, sg_p).sum(-1)  # (B, T), trains q
    prior_loss, post_loss = (kl.mean().clamp(min=free_nats) for kl in (prior_side, value))
    return balance * prior_loss + (1 - balance) * post_loss, value

def distillation_loss(z_disen, z_task):
    """Latent distillation, Eq. (3): KL(z_disen || z_task) = Σ z_disen · ln(z_disen / z_task).
    Softmax makes probability vectors of samples z_disen (the teacher's), z_task, (B, T, Z).
    Returns a scalar, nats: the sum over time, the mean over the batch."""
    log_disen = z_disen.detach().log_softmax(-1)  # sg: the teacher is fixed
    log_task = z_task.log_softmax(-1)
    return (log_disen.exp() * (log_disen - log_task)).sum((-2, -1)).mean()

def eta_schedule(step, start=0.1, end=0.01, decay_steps=50_000, delay=0):
    """η after `step` decisions (section 3.4): 0 before `delay`, then falling from start to end,
    on a line that would reach 0 at delay + decay_steps."""
    if step < delay:
        return 0.0
    return max(start * (1 - (step - delay) / decay_steps), min(start, end))  # never above start

def lambda_return(reward, value, discount, bootstrap, lambda_=0.95):
    """λ-target V_t (appendix B), the actor's objective and the critic's regression target.
        V_t = r_t + γ_t · ((1 − λ) · v_{t+1} + λ · V_{t+1}),    V_H = v_H = bootstrap
              t      0     1    …   H−1    H
         reward     r_0   r_1      r_{H−1}
          value     v_0   v_1      v_{H−1}  bootstrap
         return     V_0   V_1      V_{H−1}
    reward, value, discount: (H, ...), bootstrap: (...) → (H, ...), differentiable in all."""
    next_value = torch.cat([value[1:], bootstrap[None]])  # v_{t+1}: (H, ...)
    returns, target = [], bootstrap
    for t in reversed(range(len(reward))):
        target = reward[t] + discount[t] * torch.lerp(next_value[t], target, lambda_)
        returns.append(target)
    return torch.stack(returns[::-1])  # back in time order

# === Networks ===
ELU = nn.ELU(inplace=True)  # has no weights; 19 % less memory at 50 × 50

def kaiming(module):
    """Kaiming-normal weights and zero biases, for the β-VAE only (published)."""
    for value in module.parameters():
        nn.init.kaiming_normal_(value) if value.dim() > 1 else nn.init.zeros_(value)

class PerFrame(nn.Module):
    """Layers for the last `dims` dimensions of x; all before are one batch. fp32 out."""
    def __init__(self, dims, *layers):
        super().__init__()
        self.dims, self.net = dims, nn.Sequential(*layers)

    def forward(self, x):
        return self.net(x.flatten(0, -1 - self.dims)).float().unflatten(0, x.shape[:-self.dims])

def mlp(inputs, units, layers, outputs=1):
    """`layers` hidden layers with ELU, then a linear one: (..., inputs) → (..., outputs)."""
    hidden = [nn.Linear(inputs, units), ELU]
    for _ in range(layers - 1):
        hidden += [nn.Linear(units, units), ELU]
    return PerFrame(1, *hidden, nn.Linear(units, outputs))

class BiasGradient(torch.autograd.Function):
    """The identity of y (N, C, h, w), whose gradient, summed, is also the bias's (C,)."""
    @staticmethod
    def forward(ctx, y, bias):
        ctx.mark_dirty(y)  # not copied
        return y

    @staticmethod
    def backward(ctx, grad):
        return grad, grad.sum((0, 2, 3))

class Deconvolution(nn.ConvTranspose2d):
    """The same in less time: 16 % of an update of `small` DreamerV2."""
    def forward(self, x):
        if x.shape[-1] == 1:  # of one pixel, unpadded, it is a matrix product
            return torch.einsum("nixy,iohw->nohw", x, self.weight) + self.bias[:, None, None]
        odd = self.kernel_size[0] % 2  # kernels of odd size are slow; with zeros they are even
        weight = F.pad(self.weight, (0, odd, 0, odd))
        y = F.conv_transpose2d(x, weight, self.bias.detach(), self.stride, self.padding)
        y = BiasGradient.apply(y, self.bias)  # PyTorch sums this one slowly
        return y[..., :-1, :-1].clone() if odd else y  # ELU's gradient is slow on a view

class BetaVAEEncoder(PerFrame):
    """β-VAE encoder of Eqs. (1), (4): image (..., 3, 64, 64) → 𝐳 (..., Z)."""
    def __init__(self, z_dim=20, d=32):
        super().__init__(
            3, nn.Conv2d(3, d, 4, 2, 1), ELU,  # 32 × 32
            nn.Conv2d(d, d, 4, 2, 1), ELU,  # 16 × 16
            nn.Conv2d(d, 2 * d, 4, 2, 1), ELU,  # 8 × 8
            nn.Conv2d(2 * d, 2 * d, 4, 2, 1), ELU,  # 4 × 4
            nn.Conv2d(2 * d, 8 * d, 4), ELU,  # 1 × 1
            nn.Flatten(), nn.Linear(8 * d, 2 * z_dim))
        kaiming(self)

    def encode(self, image):
        """→ dict of `embed`, a draw of 𝐳, and its `mean` and `logvar`, (..., Z) each"""
        mean, logvar = self(image).chunk(2, -1)
        embed = Normal(mean, (logvar / 2).exp()).rsample()
        return dict(embed=embed, mean=mean, logvar=logvar)

class BetaVAEDecoder(PerFrame):
    """Decoder of Eqs. (1), (4): feat (..., S + D), a neck as narrow as 𝐳 → (..., 3, 64, 64)."""
    def __init__(self, feat_dim, z_dim=20, d=32):
        super().__init__(
            1, nn.Linear(feat_dim, z_dim), ELU,
            nn.Linear(z_dim, 8 * d), ELU, nn.Unflatten(-1, (8 * d, 1, 1)),  # 1 × 1
            Deconvolution(8 * d, 2 * d, 4), ELU,  # 4 × 4
            Deconvolution(2 * d, 2 * d, 4, 2, 1), ELU,  # 8 × 8
            Deconvolution(2 * d, d, 4, 2, 1), ELU,  # 16 × 16
            Deconvolution(d, d, 4, 2, 1), ELU,  # 32 × 32
            Deconvolution(d, 3, 4, 2, 1))  # 64 × 64
        kaiming(self)

class ConvEncoder(PerFrame):
    """DreamerV2's, for the baselines: image (..., 3, 64, 64) → embed (..., 32 d)."""
    def __init__(self, d=32):
        super().__init__(
            3, nn.Conv2d(3, d, 4, 2), ELU,  # 31 × 31
            nn.Conv2d(d, 2 * d, 4, 2), ELU,  # 14 × 14
            nn.Conv2d(2 * d, 4 * d, 4, 2), ELU,  # 6 × 6
            nn.Conv2d(4 * d, 8 * d, 4, 2), ELU, nn.Flatten())  # 2 × 2

    def encode(self, image):
        """→ dict of `embed`"""
        return dict(embed=self(image))

class ConvDecoder(PerFrame):
    """DreamerV2's, for the baselines: feat (..., S + D) → (..., 3, 64, 64)."""
    def __init__(self, feat_dim, d=32):
        super().__init__(
            1, nn.Linear(feat_dim, 32 * d), nn.Unflatten(-1, (32 * d, 1, 1)),  # 1 × 1
            Deconvolution(32 * d, 4 * d, 5, 2), ELU,  # 5 × 5
            Deconvolution(4 * d, 2 * d, 5, 2), ELU,  # 13 × 13
            Deconvolution(2 * d, d, 6, 2), ELU,  # 30 × 30
            Deconvolution(d, 3, 6, 2))  # 64 × 64

class RSSM(nn.Module):
    """Recurrent state-space model, Gaussian; action_dim=0 makes Eq. (1)'s action-free one.
        h_t = f(h_{t−1}, z_{t−1}, a_{t−1})   z_t ~ q(z_t | h_t, embed_t)   ẑ_t ~ p(ẑ_t | h_t)
    A state: dict of `deter` h (..., D), `stoch` z, later its `mean` and `std` too (..., S)."""
    def __init__(self, action_dim, embed_dim, stoch=50, deter=200, hidden=200):
        super().__init__()
        self.action_dim = action_dim
        self.sizes = dict(deter=deter, stoch=stoch)
        self.inputs = nn.Sequential(nn.Linear(stoch + action_dim, hidden), ELU)
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
        return {name: self.norm.weight.new_zeros(batch, size) for name, size in self.sizes.items()}

    def recur(self, state, action=None):
        """h_t = f(h_{t−1}, z_{t−1}, a_{t−1}): a GRU with layer norm."""
        x = state["stoch"]
        if self.action_dim:
            x = torch.cat([x, action], -1)
        gates = self.norm(self.gru(torch.cat([self.inputs(x), state["deter"]], -1)).float())
        reset, candidate, update = gates.chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        return torch.lerp(state["deter"], candidate, torch.sigmoid(update - 1))  # (B, D)

    def sample_state(self, net, inputs, deter):
        """A state around h_t, drawn from the normal that `net` makes of its inputs."""
        mean, std = net(inputs).chunk(2, -1)
        std = 2 * torch.sigmoid(std / 2) + 0.1  # in (0.1, 2.1)
        return dict(deter=deter, mean=mean, std=std, stoch=Normal(mean, std).rsample())

    def prior(self, deter):
        """ẑ_t ~ p(ẑ_t | h_t)"""
        return self.sample_state(self.prior_net, deter, deter)

    def posterior(self, deter, embed):
        """z_t ~ q(z_t | h_t, embed_t)"""
        return self.sample_state(self.post_net, torch.cat([deter, embed], -1), deter)

    def step(self, state, action, embed, keep):
        """A filtering step; where keep (B, 1) is 0, not 1, state and action are forgotten."""
        state = {name: state[name] * keep for name in self.sizes}
        if self.action_dim:
            action = action * keep
        return self.posterior(self.recur(state, action), embed)

    @torch.autocast("cuda", enabled=False)  # there, casts cost more than they save
    def observe(self, embed, action, is_first):
        """Filter windows: (B, T, Z), (B, T, A) or None, (B, T) → post, prior: (B, T, ·) each."""
        state, states = self.initial(len(embed)), []
        keep = 1 - is_first.to(embed.dtype)[..., None]
        for t in range(embed.shape[1]):
            previous = action[:, t] if self.action_dim else None  # it led to image t
            state = self.step(state, previous, embed[:, t], keep[:, t])
            states.append(state)
        post = {name: torch.stack([s[name] for s in states], 1) for name in state}
        return post, self.prior(post["deter"])  # of all steps at once

class StackedRSSM(RSSM):
    """APV's: its posterior sees s_t of the action-free RSSM `below` too, (..., S + D)."""
    def __init__(self, action_dim, embed_dim, stoch=50, deter=200, hidden=200):
        super().__init__(action_dim, embed_dim + stoch + deter, stoch, deter, hidden)
        self.below = RSSM(0, embed_dim, stoch, deter, hidden)
        self.sizes["below"] = stoch + deter

    def step(self, state, action, embed, keep):
        stoch, deter = state["below"].split([self.sizes["stoch"], self.sizes["deter"]], -1)
        below = self.feat(self.below.step(dict(stoch=stoch, deter=deter), None, embed, keep))
        return super().step(state, action, torch.cat([embed, below], -1), keep) | dict(below=below)

class IntrinsicBonus(nn.Module):
    """APV's reward for the unusual: mean distance to the k nearest of recent states."""
    def __init__(self, feat_dim, k=16, window=5, size=4096, dims=128, momentum=0.99):
        super().__init__()
        self.k, self.window, self.momentum = k, window, momentum
        self.register_buffer("projection", torch.randn(feat_dim, dims) / dims)
        self.register_buffer("queue", torch.full((size, dims), math.nan))  # newest first
        self.register_buffer("scale", torch.ones(()))  # running mean of |x|

    @torch.no_grad()
    def forward(self, feat):
        """feat (B, T, S + D) → (B, T − window + 1): row t is of rows t … t + window − 1."""
        means = feat.unfold(1, min(self.window, feat.shape[1]), 1).mean(-1)
        x = (means.double() @ self.projection.double()).float().flatten(0, 1)  # not in bf16
        self.queue.copy_(torch.cat([x, self.queue])[:len(self.queue)])  # x counts as seen
        distance = torch.cdist(x.double(), self.queue.double()).float()  # small ones drown in fp32
        nearest = distance.sort(-1).values[:, :self.k].nanmean(-1)  # NaN is sorted to the end
        self.scale.lerp_(nearest.mean(), 1 - self.momentum)
        return (nearest / (self.scale + 1e-8)).unflatten(0, means.shape[:2])

# === Video predictor, Eqs. (1) and (2) ===
class VideoPredictor(nn.Module):
    """The action-free video prediction model of Eq. (1), trained by Eq. (2)."""
    def __init__(self, cfg, action_dim=0):
        super().__init__()
        self.cfg, self.feat_dim = cfg, cfg.stoch + cfg.deter
        bf16 = cfg.precision == "bf16"  # of convolutions and MLPs; at 50 × 50 fp32 takes 1.7×
        self.autocast = torch.autocast(cfg.device, torch.bfloat16, bf16)
        if cfg.encoder == "beta_vae":
            self.encoder, embed_dim = BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth), cfg.z_dim
            self.decoder = BetaVAEDecoder(self.feat_dim, cfg.z_dim, cfg.cnn_depth)
        else:
            self.encoder, embed_dim = ConvEncoder(cfg.cnn_depth), 32 * cfg.cnn_depth
            self.decoder = ConvDecoder(self.feat_dim, cfg.cnn_depth)
        self.decoder.to(memory_format=torch.channels_last)  # with Deconvolution 12 % of a step
        rssm = StackedRSSM if cfg.carry_over == "stack" and action_dim else RSSM
        self.rssm = rssm(action_dim, embed_dim, cfg.stoch, cfg.deter, cfg.hidden)
        if cfg.device == "cuda":  # one kernel for the many of a GRU cell; without a compiler, none
            torch._dynamo.config.suppress_errors = True
            self.rssm.recur = torch.compile(self.rssm.recur)
        self.weights = dict(image=1.0, kl_loss=cfg.beta1, disentangle=cfg.beta2)

    def forward(self, batch):
        """Filter windows → dict of code (by `encode`), post, prior, feat."""
        # DEVIATION: published, the predictor sees means of latents, zeros for actions.
        code = self.encoder.encode(batch["image"])
        post, prior = self.rssm.observe(code["embed"], batch.get("action"), batch["is_first"])
        return dict(code=code, post=post, prior=prior, feat=self.rssm.feat(post))

    def frame_losses(self, out, batch):
        """The loss terms of each frame, nats: dict of (B, T)."""
        # DEVIATION: −ln p(o_t | z_t) without ½ ln 2π per pixel.
        error = F.mse_loss(self.decoder(out["feat"]).movedim(-3, -1),  # as both lie in memory
                           batch["image"].movedim(-3, -1), reduction="none")
        losses = dict(image=0.5 * error.flatten(-3).sum(-1))
        if "mean" in out["code"]:
            losses["disentangle"] = beta_vae_kl(out["code"]["mean"], out["code"]["logvar"])
        return losses

    def loss(self, out, batch, z_disen=None, eta=0.0):
        """Eq. (2) or (5), of forward's output and a teacher's z_disen (B, T, Z): loss, metrics"""
        cfg, post, prior = self.cfg, out["post"], out["prior"]
        terms = {name: loss.mean() for name, loss in self.frame_losses(out, batch).items()}
        terms["kl_loss"], kl = rssm_kl_loss(post, prior, cfg.kl_balance, cfg.free_nats)
        weights = self.weights | dict(distill=eta)
        if z_disen is not None:
            terms["distill"] = distillation_loss(z_disen, out["code"]["embed"])
        loss = sum(weights[name] * term for name, term in terms.items())
        return loss, {name: x.detach() for name, x in terms.items()} | dict(kl=kl.mean().detach())

# === World model, Eqs. (4) and (5) ===
class WorldModel(VideoPredictor):
    """The world model of Eq. (4): Eq. (1) with actions, reward and discount; Eq. (5)."""
    def __init__(self, cfg, action_dim):
        super().__init__(cfg, action_dim)
        self.weights = dict(image=1.0, kl_loss=cfg.alpha, disentangle=cfg.beta,
                            reward=cfg.reward_scale, discount=1.0)
        self.reward = mlp(self.feat_dim, cfg.units, 2)  # r̂, the mean of a unit Gaussian
        self.discount = mlp(self.feat_dim, cfg.units, 3)  # the logit of γ̂
        self.bonus = IntrinsicBonus(self.feat_dim) if cfg.bonus else None

    def frame_losses(self, out, batch):
        """Those of Eq. (2), reward, discount: (B, T). With a bonus the last rows lack a reward."""
        losses = super().frame_losses(out, batch)
        feat, reward = out["feat"], batch["reward"]
        # DEVIATION: published, the discount head of Eq. (4) is off.
        logit, target = self.discount(feat).squeeze(-1), self.cfg.gamma * batch["discount"]
        losses["discount"] = F.binary_cross_entropy_with_logits(logit, target, reduction="none")
        if "bonus" in out:
            rows = out["bonus"].shape[1]
            feat, reward = feat[:, :rows], reward[:, :rows] + self.cfg.bonus * out["bonus"]
        losses["reward"] = 0.5 * (self.reward(feat).squeeze(-1) - reward)**2
        return losses

    @torch.no_grad()
    def carry_over(self, video):
        """Take over a VideoPredictor's weights (in a stack, the RSSM's go below)."""
        # DEVIATION: it saw no actions. Zeros are as good, and train no input weights.
        for part in ("encoder", "decoder", "rssm"):
            module = getattr(self, part)
            weights = getattr(module, "below", module).state_dict()  # it shares their memory
            for name, value in getattr(video, part).state_dict().items():
                weights[name][..., :value.shape[-1]] = value  # actions' input weights stay

# === Actor-critic: behaviour in imagination, appendix B ===
class ActorCritic(nn.Module):
    """Actor π(a | s), critic v(s), and its slow copy, which gives the targets."""
    def __init__(self, cfg, action_dim):
        super().__init__()
        self.cfg, feat_dim = cfg, cfg.stoch + cfg.deter
        self.actor = mlp(feat_dim, cfg.units, 4, 2 * action_dim)
        self.critic = mlp(feat_dim, cfg.units, 3)
        self.slow_critic = mlp(feat_dim, cfg.units, 3).requires_grad_(False)  # only copied
        self.slow_critic.load_state_dict(self.critic.state_dict())

    def policy(self, feat):
        """The normal that actions come from, by `squash`, (..., A)."""
        # DEVIATION: published, a normal around tanh(m), which can get stuck.
        mean, std = self.actor(feat).chunk(2, -1)
        std = 2 * torch.sigmoid(std / 2) + 0.1  # as in the RSSM
        if self.cfg.actor == "clipped":
            mean = torch.tanh(mean)
        return Normal(mean, std)

    def squash(self, x):
        """A policy's sample or mean → an action in [−1, 1], and ln |da/dx|, (..., A) each"""
        if self.cfg.actor == "clipped":  # gradient straight through, so that it can come back
            clipped = x.clamp(1e-6 - 1, 1 - 1e-6)
            return x + (clipped - x).detach(), torch.zeros_like(x)
        log_slope = 2 * (math.log(2) - x - F.softplus(-2 * x))  # ln(1 − tanh² x)
        return torch.tanh(x), log_slope

    @torch.autocast("cuda", enabled=False)  # as in RSSM.observe
    def imagine(self, model, start):
        """Follow the policy through the world model's prior, H transitions from N states.
              t        0     1    …   H−1      H
            feat      s_0   s_1      s_{H−1}  s_H     s_0 a posterior, the others imagined
          action      a_0   a_1      a_{H−1}          a_t is taken in s_t, leads to s_{t+1}
          reward      r_0   r_1      r_{H−1}          r̂(s_t)
        discount      γ_0   γ_1      γ_{H−1}          γ̂(s_t)
        Returns the feats but s_H (H, N, S + D), s_H, log_probs and entropies (H, N)."""
        state, feats, draws = start, [model.rssm.feat(start)], []
        for _ in range(self.cfg.horizon):
            # Its gradient comes from where the action leads, not from the state it sees.
            policy = self.policy(feats[-1].detach())
            x = policy.rsample()
            action, log_slope = self.squash(x)
            draws.append((policy.mean, policy.stddev, x, log_slope))
            state = model.rssm.prior(model.rssm.recur(state, action))
            feats.append(model.rssm.feat(state))
        last = feats.pop()
        mean, std, x, log_slope = (torch.stack(values) for values in zip(*draws, strict=True))
        log_prob = (Normal(mean, std).log_prob(x.detach()) - log_slope.detach()).sum(-1)
        return torch.stack(feats), last, log_prob, (Normal(mean, std).entropy() + log_slope).sum(-1)

    def losses(self, model, start, start_discount):
        """From N detached states, (N, ·), and their true γ_0: actor_loss, critic_loss, metrics"""
        cfg = self.cfg
        feats, last, log_prob, entropy = self.imagine(model, start)
        reward = model.reward(feats).squeeze(-1)  # (H, N)
        discount = torch.sigmoid(model.discount(feats)).squeeze(-1)
        discount = torch.cat([start_discount[None], discount[1:]])  # γ_0 is known
        # DEVIATION: the published λ-return comes out reversed in time.
        target = lambda_return(reward, self.slow_critic(feats).squeeze(-1), discount,
                               self.slow_critic(last).squeeze(-1), cfg.lambda_)
        # w_t = Π_{i<t} γ_i: how likely the episode still runs; nothing to optimise.
        weight = torch.cat([torch.ones_like(discount[:1]), discount[:-1]]).cumprod(0).detach()
        value = self.critic(feats.detach()).squeeze(-1)  # the model is fixed
        critic_loss = (weight * 0.5 * (value - target.detach())**2).mean()  # sg(V_t)
        advantage = (target - value).detach()  # sg(V_t − v(s_t))
        # ρ V_t + (1 − ρ) ln π(a_t | s_t) sg(V_t − v(s_t)) + scale · H[a_t | s_t]
        objective = (cfg.rho * target + (1 - cfg.rho) * log_prob * advantage
                     + cfg.entropy_scale * entropy)
        actor_loss = -(weight * objective).mean()
        with torch.no_grad():  # is the actor alive, and does it heed the state?
            policy = self.policy(feats[0, :64])
            (mode, _), (action, _) = self.squash(policy.mean), self.squash(policy.rsample())
        return actor_loss, critic_loss, dict(
            actor=actor_loss, critic=critic_loss, actor_entropy=entropy.mean(),
            value=value.mean(), imagined_reward=reward.mean(), imagined_return=target.mean(),
            actor_slope=(1 - mode**2).mean(), actor_std=policy.stddev.mean(),
            actor_spread=policy.mean.std(0, correction=0).mean(),  # over states
            actor_saturated=(action.abs() > 0.99).float().mean())

    @torch.no_grad()
    def value_correlation(self, feats, rows):
        """Of v(s_t) with the discounted return that came, over an episode's rows but the last."""
        value = self.critic(torch.cat(feats)).squeeze(-1)  # (T,)
        reward, discount = value.new_tensor([(x["reward"], x["discount"]) for x in rows]).T
        came = lambda_return(reward, value, self.cfg.gamma * discount, value[-1], lambda_=1.0)
        return torch.corrcoef(torch.stack([value, came]))[0, 1].nan_to_num().item()

# === One update of all of them ===
def to_device(batch, device):
    """Arrays → tensors on the device, images (..., 3, 64, 64) in [−0.5, 0.5]."""
    batch = {name: torch.as_tensor(value, device=device) for name, value in batch.items()}
    return batch | dict(image=batch["image"].movedim(-1, -3).float().div_(255).sub_(0.5))

def adam(module, lr):
    """The optimiser of a module's parameters; ε as published."""
    return torch.optim.Adam(module.parameters(), lr, eps=1e-5, fused=True, capturable=True)

def descend(loss, optimizer, clip):
    """A step by the optimiser's parameters alone → the gradient's norm, which is clipped."""
    parameters = optimizer.param_groups[0]["params"]
    optimizer.zero_grad()
    loss.backward(inputs=parameters)
    norm = nn.utils.clip_grad_norm_(parameters, clip)
    optimizer.step()
    return norm

def mean_metrics(rows):
    """The average of several updates' metrics, floats. UserError, before the run saves, at NaN."""
    values = torch.stack([torch.stack([*row.values()]).double() for row in rows])
    for row in values.tolist():
        bad = [name for name, value in zip(rows[0], row, strict=True) if not math.isfinite(value)]
        if bad:
            raise UserError(f"non-finite {', '.join(bad)}; the last checkpoint is whole, go on "
                            "with --precision fp32, or --fresh and a smaller --model-lr")
    return dict(zip(rows[0], values.mean(0).tolist(), strict=True))

class Graphed:
    """A function of a dict of arrays → dict of tensors. On CUDA the fourth call records its
    kernels as one graph, which it and later calls replay: it may not branch on a value."""
    def __init__(self, function, device):
        self.function, self.device, self.inputs, self.calls = function, device, {}, 0

    def __call__(self, inputs):
        if self.device == "cpu":
            return self.function(inputs)
        for name, value in inputs.items():  # to where the graph finds them
            value = torch.as_tensor(value)
            self.inputs.setdefault(name, torch.empty_like(value, device=self.device)).copy_(value)
        self.calls += 1
        if self.calls == 4:
            self.graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self.graph, stream=torch.cuda.current_stream()):
                self.results = self.function(self.inputs)  # recorded, not computed
        if self.calls < 4:  # PyTorch asks for a few
            self.results = self.function(self.inputs)
        else:
            self.graph.replay()
        return {name: value.clone() for name, value in self.results.items()}

class Agent(nn.Module):
    """World model, actor-critic, frozen teacher and the optimisers."""
    def __init__(self, cfg, action_dim):
        super().__init__()
        self.cfg, self.action_dim = cfg, action_dim
        self.model = WorldModel(cfg, action_dim)
        self.behaviour = ActorCritic(cfg, action_dim)
        self.teacher = None
        if cfg.eta > 0:
            # DEVIATION: the published code switches its gradients on and trains it.
            self.teacher = BetaVAEEncoder(cfg.z_dim, cfg.cnn_depth).requires_grad_(False)
        self.to(cfg.device)
        self.optimizers = dict(model=adam(self.model, cfg.model_lr),
                               actor=adam(self.behaviour.actor, cfg.actor_lr),
                               critic=adam(self.behaviour.critic, cfg.critic_lr))
        self.decide, self.update = (Graphed(f, cfg.device) for f in (self.decide, self.update))

    @torch.no_grad()
    def act(self, row, state, explore):
        """A row, a state (None at first), sample or take the mode? → action (A,), state"""
        inputs = dict(image=row["image"][None], action=row["action"][None], explore=explore)
        state = self.decide(inputs | (state or self.model.rssm.initial(1)))
        return state.pop("action")[0].nan_to_num().cpu().numpy(), state  # the log tells of NaN

    def decide(self, inputs):
        """`act` on the device, Graphed → dict of the state and the action, (1, A)."""
        rssm, inputs = self.model.rssm, to_device(inputs, self.cfg.device)
        embed = self.model.encoder.encode(inputs["image"])["embed"]
        state = rssm.step(inputs, inputs["action"], embed, 1)
        policy = self.behaviour.policy(rssm.feat(state))
        sample = torch.where(inputs["explore"], policy.rsample(), policy.mean)
        return state | dict(action=self.behaviour.squash(sample)[0])

    def update(self, batch):
        """Algorithm 1, 13–18, Graphed. batch: arrays (B, T, ...), eta, index → dict of scalars."""
        cfg, behaviour, z_disen = self.cfg, self.behaviour, None
        batch = to_device(batch, cfg.device)
        with self.model.autocast:
            out = self.model(batch)
            if self.model.bonus:
                out["bonus"] = self.model.bonus(out["post"].get("below", out["feat"]))
            if self.teacher:
                z_disen = self.teacher.encode(batch["image"])["embed"]  # 13: distil, Eq. (3)
            loss, metrics = self.model.loss(out, batch, z_disen, batch["eta"])  # 14, 15: Eq. (5)
        metrics["model_grad_norm"] = descend(loss, self.optimizers["model"], cfg.grad_clip)
        start = {name: x.detach().flatten(0, 1) for name, x in out["post"].items()}  # (N, ·)
        discount = cfg.gamma * batch["discount"].flatten()
        if cfg.imagine_starts:
            chosen = torch.rand_like(discount).argsort()[:cfg.imagine_starts]
            start, discount = {name: x[chosen] for name, x in start.items()}, discount[chosen]
        due = (batch["index"] % cfg.slow_every == 0).float()
        slow = behaviour.slow_critic.state_dict()  # it shares the weights' memory
        for name, value in behaviour.critic.state_dict().items():
            slow[name].lerp_(value, due)
        with self.model.autocast:
            actor_loss, critic_loss, more = behaviour.losses(self.model, start, discount)  # 16
        for part, loss in dict(critic=critic_loss, actor=actor_loss).items():  # 17, 18
            metrics[f"{part}_grad_norm"] = descend(loss, self.optimizers[part], cfg.grad_clip)
        return {name: x.detach() for name, x in (metrics | more).items()} | dict(eta=batch["eta"])

def prepare_machine(cfg):
    """Decide what is "auto", set torch up → the Config with the decisions."""
    device = "cuda" if cfg.device != "cpu" and torch.cuda.is_available() else "cpu"
    native = (torch.cuda.is_bf16_supported(including_emulation=False) if device == "cuda"
              else torch.cpu.get_capabilities().get("avx512_bf16"))
    if cfg.device not in ("auto", device):
        raise UserError("there is no CUDA device; use --device cpu")
    torch.set_num_threads(min(cfg.threads or 1024, len(os.sched_getaffinity(0))))
    libc = ctypes.CDLL(None)
    libc.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD; to give buffers back takes 1.9×
    libc.mallopt(-1, (1 << 31) - 1)  # M_TRIM_THRESHOLD
    precision = cfg.precision.replace("auto", "bf16" if native else "fp32")
    if device == "cuda":
        torch.set_float32_matmul_precision("high")  # TF32
        torch.cuda.set_stream(torch.cuda.Stream())  # no graph is recorded on the default one
    return replace(cfg, device=device, precision=precision)

# === Runs: folders, checkpoints, logs ===
def run_folder(cfg, stage):
    """<runs>/<stage>/<tasks>/<method>[+<tag>]/seed<k>"""
    tasks = f"{cfg.src}-{cfg.dst}" if stage == "finetune" else cfg.src
    method = f"{cfg.method}+{cfg.tag}".rstrip("+").replace("/", "_")
    return Path(cfg.runs) / stage / tasks.replace("/", "_") / method / f"seed{cfg.seed}"

def read_checkpoint(path):
    """A checkpoint, loaded without executing code. No path in it is followed."""
    with reading(path, "checkpoint of ours", "run: python diswm.py finetune or pretrain --fresh"):
        saved = dict(torch.load(path, map_location="cpu", weights_only=True))
        return dict(saved, config=Config(**saved["config"]), log=str(saved["log"]))

class Run:
    """A run's folder. Colours, η and all seeds follow from `seed` and the counts in `done`."""
    def __init__(self, cfg, stage, fresh=False):
        check_task(cfg.src)
        check_task(cfg.dst)
        self.cfg, self.stage, self.fresh, self.log, self.inputs = cfg, stage, fresh, "", {}
        self.done = argparse.Namespace(env_steps=0, decisions=0, updates=0, episodes=0, seconds=0.0)
        self.folder = run_folder(cfg, stage)
        self.resumes = (self.folder / "checkpoint.pt").exists() and not fresh
        if self.resumes:
            self.saved = read_checkpoint(self.folder / "checkpoint.pt")
            self.log, self.inputs = self.saved["log"], self.saved.get("inputs", {})
            vars(self.done).update(self.saved["done"])
            old, new = vars(self.saved["config"]), vars(cfg)
            differ = [f"{flag_name(name)} {old[name]} (now {new[name]})" for name in new
                      if new[name] != old[name] and name not in MAY_CHANGE]
            if differ and old["preset"] != new["preset"]:  # explains the others
                differ = [f"--preset {old['preset']} (now {new['preset']})"]
            if differ:
                raise UserError(f"{self.folder} was started with other flags: add "
                                f"{', '.join(differ)}, or --fresh, or another --tag")
            switch, moved = (round(c.switch * c.steps) for c in (self.saved["config"], cfg))
            if switch != moved and min(switch, moved) + cfg.action_repeat <= self.done.env_steps:
                raise UserError(f"{self.folder} changes colours at step {switch}: "
                                f"add --switch {switch / cfg.steps}")

    def check_input(self, name, path, files):
        """Note files that decide the result, by content: it takes no others."""
        digest = hashlib.sha256()
        for file in files:
            with open(file, "rb") as content:
                hashlib.file_digest(content, lambda: digest)  # goes on with it
        now = f"{flag_name(name)} {path} of sha256 {digest.hexdigest()[:12]}"
        log.info("%s", now)
        before = self.inputs.setdefault(name, now)
        if before[-12:] != now[-12:]:
            raise UserError(f"{self.folder} was started with {before}, not {now}; or --fresh")

    def start(self, unit, total, **parts):
        """Make and lock the folder; parts go on from its checkpoint."""
        from torch.utils.tensorboard import SummaryWriter  # slow to import
        self.unit, self.total, self.parts, self.shown = unit, total, parts, {}
        begin, self.before = getattr(self.done, unit), self.done.seconds
        self.folder.mkdir(parents=True, exist_ok=True)
        self.lock = open(self.folder / "lock", "w")  # noqa: SIM115
        with reading(self.folder, "free folder", "another process is at work there"):
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if self.resumes:
            with reading(self.folder / "checkpoint.pt", "checkpoint of ours"):
                for name, part in parts.items():
                    part.load_state_dict(self.saved[name])
        else:  # what --fresh replaces goes late: mistakes cost nothing
            for path in set(self.folder.iterdir()) - {self.folder / "lock"}:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            self.save()
        if begin < total:  # a line for each start
            git = os.popen(f"git -C '{Path(__file__).parent}' describe --always --dirty")
            row = dict(begin=begin, commit=git.read().strip(), machine=os.uname(), **VERSIONS)
            with open(self.folder / "provenance.jsonl", "a") as file:
                file.write(json.dumps(row | self.inputs) + "\n")
        log.info(f"{self.folder}, preset {self.cfg.preset}, at {begin:,} of {total:,} {unit}, "
                 f"on {self.cfg.device} with {self.cfg.precision}")
        file = sys.stderr if sys.stderr.isatty() else io.StringIO()
        self.bar = tqdm(total=total, initial=begin, unit=f" {unit}", file=file)
        self.began = time.monotonic()  # other clocks may be set back
        if self.cfg.wandb:
            import wandb
            wandb.init(project=self.cfg.wandb, config=vars(self.cfg),
                       sync_tensorboard=True, reinit="finish_previous")
        self.writer = SummaryWriter(self.folder, purge_step=begin + 1, flush_secs=5)

    def record(self, **row):
        """Log a row of metrics, and save a checkpoint."""
        done, seconds = getattr(self.done, self.unit), time.monotonic() - self.began
        self.done.seconds = self.before + seconds  # of all resumes
        row |= dict(seconds=self.done.seconds, rate=(done - self.bar.initial) / seconds)
        self.log += json.dumps(row) + "\n"
        for name, value in row.items():
            if isinstance(value, (int, float)):
                self.writer.add_scalar(name, value, done)
        self.save()
        shown = ("train_return", "eval_return", "image", "reward", "kl", "disentangle", "eta")
        self.shown |= {name: row[name] for name in shown if name in row}
        self.bar.set_postfix(self.shown, refresh=False)
        self.bar.update(done - self.bar.n)
        if not sys.stderr.isatty():
            log.info("%s", self.bar)

    def save(self):
        """Write the checkpoint and, for people, its config and log."""
        config, file = vars(self.cfg), io.BytesIO()  # a full disk is the file's error
        state = {name: part.state_dict() for name, part in self.parts.items()}
        state |= dict(config=config, stage=self.stage, log=self.log, done=vars(self.done),
                      inputs=self.inputs)
        torch.save(state | dict(finished=state["done"][self.unit] >= self.total), file)
        write_whole(self.folder / "config.json", json.dumps(config, indent=2).encode())
        write_whole(self.folder / "metrics.jsonl", self.log.encode())
        write_whole(self.folder / "checkpoint.pt", file.getbuffer())

# === Algorithm 1 ===
def derived_seed(seed, purpose, index):
    """A seed of its own for each purpose and index."""
    # DEVIATION: published, colours are unseeded, as are weights.
    number = ("finetune", "evaluate", "pretrain", "collect").index(purpose)
    return int(np.random.SeedSequence([seed, number, index]).generate_state(1)[0])

def train_video_predictor(cfg, run, videos):
    """Algorithm 1, lines 4–8 (numbers on the right). videos: a Replay."""
    torch.manual_seed(derived_seed(cfg.seed, "pretrain", 0))  # not the student's weights
    model, done, metrics = VideoPredictor(cfg).to(cfg.device), run.done, []
    optimizer = adam(model, cfg.model_lr)
    def update(batch):
        batch = to_device(batch, cfg.device)
        with model.autocast:
            loss, metrics = model.loss(model(batch), batch)  # 6, 7: Eq. (2)
        return metrics | dict(model_grad_norm=descend(loss, optimizer, cfg.grad_clip))
    update = Graphed(update, cfg.device)
    run.start("updates", cfg.pretrain_updates, model=model, optimizer=optimizer)
    shown = Replay(run.folder / "episodes")
    if not shown.paths:  # one video stays with the run, for `traverse`
        shown.add(videos.read(videos.paths[-1])[-1000:])
    while done.updates < cfg.pretrain_updates:  # 4: for t = 1 … K_1
        torch.manual_seed(derived_seed(cfg.seed, "pretrain", done.updates + 1))  # of all noise
        metrics.append(update(videos.batch(cfg, done.updates)))  # 5, then 6 and 7
        done.updates += 1
        if done.updates % 100 == 0 or done.updates == cfg.pretrain_updates:
            run.record(update=done.updates, **mean_metrics(metrics))
            metrics = []

def color_phase(cfg, env_steps):
    """An episode's phase, and the step at which it must end."""
    switch = round(cfg.switch * cfg.steps)  # once, at the midpoint
    return ("train", switch) if env_steps < switch else ("shifted", cfg.steps)

def current_eta(cfg, decisions):
    """η of Eq. (5) after so many decisions. Across domains it waits (published)."""
    waits = cfg.eta_decay if family(cfg.src) != family(cfg.dst) else 0
    delay = waits if cfg.eta_delay < 0 else cfg.eta_delay
    # DEVIATION: the published clock is copied once, and η never anneals.
    return eta_schedule(decisions, cfg.eta, cfg.eta_end, cfg.eta_decay, delay)

def train_agent(cfg, run, env, agent):
    """Algorithm 1, lines 9–26 (numbers on the right): act, and learn."""
    folder, done = run.folder / "episodes", run.done
    if any(folder.glob("*.npy")) and not (run.resumes or run.fresh):
        raise UserError(f"{run.folder} has no checkpoint; start over with --fresh")
    run.start("env_steps", cfg.steps, agent=agent, **agent.optimizers)
    replay = Replay(folder, agent_row(agent.action_dim), cfg.device)
    replay.keep(done.episodes)
    if cfg.steps < (cfg.prefill + cfg.train_every) * cfg.action_repeat:
        log.info("warning: --steps end before an update, after --prefill %d", cfg.prefill)
    while done.env_steps < cfg.steps:  # 10: while not converged
        # 9: random episodes, until the first updates have all their data.
        learning = done.decisions >= cfg.prefill and replay.bounds[-1] >= cfg.batch_length
        phase, end = color_phase(cfg, done.env_steps)
        seed = derived_seed(cfg.seed, run.stage, done.episodes)
        torch.manual_seed(seed)  # of all noise, until the next episode
        began, state, feats, metrics = done.env_steps, None, [], []
        episode = Episode(env, seed, phase)  # 20
        while not episode.over and done.env_steps < end:  # 21: for t = 1 … T
            action = env.action_space.sample()
            if learning:
                action, state = agent.act(episode.rows[-1], state, explore=True)  # 22
                feats.append(agent.model.rssm.feat(state))
            done.env_steps += episode.step(action)  # 23
            done.decisions += 1
            if learning and done.decisions % cfg.train_every == 0:
                for _ in range(1 if done.updates else cfg.first_updates):  # 11
                    batch = replay.batch(cfg, done.updates)  # 12
                    batch |= dict(index=done.updates, eta=current_eta(cfg, done.decisions))
                    # 13 distil, 14–15 adapt, 16–18 imagine, train critic and actor
                    metrics.append(agent.update(batch))
                    done.updates += 1
        replay.add(episode.rows)  # 25
        done.episodes += 1
        row = dict(step=done.env_steps, phase=phase, train_return=episode.total) | vars(done)
        if metrics:
            row |= mean_metrics(metrics)
            row["value_correlation"] = agent.behaviour.value_correlation(feats, episode.rows[:-1])
        due = done.env_steps - done.env_steps % cfg.eval_every  # new if the episode passed it
        if due > began or done.env_steps >= cfg.steps:
            result, _ = evaluate_agent(cfg, env, agent, phase)
            row |= {f"eval_{name}": value for name, value in result.items()}
            row["eval_step"] = due if due > began else cfg.steps
            for name, pictures, *_ in picture_grids(run.folder, agent.model):
                run.writer.add_image(name, join(pictures), done.env_steps, dataformats="HWC")
        run.record(**row)

def evaluate_agent(cfg, env, agent, phase, explore=False):
    """Play the same seeds by mode, samples (explore) or chance (no agent) → dict, last episode"""
    # DEVIATION: the paper does not say in which colours.
    phase = "eval" if family(cfg.dst) == "drawer" else phase
    torch.manual_seed(cfg.seed)
    returns, successes = [], []
    for index in tqdm(range(cfg.eval_episodes), "episodes", leave=False, disable=None):
        episode, state = Episode(env, derived_seed(cfg.seed, "evaluate", index), phase), None
        while not episode.over:
            action = env.action_space.sample()
            if agent:
                action, state = agent.act(episode.rows[-1], state, explore=explore)
            episode.step(action)
        returns.append(episode.total)
        successes.append(episode.success)
    result = {"phase": phase, "return": float(np.mean(returns)), "std": float(np.std(returns)),
              "returns": returns}
    if None not in successes:
        result["success"] = float(np.mean(successes))
    return result, episode

# === Stages ===
def open_run(path, **changes):
    """A checkpoint → (Config with changes, Agent or VideoPredictor, saved)."""
    saved = read_checkpoint(path)
    changes = dict(device="auto", precision="fp32", threads=0) | changes
    cfg = prepare_machine(replace(saved["config"], **changes))
    with reading(path, "checkpoint of ours"):
        if saved["stage"] == "pretrain":
            model, name = VideoPredictor(cfg).to(cfg.device), "model"
        else:
            *_, last_bias = (value for name, value in saved["agent"].items() if ".actor." in name)
            model, name = Agent(cfg, len(last_bias) // 2), "agent"  # of means and stds
        model.load_state_dict(saved[name])
    return cfg, model, saved

def finished_run(folder, same=()):
    """The checkpoint of a finished run with the same values, its own seed first; or None."""
    for path in (folder / "checkpoint.pt", *sorted(folder.parent.glob("seed*/checkpoint.pt"))):
        saved = read_checkpoint(path) if path.exists() else dict(finished=False)
        if saved["finished"] and vars(saved["config"]).items() >= dict(same).items():
            return path

def find_teacher(cfg):
    """--teacher, or a finished pretraining → its path, its model"""
    path = cfg.teacher or finished_run(run_folder(cfg, "pretrain"))
    command = (f"run: python diswm.py pretrain --src {cfg.src} --method {cfg.method} "
               f"--seed {cfg.seed} --runs {cfg.runs}, with the same --preset")
    if not path:
        raise UserError(f"no teacher of {cfg.src} in {cfg.runs}; {command}")
    old, video, saved = open_run(path, device=cfg.device, threads=cfg.threads)
    if saved["stage"] != "pretrain" or not saved["finished"]:
        raise UserError(f"{path} is no finished pretraining; {command}")
    sizes = () if cfg.carry_over == "none" else ("stoch", "deter", "hidden")
    for name in ("src", "encoder", "z_dim", "cnn_depth", *sizes):
        if getattr(old, name) != getattr(cfg, name):
            raise UserError(f"{path} does not fit; add {flag_name(name)} {getattr(old, name)}")
    return path, video

def collect(cfg, fresh=False):
    """Learn in the distracting source task; the replay is the video set (stage 1)."""
    # In the first colours, and without what only pretraining sets.
    cfg = replace(cfg, dst=cfg.src, tag="", method="dreamerv2", steps=cfg.collect_steps,
                  switch=1.0, pretrain_updates=1, z_dim=1, beta1=0.0, **METHODS["dreamerv2"])
    return finetune(cfg, fresh, "collect")

def pretrain(cfg, fresh=False):
    """Train the video predictor (stage 2), on collect's videos or --videos."""
    cfg = replace(cfg, dst=cfg.src)
    run = Run(cfg, "pretrain", fresh)
    folder = cfg.videos
    if not folder:
        collected = run_folder(replace(cfg, method="dreamerv2", tag=""), "collect")
        found = finished_run(collected, {name: getattr(cfg, name) for name in ENVIRONMENT})
        folder = (found.parent if found else collect(cfg)) / "episodes"
    videos = Replay(folder, device=cfg.device)
    if videos.bounds[-1] < cfg.batch_length:
        raise UserError(f"{folder} has {videos.bounds[-1]} frames in *.npy, too few; {IMPORT}")
    run.check_input("videos", folder, videos.paths)
    train_video_predictor(cfg, run, videos)
    return run.folder

def finetune(cfg, fresh=False, stage="finetune"):
    """Distil, adapt and learn behaviour in the target task (stage 3)."""
    if cfg.src == cfg.dst and stage == "finetune":
        raise UserError(f"--src and --dst are both {cfg.src}; choose another")
    run, video = Run(cfg, stage, fresh), None
    if (cfg.eta > 0 or cfg.carry_over != "none") and (cfg.teacher or not run.resumes):
        path, video = find_teacher(replace(cfg, tag=""))
        run.check_input("teacher", path, [path])
    with config_env(cfg, cfg.dst) as env:
        torch.manual_seed(cfg.seed)  # of the weights
        agent = Agent(cfg, *env.action_space.shape)
        if video and agent.teacher:
            agent.teacher.load_state_dict(video.encoder.state_dict())
        if video and cfg.carry_over != "none":
            agent.model.carry_over(video)
        train_agent(cfg, run, env, agent)
    return run.folder

def evaluate(run, out=None, **changes):
    """Play a run's policy, by mode and by samples, and a random one (stage 4)."""
    cfg, agent, saved = open_run(run / "checkpoint.pt", **changes)
    if not isinstance(agent, Agent):
        raise UserError(f"{run} has no policy; give a finetune run")
    out = out or run
    out.mkdir(parents=True, exist_ok=True)
    result = dict(task=cfg.dst, step=saved["done"]["env_steps"])
    phase, _ = color_phase(cfg, min(result["step"], cfg.steps - 1))  # that of the next episode
    with config_env(cfg, cfg.dst) as env:
        for prefix, policy in (("random_", None), ("sampled_", agent), ("", agent)):
            played, episode = evaluate_agent(cfg, env, policy, phase, explore=prefix != "")
            result |= {prefix + name: value for name, value in played.items()}
            log.info("%s, %s colours: %sreturn %.1f ± %.1f", cfg.dst, played["phase"], prefix,
                     played["return"], played["std"])
    frames = np.stack([row["image"] for row in episode.rows]).repeat(4, 1).repeat(4, 2)
    write_whole(out / "evaluation.mp4", iio.imwrite("<bytes>", frames, extension=".mp4", fps=25))
    write_whole(out / "evaluation.json", json.dumps(result, indent=2).encode())
    return result

# === Figures: traverse and doctor ===
TRAVERSAL = (-9, -3, -2, -1, 0, 1, 2, 3, 9)  # the prior's, and published ±9
FAMILIES = ("walker_walk", "pusher", "drawer_open", "FetchReach-v4", "HalfCheetah-v5")

def to_picture(image):
    """float (..., 3, h, w) in [−0.5, 0.5] → uint8 (..., h, w, 3)"""
    return ((image.movedim(-3, -1) + 0.5).clamp(0, 1) * 255).round().byte().cpu().numpy()

@torch.no_grad()
def latent_traversal(model, batch, values=TRAVERSAL):
    """Vary a latent at a time (Fig. 5) → uint8 (Z, 1 + values, 64, 64, 3), names, by their nats"""
    out = model(batch)
    mean, logvar = out["code"]["mean"][0], out["code"]["logvar"][0]  # (T, Z)
    latents = torch.arange(mean.shape[1])
    z = mean[0].repeat(len(latents), 1 + len(values), 1)  # (Z, 1 + values, Z)
    z[latents, 1:, latents] = z.new_tensor(values)
    deter = out["post"]["deter"][0, 0].expand(*z.shape[:2], -1)  # all else is in 𝐳
    feat = torch.cat([model.rssm.posterior(deter, z)["mean"], deter], -1)
    nats = beta_vae_kl(mean[..., None], logvar[..., None]).mean(0)  # of each
    order = nats.argsort(descending=True)
    names = [f"z{i}  {nats[i]:.2f} nats" for i in order]
    return to_picture(model.decoder(feat[order])), names

@torch.no_grad()
def open_loop(model, batch, context=5):
    """Truth, prediction from `context` images and all actions, error: (3, T, 64, 64, 3)"""
    out = model({name: value[:, :context] for name, value in batch.items()})
    state = {name: value[:, -1] for name, value in out["post"].items()}
    feats = [out["feat"]]
    for t in range(context, batch["image"].shape[1]):
        action = batch["action"][:, t] if "action" in batch else None
        state = model.rssm.prior(model.rssm.recur(state, action))
        feats.append(model.rssm.feat(state)[:, None])
    truth = batch["image"][0]
    prediction = model.decoder(torch.cat(feats, 1))[0].clamp(-0.5, 0.5)
    return to_picture(torch.stack([truth, prediction, (prediction - truth) / 2]))

def join(pictures):
    """(rows, columns, h, w, 3) → one picture, with thin gaps"""
    pictures = np.pad(pictures, [(0, 0), (0, 0), (1, 1), (1, 1), (0, 0)], constant_values=255)
    return np.concatenate(np.concatenate(pictures, 1), 1)

def draw_grid(pictures, rows, columns, path, title=""):
    """(rows, columns, 64, 64, 3) as a labelled PNG, twice as large."""
    from matplotlib.figure import Figure  # slow to import
    picture = join(pictures)
    size = picture.shape[1] / 100, len(picture) / 100
    axes = Figure(figsize=size).add_axes((0, 0, 1, 1))
    axes.imshow(picture, interpolation="nearest")
    axes.set(title=title, frame_on=False, yticks=range(33, len(picture), 66), yticklabels=rows,
             xticks=range(33, picture.shape[1], 66), xticklabels=columns)
    axes.tick_params(length=0, labeltop=True, labelbottom=False)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    axes.figure.savefig(path, dpi=200, bbox_inches="tight")
    log.info("wrote %s", path)

def picture_grids(run, model):
    """Of a run's last episode: name, pictures, names of rows, of columns."""
    actions = model.rssm.action_dim
    replay = Replay(run / "episodes", agent_row(actions) if actions else VIDEO_ROW)
    if not replay.paths:
        raise UserError(f"no episodes in {replay.folder}; nothing to draw from")
    rows = replay.read(replay.paths[-1])
    batch = {name: np.array(rows[name][:50])[None] for name in replay.dtype.names}
    batch = to_device(batch, model.cfg.device)
    shown = np.linspace(0, len(rows) - 1, 12).astype(int)
    yield "film", rows["image"][shown][None], [""], shown
    strip = open_loop(model, batch)[:, ::5]
    columns = ["0\nseen", "5\npredicted", *range(10, 50, 5)][:strip.shape[1]]
    yield "open_loop", strip, ("truth", "model", "error"), columns
    if model.cfg.encoder == "beta_vae" and not hasattr(model.rssm, "below"):
        yield "traversal", *latent_traversal(model, batch), ["recon.", *TRAVERSAL]

def traverse(run, out=None, **changes):
    """Draw a run's film.png, open_loop.png and, of a β-VAE, traversal.png and .mp4."""
    cfg, model, saved = open_run(run / "checkpoint.pt", **changes)
    title = run_folder(replace(saved["config"], runs=""), saved["stage"])
    step = saved["done"]["env_steps"] or saved["done"]["updates"]
    torch.manual_seed(cfg.seed)
    for name, *grid in picture_grids(run, getattr(model, "model", model)):
        draw_grid(*grid, (out or run) / f"{name}.png", f"{title}, step {step:,}")
        if name == "traversal":  # a frame a value, of ten latents
            frames = [join(latents[None, :10]) for latents in grid[0].swapaxes(0, 1)[1:]]
            iio.imwrite((out or run) / "traversal.mp4", np.stack(frames), fps=3, macro_block_size=2)

def doctor(tasks=FAMILIES):
    """Draw each phase of tasks (Fig. 3), doctor.png, and say what runs here."""
    log.info("%s, CUDA: %s", VERSIONS, torch.cuda.is_available())
    pictures = np.empty((len(tasks), len(PHASES), 64, 64, 3), np.uint8)
    for task, row in zip(tasks, pictures, strict=True):
        with make_env(task) as env:
            row[:] = [env.reset(seed=0, options=dict(phase=p))[0] for p in PHASES]
    draw_grid(pictures, tasks, PHASES, "doctor.png")

# === Command line ===
COLLECT = "preset src seed runs collect_steps environment acting models behaviour machine "
COMMANDS = dict(  # groups and single fields of Config that are flags of each
    collect=COLLECT,
    pretrain=COLLECT + "method tag videos pretrain_updates encoder z_dim beta1 beta2",
    finetune="preset src dst method tag seed runs teacher steps switch environment acting models "
             "encoder carry_over bonus z_dim beta distillation behaviour machine",
    evaluate="seed environment eval_episodes device threads",
    traverse="seed device threads", doctor="")

class Parser(argparse.ArgumentParser):
    def error(self, message):  # one line
        raise UsageError(f"{message}; {self.format_usage()}")

def add_config_flags(parser, used, defaults):
    """Add flags for the fields of Config that are used, by its comments."""
    for line in inspect.getsource(Config).splitlines():
        title = re.match(r"    # --- ((\w+).*)", line)
        entry = re.match(r"    (\w+): .*?  # (.*)", line)
        if title:
            group, section = title[2], parser.add_argument_group(title[1])
        if entry and {group, entry[1]} & set(used):
            name, default = entry[1], getattr(defaults, entry[1])
            options = dict(type=type(default), choices=CHOICES.get(name))
            if type(default) is bool:
                options = dict(action=argparse.BooleanOptionalAction)
            section.add_argument(flag_name(name), dest=name, default=argparse.SUPPRESS,
                                 help=f"{entry[2]}; default: {default!r}", **options)

def parse_args(argv):
    """The command line → (what was given, dict; the Config of preset and method)."""
    chosen = Parser(add_help=False, allow_abbrev=False)
    chosen.add_argument("--preset", default="paper" if torch.cuda.is_available() else "small")
    chosen.add_argument("--method", default="diswm")
    chosen, _ = chosen.parse_known_args(argv)
    defaults = replace(PRESETS.get(chosen.preset, Config()), **METHODS.get(chosen.method, {}))
    parser = Parser(prog="diswm.py", description="Defaults without a source are as published.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, used in COMMANDS.items():
        summary = globals()[name].__doc__.split("\n")[0]
        sub = commands.add_parser(name, help=summary, description=summary, allow_abbrev=False)
        if name == "doctor":
            sub.add_argument("tasks", nargs="*", metavar="TASK", default=FAMILIES)
        elif name in ("evaluate", "traverse"):
            sub.add_argument("--run", type=lambda path: Path(path.removesuffix("checkpoint.pt")),
                             required=True, help="its folder: runs/…/seed0")
            sub.add_argument("--out", type=Path, help="where to write; default: --run")
        else:
            sub.add_argument("--fresh", action="store_true", help="start over, do not resume")
        if name in argv[:1]:  # reading Config's source takes 40 ms
            add_config_flags(sub, used.split(), defaults)
    given, unknown = parser.parse_known_args(argv)
    if unknown:
        commands.choices[given.command].error(f"unknown: {' '.join(unknown)}")
    return vars(given), defaults

def main(argv=None):
    """Run a command. A user's mistake is one line. Returns the exit code."""
    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stdout, force=True)
    try:
        given, defaults = parse_args(sys.argv[1:] if argv is None else argv)
        command = globals()[given.pop("command")]
        if "fresh" in given:
            fresh = given.pop("fresh")
            given = dict(cfg=prepare_machine(replace(defaults, **given)), fresh=fresh)
        command(**given)
        return 0
    except UserError as error:
        message, code = str(error), 2 if isinstance(error, UsageError) else 1
    except torch.OutOfMemoryError as error:
        message, code = f"{error}".split(". ")[0] + "; try a smaller --batch-size", 1
    except (ImportError, OSError, UnicodeError) as error:
        message, code = f"{error}; mend that and run the same command again", 1
    except KeyboardInterrupt:
        message, code = "interrupted; run it again: training goes on from its checkpoint", 130
    print("error:", " ".join(message.split()), file=sys.stderr)
    return code

if __name__ == "__main__":
    sys.stdout.reconfigure(errors="backslashreplace")  # a Latin-1 terminal has no β
    sys.exit(main())
