"""Write frames to an MP4 that every browser plays (H.264, yuv420p, index first), or to a GIF."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from asm_gym.files import written_whole

Frame = NDArray[np.uint8]

H264 = ["-crf", "20", "-preset", "fast", "-movflags", "+faststart"]


def write_video(path: str | Path, frames: Iterable[Frame], fps: float) -> Path:
    """Write ``frames``, each (H, W, 3) uint8 and all of one size, at ``fps`` [1/s]; the file appears when complete.

    Raises:
        ValueError: there is no frame, or one is of another size or type.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.stem}.unfinished.mp4")
    even = _even(frames)
    first = next(even, None)
    if first is None:
        raise ValueError("a video needs at least one frame")
    size = first.shape[1::-1]
    writer = imageio_ffmpeg.write_frames(
        str(unfinished), size, fps=fps, quality=None, macro_block_size=1, ffmpeg_log_level="error", output_params=H264
    )
    try:
        writer.send(None)
        for frame in chain([first], even):
            writer.send(np.ascontiguousarray(frame))
        writer.close()
        unfinished.replace(path)
    finally:
        writer.close()
        unfinished.unlink(missing_ok=True)
    return path


def _even(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Frames with their last row and column repeated where a side is odd, because yuv420p halves the colour planes."""
    shape: tuple[int, ...] | None = None
    for frame in frames:
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise ValueError(f"a frame must be (H, W, 3) uint8, got {frame.shape} {frame.dtype}")
        shape = shape or frame.shape
        if frame.shape != shape:
            raise ValueError(f"all frames must have the shape {shape}, got {frame.shape}")
        yield np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")


def write_gif(path: str | Path, frames: Sequence[Frame], fps: float, colours: int = 64) -> Path:
    """Write ``frames``, each (H, W, 3) uint8, at ``fps`` [1/s] as an endless loop in the last frame's ``colours``."""
    palette = Image.fromarray(frames[-1]).quantize(colours, dither=Image.Dither.NONE)
    each = [Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    with written_whole(path) as file:
        each[0].save(file, "GIF", save_all=True, append_images=each[1:], duration=round(1000 / fps), loop=0)
    return Path(path)
