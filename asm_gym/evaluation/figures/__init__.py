"""Figures: each function returns a matplotlib Figure, which :func:`save` writes."""

from asm_gym.evaluation.figures.detection import delay_figure, heat_map, maxima_figure, roc_figure, severity_curves
from asm_gym.evaluation.figures.episodes import attribution_figure, stream_figure, surprise_figure
from asm_gym.evaluation.figures.logs import log_figure
from asm_gym.evaluation.figures.moments import moments_figure
from asm_gym.evaluation.figures.style import figure, look, save

__all__ = [
    "attribution_figure",
    "delay_figure",
    "figure",
    "heat_map",
    "log_figure",
    "look",
    "maxima_figure",
    "moments_figure",
    "roc_figure",
    "save",
    "severity_curves",
    "stream_figure",
    "surprise_figure",
]
