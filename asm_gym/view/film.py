"""Frames to an MP4 that every browser plays: H.264, yuv420p, index first; or to a GIF, which every page shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from asm_gym.files import written_whole


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> Path:
    """Writes ``frames``, each (H, W, 3) uint8 and all of one size, at ``fps`` [1/s].

    The file appears under its name only when it is complete.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.stem}.unfinished.mp4")
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise ValueError("a video needs at least one frame")
    height, width = first.shape[:2]
    writer = imageio_ffmpeg.write_frames(
        str(unfinished),
        # yuv420p halves the colour planes, so both sides must be even.
        (width + width % 2, height + height % 2),
        fps=fps,
        codec="libx264",
        pix_fmt_in="rgb24",
        pix_fmt_out="yuv420p",
        quality=None,
        macro_block_size=1,
        ffmpeg_log_level="error",
        output_params=["-crf", "20", "-preset", "fast", "-movflags", "+faststart"],
    )
    try:
        writer.send(None)
        writer.send(_even(first))
        for frame in iterator:
            if frame.shape != first.shape:
                raise ValueError(f"all frames must have the shape {first.shape}, got {frame.shape}")
            writer.send(_even(frame))
        writer.close()
        unfinished.replace(path)
    finally:
        writer.close()
        unfinished.unlink(missing_ok=True)
    return path


def write_gif(path: str | Path, frames: Sequence[NDArray[np.uint8]], fps: float, colours: int = 64) -> Path:
    """Writes ``frames``, each (H, W, 3) uint8 and all of one size, at ``fps`` [1/s], to be shown over and over.

    Colours are those of the last frame, the most common ``colours`` of it; without dithering, for drawings.
    """
    palette = Image.fromarray(frames[-1]).quantize(colours, dither=Image.Dither.NONE)
    each = [Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    with written_whole(Path(path)) as file:
        each[0].save(file, "GIF", save_all=True, append_images=each[1:], duration=round(1000 / fps), loop=0)
    return Path(path)


def _even(frame: NDArray[Any]) -> NDArray[np.uint8]:
    """The frame with its last row and column repeated where its sides are odd."""
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ValueError(f"a frame must be (H, W, 3) uint8, got {frame.shape} {frame.dtype}")
    height, width = frame.shape[:2]
    return np.ascontiguousarray(np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))
