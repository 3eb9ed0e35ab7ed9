"""Show what a watch or a guard sees, in Rerun's viewer while it runs, or in a file for it.

    surprise, threshold                in thresholds
    state                              who acts, or that an alarm goes on
    alarms                             a line each
    worst                              the channels with the largest shares, sensed beside expected
    sensed/CHANNEL, expected/CHANNEL   [unit]; expected of the worst channels alone
    camera                             frames, where the environment renders

Source: https://rerun.io (rerun-sdk 0.41).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from asm_gym.data.alarm_reasons import MOST_SHOWN, thresholds_shown
from asm_gym.extras import require
from asm_gym.files import writable
from asm_gym.guard.alarm_outlets import say_aside
from asm_gym.guard.live_events import LiveEvent
from asm_gym.guard.robot_table import STATES
from asm_gym.guard.step_info import RowReport
from asm_gym.monitors.expectation import Expectation
from asm_gym.stream_source import StepResult

Row = NDArray[np.floating[Any]]  # (D,)

VIEWER = "view"
MOST_WORST = 3  # channels that are shown beside what is expected
MOST_VIEWS = 12  # channels with a panel of their own
FEW_VIEWS = 4  # so many have room for a legend; in others a line is named beside the pointer
AXIS = (0.0, 3.0)  # of surprise, in thresholds
FRAME_S = 0.1  # time between two frames [s]
ALARM = "alarm"  # state of a policy that goes on in alarm


def check_where(where: str) -> str:
    """Return where a view is shown; raise ValueError unless it is ``view``, a file or an address."""
    if where == VIEWER or where.endswith(".rrd") or where.startswith("rerun+http"):
        return where
    raise ValueError(
        f"a live view needs {VIEWER}, a file FILE.rrd or an address rerun+http://HOST:PORT/proxy, "
        f"got {where!r}"
    )


def until_it_fails(show: Callable[..., None]) -> Callable[..., None]:
    """Return a method of ``LiveView`` whose first error ends the view; after that it does nothing."""

    @wraps(show)
    def shown(view: LiveView, *args: Any, **kwargs: Any) -> None:
        if view._recording is None:
            return
        try:
            show(view, *args, **kwargs)
        except Exception as error:
            view._give_up(error)

    return shown


def shown_state(state: str, is_alarm: bool) -> str:
    """Return who acts, or that a policy goes on in alarm."""
    if is_alarm and state == STATES[0]:
        return ALARM
    return state


class LiveView:
    """Show the rows of one robot in Rerun.

    A problem of the viewer ends the view, and never a watch or an episode.

    Args:
        monitor: that judges the rows.
        where: ``"view"`` opens the viewer, ``FILE.rrd`` writes a recording, and
            ``rerun+http://HOST:PORT/proxy`` sends to a viewer that runs elsewhere.
        names: of the columns (D,), as the user calls them.
        has_frames: there is a panel for ``show_frame``.

    Raises:
        ImportError: rerun-sdk is not installed.
        ValueError: ``where`` is none of these.
    """

    def __init__(
        self,
        monitor: Any,
        where: str = VIEWER,
        names: Sequence[str] = (),
        has_frames: bool = False,
    ) -> None:
        check_where(where)
        self._rr = require("rerun", what="a live view")
        self._spec = monitor.spec
        self._names = names or monitor.spec.labels
        self._expectation = Expectation(monitor)
        self._rows: list[Row] = []  # the newest two
        self._state = ""
        self._expected_before: set[str] = set()  # channels that were expected in the last row
        self._recording: Any = self._rr.RecordingStream("asm-gym")
        layout = self._layout(has_frames)
        if where == VIEWER:
            self._recording.spawn(default_blueprint=layout)
        elif where.endswith(".rrd"):
            writable(Path(where))
            self._recording.save(where, default_blueprint=layout)
        else:
            self._recording.connect_grpc(where, default_blueprint=layout)
        self._name_lines()

    def _layout(self, has_frames: bool) -> Any:
        """Return the panels of the viewer."""
        panels = require("rerun.blueprint", what="a live view")
        surprise = panels.TimeSeriesView(
            name="surprise in thresholds",
            contents=["/surprise", "/threshold"],
            axis_y=panels.ScalarAxis(range=AXIS),
        )
        alarms = panels.TextLogView(origin="/alarms", name="alarms")
        state = panels.StateTimelineView(origin="/state", name="state")
        worst = panels.TextDocumentView(origin="/worst", name="worst channels")
        camera = panels.Spatial2DView(origin="/camera", name="camera")
        legend = panels.PlotLegend(visible=len(self._spec.channels) <= FEW_VIEWS)
        channels = [
            panels.TimeSeriesView(
                name=f"{channel.name} [{channel.unit}]",
                plot_legend=legend,
                contents=[self._path("sensed", channel.name), self._path("expected", channel.name)],
            )
            for channel in self._spec.channels[:MOST_VIEWS]
        ]
        left = panels.Vertical(surprise, state, alarms, row_shares=[3, 1, 2])
        right = worst
        if has_frames:
            right = panels.Vertical(worst, camera, row_shares=[1, 2])
        top = panels.Horizontal(left, right, column_shares=[2, 1])
        return panels.Blueprint(panels.Vertical(top, panels.Grid(*channels)), collapse_panels=True)

    def _path(self, *parts: str) -> str:
        """Return the path of an entity; names may hold any character."""
        return str(self._rr.new_entity_path(list(parts)))

    def _name_lines(self) -> None:
        """Name the lines of each panel."""
        for channel in self._spec.channels:
            names = list(self._names[self._spec.slices[channel.name]])
            expected = [f"{name}, expected" for name in names]
            for kind, lines in (("sensed", names), ("expected", expected)):
                series = self._rr.SeriesLines(names=lines)
                self._recording.log(self._path(kind, channel.name), series, static=True)

    def show_report(self, time: float, numbers: Row, report: RowReport) -> None:
        """Show a row (D,) at ``time`` [s] as a guard has judged it."""
        robot = report.robots[0]
        state = shown_state(STATES[robot["state"]], bool(robot["alarm"]))
        strength = float(robot["surprise"] / robot["threshold"])
        self.show_row(time, numbers, report.attribution[0], strength, state)

    @until_it_fails
    def show_row(self, time: float, numbers: Row, shares: Row, strength: float, state: str) -> None:
        """Show a row.

        Args:
            time: of the row [s].
            numbers: (D,) as they were sensed.
            shares: (D,) of the numbers in its surprise.
            strength: its surprise in thresholds.
            state: who acts, or ``"alarm"``.
        """
        self._rows = [*self._rows[-1:], np.array(numbers, np.float64)]
        self._recording.set_time("time", duration=time)
        self._recording.log("surprise", self._rr.Scalars(min(strength, MOST_SHOWN)))
        self._recording.log("threshold", self._rr.Scalars(1.0))
        if state != self._state:
            self._recording.log("state", self._rr.StateChange(state=state))
            self._state = state
        self._show_channels(shares)

    def about(self, shares: Row) -> str:
        """Return what the channel with the largest share (D,) of the newest row read, and what was expected."""
        column = int(np.argmax(shares))
        beside = self._expectation.at_end(np.array(self._rows), column)
        if beside is None:
            return f"{self._names[column]} read {self._rows[-1][column]:.4g}"
        return beside.sentence(self._names[column])

    def show_event(self, event: LiveEvent) -> None:
        """Show an alarm or a note as text."""
        self.show_text(event.time, str(event))

    @until_it_fails
    def show_text(self, time: float, text: str) -> None:
        """Show the text of an alarm at ``time`` [s]."""
        self._recording.set_time("time", duration=time)
        self._recording.log("alarms", self._rr.TextLog(text, level="WARN"))

    @until_it_fails
    def show_frame(self, frame: NDArray[np.uint8]) -> None:
        """Show a picture (H, W, 3) of the environment beside the newest row."""
        self._recording.log("camera", self._rr.Image(frame).compress())

    def close(self) -> None:
        """Write what is left to write."""
        if self._recording is not None:
            self._recording.flush()
            self._recording.disconnect()
        self._recording = None

    def _show_channels(self, shares: Row) -> None:
        """Show all channels of the newest row, and what was expected of those with the largest shares."""
        rr = self._rr
        numbers = self._rows[-1]
        expected = np.full(len(numbers), np.nan)
        lines = ["| channel | sensed | expected | share |", "|---|---|---|---|"]
        worst = np.argsort(-np.nan_to_num(shares, posinf=np.inf), kind="stable")[:MOST_WORST]
        for column in worst.tolist():
            beside = self._expectation.at_end(np.array(self._rows), column)
            sensed = f"{numbers[column]:.4g} {self._expectation.unit(column)}"
            told = "—"
            if beside is not None:
                expected[column] = beside.expected
                told = f"{beside.expected:.4g} ± {beside.plus_minus:.2g}"
            lines.append(f"| {self._names[column]} | {sensed} | {told} | {shares[column]:.3g} |")
        self._recording.log("worst", rr.TextDocument("\n".join(lines), media_type="text/markdown"))

        now_expected = set()
        for channel in self._spec.channels:
            name = channel.name
            part = self._spec.slices[name]
            self._recording.log(self._path("sensed", name), rr.Scalars(numbers[part]))
            if np.isfinite(expected[part]).any():
                now_expected.add(name)
            if name in now_expected | self._expected_before:  # once more, as a gap
                self._recording.log(self._path("expected", name), rr.Scalars(expected[part]))
        self._expected_before = now_expected

    def _give_up(self, error: Exception) -> None:
        """End the view, and say why."""
        self._recording = None
        say_aside(f"the live view ends: {error!r}")


class RerunView(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Show a guarded environment in Rerun, step by step; episodes follow one another.

    Args:
        env: ``NeuralASMSafety``, or an environment around it. With ``render_mode="rgb_array"`` its
            frames are shown too.
        where: as in ``LiveView``.

    Example:
        >>> env = RerunView(NeuralASMSafety(gym.make("asm_gym/Lift-v0")))  # doctest: +SKIP
    """

    def __init__(self, env: gym.Env[Any, Any], where: str = VIEWER) -> None:
        RecordConstructorArgs.__init__(self, where=where)
        gym.Wrapper.__init__(self, env)
        monitor = env.get_wrapper_attr("monitor")
        self._dt = float(env.get_wrapper_attr("control_period"))
        self._frame_every = max(1, round(FRAME_S / self._dt))
        self._steps = 0
        self._was_alarm = False
        self.view = LiveView(monitor, where, has_frames=env.render_mode == "rgb_array")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._was_alarm = False
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> StepResult:
        result = self.env.step(action)
        asm = result[-1]["asm"]
        numbers = self.env.get_wrapper_attr("newest_row")
        self._steps += 1
        time = self._steps * self._dt
        state = shown_state(asm["state"], asm["alarm"])
        shares = np.array(list(asm["attribution"].values()))
        strength = asm["surprise"] / asm["threshold"]
        self.view.show_row(time, numbers, shares, strength, state)
        if asm["alarm"] and not self._was_alarm:
            reason = asm["failure"] or asm["reason"]
            about = f"{self.view.about(shares)} ({thresholds_shown(strength)} thresholds)"
            self.view.show_text(time, f"{reason}: {about} {asm['response']}".rstrip())
        self._was_alarm = asm["alarm"]
        if self.env.render_mode == "rgb_array" and self._steps % self._frame_every == 0:
            self.view.show_frame(np.asarray(self.env.render()))
        return result

    def close(self) -> None:
        self.view.close()
        super().close()
