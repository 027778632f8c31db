"""Measure how disentangled a run's latents are: DCI and MIG against the simulator's factors.

Of the teacher's encoder, and of the run's own before and after its training. Writes
disentanglement.json and a labelled latent traversal, disentanglement.png, into the run.
"""

import json
from pathlib import Path

import common
import mujoco
import numpy as np
import torch
from tqdm import tqdm

import diswm


def group_name(model, array, rows):
    """What one of a DistractingEnv's groups colours."""
    if np.shares_memory(array, model.mat_rgba):
        name = model.mat(rows[0]).name
    else:
        name = model.geom(rows[0]).name or model.body(model.geom_bodyid[rows[0]]).name
    return dict(grid="floor", self="body", uar="arm").get(name, name)

def paint(env, colors):
    """Give each group of a DistractingEnv its colour. Returns a picture."""
    for (array, rows), color in zip(env.groups, colors, strict=True):
        array[rows, :3] = color
    return env.render()

def labelled_frames(cfg, count):
    """Random episodes of `cfg.dst` in colours that are drawn anew for each frame, from the box
    around both phases'. Returns images, uint8 (N, 64, 64, 3), factors (N, K): colours that show,
    joint positions, m, and angles, rad, in (−π, π]; and their names."""
    images, factors, over, rng = [], [], (), np.random.default_rng(cfg.seed)
    with diswm.config_env(cfg, cfg.dst) as env:
        model, data = env.unwrapped.model, env.unwrapped.data
        boxes = [env.boxes[phase] for phase in ("train", "shifted")]
        # One group white at a time, then none: what changes nothing does not show.
        *lit, dark = [paint(env, colors) for colors in np.eye(len(env.groups) + 1)[:, :-1]]
        shown = [index for index, image in enumerate(lit) if (image != dark).any()]
        for index in tqdm(range(count), "frames", leave=False, disable=None):
            if index % 50 == 0 or any(over):  # 50 decisions of an episode
                seed = diswm.derived_seed(cfg.seed, "evaluate", index)
                env.reset(seed=seed, options=dict(phase="none"))
            colors = rng.uniform(np.min(boxes, 0)[0], np.max(boxes, 0)[1])
            paint(env, colors)
            image, _, *over, _ = env.step(rng.uniform(-1, 1, env.action_space.shape))
            images.append(image)
            factors.append([*colors[shown].flat, *data.qpos])
        names = [f"{group_name(model, *env.groups[index])} colour ({channel})"
                 for index in shown for channel in ("red", "green", "blue")]
    for joint in map(model.joint, range(model.njnt)):
        names += [f"{joint.name} {i}".removesuffix(" 0") for i in range(len(joint.qpos0))]
    names, factors = np.array(names), np.array(factors)
    angles = 3 * len(shown) + model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]
    factors[:, angles] = np.angle(np.exp(1j * factors[:, angles]))
    varies = np.ptp(factors, 0) > 0
    return np.array(images), factors[:, varies], names[varies].tolist()

def disentanglement(codes, factors):
    """DCI (Eastwood & Williams 2018) and MIG (Chen et al. 2018, 20 bins); 1 is best. codes (N, Z),
    factors (N, K). Gradient boosting gives importance and, on the last quarter, held out, the R²
    of `informativeness`. Returns the scores, a dict, and latents' shares of each R², (K, Z)."""
    from scipy.stats import entropy  # slow to import
    from sklearn.ensemble import GradientBoostingRegressor
    n, importance, r2, gaps = len(codes) * 3 // 4, [], [], []
    for factor in tqdm(factors.T, "factors", leave=False, disable=None):
        trees = GradientBoostingRegressor(random_state=0).fit(codes[:n], factor[:n])
        importance.append(trees.feature_importances_ + 1e-12)
        r2.append(max(0.0, trees.score(codes[n:], factor[n:])))
        tables = [np.histogram2d(factor, code, 20)[0] for code in codes.T]
        # I = H(factor) + H(code) − H(both); the first is in all of them, so not in their gap.
        shared = [entropy(table.sum(0)) - entropy(table.ravel()) for table in tables]
        gaps.append(np.ptp(np.sort(shared)[-2:]) / entropy(tables[0].sum(1)))
    importance, r2 = np.array(importance), np.array(r2)
    of_latents = 1 - entropy(importance, base=max(2, factors.shape[1]), axis=0)  # (Z,)
    of_factors = 1 - entropy(importance, base=max(2, codes.shape[1]), axis=1)  # (K,)
    scores = dict(disentanglement=np.average(of_latents, weights=importance.sum(0)),
                  completeness=of_factors.mean(), informativeness=r2.mean(), mig=np.mean(gaps))
    return {name: float(score) for name, score in scores.items()}, importance * r2[:, None]

def encoder_at_start(saved, action_dim):
    """The encoder of the first checkpoint, made anew from the seed; None if it was carried over."""
    cfg = saved["config"]
    if saved["stage"] == "pretrain":
        torch.manual_seed(diswm.derived_seed(cfg.seed, "pretrain", 0))
        return diswm.VideoPredictor(cfg).encoder
    if cfg.carry_over != "none":  # then it was the teacher's
        return None
    torch.manual_seed(cfg.seed)
    return diswm.WorldModel(cfg, action_dim).encoder  # which an Agent makes first

@torch.no_grad()
def measure(run, frames=2000, **changes):
    """Score a run's encoders, write JSON and picture. changes: Config values, not the run's own."""
    cfg, model, saved = diswm.open_run(run / "checkpoint.pt", **changes)
    teacher, action_dim = None, 0
    if isinstance(model, diswm.Agent):
        teacher, action_dim, model = model.teacher, model.action_dim, model.model
    if cfg.encoder != "beta_vae" or hasattr(model.rssm, "below"):
        raise diswm.UserError(f"{run} has no β-VAE latents to measure")
    if frames < 8:
        raise diswm.UserError(f"{frames} frames are too few to measure anything")
    batch = common.first_window(run, model)
    images, factors, names = labelled_frames(cfg, frames)
    encoders = dict(teacher=teacher, start=encoder_at_start(saved, action_dim), end=model.encoder)
    result = dict(task=cfg.dst, factors=names)
    for name, encoder in encoders.items():
        if encoder:
            encoder = encoder.to(cfg.device)
            parts = (diswm.to_device(dict(image=part), cfg.device) for part in
                     torch.from_numpy(images).split(100))
            codes = torch.cat([encoder.encode(part["image"])["mean"].cpu() for part in parts])
            scores, share = disentanglement(codes.numpy(), factors)
            result[name] = scores | dict(share=share.tolist())
            print(f"{name:8}", *(f"{key} {value:.3f}" for key, value in scores.items()), sep="  ")
    (run / "disentanglement.json").write_text(json.dumps(result, indent=2) + "\n")
    pictures, labels = diswm.latent_traversal(model, batch)
    for row, label in enumerate(labels):  # z3  2.20 nats
        explained = share[:, int(label.split()[0][1:])]
        labels[row] += f"  {names[explained.argmax()]} {explained.max():.2f}"
    diswm.draw_grid(pictures, labels, ["recon.", *diswm.TRAVERSAL], run / "disentanglement.png")
    print(f"wrote {run}/disentanglement.png and disentanglement.json")

def main(argv=None):
    parser = diswm.Parser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, metavar="RUN", help="its folder: runs/…/seed0")
    parser.add_argument("--dst", metavar="TASK", help="task of the frames; default: the run's")
    parser.add_argument("--frames", type=int, default=2000, help="how many; default: 2000")
    parser.add_argument("--seed", type=int, help="of the frames; default: the run's")
    args = vars(parser.parse_args(argv))
    measure(**{name: value for name, value in args.items() if value is not None})

if __name__ == "__main__":
    common.run_script(main)
