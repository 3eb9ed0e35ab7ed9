"""Figures: each function returns a matplotlib Figure, which :func:`save` writes."""

from asm_gym.evaluation.figures.detection import delay_figure, heat_map, roc_figure
from asm_gym.evaluation.figures.episodes import attribution_figure, stream_figure, surprise_figure
from asm_gym.evaluation.figures.logs import log_figure
from asm_gym.evaluation.figures.style import figure, look, save

__all__ = [
    "attribution_figure",
    "delay_figure",
    "figure",
    "heat_map",
    "log_figure",
    "look",
    "roc_figure",
    "save",
    "stream_figure",
    "surprise_figure",
]
