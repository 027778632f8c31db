"""One page to look at a run: report.html, which opens without a network, and its moving pictures.

The page has a slider for each latent of a β-VAE, and the picture decoded from it; traversal.png,
open_loop.png, a film strip of the latest episode and the learning curve. film.png, film.gif
and traversal.mp4 are files of their own, too.
"""

import base64
import html
import json
from pathlib import Path

import common
import imageio.v3 as iio
import numpy as np
import plot
import torch
from tqdm import tqdm

import diswm

VALUES = np.linspace(-4, 4, 33)  # of a slider
STYLE = """body { font: 16px/1.5 sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em }
img { max-width: 100%; image-rendering: pixelated }
.latents { display: grid; grid-template-columns: repeat(auto-fill, minmax(190px, 1fr)); gap: 1em }
.latents figure { margin: 0 } figcaption { font-size: 14px }
.cell { width: 128px; height: 128px; image-rendering: pixelated; background-size: 3300% 100% }
input { width: 128px }"""
SCRIPT = """for (const slider of document.querySelectorAll("input")) {
  const cell = slider.parentNode.querySelector(".cell");
  const value = slider.parentNode.querySelector("output");
  const show = () => {
    cell.style.backgroundPositionX = 100 * slider.value / slider.max + "%";
    value.textContent = (8 * slider.value / slider.max - 4).toFixed(2);
  };
  slider.addEventListener("input", show);
  show();
}"""


def data_url(content, kind="image/png"):
    """A file's bytes as an address that holds them."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"

def encode_png(picture):
    """uint8 (h, w, 3) → the bytes of a PNG"""
    return iio.imwrite("<bytes>", picture, extension=".png")

def encode_film(pictures, size=2):
    """uint8 (T, h, w, 3) → the bytes of an mp4, enlarged"""
    return iio.imwrite("<bytes>", pictures.repeat(size, 1).repeat(size, 2), extension=".mp4",
                       fps=12, macro_block_size=1)

def section(head, text, *content):
    """A part of the page."""
    return f"<h2>{head}</h2>\n<p>{text}</p>\n" + "\n".join(content)

def image_tag(path):
    return f'<img src="{data_url(path.read_bytes())}" alt="{path.stem}">'

def video_tag(content):
    return f'<video src="{data_url(content, "video/mp4")}" controls loop muted></video>'

def latent_cells(pictures, labels):
    """A slider for each latent: its decodings (V, 64, 64, 3) lie side by side in one PNG."""
    last, cells = len(VALUES) - 1, []
    for decoded, label in zip(tqdm(pictures, "latents", leave=False, disable=None), labels,
                              strict=True):
        name, nats = label.split(maxsplit=1)  # z3  2.20 nats
        strip = data_url(encode_png(np.concatenate(decoded, axis=1)))
        cells.append(f'<figure><div class="cell" style="background-image: url({strip})"></div>'
                     f'<input type="range" max="{last}" value="{last // 2}" aria-label="{name}">'
                     f"<figcaption>{name} = <output></output>, {nats}</figcaption>"
                     "</figure>")
    return '<div class="latents">' + "\n".join(cells) + "</div>"

def learning_curve(run):
    """Draw curve.png by results/plot.py → whether there was an evaluation to draw."""
    if "eval_return" not in (run / "metrics.jsonl").read_text():
        return False
    plot.draw(plot.collect_figures([run]), run / "curve.png")
    return True

def write_film(run):
    """Write film.gif, the first 400 decisions of the latest episode."""
    replay = diswm.Replay(run / "episodes")
    images = replay.read(replay.paths[-1])["image"]
    large = images[:400:2].repeat(3, 1).repeat(3, 2)
    iio.imwrite(run / "film.gif", large, duration=80, loop=0)  # ms a frame

def latent_sections(run, model, batch):
    """What a β-VAE's latents do: sliders, a film of the first ten, traversal.png."""
    pictures, labels = diswm.latent_traversal(model, batch, VALUES)
    pictures = pictures[:, 1:]  # without the reconstruction
    film = encode_film(np.concatenate(pictures[:10], axis=2))
    (run / "traversal.mp4").write_bytes(film)
    return [section("Latents", "Each slider moves one latent and keeps the others. Nats: its KL to "
                    "the prior; a latent of 0 nats knows nothing of the picture.",
                    latent_cells(pictures, labels)),
            section("Traversal", "A film of the ten latents with most nats, then all latents.",
                    video_tag(film), image_tag(run / "traversal.png"))]

def report(run):
    """Write a run's report.html, film.gif, curve.png and what `traverse` draws."""
    diswm.traverse(run)
    cfg, model, saved = diswm.open_run(run / "checkpoint.pt")
    model, done = getattr(model, "model", model), saved["done"]  # an agent's
    step = f"{done['env_steps']:,} env steps" if done["env_steps"] else f"{done['updates']} updates"
    pair = cfg.dst if cfg.src == cfg.dst else f"{cfg.src} → {cfg.dst}"
    title = f"{pair}, {cfg.method}, seed {cfg.seed}, {saved['stage']}, {step}"
    write_film(run)
    sections, batch = [], common.first_window(run, model)
    if learning_curve(run):
        sections.append(section("Learning curve", "", image_tag(run / "curve.png")))
    torch.manual_seed(cfg.seed)
    if cfg.encoder == "beta_vae" and not hasattr(model.rssm, "below"):
        sections += latent_sections(run, model, batch)
    frames = np.concatenate(diswm.open_loop(model, batch), axis=2)
    sections.append(section("Open-loop prediction", "Truth, model, error. The model sees five "
                            "frames, then only actions.", video_tag(encode_film(frames, 4)),
                            image_tag(run / "open_loop.png")))
    sections.append(section("Latest episode", "Labels count decisions.",
                            image_tag(run / "film.png")))
    config = html.escape(json.dumps(vars(saved["config"]), indent=1))
    sections.append(section("Settings", "", f"<details><summary>config.json</summary><pre>{config}"
                            "</pre></details>"))
    page = (f'<!doctype html>\n<html lang="en"><meta charset="utf-8"><title>{title}</title>'
            f"<style>{STYLE}</style>\n<h1>{title}</h1>\n" + "\n".join(sections)
            + f"\n<script>{SCRIPT}</script></html>\n")
    (run / "report.html").write_text(page, encoding="utf-8")
    print(f"wrote {run}/report.html ({len(page) / 1e6:.1f} MB) and film.gif")

def main(argv=None):
    parser = diswm.Parser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, metavar="RUN", help="its folder: runs/…/seed0")
    report(parser.parse_args(argv).run)

if __name__ == "__main__":
    common.run_script(main)
