"""Animations of tours as GIF and MP4 files. They need the extra ``render``, MP4 files the extra ``video`` as well."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtsp_env.checks import check_count, check_seconds
from mtsp_env.instance import Instance
from mtsp_env.picture import Picture, missing_matplotlib, new_figure
from mtsp_env.schedule import end_time, make_log, moment
from mtsp_env.tours import Log
from mtsp_env.writing import atomic_write

Draw = Callable[[float], np.ndarray]  # a time -> its frame, uint8 (480, 640, 3)

SUFFIXES = (".gif", ".mp4")
LAST_FRAME_SECONDS = 2.0  # the finished tours stay in view
COLOURS_OF_GIF = 96  # few colours keep a GIF small; at most 256


def animate(
    path: str | os.PathLike,
    instance: Instance,
    tours: Sequence[Sequence[int]] | None = None,
    log: Sequence[Sequence[Sequence[float]]] | None = None,
    seconds: float = 8.0,
    frames_per_second: int = 10,
) -> None:
    """Write an animation of a team on its tours, 640 x 480 pixels; the suffix decides the format: .gif or .mp4.

    >>> animate("tours.gif", instance, tours)
    >>> animate("game.mp4", env.unwrapped.instance, log=env.unwrapped.log)

    If this fails, an existing file stays as it was.

    Args:
        path: where to write it.
        instance: the problem.
        tours: one per agent. All agents set off at time 0 and never wait. The instance must have neither ``appears``
            nor ``breaks``.
        log: instead of tours, one list of (node, departed, arrived, ready) per agent, in units of time.
        seconds: how long the animation lasts, above 0; the finished tours stay for two seconds more.
        frames_per_second: at least 1.

    Raises:
        ImportError: matplotlib is not installed, or for .mp4, imageio-ffmpeg.
        OSError: the file cannot be written.
        ValueError: an unknown suffix, a number outside its range, or tours or a log that do not fit the instance.
    """
    suffix = check_animation_suffix(path)
    check_seconds("seconds", seconds)
    check_count("frames_per_second", frames_per_second, minimum=1)
    checked = make_log(instance, tours, log)
    draw = _artist(instance, checked)
    times = np.linspace(0.0, end_time(checked), max(2, round(seconds * frames_per_second))).tolist()
    write = _write_gif if suffix == ".gif" else _write_mp4
    with atomic_write(path) as temporary:
        write(temporary, draw, times, frames_per_second)


def check_animation_suffix(path: str | os.PathLike) -> str:
    """The animation format that a path's suffix names, ".gif" or ".mp4".

    Raises:
        ImportError: a package that the format needs is not installed.
        ValueError: another suffix.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{os.fspath(path)}: unknown animation suffix {suffix!r}; choose from {list(SUFFIXES)}")
    try:
        import matplotlib  # noqa: F401
        import PIL  # noqa: F401
    except ImportError as error:
        raise missing_matplotlib() from error
    if suffix == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            raise ImportError('.mp4 files need imageio-ffmpeg: pip install "mtsp-env[video]"') from error
    return suffix


def _artist(instance: Instance, log: Log) -> Draw:
    """A function that draws the frame of a time, uint8 (480, 640, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    end = end_time(log)
    longest = float(moment(instance, log, end).lengths.max()) * instance.scale
    figure = new_figure((8.0, 6.0), dpi=80)  # MP4 wants a width and a height that 16 divides
    picture = Picture(figure.add_axes((0.02, 0.02, 0.70, 0.90)), instance, longest)
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)

    def draw(time: float) -> np.ndarray:
        picture.update_moment(moment(instance, log, time), time, end)
        canvas.draw()
        return np.array(np.asarray(canvas.buffer_rgba())[:, :, :3])

    return draw


def _write_gif(path: Path, draw: Draw, times: list[float], frames_per_second: int) -> None:
    from PIL import Image

    palette = _common_palette([Image.fromarray(draw(times[k])) for k in (0, len(times) // 2, -1)])
    frames = (Image.fromarray(draw(t)).quantize(palette=palette, dither=Image.Dither.NONE) for t in times)
    durations = [round(1000 / frames_per_second)] * (len(times) - 1) + [round(1000 * LAST_FRAME_SECONDS)]  # ms
    next(frames).save(path, format="GIF", save_all=True, append_images=frames, duration=durations, loop=0)


def _common_palette(images: list[Any]) -> Any:
    """An image with one palette for all frames: only what moves from frame to frame is then stored again."""
    from PIL import Image

    width, height = images[0].size
    sheet = Image.new("RGB", (width, height * len(images)))
    for row, image in enumerate(images):
        sheet.paste(image, (0, row * height))
    palette = sheet.quantize(COLOURS_OF_GIF)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[(colours > 247).all(axis=1)] = 255  # averages of almost white colours would make the background grey
    palette.putpalette(colours.ravel().tolist())
    return palette


def _write_mp4(path: Path, draw: Draw, times: list[float], frames_per_second: int) -> None:
    import imageio_ffmpeg

    still = [times[-1]] * round(LAST_FRAME_SECONDS * frames_per_second)
    height, width, _ = draw(0.0).shape
    frames = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(frames_per_second), "-i", "-"]
    film = ["-c:v", "libx264", "-crf", "25", "-pix_fmt", "yuv420p", "-f", "mp4", "-y", str(path)]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", *frames, *film]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None  # it is a pipe
        with contextlib.suppress(BrokenPipeError):  # it has ended, and says why
            for time in [*times, *still]:
                ffmpeg.stdin.write(draw(time).tobytes())
        errors = ffmpeg.communicate()[1].decode(errors="replace").split("\n")
    if ffmpeg.returncode != 0:
        raise OSError(f"ffmpeg failed with exit code {ffmpeg.returncode} {errors[0]}".rstrip())
