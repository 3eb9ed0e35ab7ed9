"""Tables and figure of the study of learning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from asm_gym.evaluation.defaults import TRANSIENT
from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.statistics import Estimate
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.kit import Record

TARGETS = {"Lift": 12.0, "Door": 18.0, "Stack": 5.0, "Reach": 30.0}
"""Reward of an episode, in the mean of ``SMOOTHED`` episodes, that an agent is to come to."""
SMOOTHED = 20
CELL = ["robot", "task", "algorithm", "way"]
DIFFERENCES = [
    "last_reward",
    "last_success",
    "alone_success",
    "default_success",
    "default_reward",
]
BINS = 16  # points of a curve
FIFTH = 0.2  # share of the steps that counts as the beginning, or the end, of learning
ALONE = "alone"


def findings(results: Sequence[Record], paces: Sequence[Record]) -> kit.Findings:
    """Return the tables and the figure of runs and paces."""
    frame = pd.DataFrame([summary(result) for result in results])
    curves = [point for result in results for point in curve(result)]
    tables = [learning_table(frame), trained_table(frame), wear_table(frame)]
    if (frame.way == ALONE).any():
        tables.insert(1, difference_table(frame))
    if paces:
        tables.append(pace_table(pd.DataFrame(paces)))
    records = frame.to_dict(orient="records") + curves + list(paces)
    return kit.Findings(records, tables, curves_figure(curves))


def summary(result: Record) -> Record:
    """Return one row of numbers of a run, which its file holds."""
    episodes = pd.DataFrame(result["learning"])
    total = episodes.sum(skipna=False)
    per_step = total / total.length
    hours = total.length * result["period"] / 3600.0
    first = episodes[episodes.step <= FIFTH * result["steps"]]
    last = episodes[episodes.step > (1.0 - FIFTH) * result["steps"]]
    row = {name: result[name] for name in (*CELL, "seed")} | {
        "kind": "run",
        "episodes": len(episodes),
        "harm": total.harm,
        "harm_hour": total.harm / hours,
        "blows": total.blows,
        "peak": episodes.peak.max(),
        "overridden": per_step.overridden,
        "slowed": per_step.slowed,
        "cost": per_step.cost,
        "joint_stops": 1000.0 * per_step.joint_stops,
        "self_contacts": 1000.0 * per_step.self_contacts,
        "first_reward": first.reward.mean(),
        "last_reward": last.reward.mean(),
        "last_success": last.success.mean(),
        "steps_to_target": steps_to_target(episodes, TARGETS[result["task"]]),
        "processor_steps_s": result["steps"] / result["processor_seconds"],
    }
    for name, played in result["trained"].items():
        judged = pd.DataFrame(played)
        judged_hours = judged.length.sum() * result["period"] / 3600.0
        row[f"{name}_success"] = judged.success.mean()
        row[f"{name}_reward"] = judged.reward.mean()
        row[f"{name}_harm_hour"] = judged.harm.sum() / judged_hours
    return row


def steps_to_target(episodes: pd.DataFrame, target: float) -> float:
    """Return the steps after which the mean reward of the last episodes reached a target; NaN for never."""
    smooth = episodes.reward.rolling(SMOOTHED).mean()
    reached = episodes.step[smooth >= target]
    if reached.empty:
        return math.nan
    return float(reached.iloc[0])


def curve(result: Record) -> list[Record]:
    """Return the points of a run's curves: means of the episodes in a part of the steps, and the harm so far."""
    episodes = pd.DataFrame(result["learning"])
    width = result["steps"] / BINS
    key = {name: result[name] for name in (*CELL, "seed")}
    points = []
    for number in range(BINS):
        end = (number + 1) * width
        so_far = episodes[episodes.step <= end]
        own = so_far[so_far.step > number * width]
        if len(own):
            points.append(
                {
                    **key,
                    "kind": "curve",
                    "step": end,
                    "reward": own.reward.mean(),
                    "success": own.success.mean(),
                    "harm": so_far.harm.sum(),
                }
            )
    return points


# ------------------------------------------------------------------ tables


def name_of(group: pd.DataFrame) -> Record:
    """Return the cells that name a group of runs."""
    first = group.iloc[0]
    return {
        "": f"{first.robot}, {first.task}, {first.algorithm}",
        "way": first.way,
        "seeds": str(group.seed.nunique()),
    }


def cell(values: Any, digits: int = 0, scale: float = 1.0) -> str:
    """Return the mean of values over seeds with its interval; empty where there are none."""
    known = scale * np.asarray(values, np.float64)
    known = known[np.isfinite(known)]
    if not len(known):
        return ""
    return Estimate.of_mean(known.tolist()).text(digits)


def alone_of(group: pd.DataFrame, frame: pd.DataFrame) -> pd.DataFrame:
    """Return the runs of a group's task and algorithm alone, by seed."""
    same = frame[frame.way == ALONE]
    for name in ("robot", "task", "algorithm"):
        same = same[same[name] == group.iloc[0][name]]
    return same.set_index("seed")


def share_of_alone(group: pd.DataFrame, frame: pd.DataFrame) -> str:
    """Return the harm as a share of that alone with the same seed [%]."""
    pairs = group.set_index("seed").harm / alone_of(group, frame).harm
    return cell(pairs, digits=2, scale=100.0)


def difference_table(frame: pd.DataFrame) -> Table:
    """Return how much more each way leads to than learning alone with the same seed."""
    rows = []
    for _, group in frame[frame.way != ALONE].groupby(CELL, sort=False):
        alone = alone_of(group, frame)
        own = group.set_index("seed")
        seeds = own.index.intersection(alone.index)
        difference = own.loc[seeds, DIFFERENCES] - alone.loc[seeds, DIFFERENCES]
        rows.append(
            {
                **name_of(group),
                "seeds": str(len(seeds)),
                "reward, last fifth": cell(difference.last_reward, 1),
                "solved, last fifth [%]": cell(difference.last_success, 0, 100.0),
                "trained: solved, alone [%]": cell(difference.alone_success, 0, 100.0),
                "solved, default [%]": cell(difference.default_success, 0, 100.0),
                "reward, default": cell(difference.default_reward, 1),
            }
        )
    return kit.table_of("More than alone with the same seed; 95 % intervals of Student's t", rows)


def learning_table(frame: pd.DataFrame) -> Table:
    """Return what was learned, and what was harmed meanwhile."""
    rows = []
    for _, group in frame.groupby(CELL, sort=False):
        reached = np.isfinite(group.steps_to_target)
        rows.append(
            {
                **name_of(group),
                "harm [N s]": cell(group.harm),
                "% of alone": share_of_alone(group, frame),
                f"contacts over {TRANSIENT:g} N": cell(group.blows),
                "hardest [N]": f"{group.peak.max():.0f}",
                "reward, last fifth": cell(group.last_reward, 1),
                "first fifth": cell(group.first_reward, 1),
                "solved, last fifth [%]": cell(group.last_success, 0, 100.0),
                "slowed [%]": cell(group.slowed, 1, 100.0),
                "overridden [%]": cell(group.overridden, 1, 100.0),
                "steps to the reward": cell(group.steps_to_target),
                "came to it": f"{reached.sum()} of {len(group)}",
                "harm an hour [N s/h]": cell(group.harm_hour),
            }
        )
    tasks = frame.task.unique()
    targets = ", ".join(f"{task} {TARGETS[task]:g}" for task in tasks)
    return kit.table_of(
        "While learning; means over seeds with 95 % intervals of Student's t. "
        f"The reward to come to: {targets} in the mean of {SMOOTHED} episodes",
        rows,
    )


def trained_table(frame: pd.DataFrame) -> Table:
    """Return what the trained policies do, alone and under the default guard."""
    rows = []
    for _, group in frame.groupby(CELL, sort=False):
        row = name_of(group)
        for name in (ALONE, "default"):
            row[f"solved, {name} [%]"] = cell(group[f"{name}_success"], 0, 100.0)
            row[f"reward, {name}"] = cell(group[f"{name}_reward"], 1)
            row[f"harm an hour, {name} [N s/h]"] = cell(group[f"{name}_harm_hour"])
        rows.append(row)
    return kit.table_of("The trained policy, alone and under the default guard", rows)


def wear_table(frame: pd.DataFrame) -> Table:
    """Return how often joints were at their stops and the robot touched itself, and the pace."""
    rows = []
    for _, group in frame.groupby(CELL, sort=False):
        rows.append(
            {
                **name_of(group),
                "joints at stops, per 1,000 steps": cell(group.joint_stops, 1),
                "contacts with itself, per 1,000 steps": cell(group.self_contacts, 1),
                "in alarm [%]": cell(group.cost, 1, 100.0),
                "steps a second of processor time": cell(group.processor_steps_s),
            }
        )
    return kit.table_of("Wear while learning, and pace", rows)


def pace_table(paces: pd.DataFrame) -> Table:
    """Return the steps a second of PPO with the guard, as a share of those without in the same block."""
    rows = []
    for count, group in paces.groupby("envs", sort=False):
        by_block = group.pivot_table(["steps_s", "processor_steps_s"], "seed", "way")
        row: Record = {"environments": str(count), "blocks": str(len(by_block))}
        for name, heading in (("steps_s", "by the clock"), ("processor_steps_s", "by processor")):
            row[f"alone, {heading} [1/s]"] = cell(by_block[name][ALONE])
            row[f"guarded, {heading}"] = cell(by_block[name]["default"])
            row[f"share, {heading}"] = cell(by_block[name]["default"] / by_block[name][ALONE], 2)
        rows.append(row)
    return kit.table_of("Steps a second of PPO, alone and under the default guard in turn", rows)


# ------------------------------------------------------------------ figure


def curves_figure(points: Sequence[Record]) -> Figure:
    """Draw reward, success and harm over steps, with a band of a SD, a row of panels for each task and algorithm."""
    frame = pd.DataFrame(points)
    frame["way"] = frame["way"].replace("default", "default guard")
    motions = list(frame.groupby(["task", "algorithm"], sort=False))
    ways = list(frame["way"].unique())
    known: dict[str, Any] = {}
    with figure(height=0.5 + 2.3 * len(motions)) as fig:
        axes = fig.subplots(len(motions), 3, squeeze=False, sharex=True)
        for (left, middle, right), ((task, algorithm), own) in zip(axes, motions, strict=True):
            kit.curves(left, own, "reward", "step", "way", ways)
            kit.curves(middle, own, "success", "step", "way", ways)
            kit.curves(right, own, "harm", "step", "way", ways)
            handles, labels = left.get_legend_handles_labels()
            known |= dict(zip(labels, handles, strict=True))
            left.set(title=f"{task}, {algorithm}: reward", ylim=(0, None))
            middle.set(title="share solved", ylim=(0, 1))
            right.set(title="harm so far [N s]", yscale="symlog", ylim=(0, None))
        for ax in axes[-1]:
            ax.set_xlabel("control steps")
            ax.locator_params(axis="x", nbins=3)
        for ax in axes.ravel():
            ax.grid(axis="y")
        fig.legend(
            known.values(), known.keys(), loc="outside upper center", ncols=min(4, len(known))
        )
    return fig
