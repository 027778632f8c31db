"""Learning curves of finetune runs: means over seeds with bootstrap 95 % intervals.

A run is a folder …/<tasks>/<method>/seed<k> with a metrics.jsonl. The figures are printed, and
written beside the picture as JSON: final (mean of the last three evaluations), area (under the
curve, by its length in env steps), before and after (the evaluations around the change of
colours). Each is [mean, low, high] over the seeds, or [mean] of one seed.
"""

import json
import re
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import diswm  # noqa: E402


def read_run(folder):
    """A run's log → ({env step: evaluation return}, the step of the colours' change, or None)."""
    curve, last_step = {}, {}
    with diswm.reading(folder / "metrics.jsonl", "log of ours", "name other runs"):
        for line in (folder / "metrics.jsonl").read_text().splitlines():
            row = json.loads(line)
            if "phase" in row:  # else it is of a pretraining
                last_step[row["phase"]] = int(row["step"])
            if "eval_return" in row:  # eval_step: when it was due
                curve[int(row.get("eval_step", row["step"]))] = float(row["eval_return"])
    switch = last_step["train"] if {"train", "shifted"} <= last_step.keys() else None
    return curve, switch

def mean_interval(values):
    """Of values (seeds, ...): [mean, low, high], or [mean] of one seed; lists or floats."""
    from scipy.stats import bootstrap  # slow to import
    estimates = [values.mean(0)]
    if len(values) > 1:
        found = bootstrap([values], np.mean, method="percentile", rng=0)
        estimates += found.confidence_interval
    return [estimate.tolist() for estimate in estimates]

def curve_figures(runs, switch=None):
    """Figures of a method. runs: {env step: return} of each seed; steps that all share count."""
    steps = sorted(set.intersection(*map(set, runs)))
    if not steps:
        raise diswm.UserError("the seeds of a method share no evaluation step; name fewer runs")
    values = np.array([[run[step] for step in steps] for run in runs])  # (seeds, steps)
    area = np.trapezoid(values, steps) / (steps[-1] - steps[0]) if steps[1:] else values[:, 0]
    figures = dict(curve=values, final=values[:, -3:].mean(1), area=area)
    if switch and steps[0] <= switch < steps[-1]:
        after = np.searchsorted(steps, switch, "right")
        figures |= dict(before=values[:, after - 1], after=values[:, after])
    figures = {name: mean_interval(values) for name, values in figures.items()}
    return dict(seeds=len(runs), steps=steps, switch=switch) | figures

def collect_figures(folders):
    """Runs → {tasks: {method: curve_figures}}"""
    curves, switches = {}, {}
    for folder in folders:
        curve, switch = read_run(folder)
        if curve:
            tasks, method, _ = folder.resolve().parts[-3:]
            curves.setdefault(tasks, {}).setdefault(method, []).append(curve)
            switches[tasks] = switch or switches.get(tasks)
    if not curves:
        raise diswm.UserError("no evaluations to plot; run: python diswm.py finetune")
    return {tasks: {method: curve_figures(runs, switches[tasks])
                    for method, runs in sorted(methods.items())}
            for tasks, methods in curves.items()}

def draw(result, path):
    """Draw and print a result of collect_figures: a panel for each pair of tasks."""
    from matplotlib.figure import Figure  # slow to import
    panels = Figure(figsize=(5.5 * len(result), 3.8)).subplots(1, len(result), squeeze=False)[0]
    for axes, (tasks, methods) in zip(panels, result.items(), strict=True):
        for method, figures in methods.items():
            mean, *interval = figures["curve"]
            label = f"{method}, {figures['seeds']} seed{'s' if interval else ''}"
            line, = axes.plot(figures["steps"], mean, marker=".", label=label)
            if interval:
                axes.fill_between(figures["steps"], *interval, alpha=0.2, color=line.get_color())
            print(f"{tasks}: {label}", *(f"{name} {np.round(figures[name], 1).tolist()}"
                                         for name in ("final", "area", "before", "after")
                                         if name in figures), sep=", ")
        if figures["switch"]:
            axes.axvline(figures["switch"], color="gray", ls=":", label="the colours change")
        axes.set(title=re.sub(r"-(?!v\d)", " → ", tasks),  # Hopper-v5 has a hyphen of its own
                 ylim=(min(0, axes.get_ylim()[0]), None),  # the pusher's returns are below 0
                 xlabel="env steps", ylabel="evaluation return")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)  # hides no curve
        axes.grid(alpha=0.3)
    axes.figure.savefig(path, dpi=100, bbox_inches="tight")

def main(argv=None):
    parser = diswm.Parser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, nargs="*", help="their folders; default: all in --runs")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of all runs")
    parser.add_argument("--out", type=Path, help="PNG to write; default: curves.png in --runs")
    args = parser.parse_args(argv)
    logs = sorted(args.runs.glob("finetune/*/*/seed*/metrics.jsonl"))
    result, path = collect_figures(args.run or [log.parent for log in logs]), args.out or args.runs
    path = (path / "curves" if path.is_dir() else path).with_suffix(".png")
    path.parent.mkdir(parents=True, exist_ok=True)
    draw(result, path)
    path.with_suffix(".json").write_text(json.dumps(result, indent=2) + "\n")
    print(f"wrote {path} and {path.stem}.json")

if __name__ == "__main__":
    try:
        main()
    except (diswm.UserError, OSError) as error:
        sys.exit("error: " + " ".join(str(error).split()))
