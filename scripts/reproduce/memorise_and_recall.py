"""Memorise and recall: one network learns a repertoire without labels, and expresses each skill from a cue.

Repertoires of handwriting-like movements in two and three dimensions, and of cubic splines. Online, every row is read
after it was expected; offline, none after the cue. What recalls them is in ``recall_rivals``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from matplotlib.figure import Figure

from asm_gym.evaluation.figures import figure
from asm_gym.evaluation.tables import Table
from asm_gym.scripts.options import fixed, option
from asm_gym.scripts.reproduce import kit
from asm_gym.scripts.reproduce.curves import curve
from asm_gym.scripts.reproduce.handwriting import STEPS, check_letters
from asm_gym.scripts.reproduce.kit import Findings, Record, over_seeds, shown
from asm_gym.scripts.reproduce.recall_rivals import CALLED, EVERY, MODELS, Condition, Practice, recall
from asm_gym.scripts.reproduce.recordings import wide_enough


@dataclass(frozen=True)
class Config(kit.Config):
    """Recall from a cue, against what else can recall."""

    repertoires: tuple[int, ...] = option((1, 2, 4, 8, 16, 32), quick=(1, 4), least=1, check=check_letters)
    """How many letters one network learns."""
    widths: tuple[int, ...] = option(
        (16, 32, 64, 128, 256, 512), quick=(16, 32), least=1, check=partial(wide_enough, channels=6)
    )
    """Hidden units, for a repertoire of eight."""
    cues: tuple[int, ...] = option((1, 2, 5, 10, 20, 30), least=1)
    """Steps that are read before recall begins."""
    models: tuple[str, ...] = option(MODELS, least=1, known=MODELS)
    """What learns, recalls, and is compared."""
    steps: int = option(16000, quick=1500, least=1)
    """Steps in which the synapses of the memory change."""
    updates: int = option(1200, quick=40, least=1)
    """Updates of the networks trained by backpropagation through time, by 16 letters each."""
    hidden: int = fixed(64, quick=32, check=partial(wide_enough, channels=6))
    """Hidden units for the other repertoires."""
    dims: tuple[int, ...] = fixed((2, 3))
    """Dimensions to write in; 3 with a repertoire of eight only."""
    splines: int = fixed(16, quick=2, least=0)
    """How many cubic splines one network learns; 0 leaves them out."""
    width_seeds: int = fixed(1, least=0)
    """How many of the seeds are repeated with other widths, and in three dimensions."""
    writings: int = fixed(8, quick=4, least=1)
    """Writings of each letter to learn from."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for cue in self.cues:
            if not 1 <= cue < STEPS:
                raise ValueError(f"a cue must be shorter than the letter, 1 to {STEPS - 1} steps, got {cue}")
        if self.splines:
            check_letters(self.splines)
        if 2 not in self.dims or not set(self.dims) <= {2, 3}:
            raise ValueError(f"letters are written in 2 dimensions, or in 2 and 3, got {self.dims}")


def conditions(config: Config) -> list[Condition]:
    """Repertoires and splines for every seed; widths and three dimensions for some."""
    middle = _middle(config)
    few = config.repetitions[: config.width_seeds]
    all_seeds = [Condition(s, n, config.hidden, 2) for s in config.repetitions for n in config.repertoires]
    if config.splines:
        all_seeds += [Condition(s, config.splines, config.hidden, 2, "splines") for s in config.repetitions]
    wide = [Condition(s, middle, h, 2) for s in few for h in config.widths]
    deep = [Condition(s, middle, config.hidden, d) for s in few for d in config.dims if d > 2]
    return list(dict.fromkeys(all_seeds + wide + deep))


def tables(records: Sequence[Record], config: Config) -> list[Table]:
    """Repertoires, widths, cues and splines."""
    middle, longest = _middle(config), max(config.cues)
    basis: Record = {"domain": "letters", "dims": 2, "skills": middle, "hidden": config.hidden, "cue": longest}

    def cell(right: bool, **where: Any) -> str:
        error = shown(records, "error_cm", **basis | where)
        return f"{error} ({over_seeds(records, 'right', **basis | where).mean:.2f})" if right and error else error

    def rows(key: str, values: Sequence[int], right: bool = True, **where: Any) -> list[tuple[str, ...]]:
        return [(CALLED[m], *(cell(right, **{**where, key: v, "model": m}) for v in values)) for m in config.models]

    sizes, widths, cues = (("", *map(str, v)) for v in (config.repertoires, config.widths, config.cues))
    units = f"{config.hidden} units, cue of {longest}; mean ± SD over seeds, and share of right skills"
    online = rows("skills", config.repertoires, right=False, cue=STEPS)
    made = [
        Table(f"Offline error [cm] by letters, {units}", sizes, rows("skills", config.repertoires)),
        Table("Online error [cm] by letters", sizes, online),
    ]
    asked: dict[str, Record] = {CALLED[m]: {"model": m} for m in config.models if m != "hopfield"}
    gaps = {f"{n} letters, 1 in {e}": {"skills": n, "every": e} for n in config.repertoires for e in EVERY}
    own: Record = {"domain": "letters", "dims": 2, "hidden": config.hidden}
    made.append(kit.grid("Error [cm] where one row in so many is sensed", records, "glimpsed_cm", asked, gaps, **own))
    made += [
        Table(f"Offline error [cm] by cue, {n} letters", cues, rows("cue", config.cues, skills=n))
        for n in config.repertoires
        if n >= middle
    ]
    if config.splines:
        drawn_ones = rows("cue", config.cues, domain="splines", skills=config.splines)
        made.append(Table(f"Offline error [cm] by cue, {config.splines} splines", cues, drawn_ones))
    if config.width_seeds:
        seeds = "one seed" if config.width_seeds == 1 else f"{config.width_seeds} seeds"
        where = f"{middle} letters, {seeds} for widths other than {config.hidden}"
        made.append(Table(f"Offline error [cm] by hidden units, {where}", widths, rows("hidden", config.widths)))
        if len(config.dims) > 1:
            heads = ("", *map(str, config.dims))
            made.append(Table(f"Offline error [cm] by dimensions, {middle} letters", heads, rows("dims", config.dims)))
    return made


def _middle(config: Config) -> int:
    """The repertoire for which widths and dimensions are tried."""
    return 8 if 8 in config.repertoires else max(config.repertoires)


def drawn(records: Sequence[Record], config: Config) -> Figure:
    """Error by repertoire, width and cue."""
    middle, longest = _middle(config), max(config.cues)
    base = {"domain": "letters", "dims": 2, "skills": middle, "hidden": config.hidden, "cue": longest}
    panels: list[tuple[str, str, Sequence[int], str]] = [
        ("skills", "skills in the repertoire", config.repertoires, "error_cm"),
        ("hidden", "hidden units", config.widths, "error_cm"),
        ("cue", "cue [steps]", config.cues, "error_cm"),
        ("cue", "cue [steps]", config.cues, "right"),
    ]
    if not config.width_seeds:
        del panels[1]
    with figure(height=6.0, width=9.0) as fig:
        axes = fig.subplots(2, 3)
        for ax, (key, label, values, value) in zip(axes.flat, panels, strict=False):
            for i, model in enumerate(config.models):
                found = [over_seeds(records, value, **{**base, key: v, "model": model}) for v in values]
                curve(ax, values, found, i, CALLED[model] if ax is axes[0, 0] else None)
            ax.set(xlabel=label, ylabel="offline error [cm]" if value == "error_cm" else "right skill [share]", ylim=0)
            if key != "cue":
                ax.set_xscale("log", base=2)
            ax.set_xticks(values, [str(v) for v in values])
        _online(axes[1, 1], records, config, base)
        for ax in axes.flat:
            ax.set_visible(ax.has_data())
        fig.legend(loc="outside upper center", ncols=3)
    return fig


def _online(ax: Any, records: Sequence[Record], config: Config, base: Record) -> None:
    for i, model in enumerate(config.models):
        found = [
            over_seeds(records, "error_cm", **base | {"cue": STEPS, "skills": n, "model": model})
            for n in config.repertoires
        ]
        curve(ax, config.repertoires, found, i, None)
    ax.set_xscale("log", base=2)
    ax.set_xticks(config.repertoires, [str(v) for v in config.repertoires])
    ax.set(xlabel="skills in the repertoire", ylabel="online error [cm]", ylim=0)


def run(config: Config) -> Findings:
    """Runs every condition and sums up."""
    # The longest first, so that no process is left with one of them at the end.
    practice = Practice(config.writings, config.steps, config.updates)
    work = partial(recall, practice=practice, cues=config.cues, models=config.models)
    records = kit.together(kit.each("learning", work, conditions(config), config))
    return Findings(records, tables(records, config), drawn(records, config))
