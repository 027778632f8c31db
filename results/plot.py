"""Learning curves of finetune runs: means over seeds with bootstrap 95 % intervals.

A run is a folder …/<tasks>/<method>/seed<k> with a metrics.jsonl. Runs whose config.json agree,
but for the seed and what changes no result, are the seeds of one curve. Beside the picture, and on
the terminal, are figures: final (mean of the last three evaluations up to final_step, the last that
all seeds have), area (under the curve up to there, by its length in env steps), before and after
(the evaluations around the change of colours). Each is [mean, low, high] over the seeds, or [mean]
of one seed. `minus` has the same of the differences to other methods, seed by seed.
"""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import common
import numpy as np
from tqdm import tqdm

import diswm

# Okabe and Ito's, which people who see few colours can tell apart, too.
COLORS = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"
LINES = "-", "--", ":"
NO_VIDEOS = "dreamerv2", "no_distill"  # methods for which the source does not matter
FIGURES = "final", "area", "before", "after"
AXIS = dict(eval_return="evaluation return", eval_success="success rate")


def read_config(folder):
    """A run's settings from its config.json, or None where there is none, as in old logs."""
    path = folder / "config.json"
    if not path.exists():
        return None
    with diswm.reading(path, "config.json of ours", "name other runs"):
        return dict(tag="") | dict(json.loads(path.read_text()))

def read_run(folder, metric="eval_return"):
    """A run's log and settings: its curve is {env step: value of the metric}, `switch` the step
    of the colours' change, or None."""
    folder, curve, last_step = folder.resolve(), {}, {}
    with diswm.reading(folder / "metrics.jsonl", "log of ours", "name other runs"):
        for line in (folder / "metrics.jsonl").read_text().splitlines():
            row = json.loads(line)
            if "phase" in row:  # else it is of a pretraining
                last_step[row["phase"]] = int(row["step"])
            if metric in row:  # eval_step: when it was due
                due = row.get("eval_step", row["step"]) if metric[:5] == "eval_" else row["step"]
                curve[int(due)] = float(row[metric])
    switch = last_step["train"] if {"train", "shifted"} <= last_step.keys() else None
    config = read_config(folder)
    tasks, label, seed = folder.parts[-3:]
    src, *dst = re.split(r"-(?!v\d)", tasks)  # Hopper-v5 has a hyphen of its own
    dst = dst[0] if dst else src
    if config:
        src, dst, seed = config["src"], config["dst"], f"seed{config['seed']}"
        label = config["method"] + (f"+{config['tag']}" if config["tag"] else "")
    return SimpleNamespace(folder=folder, curve=curve, switch=switch, config=config, src=src,
                           dst=dst, label=label, seed=seed)

def color_change(config):
    """The env step at which a run's colours change, or None."""
    return round(config["switch"] * config["steps"]) if config["switch"] < 1 else None

def check_seeds(runs, where):
    """Raise UserError unless runs under one label differ in their seed, and in nothing else."""
    label, known = runs[0].label, [run for run in runs if run.config]
    known.sort(key=lambda run: -len(run.config))  # the first has all fields
    for run in known[1:]:
        for name, value in known[0].config.items():
            other = run.config.get(name, value)  # a field that came later says nothing
            free = name in (*diswm.MAY_CHANGE, "seed", "tag", "src", "note")  # src: `where` has it
            if value != other and not free:
                raise diswm.UserError(
                    f"{known[0].folder} and {run.folder} are both {label}, but {name} is {value} "
                    f"and {other}; they are no seeds of one method: train one with --tag NAME, or "
                    "plot them apart")
        one, other = color_change(known[0].config), color_change(run.config)
        if one != other:
            raise diswm.UserError(f"{known[0].folder} and {run.folder} are both {label}, but their "
                                  f"colours change at step {one} and {other}; plot them apart")
    seeds = {}
    for run in runs:
        if run.seed in seeds:
            raise diswm.UserError(f"{seeds[run.seed].folder} and {run.folder} are both {run.seed} "
                                  f"of {label}, {where}: name one, or train one with --tag NAME")
        seeds[run.seed] = run

def mean_interval(values):
    """Of values (seeds, ...): [mean, low, high], or [mean] of one seed; lists or floats."""
    from scipy.stats import bootstrap  # slow to import
    estimates = [values.mean(0)]
    if len(values) > 1:
        found = bootstrap([values], np.mean, method="percentile", rng=0)
        estimates += found.confidence_interval
    return [estimate.tolist() for estimate in estimates]

def seed_figures(runs, switch=None):
    """The figures of each seed. runs: {env step: value} of each → the steps that all have, and
    arrays (seeds,) by name."""
    shared = sorted(set.intersection(*map(set, runs)))
    if not shared:
        raise diswm.UserError("the seeds of a method share no evaluation step; name fewer runs")
    values = np.array([[run[step] for step in shared] for run in runs])
    length = shared[-1] - shared[0]
    area = np.trapezoid(values, shared) / length if length else values[:, 0]
    figures = dict(final=values[:, -3:].mean(1), area=area)
    if switch and shared[0] <= switch < shared[-1]:
        after = np.searchsorted(shared, switch, "right")
        figures |= dict(before=values[:, after - 1], after=values[:, after])
    return shared, figures

def curve_figures(runs, switch=None):
    """A method's curve and figures. runs: {env step: value} of each seed. `steps` are those that
    all seeds have, and then those of the longer seeds alone; `counts` says how many have them."""
    shared, figures = seed_figures(runs, switch)
    steps = shared + sorted({step for run in runs for step in run if step > shared[-1]})
    at = [[run[step] for run in runs if step in run] for step in steps]
    curve = [mean_interval(np.array(values)) for values in at]
    figures = {name: mean_interval(values) for name, values in figures.items()}
    return dict(seeds=len(runs), steps=steps, counts=[len(values) for values in at], curve=curve,
                each=runs, switch=switch, final_step=shared[-1]) | figures

def paired_differences(ours, theirs, switch=None):
    """Figures of what a method has more than another, seed by seed, up to the last step that all
    have; {} unless they share two seeds and a step. ours, theirs: {seed: {env step: value}}."""
    gaps = [{step: value - theirs[seed][step] for step, value in ours[seed].items()
             if step in theirs[seed]} for seed in sorted(ours.keys() & theirs.keys())]
    if len(gaps) < 2 or not set.intersection(*map(set, gaps)):
        return {}
    shared, figures = seed_figures(gaps, switch)
    return dict(seeds=len(gaps), final_step=shared[-1]) | {
        name: mean_interval(values) for name, values in figures.items()}

def collect_figures(folders, metric="eval_return", by="pair"):
    """Runs → {panel: {label: curve_figures}}; a panel is a pair of tasks, by src a target."""
    panels = {}
    for folder in folders:
        run = read_run(folder, metric)
        if not run.curve:
            print(f"left out: {folder} has no {metric} yet")
            continue
        if not run.config:
            print(f"{folder} has no config.json: its settings are unknown and not compared")
        panel = run.dst if by == "src" or run.src == run.dst else f"{run.src} → {run.dst}"
        if by == "src" and run.label.split("+")[0] not in NO_VIDEOS:
            run.label += f" from {run.src}"
        panels.setdefault(panel, {}).setdefault(run.label, []).append(run)
    if not panels:
        raise diswm.UserError(f"no {metric} to plot; name runs, or their folder: --runs")
    result = {}
    for panel, labels in tqdm(panels.items(), "intervals", leave=False, disable=None):
        curves, switches, result[panel] = {}, {}, {}
        for label, runs in sorted(labels.items()):
            check_seeds(runs, panel)
            curves[label] = {run.seed: run.curve for run in runs}
            switches[label] = max((run.switch for run in runs if run.switch), default=None)
        for label, ours in curves.items():
            switch, minus = switches[label], {}
            for other in curves:
                if other > label:  # each pair once
                    common_switch = switch if switches[other] == switch else None
                    gaps = paired_differences(ours, curves[other], common_switch)
                    minus |= {other: gaps} if gaps else {}
            figures = curve_figures([*ours.values()], switch)
            result[panel][label] = figures | dict(minus=minus)
    return result

def draw_curve(axes, figures, color, line):
    """A method: its seeds faintly, their mean, the interval, and where the number of seeds falls.
    Each stretch of equally many seeds is a line of its own: a mean of fewer is another mean."""
    counts, steps = figures["counts"], figures["steps"]
    if figures["seeds"] > 1:
        for run in figures["each"]:
            axes.plot(sorted(run), [run[step] for step in sorted(run)], color=color, lw=0.7,
                      alpha=0.35)
    for count in sorted(set(counts), reverse=True):
        part = [i for i, n in enumerate(counts) if n == count]
        mean, *interval = zip(*(figures["curve"][i] for i in part), strict=True)
        axes.plot([steps[i] for i in part], mean, color=color, ls=line, marker=".", lw=1.8)
        if interval:
            axes.fill_between([steps[i] for i in part], *interval, alpha=0.15, lw=0, color=color)
        if count < figures["seeds"]:
            axes.annotate(f"n = {count}", (steps[part[0]], mean[0]), color=color, fontsize=7,
                          xytext=(2, 5), textcoords="offset points")

def count_seeds(methods):
    """How many seeds a label has in the panels: "3 seeds", "1 to 3 seeds"."""
    counts = {figures["seeds"] for figures in methods}
    low, high = min(counts), max(counts)
    return (f"{low} to {high}" if low < high else f"{high}") + (" seeds" if high > 1 else " seed")

def draw(result, path, metric="eval_return"):
    """Draw a result of collect_figures: a panel for each pair of tasks, three in a row."""
    from matplotlib.figure import Figure  # slow to import
    from matplotlib.lines import Line2D
    columns, rows = min(3, len(result)), -(-len(result) // 3)
    figure = Figure(figsize=(4.4 * columns + 0.6, 3.4 * rows + 0.6), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in panels[len(result):]:
        axes.remove()
    handles, switches = [], set()
    for index, label in enumerate(sorted({label for methods in result.values()
                                          for label in methods})):
        color, line = COLORS[index % len(COLORS)], LINES[index // len(COLORS) % len(LINES)]
        has_it = [methods[label] for methods in result.values() if label in methods]
        handles.append(Line2D([], [], color=color, ls=line,
                              label=f"{label}, {count_seeds(has_it)}"))
        for axes, methods in zip(panels, result.values(), strict=False):
            if label in methods:
                draw_curve(axes, methods[label], color, line)
    for axes, (panel, methods) in zip(panels, result.items(), strict=False):
        for switch in {figures["switch"] for figures in methods.values()} - {None}:
            axes.axvline(switch, color="gray", ls=":")
            switches.add(switch)
        axes.set(title=panel, ylim=(min(0, axes.get_ylim()[0]), None),  # the pusher's are below 0
                 xlabel="env steps", ylabel=AXIS.get(metric, metric))
        axes.locator_params(axis="x", nbins=6)
        axes.grid(alpha=0.3)
    if switches:
        handles.append(Line2D([], [], color="gray", ls=":", label="the colours change"))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(4, 2 * columns),
                  title="mean of seeds; band: 95 % bootstrap interval; thin: each seed",
                  fontsize=8, title_fontsize=8)
    figure.savefig(path, dpi=200)

def rounded(values):
    """Success rates to three decimals, returns to one."""
    return np.round(values, 3 if max(map(abs, values)) < 2 else 1).tolist()

def print_table(result):
    """The figures of a result of collect_figures, a line for each method."""
    for panel, methods in result.items():
        for label, figures in methods.items():
            seeds = f"{figures['seeds']} seed" + "s" * (figures["seeds"] > 1)
            print(f"{panel}: {label}, {seeds}, at {figures['final_step']:,} env steps",
                  *(f"{name} {rounded(figures[name])}" for name in FIGURES if name in figures),
                  sep=", ")
            for other, gaps in figures["minus"].items():
                print(f"    minus {other}, {gaps['seeds']} seeds, at {gaps['final_step']:,}",
                      *(f"{name} {rounded(gaps[name])}" for name in FIGURES if name in gaps),
                      sep=", ")

def main(argv=None):
    parser = diswm.Parser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, nargs="*", help="their folders; default: all in --runs")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of all runs")
    parser.add_argument("--by", choices=("pair", "src"), default="pair",
                        help="src: overlay the sources of videos of one target (Fig. 8)")
    parser.add_argument("--metric", default="eval_return",
                        help="of the log, such as eval_success (Table B); default: eval_return")
    parser.add_argument("--out", type=Path,
                        help=".png, .pdf or .svg to write; default: curves.png in --runs")
    args = parser.parse_args(argv)
    logs = sorted(args.runs.glob("finetune/*/*/seed*/metrics.jsonl"))
    path = args.out or args.runs / "curves.png"
    path = path / "curves.png" if path.is_dir() else path
    if path.suffix not in (".png", ".pdf", ".svg"):
        raise diswm.UsageError(f"--out {path}: give a name that ends in .png, .pdf or .svg")
    folders = args.run or [log.parent for log in logs]
    result = collect_figures(folders, args.metric, args.by)
    path.parent.mkdir(parents=True, exist_ok=True)
    draw(result, path, args.metric)
    print_table(result)
    path.with_suffix(".json").write_text(json.dumps(result, indent=2) + "\n")
    print(f"wrote {path} and {path.stem}.json")

if __name__ == "__main__":
    common.run_script(main)
