"""Hold an episode in arrays, and save it to a file: a checkpoint of arrays and JSON, written whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asm_gym.checkpoint import DAMAGE, read_checkpoint, write_checkpoint
from asm_gym.data.schema import LOG_ORIGIN, LOG_SCHEMA, LogSchema
from asm_gym.data.schema_inference import SchemaHints, infer_schema, note_columns
from asm_gym.data.table_layout import laid_out
from asm_gym.exceptions import DamagedFile
from asm_gym.files import regular_file
from asm_gym.spec import StreamSpec
from asm_gym.validation import as_float32, typed

EPISODE_KIND = "episode"
CONTROLLER = "controller"  # key of ``info`` for the controller of the arm while it was recorded
EPISODE_ARRAYS = {
    "stream": "f",
    "actions": "f",
    "observations": "fiub",
    "rewards": "f",
    "faults": "b",
    "contact_force": "f",
}
"""Arrays of an episode file, and the NumPy dtype kinds that each may have."""


@dataclass(frozen=True)
class EpisodeLabel:
    """The task and role that an episode was recorded for."""

    task: str
    role: str  # "fit", "calibration", "nominal" or "faulty"
    kind: str = ""  # of the fault; empty without one
    severity: str = ""
    seed: int = 0  # of the environment and of the policy. Episodes that share it are twins
    onset: int | None = None  # the first control step with the fault or variation
    # labels of the stream in which the fault shows first
    affected_channels: frozenset[str] = field(default=frozenset(), compare=False)

    @property
    def path(self) -> Path:
        """File of the episode in a run's folder."""
        parts = [part for part in (self.kind, self.severity) if part]
        return Path("episodes") / self.task / self.role / "-".join([*parts, f"{self.seed}.npz"])


@dataclass(frozen=True, eq=False)
class Episode:
    """Hold the arrays of one episode of T control steps.

    Args:
        stream: (T, D) float32; row t was sensed after action t. (k T, D) at k times the control rate.
        spec: names the D numbers.
        success: the task was solved at some step.
        seed: of ``reset``.
        actions: (T, A) float32, as the policy commanded them.
        observations: (T + 1, O) float32, the first one from ``reset``.
        rewards: (T,) float32.
        faults: (T,) bool, a fault was active in that row of the stream.
        contact_force: (T,) float32, between the robot and everything else [N].
        label: task and role that it was recorded for; None where unknown.
        info: anything else, such as the name of the ``controller``; JSON-serialisable.

    Example:
        >>> import numpy as np
        >>> from asm_gym import Channel, Episode, StreamSpec
        >>> spec = StreamSpec((Channel("position", 2, "m"),), dt=0.01)
        >>> episode = Episode.from_stream(np.zeros((50, 2)), spec, success=True, info={"skill": "wait"})
        >>> len(episode), episode.stream.shape
        (50, (50, 2))
    """

    stream: NDArray[np.float32]
    spec: StreamSpec
    success: bool = False
    seed: int | None = None
    actions: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    observations: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    rewards: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    faults: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    contact_force: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    label: EpisodeLabel | None = None
    info: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.stream.ndim != 2:
            raise ValueError(
                f"an episode's stream must have the shape (T, D), got {self.stream.shape}"
            )
        self.spec.check_row(self.stream)

    def __len__(self) -> int:
        return len(self.stream)

    def __repr__(self) -> str:
        """Return length, source and outcome in a line."""
        rows = len(self)
        outcome = "no success"
        if self.success:
            outcome = "success"
        parts = [f"{rows} rows of {self.spec.size}", f"{rows * self.spec.dt:g} s", outcome]
        if self.seed is not None:
            parts.append(f"seed {self.seed}")
        if self.faults.any():
            parts.append(f"{self.faults.sum()} rows with a fault")
        return f"<Episode of {self.spec.source or 'a stream'}: {', '.join(parts)}>"

    @property
    def labelled(self) -> EpisodeLabel:
        """The label. Raises ValueError without one."""
        if self.label is None:
            raise ValueError(
                "this episode has no label, which holds the task and "
                "the role that it was recorded for"
            )
        return self.label

    @classmethod
    @typed
    def from_stream(cls, x: NDArray[np.floating[Any]], spec: StreamSpec, **fields: Any) -> Episode:
        """Make an episode from a recorded stream ``x`` (T, D)."""
        return cls(np.ascontiguousarray(as_float32(x, "a stream")), spec, **fields)

    @classmethod
    @typed
    def from_table(
        cls,
        frame: Any,
        channels: LogSchema | StreamSpec | Sequence[str] | None = None,
        **options: Any,
    ) -> Episode:
        """Make an episode from one log; the arguments are those of ``from_tables``."""
        return cls.from_tables([frame], channels, **options)[0]

    @classmethod
    @typed
    def from_tables(
        cls,
        frames: Sequence[Any],
        channels: LogSchema | StreamSpec | Sequence[str] | None = None,
        rate: float | None = None,
        action: Sequence[str] = (),
        labels: Sequence[str] = (),
        ignore: Sequence[str] = (),
        clock: str = "",
        **fields: Any,
    ) -> list[Episode]:
        """Make an episode from each log of one robot, by one schema that is inferred from all of them.

        Args:
            frames: for each log a dictionary of arrays, a pandas or Polars frame, or an Arrow table.
            channels: a schema; or the columns to read, as patterns such as ``joint*``; or the spec
                of a memory. By default all senses and commands.
            rate: rows a second [Hz]; by default from the clock.
            action: patterns of the columns of commands; by default by their names.
            labels: patterns of further columns that label faults.
            ignore: patterns of columns to leave out.
            clock: the column of times, perhaps with a unit, ``"tick [ms]"``; by default the steadiest.
            fields: other arguments of ``Episode``.

        Raises:
            ValueError: bad columns; the rate is unknown or differs from the spec's; time runs
                backwards.
        """
        hints = SchemaHints(rate=rate, clock=clock, action=action, labels=labels, ignore=ignore)
        tables = [laid_out(frame) for frame in frames]
        if isinstance(channels, StreamSpec):
            channels = LogSchema.of_spec(channels)
        if isinstance(channels, LogSchema):
            schema = hints.apply(channels)
        else:
            schema = infer_schema(tables, replace(hints, channels=tuple(channels or ())))
        note_columns(schema)
        return [cls.read(table, schema, **fields) for table in tables]

    @classmethod
    def read(cls, table: Any, schema: LogSchema, **fields: Any) -> Episode:
        """Make an episode from a log by its schema, which the episode keeps in its ``info``.

        Raises:
            ValueError: the log does not fit the schema.
        """
        recorded = schema.read(table)
        info: dict[str, Any] = {LOG_ORIGIN: recorded.origin}
        if schema.memory_spec is None:
            info[LOG_SCHEMA] = schema.to_json()
        from_log: dict[str, Any] = {"faults": recorded.faults, "info": info}
        return cls(recorded.stream, recorded.spec, **from_log | fields)


def check_lengths(episode: Episode) -> None:
    """Raise ValueError unless an episode's arrays have matching lengths, and its rewards are finite."""
    rows = len(episode)
    steps = len(episode.actions)
    lengths = {"observations": steps + 1, "rewards": steps, "contact_force": steps}
    for name, length in lengths.items():
        size = len(getattr(episode, name))
        if steps and size not in (0, length):
            raise ValueError(f"{steps} actions need {length} {name}, got {size}")
    for name in ("rewards", "faults", "contact_force"):
        shape = getattr(episode, name).shape
        if len(shape) != 1:
            raise ValueError(f"{name} must have one dimension, got the shape {shape}")
    if len(episode.faults) not in (0, rows):
        raise ValueError(f"{rows} rows of a stream need {rows} faults, got {len(episode.faults)}")
    if steps and rows % steps:
        raise ValueError(f"{steps} actions cannot have {rows} rows of a stream")
    not_finite = np.flatnonzero(~np.isfinite(episode.rewards))
    if len(not_finite):
        step = not_finite[0]
        raise ValueError(f"the reward of step {step} must be finite, got {episode.rewards[step]}")


@typed
def save_episode(path: str | Path, episode: Episode) -> Path:
    """Write one episode to a file of its own, which appears only when it is complete; return its path."""
    check_lengths(episode)
    label = None
    if episode.label is not None:
        label = asdict(episode.label)
        label["affected_channels"] = sorted(label["affected_channels"])
    header = {
        "spec": episode.spec.to_json(),
        "success": bool(episode.success),
        "seed": episode.seed,
        "label": label,
        "info": episode.info,
    }
    write_checkpoint(
        path, EPISODE_KIND, header, {name: getattr(episode, name) for name in EPISODE_ARRAYS}
    )
    return Path(path)


@typed
def load_episode(path: str | Path) -> Episode:
    """Read what ``save_episode`` wrote. Raises FileNotFoundError, or ValueError where the file is damaged."""
    regular_file(path)
    try:
        saved = read_checkpoint(Path(path), EPISODE_KIND)
        header = saved.header
        for name, dtype_kinds in EPISODE_ARRAYS.items():
            array = saved.arrays.get(name)
            if array is not None and array.dtype.kind not in dtype_kinds:
                raise ValueError(f"{name} cannot be of {array.dtype}")
        label = header["label"]
        if label is not None:
            label["affected_channels"] = frozenset(label["affected_channels"])
            label = EpisodeLabel(**label)
        arrays: dict[str, Any] = saved.arrays
        episode = Episode(
            spec=StreamSpec.from_json(header["spec"]),
            success=header["success"],
            seed=header["seed"],
            label=label,
            info=header["info"],
            **arrays,
        )
        check_lengths(episode)
        return episode
    except FileNotFoundError:
        raise
    except (*DAMAGE, TypeError) as error:
        raise DamagedFile(path, error, "is damaged or no episode that can be read") from error
